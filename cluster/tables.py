"""What a comparison says: its tables, and sentences made from its numbers, whichever way these fall."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cluster.experiment import Plan
from cluster.finished import ERROR_FIGURES, RUN_FIGURES, Run
from cluster.statistics import RESAMPLES, Spread, separation_by_chance, span_coverage, spread
from gridsim.scenarios import REGISTRY, default_traffic, label

NAMES = {"evolution": "evolution", "two-parents": "two parents", "dqn": "DQN", "random": "random search"}
COLUMNS = (
    "scenario", "traffic", "observation", "learner", "seed", *RUN_FIGURES, *ERROR_FIGURES, "champion_sha256", "run",
)  # fmt: skip
"""Of table.csv."""

# What the paper gives for evolution on its seamless road; its "ppu" taken as m/s at 16 pixels a metre.
PAPER = {
    "velocity_error_mps": 1.692,
    "velocity_error_max_mps": 8.988,
    "steering_error_deg": 4.726,
    "steering_error_max_deg": 21.619,
}
ALIKE = 0.05  # share by which two times must differ to be told apart
SHORT = 0.5  # share of held-out drives that must succeed before an error tells of good driving
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
    """What was done, two tables, and what they say."""
    parts = [_introduction(groups, plan), _driving(groups), _errors(groups)]
    parts.append("\n".join(f"- {sentence}" for sentence in findings(groups)))
    return ("\n\n".join(part for part in parts if part) + "\n").encode()


def _introduction(groups: Sequence[Group], plan: Plan | None) -> str:
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


def _driving(groups: Sequence[Group]) -> str:
    """How far and fast champions drive where they never were, and what training cost."""
    columns = (
        ("success, %", "success_rate", 100.0, 0),
        ("distance, m", "distance_m", 1.0, 0),
        ("speed, m/s", "speed_mps", 1.0, 1),
        ("training, s", "training_s", 1.0, 0),
        ("its champion after, s", "best_wall_s", 1.0, 0),
        ("car-steps, million", "car_steps", 1e-6, 1),
    )
    rows = [["road", "learner", "seeds", *(column[0] for column in columns)]]
    for each in groups:
        asked, there = len(each.seeds), len(each.runs)
        count = f"{there}" if there == asked else f"{there} of {asked}" if there else "missing"
        cells = [_shown(each.spread(figure), scale, digits) for _, figure, scale, digits in columns]
        rows.append([each.road, each.name, count, *cells])
    return _markdown(rows)


def _errors(groups: Sequence[Group]) -> str:
    """Errors against the reference."""
    columns = (
        ("velocity error, m/s", "velocity_error_mps", 2),
        ("% of the reference's speed", "velocity_error_percent", 1),
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
    return _markdown(rows)


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


# -------------------------------------------------------------------------------------------------------- findings


def findings(groups: Sequence[Group]) -> list[str]:
    """What the numbers say, a sentence or two each, above all whether the paper's claim holds."""
    found: list[str] = []
    views = list(dict.fromkeys(each.observation for each in groups))
    for view in views:
        mine = [each for each in groups if each.observation == view]
        ahead = f"On {view}: " if len(views) > 1 else ""
        found += [ahead + sentence for sentence in (*_claim(mine), *_against_random(mine), *_paper(mine))]
    found += _caution(groups)
    found += _power(groups)
    return found


def _pairs(groups: Sequence[Group], figure: str, first: str, second: str) -> Iterator[tuple[Group, Group]]:
    """Two learners on the same road, where both were measured."""
    for a in groups:
        for b in groups:
            same = (a.scenario, a.traffic) == (b.scenario, b.traffic)
            if same and (a.learner, b.learner) == (first, second) and a.spread(figure).n and b.spread(figure).n:
                yield a, b


def _apart(a: Group, b: Group, figure: str) -> bool:
    """Whether each of a's seeds is below each of b's."""
    return max(v for v in a.values(figure) if math.isfinite(v)) < min(v for v in b.values(figure) if math.isfinite(v))


def _claim(groups: Sequence[Group]) -> Iterator[str]:
    """The paper's claim, in its two halves."""
    figure = "velocity_error_percent"
    pairs = list(_pairs(groups, figure, "evolution", "dqn"))
    if not pairs:
        yield (
            "The paper claims that evolution has a smaller velocity error than a DQN in all five scenarios, at a low "
            "training time. These runs cannot tell: there is no road on which both were measured."
        )
        return
    smaller = [(a, b) for a, b in pairs if a.median(figure) < b.median(figure)]
    larger = [pair for pair in pairs if pair not in smaller]
    whole = {a.scenario for a, _ in pairs} >= set(REGISTRY)
    if not larger:
        verdict = "holds" if whole else f"holds on the {_count(pairs, 'road')} that were compared, not all five"
    elif smaller:
        verdict = f"does not hold on all roads: on {len(smaller)} of {len(pairs)} only"
    else:
        verdict = "does not hold on any road" + ("" if whole else " that was compared")
    text = f"**Velocity error: the paper's claim that evolution's is smaller than the DQN's {verdict}.**"
    for word, some in (("smaller", smaller), ("not smaller", larger)):
        if some:
            text += f" It is {word} on " + _list(f"{a.road} ({_two(a, b, figure, '%', 1)})" for a, b in some) + "."
    apart = [(a, b) for a, b in smaller if _apart(a, b, figure)] + [(a, b) for a, b in larger if _apart(b, a, figure)]
    if max(len(a.runs) + len(b.runs) for a, b in pairs) > 2:
        if apart:
            text += f" No seed of one learner is among the other's on {_list([a.road for a, _ in apart])}."
        mixed = [a.road for a, b in pairs if (a, b) not in apart]
        text += f" Seeds overlap on {_list(mixed)}." if mixed else ""
    yield text
    yield _time(groups)


def _time(groups: Sequence[Group]) -> str:
    """How long the two trained."""
    pairs = list(_pairs(groups, "training_s", "evolution", "dqn"))
    kinds: dict[str, list[str]] = {"shorter": [], "longer": [], "alike": []}
    for a, b in pairs:
        mine, theirs = a.median("training_s"), b.median("training_s")
        kind = "alike" if abs(mine - theirs) <= ALIKE * max(mine, theirs) else "shorter" if mine < theirs else "longer"
        kinds[kind].append(f"{a.road} ({_two(a, b, 'training_s', 's', 0)})")
    if len(kinds["shorter"]) == len(pairs):
        text = "**Training time: evolution's is shorter than the DQN's on every road compared**"
    else:
        text = (
            f"**Training time: evolution's is shorter than the DQN's on {len(kinds['shorter'])} of {len(pairs)} roads**"
        )
    parts = [f"{kind} on {_list(roads)}" for kind, roads in kinds.items() if roads]
    return f"{text}: {'; '.join(parts)}."


def _against_random(groups: Sequence[Group]) -> Iterator[str]:
    """Whether learning is better than luck."""
    for learner in ("evolution", "dqn"):
        pairs = list(_pairs(groups, "distance_m", learner, "random"))
        if pairs:
            further = [a.road for a, b in pairs if a.median("distance_m") > b.median("distance_m")]
            rest = [a.road for a, _ in pairs if a.road not in further]
            text = f"{NAMES[learner][0].upper()}{NAMES[learner][1:]} drives further than random search on "
            text += f"{len(further)} of {_count(pairs, 'road')}"
            yield text + (f", not on {_list(rest)}." if rest else ".")


def _paper(groups: Sequence[Group]) -> Iterator[str]:
    """Evolution on the seamless road beside the paper's figures."""
    for each in groups:
        if each.learner == "evolution" and each.scenario == "seamless" and each.spread("velocity_error_mps").n:
            mine = {figure: each.median(figure) for figure in PAPER}
            below = [figure for figure in PAPER if mine[figure] < PAPER[figure]]
            words = {
                "velocity_error_mps": "mean velocity error {} m/s",
                "velocity_error_max_mps": "largest {} m/s",
                "steering_error_deg": "mean steering error {} degrees",
                "steering_error_max_deg": "largest {} degrees",
            }
            parts = [
                words[figure].format(f"{mine[figure]:.2f}") + f" (the paper: {PAPER[figure]:.2f})" for figure in PAPER
            ]
            verdict = "each below" if len(below) == len(PAPER) else f"{len(below)} of {len(PAPER)} below"
            yield f"Evolution on {each.road}: {', '.join(parts)}; {verdict} the paper's."


def _caution(groups: Sequence[Group]) -> Iterator[str]:
    """Where an error tells little, as few of the drives were finished."""
    short = [each for each in groups if each.spread("velocity_error_percent").n and each.median("success_rate") < SHORT]
    if short:
        where = _list(f"{each.name} on {each.road}" for each in short)
        yield (
            "Errors are means over the metres that a car drove before it crashed or arrived, so a small one is no "
            f"praise where fewer than half of the held-out drives succeed: {where}."
        )


def _power(groups: Sequence[Group]) -> Iterator[str]:
    """How far so few seeds can be believed."""
    counts = [len(each.runs) for each in groups if each.runs]
    if not counts:
        return
    n = max(counts, key=counts.count)  # of most of them
    text = f"The intervals are percentile bootstraps of the median ({RESAMPLES:,} resamples)"
    chance = f"{100 * separation_by_chance(n, n):.{1 if n > 5 else 0}f} %"
    if n == 1:
        yield "One seed says nothing of how much seeds differ: no interval can be given."
    elif n <= 5:
        yield (
            f"{text}. Of {n} seeds that is their whole span, which holds the true median with a probability of "
            f"{100 * span_coverage(n):.0f} %, not 95 %; and two learners that do not differ would have all seeds of "
            f"one below all of the other's by chance in {chance} of comparisons. More seeds tell more."
        )
    else:
        yield (
            f"{text}; two learners that do not differ would have all {n} seeds of one below all of the other's by "
            f"chance in {chance} of comparisons."
        )


def _two(a: Group, b: Group, figure: str, unit: str, digits: int) -> str:
    return f"{a.median(figure):,.{digits}f} against {b.median(figure):,.{digits}f} {unit}"


def _count(things: Sequence[object], noun: str) -> str:
    return f"{len(things)} {noun}{'' if len(things) == 1 else 's'}"


def _list(words: Iterator[str] | Sequence[str]) -> str:
    """`a, b and c`."""
    *most, last = words
    return f"{', '.join(most)} and {last}" if most else last
