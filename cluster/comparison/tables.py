"""What a comparison says: its tables, and how far they can be believed."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cluster.comparison.plan import Plan
from cluster.comparison.results import ERROR_FIGURES, RUN_FIGURES, Run
from cluster.comparison.statistics import Spread, separation_by_chance, span_coverage, spread
from gridsim.maps.scenarios import REGISTRY, default_traffic, label

NAMES = {"evolution": "evolution", "two-parents": "two parents", "dqn": "DQN", "random": "random search"}
COLUMNS = (
    "scenario", "traffic", "observation", "learner", "seed", *RUN_FIGURES, *ERROR_FIGURES, "champion_sha256", "run",
)  # fmt: skip
"""Of table.csv."""

ALIKE = 0.05  # share by which two trainings must differ to be told apart
FEW = 3  # seeds of each; fewer allow no verdict
NOTHING = "–"


@dataclass(frozen=True)
class Group:
    """The runs of one learner on one road, all seeds of them.

    Attributes:
        scenario, traffic, observation, learner: what they have in common.
        road: the scenario's name, with its traffic where the comparison has it twice.
        name: the learner's, with what it sees where the comparison has both.
        runs: those that are finished.
        seeds: that were asked for.
    """

    scenario: str
    traffic: int
    observation: str
    learner: str
    road: str
    name: str
    runs: tuple[Run, ...]
    seeds: tuple[int, ...]

    def values(self, figure: str) -> list[float]:
        """One number a run."""
        return [run.figures.get(figure, math.nan) for run in self.runs]

    def spread(self, figure: str) -> Spread:
        """Over seeds."""
        return spread(self.values(figure))

    def median(self, figure: str) -> float:
        """Over seeds; not a number where nothing was measured."""
        return self.spread(figure).median


def group(runs: Sequence[Run], plan: Plan | None = None) -> list[Group]:
    """Runs by road and learner, in the order of the registry and of NAMES; with a plan also what is missing."""
    wanted: dict[tuple[str, int, str, str], list[int]] = {}
    if plan:
        for scenario in plan.scenarios:
            traffic = default_traffic(scenario) if plan.traffic == -1 else plan.traffic
            for name in plan.learners:
                wanted[scenario, traffic, plan.observation, name] = list(range(plan.seeds))
    else:
        for run in runs:
            wanted.setdefault((run.scenario, run.traffic, run.observation, run.learner), []).append(run.seed)
    places = list(REGISTRY)

    def order(key: tuple[str, int, str, str]) -> tuple[int, str, int, int, str]:
        scenario, traffic, observation, learner = key
        place = places.index(scenario) if scenario in places else len(places)
        return place, scenario, traffic, list(NAMES).index(learner), observation

    keys = sorted(wanted, key=order)
    several_views = len({key[2] for key in keys}) > 1
    found = []
    for key in keys:
        scenario, traffic, observation, learner = key
        several = len({other[1] for other in keys if other[0] == scenario}) > 1
        road = label(scenario) + (f", {traffic} cars" if several else "")
        called = NAMES[learner] + (f" on {observation}" if several_views else "")
        mine = [run for run in runs if (run.scenario, run.traffic, run.observation, run.learner) == key]
        mine.sort(key=lambda run: run.seed)
        found.append(Group(*key, road, called, tuple(mine), tuple(sorted(wanted[key]))))
    return found


# ------------------------------------------------------------------------------------------------------- table.csv


def table_csv(groups: Sequence[Group], folder: Path) -> bytes:
    """A row a run, raw; the figures of a missing one are empty. Runs inside `folder` are told by their name there."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for each in groups:
        common = [label(each.scenario), each.traffic, each.observation, each.learner]
        for run in each.runs:
            figures = [run.figures.get(name, math.nan) for name in (*RUN_FIGURES, *ERROR_FIGURES)]
            inside = run.folder.is_relative_to(folder)
            where = run.folder.relative_to(folder) if inside else run.folder
            numbers = [repr(value) if math.isfinite(value) else "" for value in figures]
            writer.writerow([*common, run.seed, *numbers, run.champion_sha256, where])
        there = [run.seed for run in each.runs]
        for seed in each.seeds:
            if seed not in there:
                writer.writerow([*common, seed, *[""] * (len(COLUMNS) - 5)])
    return stream.getvalue().encode()


# -------------------------------------------------------------------------------------------------------- table.md


def table_md(groups: Sequence[Group], plan: Plan | None = None) -> bytes:
    """What was done, two tables, and how far they can be believed."""
    parts = [introduction(groups, plan), *(_markdown(rows) for rows in (driving(groups), errors(groups)))]
    parts.append("\n".join(f"- {sentence}" for sentence in notes(groups)))
    return ("\n\n".join(parts) + "\n").encode()


def introduction(groups: Sequence[Group], plan: Plan | None) -> str:
    """What was done."""
    counts = sorted({len(each.runs) for each in groups})
    seeds = f"{counts[0]}" if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
    words = f"{seeds} seed{'s' * (counts[-1] != 1)} each"
    if plan:
        views = {"rays": "31 rays", "grid": "the occupancy grid"}
        traffic = "traffic as each road has it by default" if plan.traffic == -1 else f"{plan.traffic} other cars"
        words += f", at most {plan.budget.words()} a run, {views[plan.observation]}, {traffic}"
    if counts[-1] > 1:
        words += "; medians over seeds, quartiles in brackets"
    missing = sum(len(each.seeds) - len(each.runs) for each in groups)
    if missing:
        words += f". {missing} of {sum(len(each.seeds) for each in groups)} runs are missing"
    return words + "."


def driving(groups: Sequence[Group]) -> list[list[str]]:
    """How far and fast champions drive where they never were, and what training cost."""
    columns = (
        ("success, %", "success_rate", 100.0, 0),
        ("distance, m", "distance_m", 1.0, 0),
        ("speed, m/s", "speed_mps", 1.0, 1),
        ("training, s", "training_s", 1.0, 0),
        ("best after, s", "best_wall_s", 1.0, 0),
        ("million car-steps", "car_steps", 1e-6, 1),
    )
    rows = [["road", "learner", "seeds", *(column[0] for column in columns)]]
    for each in groups:
        asked, there = len(each.seeds), len(each.runs)
        count = f"{there}" if there == asked else f"{there} of {asked}" if there else "missing"
        cells = [_shown(each.spread(figure), scale, digits) for _, figure, scale, digits in columns]
        rows.append([each.road, each.name, count, *cells])
    return rows


def errors(groups: Sequence[Group]) -> list[list[str]]:
    """Errors against the reference."""
    columns = (
        ("velocity error, m/s", "velocity_error_mps", 2),
        ("% of the reference", "velocity_error_percent", 1),
        ("largest, m/s", "velocity_error_max_mps", 1),
        ("steering error, degrees", "steering_error_deg", 2),
        ("largest, degrees", "steering_error_max_deg", 1),
    )
    rows = [["road", "learner", *(column[0] for column in columns)]]
    rows[0].insert(4, "its bootstrap interval")
    for each in groups:
        cells = [_shown(each.spread(figure), 1.0, digits) for _, figure, digits in columns]
        interval = each.spread("velocity_error_percent")
        cells.insert(2, f"{interval.low:.1f} to {interval.high:.1f}" if interval.n > 1 else NOTHING)
        rows.append([each.road, each.name, *cells])
    return rows


def _shown(found: Spread, scale: float, digits: int) -> str:
    """A median with its quartiles."""
    if not found.n:
        return NOTHING
    median, lower, upper = (f"{value * scale:,.{digits}f}" for value in (found.median, found.lower, found.upper))
    return median if found.n == 1 else f"{median} ({lower} to {upper})"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table: words to the left, numbers to the right; the first row is its head."""
    words = sum(cell in ("road", "learner") for cell in rows[0])
    rule = ["---"] * words + ["---:"] * (len(rows[0]) - words)
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in [rows[0], rule, *rows[1:]])


# ----------------------------------------------------------------------------------------------------------- notes


def notes(groups: Sequence[Group]) -> list[str]:
    """How far the tables can be believed. They give no verdict: a reader does."""
    found = ["Errors are means over the metres that were driven: small ones of drivers that crash soon say nothing."]
    unequal = list(dict.fromkeys(each.road for each in groups if each.runs and _unequal(each, groups)))
    if unequal:
        found.append(f"Training took unequal time and car-steps on {', '.join(unequal)}.")
    n = min((len(each.runs) for each in groups if each.runs), default=0)
    if n < FEW:
        return [*found, f"Too few seeds for a verdict ({n}; {FEW} or more)."]
    text = f"With {n} seeds each, two learners that do not differ have all seeds of one below all of the other's in "
    text += f"{100 * separation_by_chance(n, n):.{1 if n > 5 else 0}f} % of comparisons, by chance"
    if n <= 5:
        text += f"; the bootstrap interval is their whole span, and holds the true median in {span_coverage(n):.0%}"
    return [*found, text + "."]


def _unequal(group: Group, groups: Sequence[Group]) -> bool:
    """Whether some learner on the same road was trained both for another time and with other car-steps."""

    def alike(other: Group, figure: str) -> bool:
        return math.isclose(group.median(figure), other.median(figure), rel_tol=ALIKE)

    return not all(
        alike(other, "training_s") or alike(other, "car_steps")
        for other in groups
        if (other.scenario, other.traffic) == (group.scenario, group.traffic) and other.runs
    )
