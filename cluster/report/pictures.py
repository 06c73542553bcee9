"""What a run leaves to look at: pictures for its folder, tables for the terminal."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Column, Table

from gridsim.car.ego import SPEED, X, Y
from gridsim.maps.map import Map
from gridsim.maps.roads import node_clearance

if TYPE_CHECKING:
    from cluster.comparison.tables import Group

_BEST, _MEAN, _OTHER = "#0b7285", "#868e96", "#f08c00"
_ROAD, _WALL = "#4a4e57", "#e9efe6"
_LEARNERS = {"evolution": "#0b7285", "two-parents": "#7048e8", "dqn": "#f08c00", "random": "#868e96"}


@contextlib.contextmanager
def plain_style() -> Iterator[None]:
    """Matplotlib's defaults, whatever the user's matplotlibrc says, and names as they are: `$` begins no formula."""
    import matplotlib

    style: dict[Any, Any] = {**matplotlib.rcParamsDefault, "text.parse_math": False}
    del style["backend"]  # takes 0.8 s to load
    # For good: to undo it would undo what another thread, in which MLflow writes the model, has set meanwhile.
    warnings.filterwarnings("ignore", "Glyph .* missing from font")
    with matplotlib.rc_context(style):
        yield


def _drawable(name: str) -> str:
    """A name as Matplotlib can draw it: bytes of a file's name that are no text become question marks."""
    return name.encode(errors="replace").decode()


def _figure(width: float, height: float, columns: int = 1) -> tuple[Any, Any]:
    """A figure that needs no display and no global state, and the axes of its columns."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(1, columns, squeeze=False)[0]


@plain_style()
def curves(history: Sequence[Mapping[str, float]], path: Path, step_name: str) -> None:
    """Draw fitness (of the DQN: Q values), distance, speed and success over generations or evaluations to a PNG."""
    figure, axes = _figure(15, 3.8, 4)
    step = np.arange(len(history))

    def plot(axis: Any, name: str, color: str, label: str, **style: Any) -> np.ndarray:
        values = np.array([row[name] for row in history])
        axis.plot(step, values, color=color, label=label, **style)
        return values

    if history and "fitness/best" in history[0]:
        best, mean_of = "leader, on longer drives", "members, mean"
        success = "leader/success_rate", best
        plot(axes[0], "fitness/best", _BEST, best)
        mean, std = plot(axes[0], "fitness/mean", _MEAN, mean_of), np.array([row["fitness/std"] for row in history])
        band = {"color": _MEAN, "alpha": 0.2, "linewidth": 0, "label": "members, standard deviation"}
        axes[0].fill_between(step, mean - std, mean + std, **band)
        axes[0].set(title="fitness", ylim=(0, 1.05))
        plot(axes[1], "target_m", _OTHER, "members, episode length", linestyle=":", drawstyle="steps-mid")
    else:
        plot(axes[0], "q/mean", _BEST, "Q, mean")
        plot(axes[0], "loss", _OTHER, "loss")
        axes[0].set(title="Q values, loss")
        best, mean_of, success = "network, validation", "training", ("network/success_rate", "network, validation")
    for axis, name, title in ((axes[1], "distance_m", "distance, m"), (axes[2], "speed_mps", "speed, m/s")):
        plot(axis, f"{name}/best", _BEST, best)
        plot(axis, f"{name}/mean", _MEAN, mean_of)
        axis.set(title=title)
    plot(axes[3], "validation/success_rate", _BEST, "champion, validation")
    plot(axes[3], success[0], _OTHER, success[1], alpha=0.5)
    axes[3].set(title="success rate", ylim=(-0.02, 1.05))
    for axis, corner in zip(axes, ("lower right", "upper left", "lower right", "upper left"), strict=True):
        axis.set_xlabel(step_name)
        axis.grid(alpha=0.25)
        axis.legend(loc=corner, frameon=False, fontsize=8)
    figure.savefig(path, dpi=100)


def bounds(road_map: Map) -> list[float]:
    """The part of a map that is shown, in m: left, right, low, high.

    A map from a file is shown around its road, since its sides are rounded up to powers of two, with wall.
    """
    width, height = float(road_map.road.width), float(road_map.road.height)
    if road_map.torus:
        return [0.0, width, 0.0, height]
    nodes = node_clearance(road_map.road)
    y, x = np.nonzero(nodes > 0.0)
    return (np.array([x.min(), x.max(), y.min(), y.max()]) / nodes.shape[1] * width + [-5.0, 5.0, -5.0, 5.0]).tolist()


@plain_style()
def trajectory(scenario: Map, states: np.ndarray, path: Path, title: str) -> None:
    """Draw a map and a car's path on it, coloured by speed, to a PNG. states float32 [steps, FIELDS]."""
    from matplotlib.collections import LineCollection

    figure, (axis,) = _figure(8.6, 7.6)
    road = scenario.road
    nodes = node_clearance(road)
    width, height = float(road.width), float(road.height)
    extent = (0.0, width, 0.0, height)
    axis.set_facecolor(_WALL)
    axis.contourf(nodes, levels=[0.0, 100.0], colors=[_ROAD], extent=extent)
    axis.contour(nodes, levels=[0.0], colors=["#ffffff"], linewidths=0.8, extent=extent)
    axis.set(aspect="equal", xlabel="x, m", ylabel="y, m", title=_drawable(title))
    axis.axis(bounds(scenario))
    points = states[:, [X, Y]].astype(np.float64)
    steps = np.stack([points[:-1], points[1:]], axis=1)
    near = np.abs(points[1:] - points[:-1]).max(axis=1) < min(width, height) / 2
    lines = LineCollection(list(steps[near]), cmap="plasma", linewidths=2.0)
    lines.set_array(states[:-1, SPEED][near])
    lines.set_clim(0.0, float(road.speed_high))
    axis.add_collection(lines)
    axis.plot(*points[0], marker="o", color="#2f9e44", markersize=9, markeredgecolor="white", label="start")
    axis.plot(*points[-1], marker="s", color="#e03131", markersize=8, markeredgecolor="white", label="end")
    axis.legend(loc="upper right")
    figure.colorbar(lines, ax=axis, shrink=0.8, label="speed, m/s")
    figure.savefig(path, dpi=100)


@plain_style()
def comparison(groups: Sequence[Group], path: Path) -> None:
    """Draw success, velocity error and training time of each road and learner to a PNG.

    Bars are medians over seeds, whiskers quartiles, dots the seeds.
    """
    roads = list(dict.fromkeys(group.road for group in groups))
    names = list(dict.fromkeys(group.name for group in groups))
    several_observations = len({group.observation for group in groups}) > 1
    width = 0.8 / len(names)
    figure, axes = _figure(max(12.0, 4.0 + 3.0 * len(roads)), 4.6, 3)
    panels = (
        ("success_rate", 100.0, "success on held-out roads, %"),
        ("velocity_error_percent", 1.0, "velocity error, % of the reference's speed"),
        ("best_wall_s", 1.0, "time to the champion, s"),
    )
    for axis, (name, scale, title) in zip(axes, panels, strict=True):
        for group in groups:
            place = roads.index(group.road) + (names.index(group.name) - (len(names) - 1) / 2) * width
            n, *found = group.spread(name)
            if not n:
                axis.text(place, 0.0, " no run", rotation=90, ha="center", va="bottom", fontsize=7, color="#868e96")
                continue
            color = f"C{names.index(group.name) % 10}" if group.variant else _LEARNERS[group.learner]
            lower, median, upper = (scale * value for value in found)
            whiskers = [[median - lower], [upper - median]] if n > 1 else None
            hatch = "//" if group.observation == "grid" and several_observations else None
            axis.bar(
                place, median, 0.92 * width, color=color, alpha=0.75, yerr=whiskers, capsize=3,
                hatch=hatch, error_kw={"ecolor": "#212529", "elinewidth": 1.1}, zorder=2, label=group.name,
            )  # fmt: skip
            seeds = [scale * value for value in group.values(name)]
            beside = place + width * np.linspace(-0.22, 0.22, len(seeds)) if len(seeds) > 1 else [place]
            axis.plot(beside, seeds, linestyle="", marker="o", markersize=3.5, color="white",
                      markeredgecolor="#212529", markeredgewidth=0.8, zorder=4)  # fmt: skip
        axis.set_title(title)
        axis.set_xticks(range(len(roads)), map(_drawable, roads))
        axis.set_xlim(-0.5, len(roads) - 0.5)
        axis.set_ylim(bottom=0.0)
        axis.grid(axis="y", alpha=0.25, zorder=0)
        axis.spines[["top", "right"]].set_visible(False)
    bars = {bar.get_label(): bar for bar in axes[-1].containers if hasattr(bar, "patches")}
    figure.legend(
        bars.values(), bars, loc="outside lower center", ncols=len(names), frameon=False, title_fontsize=9,
        title="bars: medians over seeds; whiskers: quartiles; dots: the seeds",
    )  # fmt: skip
    figure.savefig(path, dpi=100)


def held_out_table(title: str, figures: Mapping[str, float]) -> Table:
    """How well a champion drives on roads it never saw."""
    table = Table("", Column(justify="right"), title=title, title_justify="left", show_header=False)
    table.add_row("episodes", f"{figures['episodes']:.0f}")
    table.add_row("success (2,000 m without a collision)", f"{figures['success_rate']:.1%}")
    table.add_row("mean distance", f"{figures['distance_m']:,.0f} m")
    table.add_row("mean speed", f"{figures['speed_mps']:.2f} m/s")
    table.add_row("collisions", f"{figures['collision_rate']:.1%}")
    table.add_row("stopped, or out of time", f"{1.0 - figures['success_rate'] - figures['collision_rate']:.1%}")
    return table


def errors_table(title: str, figures: Mapping[str, float]) -> Table:
    """Velocity and steering errors, as from `gridsim.reference.errors.errors`."""
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
