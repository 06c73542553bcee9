"""A comparison's plan: scenarios x learners x seeds, each a training run in a folder of its own.

Runs are ordered by seed first, so that a stopped comparison has results of every learner on every road. The plan is
kept in comparison.json.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from cluster.compare.results import LEARNERS, Learner, Run, read_run
from cluster.settings import IN_WORDS, MAX_STEPS, DqnSettings, EvolveSettings, RunSettings
from cluster.store import checkpoint
from cluster.store.checkpoint import SUMMARY
from cluster.text import as_argument, file_name
from evolution.networks.policy import Observation
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import REGISTRY, is_map_file, label

COMPARISON = "comparison.json"
FORMAT = 3
MAX_SEEDS, MAX_CAR_STEPS, MAX_WALL_S = 1000, 10**13, 30 * 86_400.0
UNLIMITED = MAX_STEPS  # generations or car-steps of a run that its wall time ends
CAR_STEPS = {None: 1, "k": 10**3, "M": 10**6, "G": 10**9}  # in units of a budget
SECONDS = {"s": 1, "min": 60, "h": 3600}
EVALUATIONS = 10  # of the DQN, at least
# Settings that other flags or the comparison itself decide, so that --grid cannot vary them.
PLANNED = (
    "scenario", "traffic", "seed", "observation", "until", "search", "recombination", "car_steps", "generations",
    "evaluate_every",
)  # fmt: skip


@dataclass(frozen=True)
class PlannedRun:
    """A training run of a comparison: its folder, which may not be there yet, and what it is asked to do."""

    path: Path
    settings: RunSettings

    @property
    def name(self) -> str:
        return self.path.name

    def finished(self) -> bool:
        """Whether there is a summary, the last file that a run writes."""
        return (self.path / SUMMARY).is_file()

    def flags(self) -> list[str]:
        """Flags with which the learner's command makes this run: the road, the seed, and what is not the default."""
        own, always = vars(self.settings), ("scenario", "traffic", "seed", "observation")
        usual = vars(type(self.settings)(own["scenario"], own["traffic"], observation=own["observation"]))
        chosen = {name: value for name, value in own.items() if name in always or value != usual[name]}
        chosen |= {"output": self.path.parent, "name": self.name}
        return [f"--{name.replace('_', '-')}={value}" for name, value in chosen.items()]


@dataclass(frozen=True)
class Plan:
    """A comparison's plan: the fields are the command's flags, and comparison.json stores them."""

    scenarios: tuple[str, ...] = tuple(REGISTRY)
    """Roads to compare on."""
    learners: tuple[Learner, ...] = LEARNERS
    """Learners to compare."""
    seeds: int = 3
    """Seeds of each, 0 and up; 1 with --quick."""
    observation: Observation = "rays"
    """What the networks see besides the speed: rays (31 ranges) or grid (an occupancy grid)."""
    budget: str = "60s"
    """What a run may use at most: car-steps (20M, 500k) or wall time (60s, 5min, 1h); 10s with --quick. Car-steps give
    the same networks on any machine. A run may end earlier by its learner's own stopping rule."""
    traffic: Annotated[int, IN_WORDS] = -1
    """Other cars on the road; by default as many as each road usually has."""
    population: Annotated[int, IN_WORDS] = 0
    """Members of a generation, of evolution and random search; by default as for gridsim-evolve."""
    generations: Annotated[int, IN_WORDS] = 0
    """Generations at most, of evolution and random search; by default any number within the budget."""
    grid: Annotated[tuple[str, ...], IN_WORDS] = ()
    """Settings to vary, as in sigma=0.3,0.5 population=128,256: each combination is compared as a learner of its
    own."""

    def __post_init__(self) -> None:
        absolute = tuple(os.path.abspath(name) if is_map_file(name) else name for name in self.scenarios)
        object.__setattr__(self, "scenarios", absolute)

    def check(self) -> None:
        """Raises GridSimError, one line that says what to change."""
        for flag, given in (("scenarios", self.scenarios), ("learners", self.learners)):
            if not given or len(set(given)) != len(given):
                raise GridSimError(f"--{flag} {' '.join(given)}: name at least one, and each once")
        if not set(self.learners) <= set(LEARNERS):
            raise GridSimError(f"--learners: use {', '.join(LEARNERS)}")
        for flag, number, least, most in (
            ("seeds", self.seeds, 1, MAX_SEEDS),
            ("population", self.population, 0, MAX_STEPS),
            ("generations", self.generations, 0, MAX_STEPS),
        ):
            if not least <= number <= most:
                raise GridSimError(f"--{flag} must be {least} to {most:,}, not {number}")
        runs = dataclasses.replace(self, seeds=1).planned(Path())
        if len({run.name for run in runs}) != len(runs):
            raise GridSimError("two runs would have the same name: rename a map, or name a value of --grid once")
        for run in runs:
            run.settings.check()

    def planned(self, folder: Path) -> list[PlannedRun]:
        """All runs of a comparison in that folder, in the order in which they are made."""
        found = []
        for seed, scenario, learner in itertools.product(range(self.seeds), self.scenarios, self.learners):
            for variant in self.variants(learner):
                words = [label(scenario), learner, *(f"{name}={value}" for name, value in variant.items()), f"s{seed}"]
                settings = self.settings(scenario, learner, seed, **variant)
                found.append(PlannedRun(folder / file_name("-".join(words)), settings))
        return found

    def variants(self, learner: Learner) -> list[dict[str, Any]]:
        """The combinations of `grid` for a learner, by the settings' names. Raises GridSimError."""
        plain = self.settings(self.scenarios[0], learner, 0)
        choices: list[list[tuple[str, Any]]] = []
        for text in self.grid:
            flag, _, values = text.partition("=")
            name = flag.replace("-", "_")
            planned = name in PLANNED or (name == "population" and self.population)
            if planned or name not in vars(plain):
                what = "the comparison sets it" if planned else f"{learner} has no such setting"
                raise GridSimError(f"--grid {text:.80}: {what}; vary another one, as in sigma=0.3,0.5")
            kind = type(getattr(plain, name))
            try:  # a word, such as mlp:6,7, may have commas, and begins with a letter
                words = re.split(",(?=[a-z])" if kind is str else ",", values)
                choices.append([(name, kind(float(word)) if kind is int else kind(word)) for word in words])
            except ValueError:
                raise GridSimError(f"--grid {text:.80}: give numbers, as in {flag}=1,2") from None
        return [dict(chosen) for chosen in itertools.product(*choices)]

    def settings(self, scenario: str, learner: Learner, seed: int, **variant: Any) -> RunSettings:
        """The settings of one run; `variant` is one of `variants`."""
        car_steps, _ = limits(self.budget)
        common: dict[str, Any] = {
            "scenario": scenario,
            "traffic": self.traffic,
            "seed": seed,
            "observation": self.observation,
            "until": 1.0,  # equal budgets: a run ends earlier only if its champion succeeds in every validation drive
            **variant,
        }
        if learner == "dqn":
            steps, usual = car_steps or UNLIMITED, DqnSettings(observation=self.observation).evaluate_every
            return DqnSettings(**common, car_steps=steps, evaluate_every=min(usual, max(steps // EVALUATIONS, 1)))
        return EvolveSettings(
            **{"population": self.population, **common},
            search="random" if learner == "random" else "evolution",
            recombination="two" if learner == "two-parents" else "all",
            car_steps=car_steps,
            generations=self.generations or UNLIMITED,
        )


def limits(budget: str) -> tuple[int, float]:
    """Car-steps and seconds of wall time that a run may use at most; 0 for the one that is not limited.

    Reads `20M`, `500k` or `20,000,000` car-steps; `60s`, `5min` or `1h` of wall time. Raises GridSimError.
    """
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,9})?)\s*(k|M|G|s|min|h)?", re.sub(r"(?<=\d)[,_](?=\d)", "", budget))
    amount = float(match[1]) if match else 0.0
    if match and match[2] in SECONDS:
        if 1.0 <= (seconds := round(amount * SECONDS[match[2]], 3)) <= MAX_WALL_S:
            return 0, seconds
    elif match and 1 <= (steps := round(amount * CAR_STEPS[match[2]])) <= MAX_CAR_STEPS:
        return steps, 0.0
    usage = "give car-steps, as in 20M or 500k, or wall time from 1 s to 30 days, as in 60s, 5min or 1h"
    raise GridSimError(f"--budget {budget[:40]}: {usage}")


@dataclass
class ComparisonFolder:
    """Where a comparison is kept, its plan, and when it began (s since the epoch)."""

    path: Path
    plan: Plan
    started: float = field(default_factory=time.time)

    def write(self) -> None:
        """Write comparison.json. Raises CheckpointError."""
        content = {
            "format": FORMAT,
            "command": "gridsim-compare",
            "gridsim": version("gridsim"),
            "started": self.started,
            "plan": dataclasses.asdict(self.plan),
        }
        checkpoint.write_atomic(self.path / COMPARISON, (json.dumps(content, indent=2) + "\n").encode())

    def planned(self) -> list[PlannedRun]:
        """All runs, in the order in which they are made."""
        return self.plan.planned(self.path)


def open_comparison(folder: Path) -> ComparisonFolder:
    """A comparison's folder, to be resumed or read. Raises GridSimError."""
    path = folder / COMPARISON
    if not path.is_file():
        reason = f"it has no {COMPARISON}" if folder.is_dir() else "no such folder"
        raise GridSimError(f"{folder} is not a comparison's folder: {reason}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise GridSimError(f"not a {COMPARISON} of this version of GridSim; start a new comparison")
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in content["plan"].items()
        }
        found = ComparisonFolder(folder.resolve(), Plan(**values), float(content["started"]))
        found.plan.check()
        return found
    except GridSimError as error:
        raise GridSimError(f"{path}: {error}") from error
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise GridSimError(f"{path}: damaged ({type(error).__name__}); start a new comparison") from error


def read_runs(folders: Iterable[Path]) -> list[Run]:
    """Finished runs from their folders, each once; a comparison's folder stands for its finished runs.

    Raises: GridSimError.
    """
    found: dict[Path, Run] = {}
    for folder in folders:
        paths = [folder]
        if (folder / COMPARISON).is_file():
            paths = [run.path for run in open_comparison(folder).planned() if run.finished()]
            if not paths:
                again = f"continue it with --resume {as_argument(folder)}"
                raise GridSimError(f"{folder}: none of its runs is finished; {again}")
        for path in paths:
            found.setdefault(path.resolve(), read_run(path))
    return list(found.values())
