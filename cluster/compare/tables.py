"""A comparison's tables: medians over seeds, with quartiles."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

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
NOTHING = "–"


@dataclass(frozen=True)
class Group:
    """The runs of one learner on one road with all seeds."""

    scenario: str
    traffic: int
    observation: str
    learner: str
    variant: str  # its settings, in words, in which others of this learner on this road differ
    road: str  # the scenario's name, with the traffic if the comparison has several amounts of it
    name: str  # the learner's, with its variant, and with the observation if the comparison has both
    runs: tuple[Run, ...]  # the finished ones
    seeds: tuple[int, ...]  # all of the plan's

    def values(self, figure: str) -> list[float]:
        """One number for each run that has it: an error may not have been measured."""
        return [value for run in self.runs if math.isfinite(value := run.figures.get(figure, math.nan))]

    def spread(self, figure: str) -> tuple[int, float, float, float]:
        """The number of runs that have it, and its quartiles over them; nan if there are none."""
        found = self.values(figure)
        lower, median, upper = np.quantile(found or [math.nan], [0.25, 0.5, 0.75]).tolist()
        return len(found), lower, median, upper


Kind = tuple[str, int, str, str]  # a group's scenario, traffic, observation and learner


def group(runs: Sequence[Run], plan: Plan | None = None) -> list[Group]:
    """Runs by road and learner, in the order of the registry and of NAMES; with a plan, also the missing ones."""
    kinds: dict[Kind, list[RunSettings]] = {}
    for each in plan.cells(Path()) if plan else runs:
        s = each.settings
        kinds.setdefault((s.scenario, s.traffic, s.observation, s.learner), []).append(s)

    def order(kind: Kind) -> tuple[int, str, int, int, str]:
        scenario, traffic, observation, learner = kind
        return [*REGISTRY, scenario].index(scenario), scenario, traffic, [*NAMES].index(learner), observation

    several_observations = len({observation for _, _, observation, _ in kinds}) > 1
    found = []
    for kind in sorted(kinds, key=order):
        scenario, traffic, observation, learner = kind
        several_traffics = len({other[1] for other in kinds if other[0] == scenario}) > 1
        road = label(scenario) + (f", {traffic} cars" if several_traffics else "")
        name = NAMES[learner] + (f" on {observation}" if several_observations else "")
        for variant, settings in _variants(kinds[kind]).items():
            asked, seeds = set(settings), sorted(each.seed for each in settings)
            finished = sorted((run for run in runs if run.settings in asked), key=lambda run: run.settings.seed)
            full_name = f"{name}, {variant}" if variant else name
            found.append(Group(*kind, variant, road, full_name, tuple(finished), tuple(seeds)))
    return found


def _variants(settings: Sequence[RunSettings]) -> dict[str, list[RunSettings]]:
    """Settings of one kind by what they differ in besides seeds and limits, in words."""
    values = [dataclasses.asdict(each) for each in settings]
    left_out = {"seed", "until", *settings[0].unbound}
    varied = [name for name in values[0] if name not in left_out and len({each[name] for each in values}) > 1]
    found: dict[str, list[RunSettings]] = {}
    for each in settings:
        found.setdefault(", ".join(f"{name} {getattr(each, name)}" for name in varied), []).append(each)
    return found


def table_csv(groups: Sequence[Group], folder: Path) -> bytes:
    """A row for each run, without rounding; a missing run has no figures. Paths are relative to `folder`."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for each in groups:
        finished = {run.settings.seed for run in each.runs}
        common = {name: getattr(each, name) for name in ("traffic", "observation", "learner", "variant")}
        common["scenario"] = label(each.scenario)
        for run in each.runs:
            where = run.folder.relative_to(folder) if run.folder.is_relative_to(folder) else run.folder
            numbers = {name: repr(value) for name, value in run.figures.items() if math.isfinite(value)}
            own = {"seed": run.settings.seed, "champion_sha256": run.champion_sha256, "run": where}
            writer.writerow(common | own | numbers)
        writer.writerows(common | {"seed": seed} for seed in each.seeds if seed not in finished)
    return stream.getvalue().encode(errors="surrogateescape")


def table_md(groups: Sequence[Group], plan: Plan | None = None) -> bytes:
    """The plan, two tables, and notes on them."""
    parts = [introduction(plan), *(_markdown(table(groups, columns)) for columns in (DRIVING, ERRORS))]
    parts.append("\n".join(f"- {note}" for note in notes(groups)))
    return ("\n\n".join(parts) + "\n").encode(errors="surrogateescape")


def notes(groups: Sequence[Group]) -> list[str]:
    """What to keep in mind when reading the tables."""
    few = " Fewer than 3 seeds are too few for a verdict." if min(len(group.runs) for group in groups) < 3 else ""
    return [
        f"Medians over seeds, quartiles in brackets.{few}",
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


def _seeds(group: Group) -> str:
    """How many runs are finished."""
    asked, finished = len(group.seeds), len(group.runs)
    return f"{finished}" if finished == asked else f"{finished} of {asked}" if finished else "missing"


def _median(figure: str, scale: float, digits: int) -> Callable[[Group], str]:
    """A column of medians with their quartiles."""

    def cell(group: Group) -> str:
        n, *found = group.spread(figure)
        lower, median, upper = (f"{value * scale:,.{digits}f}" for value in found)
        return f"{median} ({lower} to {upper})" if n > 1 else median if n else NOTHING

    return cell


Columns = Mapping[str, Callable[[Group], str]]
DRIVING: Columns = {
    "seeds": _seeds,
    "success, %": _median("success_rate", 100.0, 0),
    "distance, m": _median("distance_m", 1.0, 0),
    "speed, m/s": _median("speed_mps", 1.0, 1),
    "training, s": _median("training_s", 1.0, 0),
    "best after, s": _median("best_wall_s", 1.0, 0),
    "million car-steps": _median("car_steps", 1e-6, 1),
}
"""How far and fast champions drive on held-out roads, and what training cost."""
ERRORS: Columns = {
    "velocity error, m/s": _median("velocity_error_mps", 1.0, 2),
    "% of the reference": _median("velocity_error_percent", 1.0, 1),
    "largest, m/s": _median("velocity_error_max_mps", 1.0, 1),
    "steering error, degrees": _median("steering_error_deg", 1.0, 2),
    "largest, degrees": _median("steering_error_max_deg", 1.0, 1),
}
"""Errors against the reference."""


def table(groups: Sequence[Group], columns: Columns) -> list[list[str]]:
    """Header and rows of a table: road, learner and the columns."""
    rows = [[group.road, group.name, *(cell(group) for cell in columns.values())] for group in groups]
    return [["road", "learner", *columns], *rows]


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, words aligned left and numbers right; the first row is its header."""
    rule = ["---", "---", *["---:"] * (len(rows[0]) - 2)]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in [rows[0], rule, *rows[1:]])
