"""What a run leaves to look at: pictures for its folder, tables for the terminal."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from gridsim.ego import X, Y
from gridsim.roads import FIELD_FLOOR, FIELD_UNITS
from gridsim.scenarios import Scenario

_BEST, _MEAN, _OTHER = "#0b7285", "#868e96", "#f08c00"
_ROAD, _WALL, _PATH = "#4a4e57", "#e9efe6", "#f5a524"


def _figure(width: float, height: float, columns: int = 1) -> tuple[Any, Any]:
    """A figure that needs no display and no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def curves(history: Sequence[Mapping[str, float]], path: str | os.PathLike[str], step_name: str) -> None:
    """Draw fitness (of the DQN: Q values), distance, speed and success over generations or evaluations to a PNG."""
    figure, axes = _figure(15, 3.8, 4)
    step = np.arange(len(history))

    def plot(axis: Any, name: str, color: str, label: str, **style: Any) -> np.ndarray:
        values = np.array([row[name] for row in history])
        axis.plot(step, values, color=color, label=label, **style)
        return values

    if history and "fitness/best" in history[0]:
        plot(axes[0], "fitness/best", _BEST, "best")
        mean, std = plot(axes[0], "fitness/mean", _MEAN, "mean"), np.array([row["fitness/std"] for row in history])
        axes[0].fill_between(step, mean - std, mean + std, color=_MEAN, alpha=0.2, linewidth=0)
        axes[0].set(title="fitness", ylim=(0, 1.05))
        best, mean_of, success = "best", "mean", ("race/success_rate", "leaders, training")
        plot(axes[1], "target_m", _OTHER, "episode length", linestyle=":", drawstyle="steps-mid")
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
    for axis in axes:
        axis.set_xlabel(step_name)
        axis.grid(alpha=0.25)
        axis.legend(frameon=False, fontsize=8)
    figure.savefig(Path(path), dpi=100)


def draw_map(axis: Any, scenario: Scenario) -> None:
    """Draw a scenario's drivable area and lane marks."""
    road = scenario.road
    nodes = (road.field & np.uint32(255)).reshape(int(road.rows), int(road.columns)) / FIELD_UNITS + FIELD_FLOOR
    width, height = float(road.width), float(road.height)
    extent = (0.0, width, 0.0, height)
    axis.set_facecolor(_WALL)
    axis.contourf(nodes, levels=[0.0, 100.0], colors=[_ROAD], extent=extent)
    axis.contour(nodes, levels=[0.0], colors=["#ffffff"], linewidths=0.8, extent=extent)
    axis.set(xlim=(0, width), ylim=(0, height), aspect="equal", xlabel="x, m", ylabel="y, m")


def trajectory(scenario: Scenario, states: np.ndarray, path: str | os.PathLike[str], title: str) -> None:
    """Draw a map and a car's path on it, coloured by speed, to a PNG. states float32 [steps, FIELDS]."""
    from matplotlib.collections import LineCollection

    from gridsim.ego import SPEED

    figure, (axis,) = _figure(8.6, 7.6)
    draw_map(axis, scenario)
    points = states[:, [X, Y]].astype(np.float64)
    steps = np.stack([points[:-1], points[1:]], axis=1)
    near = np.abs(points[1:] - points[:-1]).max(axis=1) < min(scenario.road.width, scenario.road.height) / 2
    lines = LineCollection(list(steps[near]), cmap="plasma", linewidths=2.0)
    lines.set_array(states[:-1, SPEED][near])
    lines.set_clim(0.0, float(scenario.road.speed_high))
    axis.add_collection(lines)
    axis.plot(*points[0], marker="o", color="#2f9e44", markersize=9, markeredgecolor="white", label="start")
    axis.plot(*points[-1], marker="X", color="#e03131", markersize=10, markeredgecolor="white", label="end")
    axis.legend(loc="upper right")
    axis.set_title(title)
    figure.colorbar(lines, ax=axis, shrink=0.8, label="speed, m/s")
    figure.savefig(Path(path), dpi=100)


def held_out_table(title: str, figures: Mapping[str, float]) -> Table:
    """The closing table: how good a champion is where it never was."""
    table = Table(title=title, title_justify="left", show_header=False)
    table.add_column()
    table.add_column(justify="right")
    table.add_row("episodes", f"{figures['episodes']:.0f}")
    table.add_row("success (2,000 m without a collision)", f"{figures['success_rate']:.1%}")
    table.add_row("mean distance", f"{figures['distance_m']:,.0f} m")
    table.add_row("mean speed", f"{figures['speed_mps']:.2f} m/s")
    table.add_row("collisions", f"{figures['collision_rate']:.1%}")
    return table


def errors_table(title: str, figures: Mapping[str, float]) -> Table:
    """Velocity and steering errors, `gridsim.errors.Errors.figures`."""
    table = Table("", "mean", "max", title=title, title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, unit, digits in (("velocity", "mps", 2), ("steering", "deg", 1)):
        shown = "m/s" if unit == "mps" else "degrees"
        table.add_row(
            f"{name} error, {shown}",
            *(f"{figures[f'{name}_{kind}_{unit}']:.{digits}f}" for kind in ("mean", "max")),
        )
        of = "the reference's mean speed" if unit == "mps" else "the steering limit"
        table.add_row(f"  % of {of}", *(f"{figures[f'{name}_{kind}_percent']:.1f}" for kind in ("mean", "max")))
    table.caption = f"over {figures['metres']:,.0f} m; the reference's mean speed is {figures['reference_mps']:.2f} m/s"
    return table
