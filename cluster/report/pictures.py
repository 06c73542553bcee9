"""Pictures of the curves of a run, the path of a drive, and the lanes of a map."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from gridsim.maps.map import Map
from gridsim.maps.roads import node_clearance
from gridsim.state import SPEED, X, Y

_BEST, _MEAN, _OTHER = "#0b7285", "#868e96", "#f08c00"
_ROAD, _WALL = "#4a4e57", "#e9efe6"


@contextlib.contextmanager
def plain_style() -> Iterator[None]:
    """A context in which Matplotlib has its defaults, whatever the user's matplotlibrc says, and draws `$` as it is."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # else it warns where the home folder cannot be written to
    import matplotlib

    style: dict[Any, Any] = {**matplotlib.rcParamsDefault, "text.parse_math": False}
    del style["backend"]  # takes 0.8 s to load
    # This filter is left in place: restoring Python's filters would also undo what another thread has set meanwhile.
    warnings.filterwarnings("ignore", "Glyph .* missing from font")
    with matplotlib.rc_context(style):
        yield


def drawable(name: str) -> str:
    """A name as Matplotlib can draw it: bytes of a file's name that are no text become question marks."""
    return name.encode(errors="replace").decode()


def figure_of(width: float, height: float, columns: int = 1) -> tuple[Any, Any]:
    """A figure, in inches, that needs no display and no global state, and its axes, one for each column."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(1, columns, squeeze=False)[0]


@plain_style()
def curves(history: Sequence[Mapping[str, float]], path: Path, step_name: str) -> None:
    """Draw fitness (DQN: Q values, loss), distance, speed and success over generations or evaluations to a PNG."""
    figure, axes = figure_of(15, 3.8, 4)
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

    Of a map from a file this is the part around its road: the map is filled up with wall to sides of powers of two.
    """
    width, height = float(road_map.road.width), float(road_map.road.height)
    if road_map.torus and len(road_map.strips.lines):
        return [0.0, width, 0.0, height]
    nodes = node_clearance(road_map.road)
    y, x = np.nonzero(nodes > 0.0)
    margin = 5.0 * float(road_map.road.unit) * np.array([-1.0, 1.0, -1.0, 1.0])
    return (np.array([x.min(), x.max(), y.min(), y.max()]) / nodes.shape[1] * width + margin).tolist()


def _ground(axis: Any, scenario: Map, title: str) -> None:
    """Draw a map's road."""
    nodes = node_clearance(scenario.road)
    extent = (0.0, float(scenario.road.width), 0.0, float(scenario.road.height))
    axis.set_facecolor(_WALL)
    axis.contourf(nodes, levels=[0.0, 100.0], colors=[_ROAD], extent=extent)
    axis.contour(nodes, levels=[0.0], colors=["#ffffff"], linewidths=0.8, extent=extent)
    axis.set(aspect="equal", xlabel="x, m", ylabel="y, m", title=drawable(title))
    axis.axis(bounds(scenario))


@plain_style()
def road_map(scenario: Map, path: Path, title: str) -> None:
    """Draw a map with its stop lines and lanes to a PNG: arrows show the direction, red lanes cross others or merge."""
    from matplotlib.collections import LineCollection

    figure, (axis,) = figure_of(12.0, 11.0)
    _ground(axis, scenario, title)
    network, size = scenario.network, scenario.size
    crossed = np.diff(network.crossing_offsets) > 0
    lanes = [network.points[a:b] for a, b in pairwise(network.offsets)]
    for shift in product((-1, 0, 1), repeat=2) if lanes else ():
        moved = [points + np.array(shift) * size for points in lanes]
        axis.add_collection(LineCollection(moved, colors=np.where(crossed, "#ff6b6b", "#74c0fc"), linewidths=0.8))
    x, y, cosine, sine, half = network.lines.T
    ends = [np.stack([x + side * half * sine, y - side * half * cosine], axis=1) for side in (-1.0, 1.0)]
    axis.add_collection(LineCollection([*np.stack(ends, axis=1)], colors="#ffd43b", linewidths=2.0))
    for points in lanes:
        one, other = points[len(points) // 2 - 1] % size, points[len(points) // 2] % size
        style = {"arrowstyle": "-|>", "color": "#ffffff", "linewidth": 0.4, "mutation_scale": 6}
        axis.annotate("", other, one, arrowprops=style, annotation_clip=True)
    figure.savefig(path, dpi=100)


@plain_style()
def trajectory(scenario: Map, states: np.ndarray, path: Path, title: str) -> None:
    """Draw a map and a car's path on it, coloured by speed, to a PNG. states float32 [steps, CAR_FIELDS]."""
    from matplotlib.collections import LineCollection

    figure, (axis,) = figure_of(8.6, 7.6)
    road, (width, height) = scenario.road, scenario.size
    _ground(axis, scenario, title)
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
