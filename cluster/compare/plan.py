"""A comparison's plan: scenarios x learners x variants (of --grid) x seeds, each a training run in its own folder.

All runs of one seed come before those of the next, so that a comparison that is stopped after the first seed has
results of every learner on every road. The plan is kept in comparison.json.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from cluster.compare.results import LEARNERS, Learner, Run, read_run
from cluster.settings import IN_WORDS, MAX_STEPS, DqnSettings, EvolveSettings, RunSettings
from cluster.store import checkpoint
from cluster.store.checkpoint import SUMMARY
from cluster.store.folder import RunFolder
from cluster.text import as_argument, file_name
from evolution.networks.policy import Observation
from gridsim.config import names_file
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import REGISTRY, Traffic, full_name, label
from gridsim.packages import DISTRIBUTION

COMPARISON = "comparison.json"
MAX_SEEDS, MAX_CAR_STEPS, MAX_WALL_S = 1000, 10**13, 30 * 86_400.0
UNLIMITED = MAX_STEPS  # generations or car-steps of a run that another limit ends
CAR_STEPS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9}  # car-steps of each unit of --budget
SECONDS = {"s": 1, "min": 60, "h": 3600}  # seconds of each unit of --budget
EVALUATIONS = 10  # least number of evaluations of the DQN within a budget of car-steps
# Settings that other flags or the comparison itself decide, so that --grid cannot vary them.
PLANNED = (
    "scenario", "sim", "traffic", "seed", "observation", "until", "search", "recombination", "car_steps", "generations",
    "evaluate_every",
)  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """A comparison's plan: the fields are the command's flags, and comparison.json stores them."""

    scenarios: tuple[str, ...] = tuple(REGISTRY)
    """Roads to compare on."""
    learners: tuple[Learner, ...] = LEARNERS
    """Learners to compare."""
    seeds: int = 3
    """How many seeds, from 0 on, each is trained with; 1 with --quick."""
    observation: Observation = "rays"
    """What the networks see besides the speed: rays (31 ranges) or grid (an occupancy grid)."""
    budget: str = "60s"
    """What a run may use at most: car-steps (20M, 500k) or wall time (60s, 5min, 1h); 10s with --quick. Car-steps give
    the same networks on any machine. A run may end earlier by its learner's own stopping rule."""
    sim: Annotated[str, IN_WORDS] = ""
    """Car, sensor, episode and traffic: default, f1tenth, sedan, truck, lights, or a YAML file (docs/own.md); by
    default as for gridsim-evolve."""
    traffic: Annotated[Traffic, IN_WORDS] = -1
    """Other cars on the road: usual, heavy or a number; by default as for gridsim-evolve."""
    population: Annotated[int, IN_WORDS] = 0
    """Members of a generation, of evolution and random search; by default as for gridsim-evolve."""
    generations: Annotated[int, IN_WORDS] = 0
    """Generations at most, of evolution and random search; by default any number within the budget."""
    grid: Annotated[tuple[str, ...], IN_WORDS] = ()
    """Settings to vary, which all --learners must have: sigma=0.3,0.5 population=128,256 of evolution. Each combination
    is compared as a learner of its own."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "scenarios", tuple(map(full_name, self.scenarios)))
        if names_file(self.sim):
            object.__setattr__(self, "sim", os.path.abspath(self.sim))

    def check(self) -> None:
        """Raises GridSimError if the plan cannot be carried out; its one line says what to change."""
        if not self.scenarios or not self.learners:
            raise GridSimError("--scenarios, --learners: name at least one of each")
        if not 1 <= self.seeds <= MAX_SEEDS:
            raise GridSimError(f"--seeds must be 1 to {MAX_SEEDS:,}, not {self.seeds}")
        runs = dataclasses.replace(self, seeds=1).planned(Path())
        if len({run.name for run in runs}) != len(runs):
            raise GridSimError(
                "two runs would have the same name: give each scenario, learner and --grid value once, or rename a map"
            )
        # Evolution's settings are checked even if only the DQN runs: the DQN's lack --population and --generations.
        for settings in (self.settings(self.scenarios[0], "evolution", 0), *(run.settings for run in runs)):
            settings.check()

    def planned(self, folder: Path) -> list[RunFolder]:
        """All runs of the comparison in `folder`, in the order of their training; they may not have begun yet."""
        found = []
        for seed, scenario, learner in itertools.product(range(self.seeds), self.scenarios, self.learners):
            for variant in self.variants(learner):
                words = [label(scenario), learner, *(f"{name}={value}" for name, value in variant.items()), f"s{seed}"]
                settings = self.settings(scenario, learner, seed, **variant)
                found.append(RunFolder(folder / file_name("-".join(words)), settings))
        return found

    def variants(self, learner: Learner) -> list[dict[str, Any]]:
        """The combinations of `grid` for a learner, each as values by settings' names; [{}] without a grid.

        Raises: GridSimError.
        """
        usual = vars(self.settings(self.scenarios[0], learner, 0))
        choices: list[list[tuple[str, Any]]] = []
        for text in self.grid:
            flag, _, values = text.partition("=")
            name = flag.replace("-", "_")
            if name in PLANNED or name not in usual:
                what = f"{learner} has no such setting, or the comparison sets it"
                remedy = "vary another one, or give --learners that all have it, as in --learners evolution"
                raise GridSimError(f"--grid {text:.80}: {what}; {remedy}")
            kind = type(usual[name])
            words = re.split(",(?=[a-z])" if kind is str else ",", values)  # mlp:6,7 is one word
            try:
                choices.append([(name, kind(float(word)) if kind is int else kind(word)) for word in words])
            except (ValueError, OverflowError):
                raise GridSimError(f"--grid {text:.80}: give numbers, as in {flag}=1,2") from None
        return [dict(chosen) for chosen in itertools.product(*choices)]

    def settings(self, scenario: str, learner: Learner, seed: int, **variant: Any) -> RunSettings:
        """The settings of one run; `variant` is one of `variants`."""
        car_steps, _ = limits(self.budget)
        common: dict[str, Any] = {
            "scenario": scenario,
            "sim": self.sim,
            "traffic": self.traffic,
            "seed": seed,
            "observation": self.observation,
            "until": 1.0,  # equal budgets: success ends a run earlier only if it is in every validation drive
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

    Reads a number with a unit of CAR_STEPS or SECONDS, such as `20M`, `20,000,000` or `1.5h`: from 1 car-step or second
    to MAX_CAR_STEPS or MAX_WALL_S. Raises GridSimError for another text.
    """
    if match := re.fullmatch(r"(\d+(?:\.\d+)?) ?([a-zA-Z]*)", re.sub(r"(?<=\d)[,_](?=\d)", "", budget)):
        amount, unit = float(match[1]), match[2]
        if 1.0 <= (seconds := amount * SECONDS.get(unit, 0)) <= MAX_WALL_S:
            return 0, seconds
        if 1 <= (steps := amount * CAR_STEPS.get(unit, 0)) <= MAX_CAR_STEPS:
            return round(steps), 0.0
    usage = "give car-steps, as in 20M or 500k, or wall time from 1 s to 30 days, as in 60s, 5min or 1h"
    raise GridSimError(f"--budget {budget:.40}: {usage}")


def write_plan(folder: Path, plan: Plan) -> None:
    """Write comparison.json. Raises CheckpointError."""
    content = {"command": "gridsim-compare", "gridsim": version(DISTRIBUTION), "plan": dataclasses.asdict(plan)}
    checkpoint.write_atomic(folder / COMPARISON, (json.dumps(content, indent=2) + "\n").encode())


def read_plan(folder: Path) -> Plan:
    """The plan of a comparison's folder. Raises GridSimError."""
    path = folder / COMPARISON
    if not path.is_file():
        raise GridSimError(f"{folder} is not a comparison's folder: there is no {COMPARISON}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in content["plan"].items()}
        plan = Plan(**values)
        plan.check()
        return plan
    except GridSimError as error:
        raise GridSimError(f"{path}: {error}") from error
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise GridSimError(f"{path}: damaged, or of another version of GridSim; start a new comparison") from error


def has_summary(run: RunFolder) -> bool:
    """Whether there is a summary, the last file that a run writes."""
    return (run.path / SUMMARY).is_file()


def read_finished(folder: Path, plan: Plan) -> list[Run]:
    """The finished runs of a comparison. Raises GridSimError if one is damaged, or is not what was planned."""
    runs = []
    for planned in filter(has_summary, plan.planned(folder)):
        runs.append(read_run(planned.path))
        if runs[-1].settings != planned.settings:
            what = f"{planned.path} is not what {COMPARISON} asks for"
            raise GridSimError(f"{what}; was it edited, or made by another version? Start a new comparison")
    return runs


def read_runs(folders: Iterable[Path]) -> list[Run]:
    """Finished runs from their folders, each once; a comparison's folder stands for its finished runs.

    Raises: GridSimError, also for the same run in two folders.
    """
    runs: list[Run] = []
    for folder in folders:
        if not (folder / COMPARISON).is_file():
            runs.append(read_run(folder))
        elif finished := read_finished(folder, read_plan(folder)):
            runs += finished
        else:
            again = f"continue it with --resume {as_argument(folder)}"
            raise GridSimError(f"{folder}: none of its runs is finished; {again}")
    once: dict[tuple[RunSettings, str], Run] = {}
    for run in {run.folder.resolve(): run for run in runs}.values():
        if (other := once.setdefault((run.settings, run.champion_sha256), run)) is not run:
            raise GridSimError(f"{other.folder} and {run.folder} are the same run, made twice; leave one out")
    return list(once.values())
