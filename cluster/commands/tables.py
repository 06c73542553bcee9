"""Tables of how a champion drives, for the terminal."""

from collections.abc import Mapping, Sequence

from rich.table import Column, Table

from cluster.report.stress import Stress
from cluster.text import km_per_collision


def driving_table(
    title: str,
    figures: Mapping[str, float],
    roads: Mapping[str, Mapping[str, float]],
    crowds: Sequence[int],
    target: float,
) -> Table:
    """How well a champion drives; with several roads a row for each, with its number of other cars, and one for all.

    An episode is a success if the champion drives `target` m without a collision.

    Args: `crowds`, the number of other cars on each road.
    """
    if len(roads) == 1:
        return _one_road(title, figures, target)
    heads = "cars", "success", "km/collision", "m/s", "collisions", "other"
    columns = (Column(head, justify="left" if not head else "right", no_wrap=True) for head in ("", *heads))
    table = Table(*columns, title=title, title_justify="left")
    rows = list(zip(roads, map(str, crowds), roads.values(), strict=True))
    for road, cars, row in [*rows, ("all", "", figures)]:
        success, collisions = row["success_rate"], row["collision_rate"]
        other, speed = _rest(row), f"{row['speed_mps']:.2f}"
        last = road == rows[-1][0]
        shares = f"{success:.1%}", km_per_collision(row), speed, f"{collisions:.1%}", other
        table.add_row(road, cars, *shares, end_section=last)
    table.caption = f"{figures['episodes'] / len(roads):.0f} episodes each; success: {target:,g} m without a collision"
    return table


def _one_road(title: str, figures: Mapping[str, float], target: float) -> Table:
    table = Table("", Column(justify="right"), title=title, title_justify="left", show_header=False)
    table.add_row("episodes", f"{figures['episodes']:.0f}")
    table.add_row(f"success ({target:,g} m without a collision)", f"{figures['success_rate']:.1%}")
    table.add_row("mean distance", f"{figures['distance_m']:,.0f} m")
    table.add_row("mean speed", f"{figures['speed_mps']:.2f} m/s")
    table.add_row("collisions", f"{figures['collision_rate']:.1%}")
    table.add_row("kilometres per collision", km_per_collision(figures))
    table.add_row("stopped, astray, or out of time", _rest(figures))
    return table


def _rest(figures: Mapping[str, float]) -> str:
    """The share of episodes that neither succeed nor collide."""
    return f"{abs(round(1.0 - figures['success_rate'] - figures['collision_rate'], 6)):.1%}"


def errors_table(title: str, figures: Mapping[str, float]) -> Table:
    """Velocity and steering errors, as from `gridsim.reference`."""
    numbers = Column("mean", justify="right"), Column("max", justify="right")
    table = Table("", *numbers, title=title, title_justify="left")
    for head, mean, largest, digits in (
        ("velocity error, m/s", "velocity_mean_mps", "velocity_max_mps", 2),
        ("  % of the reference's mean speed", "velocity_mean_percent", "velocity_max_percent", 1),
        ("steering error, degrees", "steering_mean_deg", "steering_max_deg", 1),
        ("  % of the steering limit", "steering_mean_percent", "steering_max_percent", 1),
    ):
        table.add_row(head, f"{figures[mean]:.{digits}f}", f"{figures[largest]:.{digits}f}")
    table.caption = f"over {figures['metres']:,.0f} m; the reference's mean speed is {figures['reference_mps']:.2f} m/s"
    return table


def stress_table(found: Sequence[tuple[Stress, float, Mapping[str, float]]]) -> Table:
    """Success at each level of each stress."""
    table = Table(title="Success under stress", title_justify="left", show_header=False)
    for stress in dict.fromkeys(each for each, _, _ in found):
        rows = [(level, figures["success_rate"]) for each, level, figures in found if each == stress]
        table.add_row(stress.label, *(f"{level:g}" for level, _ in rows), style="dim")
        table.add_row("", *(f"{share:.0%}" for _, share in rows), end_section=True)
    return table
