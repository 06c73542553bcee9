"""The paper's comparison: scenarios x learners x seeds, each a training run in a folder of its own.

Runs are ordered by seed first, so that a stopped comparison has results of every learner on every road. Its plan is
kept in comparison.json.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
import uuid
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from cluster.compare.results import LEARNERS, Learner, Run, read_run
from cluster.redaction import redacted
from cluster.settings import IN_WORDS, MAX_STEPS, DqnSettings, EvolveSettings, RunSettings
from cluster.store import checkpoint
from cluster.store.folder import CHECKPOINT, CONFIG, SUMMARY, RunFolder, lock, open_run, read_config
from cluster.text import as_argument, file_name
from evolution.networks.policy import Observation
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import REGISTRY, is_map_file, label

COMPARISON = "comparison.json"
FORMAT = 2
MAX_SEEDS, MAX_CAR_STEPS, MAX_WALL_S = 1000, 10**13, 30 * 86_400.0
UNBOUND = MAX_STEPS  # generations or car-steps, if a budget ends the run
EVALUATIONS = 10  # of the DQN, at least
# Settings that other flags or the comparison itself decide, so that --grid cannot vary them.
PLANNED = (
    "scenario", "traffic", "seed", "observation", "until", "search", "recombination", "car_steps", "generations",
    "evaluate_every",
)  # fmt: skip


class Cell(RunFolder):
    """One training run of a comparison."""

    def finished(self) -> bool:
        """Whether there is a summary, the last file that a run writes."""
        return (self.path / SUMMARY).is_file()

    def check(self) -> None:
        """Raises GridSimError if the folder holds something else."""
        if (self.path / CONFIG).is_file():
            if read_config(self.path / CONFIG)[0] != self.settings:
                raise GridSimError(
                    f"{self.path} is not what {COMPARISON} asks for: one of them was edited, or another version of "
                    "GridSim wrote it; start a new comparison"
                )
        # A run that is killed while it writes its first file leaves a hidden one.
        elif self.path.is_file() or any(self.path.glob("[!.]*")):
            raise GridSimError(f"{self.path} is in the way and is not a run; move it elsewhere")

    def open(self) -> RunFolder:
        """A new run's folder, or that of a run to be resumed, after `check`. Raises RunError, CheckpointError."""
        lock(self.path)  # first: a job that outlived its comparison may still write its first checkpoint
        return open_run(self.path) if (self.path / CHECKPOINT).is_file() else self


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
            if not given:
                raise GridSimError(f"--{flag}: name at least one")
            if len(set(given)) != len(given):
                raise GridSimError(f"--{flag}: {next(n for n in given if given.count(n) > 1)} is named twice")
        for learner in self.learners:
            if learner not in LEARNERS:
                raise GridSimError(f"--learners: {learner!r:.40} is not a learner; use {', '.join(LEARNERS)}")
        if not 1 <= self.seeds <= MAX_SEEDS:
            raise GridSimError(f"--seeds must be 1 to {MAX_SEEDS:,}, not {self.seeds}")
        for flag, count in (("population", self.population), ("generations", self.generations)):
            if count < 0:
                raise GridSimError(f"--{flag} must be positive, not {count}")
        cells = dataclasses.replace(self, seeds=1).cells(Path())
        if len({cell.name for cell in cells}) != len(cells):
            raise GridSimError("two runs would have the same name: rename a map, or name a value of --grid once")
        for cell in cells:
            cell.settings.check()

    def cells(self, folder: Path) -> list[Cell]:
        """All runs of a comparison in that folder, in the order in which they are made."""
        found = []
        for seed, scenario, learner in itertools.product(range(self.seeds), self.scenarios, self.learners):
            for variant in self.variants(learner):
                words = [label(scenario), learner, *(f"{name}={value}" for name, value in variant.items()), f"s{seed}"]
                settings = self.settings(scenario, learner, seed, **variant)
                found.append(Cell(folder / file_name("-".join(words)), settings))
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
        }
        if learner == "dqn":
            steps = car_steps or UNBOUND
            usual = DqnSettings.suited[self.observation]["evaluate_every"]
            every = min(usual, max(steps // EVALUATIONS, 1))
            return DqnSettings(**common | variant, car_steps=steps, evaluate_every=every)
        if self.population:
            common["population"] = self.population
        return EvolveSettings(
            **common | variant,
            search="random" if learner == "random" else "evolution",
            recombination="two" if learner == "two-parents" else "all",
            car_steps=car_steps,
            generations=self.generations or UNBOUND,
        )


def limits(budget: str) -> tuple[int, float]:
    """Car-steps and seconds of wall time that a run may use at most; 0 for the one that is not limited.

    Reads `20M`, `500k` or `20,000,000` car-steps; `60s`, `5min` or `1h` of wall time. Raises GridSimError.
    """
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,9})?)\s*(k|M|G|s|min|h)?", re.sub(r"(?<=\d)[,_](?=\d)", "", budget))
    if not match:
        raise GridSimError(
            f"--budget {budget[:40]}: give car-steps, as in 20M or 500k, or wall time, as in 60s, 5min or 1h"
        )
    number, unit = float(match[1]), match[2] or ""
    if unit in ("s", "min", "h"):
        seconds = round(number * {"s": 1.0, "min": 60.0, "h": 3600.0}[unit], 3)
        if not 1.0 <= seconds <= MAX_WALL_S:
            raise GridSimError(f"--budget {budget[:40]}: wall time must be 1 s to 30 days")
        return 0, seconds
    steps = round(number * {"": 1, "k": 10**3, "M": 10**6, "G": 10**9}[unit])
    if not 1 <= steps <= MAX_CAR_STEPS:
        raise GridSimError(f"--budget {budget[:40]}: car-steps must be 1 to {MAX_CAR_STEPS:,}")
    return steps, 0.0


@dataclass
class ComparisonFolder:
    """Where a comparison is kept, its plan, and how its parent run is found in MLflow: the address and the key."""

    path: Path
    plan: Plan
    tracking_uri: str = ""
    tracking_key: str = field(default_factory=lambda: uuid.uuid4().hex)

    def write(self) -> None:
        """Write comparison.json. Raises CheckpointError."""
        content = {
            "format": FORMAT,
            "command": "gridsim-compare",
            "gridsim": version("gridsim"),
            "plan": dataclasses.asdict(self.plan),
            "tracking_uri": redacted(self.tracking_uri),  # MLflow gets this file, so it must not hold a password
            "tracking_key": self.tracking_key,
        }
        checkpoint.write_atomic(self.path / COMPARISON, (json.dumps(content, indent=2) + "\n").encode())


def open_comparison(folder: Path) -> ComparisonFolder:
    """A comparison's folder, to be resumed or read. Raises GridSimError."""
    path = folder / COMPARISON
    if not path.is_file():
        reason = f"it has no {COMPARISON}" if folder.is_dir() else "no such folder"
        raise GridSimError(f"{folder} is not a comparison's folder: {reason}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise GridSimError(f"not a {COMPARISON} of this GridSim")
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in content["plan"].items()
        }
        plan = Plan(**values)
        plan.check()
        uri, key = str(content.get("tracking_uri", "")), uuid.UUID(content["tracking_key"]).hex
        return ComparisonFolder(folder.resolve(), plan, uri, key)
    except GridSimError as error:
        raise GridSimError(f"{path}: {error}") from error
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise GridSimError(f"{path}: not a {COMPARISON} of this GridSim ({type(error).__name__})") from error


def read_runs(folders: Iterable[Path]) -> list[Run]:
    """Finished runs from their folders; a comparison's folder stands for its finished runs. Raises GridSimError."""
    found: list[Run] = []
    for folder in folders:
        if (folder / COMPARISON).is_file():
            comparison = open_comparison(folder)
            runs = [read_run(cell.path) for cell in comparison.plan.cells(comparison.path) if cell.finished()]
            if not runs:
                again = f"continue it with --resume {as_argument(folder)}"
                raise GridSimError(f"{folder}: none of its runs is finished; {again}")
            found += runs
        else:
            found.append(read_run(folder))
    first: dict[tuple[object, ...], Run] = {}
    for run in found:  # the same run as two seeds would make figures look more certain than they are
        same = (run.champion_sha256, run.settings.learner, run.settings.scenario, run.settings.traffic)
        other = first.setdefault(same, run)
        if other is not run:
            if other.folder.resolve() == run.folder.resolve():
                raise GridSimError(f"{run.folder.resolve()} is named twice")
            raise GridSimError(f"{other.folder} and {run.folder} are the same run, made twice; leave one out")
    return found
