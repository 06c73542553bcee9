"""A comparison's tables: medians over seeds, with quartiles."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cluster.compare.plan import Plan
from cluster.compare.results import ERROR_FIGURES, RUN_FIGURES, Run
from cluster.text import cars, count
from gridsim.maps.scenarios import Traffic, label

NAMES = {"evolution": "evolution", "two-parents": "two parents", "dqn": "DQN", "random": "random search"}
LIMITS = ("seed", "until", "generations", "car_steps", "episodes")  # settings that may differ within a group
Groups = dict[tuple[str, str], list[Run]]
Columns = Mapping[str, tuple[str, float, int]]  # by header: the figure, factor to the column's unit, decimals
DRIVING: Columns = {
    "success, %": ("success_rate", 100.0, 0),
    "km per crash": ("km_per_collision", 1.0, 1),
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
    """Group runs by the names of their road and learner; with a plan, also its missing runs, which have no figures.

    Names say only what is needed to tell groups apart. A road's name includes the traffic if its runs have several
    amounts of it. A learner's name includes the observation if there are both rays and grid, and the settings, except
    LIMITS, in which its runs on the road differ.
    """
    if plan:
        made = {run.settings: run for run in runs}
        planned = plan.planned(Path())
        runs = [made.get(run.settings) or Run(run.path, run.settings, "", {}) for run in planned]
    of_learner: dict[tuple[str, Traffic, str, str], list[Run]] = {}  # on one road
    for run in runs:
        s = run.settings
        of_learner.setdefault((s.scenario, s.traffic, s.learner, s.observation), []).append(run)
    groups: Groups = {}
    roads = _names_of_roads(runs)
    for (scenario, traffic, learner, observation), alike in of_learner.items():
        several_traffics = len({other for name, other, *_ in of_learner if name == scenario}) > 1
        several_observations = len({other for *_, other in of_learner}) > 1
        road = roads[scenario] + (f", {cars(traffic)}" if several_traffics else "")
        words = NAMES[learner] + (f" on {observation}" if several_observations else "")
        varied = [name for name in vars(alike[0].settings) if len({getattr(run.settings, name) for run in alike}) > 1]
        for run in alike:
            own = [f"{name} {getattr(run.settings, name)}" for name in varied if name not in LIMITS]
            groups.setdefault((road, ", ".join([words, *own])), []).append(run)
    return groups


def _names_of_roads(runs: Sequence[Run]) -> dict[str, str]:
    """The name of each scenario: its label, or all of it where two scenarios have the same label."""
    labels = {scenario: label(scenario) for scenario in {run.settings.scenario for run in runs}}
    return {name: short if [*labels.values()].count(short) == 1 else name for name, short in labels.items()}


def quartiles(runs: Sequence[Run], figure: str) -> tuple[list[float], tuple[float, float, float]]:
    """The runs' finite values of a figure, and (lower quartile, median, upper quartile), nan without a value."""
    values = [run.figures[figure] for run in runs if math.isfinite(run.figures.get(figure, math.nan))]
    lower, median, upper = np.quantile(values or [math.nan], [0.25, 0.5, 0.75]).tolist()
    return values, (lower, median, upper)


def table(groups: Groups, columns: Columns, spread: bool = True) -> list[list[str]]:
    """Header and rows of a table: road, learner, seeds and the columns; with `spread`, quartiles beside the medians."""
    lines = [["road", "learner", "seeds", *columns]]
    for names, runs in groups.items():
        done = sum(bool(run.figures) for run in runs)
        lines.append([*names, f"{done}" if done == len(runs) else f"{done} of {len(runs)}" if done else "missing"])
        for figure, scale, digits in columns.values():
            values, found = quartiles(runs, figure)
            lower, median, upper = (f"{scale * value:,.{digits}f}" for value in found)
            lines[-1].append(
                f"{median} ({lower} to {upper})" if spread and len(values) > 1 else median if values else "–"
            )
    return lines


def table_csv(groups: Groups, folder: Path) -> bytes:
    """A line for each run, without rounding; a missing run has no figures. Paths are relative to `folder`."""
    lines: list[dict[str, object]] = []
    roads = _names_of_roads([run for runs in groups.values() for run in runs])
    for (_, learner), runs in groups.items():
        for run in runs:
            s, figures = run.settings, {**dict.fromkeys((*RUN_FIGURES, *ERROR_FIGURES), math.nan), **run.figures}
            lines.append({
                "scenario": roads[s.scenario], "traffic": s.traffic, "observation": s.observation,
                "learner": s.learner, "variant": learner.partition(", ")[2], "seed": s.seed,
                **{name: value if math.isfinite(value) else "" for name, value in figures.items()},
                "champion_sha256": run.champion_sha256,
                "run": os.path.relpath(run.folder, folder) if run.figures else "",
            })  # fmt: skip
    stream = io.StringIO()
    writer = csv.DictWriter(stream, lines[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return stream.getvalue().encode(errors="surrogateescape")


def table_md(groups: Groups, plan: Plan | None = None) -> bytes:
    """The plan, two tables, and notes on them, as Markdown."""
    parts = [introduction(plan)]
    for columns in (DRIVING, ERRORS):
        head, *rows = [[cell.replace("|", "/") for cell in row] for row in table(groups, columns)]
        rule = ["---", "---", *["---:"] * (len(head) - 2)]
        parts.append("\n".join(f"| {' | '.join(row)} |" for row in [head, rule, *rows]))
    parts.append("\n".join(f"- {note}" for note in notes(groups)))
    return ("\n\n".join(parts) + "\n").encode(errors="surrogateescape")


def notes(groups: Groups) -> list[str]:
    """What to keep in mind when reading the tables."""
    few = min(sum(bool(run.figures) for run in runs) for runs in groups.values()) < FEW
    return [
        "Medians over seeds, quartiles in brackets."
        + (f" Fewer than {FEW} seeds are too few for a verdict." if few else ""),
        "Kilometres per crash are per collision; of a champion without one, all that it drove, so at least so many.",
        "Errors compare champions with a reference driver, which takes the bends of their paths as fast as is "
        "comfortable within the road's interval. They are means over the metres that were driven: those of a driver "
        "that crashes soon say little.",
    ]


def introduction(plan: Plan | None) -> str:
    """The plan in a line; without one, what to know of finished runs."""
    if plan is None:
        return (
            "Finished runs. Their budgets may differ: compare training times and car-steps first. The first run on a "
            "machine takes some 20 s more, to compile the simulator."
        )
    sensors = {"rays": "31 rays", "grid": "the occupancy grid"}
    traffic = "traffic as each road has it by default" if plan.traffic == -1 else f"{cars(plan.traffic)} beside it"
    return f"{count(plan.seeds, 'seed')}, at most {plan.budget} a run, {sensors[plan.observation]}, {traffic}."
