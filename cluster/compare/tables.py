"""A comparison's tables: medians over seeds, with quartiles."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cluster.compare.plan import Plan
from cluster.compare.results import ERROR_FIGURES, RUN_FIGURES, Run
from cluster.settings import RunSettings
from cluster.text import count
from gridsim.maps.scenarios import REGISTRY, label

NAMES = {"evolution": "evolution", "two-parents": "two parents", "dqn": "DQN", "random": "random search"}
COLUMNS = (
    "scenario", "traffic", "observation", "learner", "variant", "seed",
    *RUN_FIGURES, *ERROR_FIGURES, "champion_sha256", "run",
)  # fmt: skip
"""Columns of table.csv."""
LIMITS = ("seed", "until", "generations", "car_steps", "episodes")  # settings in which variants do not differ
Row = dict[str, Any]
Groups = dict[tuple[str, str], list[Row]]
Columns = Mapping[str, tuple[str, float, int]]  # of each column: the figure, its unit's scale, decimal places
DRIVING: Columns = {
    "success, %": ("success_rate", 100.0, 0),
    "distance, m": ("distance_m", 1.0, 0),
    "speed, m/s": ("speed_mps", 1.0, 1),
    "training, s": ("training_s", 1.0, 0),
    "best after, s": ("best_wall_s", 1.0, 0),
    "million car-steps": ("car_steps", 1e-6, 1),
}
"""How far and fast champions drive on held-out roads, and what training cost."""
ERRORS: Columns = {
    "velocity error, m/s": ("velocity_error_mps", 1.0, 2),
    "% of the reference": ("velocity_error_percent", 1.0, 1),
    "largest, m/s": ("velocity_error_max_mps", 1.0, 1),
    "steering error, degrees": ("steering_error_deg", 1.0, 2),
    "largest, degrees": ("steering_error_max_deg", 1.0, 1),
}
"""Errors against the reference."""
FEW = 3  # seeds; fewer are too few for a verdict


def group(runs: Sequence[Run], plan: Plan | None = None) -> Groups:
    """A row of COLUMNS for each run, by the names of its road and learner; with a plan, also the missing ones.

    A road's name has the traffic if there are several amounts of it, a learner's the observation if there are both, and
    the settings in which others of this learner on this road differ.
    """
    made = {run.settings: run for run in runs}
    pairs: list[tuple[RunSettings, Run | None]] = [(run.settings, run) for run in runs]
    if plan:
        pairs = [(planned.settings, made.get(planned.settings)) for planned in plan.planned(Path())]
    traffics: dict[str, set[int]] = {}
    values: dict[tuple[object, ...], dict[str, set[object]]] = {}  # of each setting, for a learner on a road
    for s, _ in pairs:
        traffics.setdefault(s.scenario, set()).add(s.traffic)
        for name, value in vars(s).items():
            values.setdefault(_kind(s), {}).setdefault(name, set()).add(value)
    several_observations = len({s.observation for s, _ in pairs}) > 1
    found: Groups = {}
    for s, run in sorted(pairs, key=lambda pair: (*_kind(pair[0]), pair[0].seed)):
        own = {name: v for name, v in vars(s).items() if name not in LIMITS and len(values[_kind(s)][name]) > 1}
        variant = ", ".join(f"{name} {value}" for name, value in own.items())
        road = label(s.scenario) + (f", {s.traffic} cars" if len(traffics[s.scenario]) > 1 else "")
        name = NAMES[s.learner] + (f" on {s.observation}" if several_observations else "")
        row: Row = {"scenario": label(s.scenario), "learner": s.learner, "variant": variant}
        row |= {name: getattr(s, name) for name in ("traffic", "observation", "seed")}
        if run:
            row |= {name: value for name, value in run.figures.items() if math.isfinite(value)}
            row |= {"champion_sha256": run.champion_sha256, "run": run.folder}
        found.setdefault((road, f"{name}, {variant}" if variant else name), []).append(row)
    return found


def _kind(s: RunSettings) -> tuple[object, ...]:
    """What distinguishes a learner on a road, in the order of the tables: that of the registry and of NAMES."""
    return [*REGISTRY, s.scenario].index(s.scenario), s.scenario, s.traffic, [*NAMES].index(s.learner), s.observation


def quartiles(rows: Sequence[Row], figure: str) -> tuple[list[float], tuple[float, float, float]]:
    """The runs' values of a figure, and their quartiles; nan if there are none."""
    values = [row[figure] for row in rows if figure in row]
    lower, median, upper = np.quantile(values or [math.nan], [0.25, 0.5, 0.75]).tolist()
    return values, (lower, median, upper)


def table(groups: Groups, columns: Columns, spread: bool = True) -> list[list[str]]:
    """Header and rows of a table: road, learner, seeds and the columns; with `spread`, quartiles beside the medians."""
    lines = [["road", "learner", "seeds", *columns]]
    for names, rows in groups.items():
        done = sum("run" in row for row in rows)
        lines.append([*names, f"{done}" if done == len(rows) else f"{done} of {len(rows)}" if done else "missing"])
        for figure, scale, digits in columns.values():
            values, found = quartiles(rows, figure)
            lower, median, upper = (f"{scale * value:,.{digits}f}" for value in found)
            lines[-1].append(
                f"{median} ({lower} to {upper})" if spread and len(values) > 1 else median if values else "–"
            )
    return lines


def table_csv(groups: Groups, folder: Path) -> bytes:
    """A line for each run, without rounding; a missing run has no figures. Paths are relative to `folder`."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for row in (row for rows in groups.values() for row in rows):
        run = row.get("run", "")
        writer.writerow(row | {"run": run.relative_to(folder) if run and run.is_relative_to(folder) else run})
    return stream.getvalue().encode(errors="surrogateescape")


def table_md(groups: Groups, plan: Plan | None = None) -> bytes:
    """The plan, two tables, and notes on them."""
    parts = [introduction(plan)]
    for columns in (DRIVING, ERRORS):
        head, *rows = [[cell.replace("|", "/") for cell in row] for row in table(groups, columns)]
        rule = ["---", "---", *["---:"] * (len(head) - 2)]
        parts.append("\n".join(f"| {' | '.join(row)} |" for row in [head, rule, *rows]))
    parts.append("\n".join(f"- {note}" for note in notes(groups)))
    return ("\n\n".join(parts) + "\n").encode(errors="surrogateescape")


def notes(groups: Groups) -> list[str]:
    """What to keep in mind when reading the tables."""
    few = min(sum("run" in row for row in rows) for rows in groups.values()) < FEW
    return [
        "Medians over seeds, quartiles in brackets."
        + (f" Fewer than {FEW} seeds are too few for a verdict." if few else ""),
        "Errors compare champions with a reference driver, which takes the bends of their paths as fast as is "
        "comfortable within the road's interval. They are means over the metres that were driven: those of a driver "
        "that crashes soon say little.",
    ]


def introduction(plan: Plan | None) -> str:
    """The plan in a line."""
    if plan is None:
        return (
            "Finished runs. Their budgets may differ: compare training times and car-steps first. The first run on a "
            "machine takes some 20 s more, to compile the simulator."
        )
    sensors = {"rays": "31 rays", "grid": "the occupancy grid"}
    traffic = "traffic as each road has it by default" if plan.traffic == -1 else f"{plan.traffic} other cars"
    return f"{count(plan.seeds, 'seed')}, at most {plan.budget} a run, {sensors[plan.observation]}, {traffic}."
