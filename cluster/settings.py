"""A run's settings: the fields are the command's flags, and config.json stores them."""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args, get_origin, get_type_hints

import tyro

from cluster import fitness
from evolution.episodes.curriculum import IN_TRAFFIC, CurriculumConfig
from evolution.episodes.rollout import policy_buffers
from evolution.networks.policy import CONTINUOUS, Actions, Observation, PolicySpec
from evolution.search.base import SearchConfig
from gridsim.config import SimConfig, names_file
from gridsim.errors import GridSimError
from gridsim.maps.parts import roads_of
from gridsim.maps.scenarios import (
    ALL,
    AMOUNTS,
    REGISTRY,
    Traffic,
    check_name,
    crowds,
    full_name,
    has_lanes,
    speed_interval,
)
from gridsim.step import parameters
from gridsim.traffic.world import check_traffic

MAX_TRAFFIC = 100
MAX_STEPS = 10**15  # largest number that a flag may give for car-steps, generations, episodes and the like
SETTLED = 40  # in traffic, the search takes smaller steps from this generation on (`SearchConfig.settled`); measured
LEAST_GROUP = 16  # members that a group should have at least, so that its best ones are good

IN_WORDS = tyro.conf.arg(help_behavior_hint="")
"""For flags whose help describes the default in words."""

ROADS = f"{', '.join(REGISTRY)}, or a file of a map or a road, or a folder of them (docs/roads.md)."
SEVERAL = f"{ALL}, or several of these, separated by commas, are one driver's roads."
SCENARIO = tyro.conf.arg(help=f"Road to learn on: {ROADS[:-1]}; {SEVERAL}")

S = TypeVar("S", bound="RunSettings")


@dataclass(frozen=True)
class RunSettings(ABC):
    """What any learner's run depends on: two runs with equal settings have the same champion."""

    command: ClassVar[str]  # console script of this learner
    extendable: ClassVar[tuple[str, ...]]  # limits that --resume may raise
    step_name: ClassVar[str]  # what a step of learning is called
    verb: ClassVar[str]  # what is done to a network

    scenario: Annotated[str, SCENARIO] = "seamless"
    traffic: Annotated[Traffic, IN_WORDS] = -1
    """Other cars on the road: usual, heavy (twice as many) or a number. By default as each road has it (docs/roads.md),
    on several roads usual."""
    sim: Annotated[str, IN_WORDS] = ""
    """Car, sensor, episode and traffic: default, f1tenth, sedan, truck, lights (default, but city has traffic lights)
    or a YAML file (docs/own.md); by default lights where city is one of several roads, else default."""
    seed: int = 0
    """Seed of every random number of the run."""
    observation: Observation = "rays"
    """What the network sees besides the speed: rays (31 ranges) or grid (an occupancy grid)."""
    policy: Annotated[str, IN_WORDS] = ""
    """Network; by default one that suits the observation."""
    car_steps: Annotated[int, IN_WORDS] = 0
    """Car-steps at most; the last generation may exceed it. By default 60 million a road, and any number with
    --generations."""
    until: float = 0.99
    """Stop when the champion succeeds in this share of validation episodes, at --pace or faster; above 1: never. With
    several roads the worst one counts."""

    pace: Annotated[float, IN_WORDS] = 0.0
    """Mean speed in m/s below which success counts for less; training's time limits follow from it. By default a little
    above the lower end of the road's speed interval (docs/roads.md)."""

    def __post_init__(self) -> None:
        for name in ("scenario", "sim"):
            value: Any = getattr(self, name)
            if isinstance(value, os.PathLike):
                object.__setattr__(self, name, os.fspath(value))
            elif not isinstance(value, str):
                raise GridSimError(f"setting {name!r} must be a name or a file's path, not a {type(value).__name__}")
        object.__setattr__(self, "scenario", full_name(self.scenario))  # config.json may be read from another folder
        if not self.sim:
            roads = roads_of(self.scenario)
            object.__setattr__(self, "sim", "lights" if len(roads) > 1 and "city" in roads else "default")
        if names_file(self.sim):
            object.__setattr__(self, "sim", os.path.abspath(self.sim))
        cars = crowds(self.scenario, None if self.traffic == -1 else self.traffic, self.simulator())
        if len(cars) == 1 or not any(cars):
            object.__setattr__(self, "traffic", cars[0])
        elif self.traffic == -1:
            object.__setattr__(self, "traffic", "usual")
        for name, value in self.defaults().items():
            if not getattr(self, name):
                object.__setattr__(self, name, value)

    @abstractmethod
    def defaults(self) -> dict[str, Any]:
        """Values, by name, that replace 0 or "" in the settings named here, when settings are made."""

    @property
    @abstractmethod
    def algorithm(self) -> str:
        """What learns: evolution, random or dqn."""

    @property
    def learner(self) -> str:
        """The learner's name in a comparison. Unlike `algorithm`, it tells apart the two kinds of recombination."""
        return self.algorithm

    def simulator(self) -> SimConfig:
        """The simulator's numbers. Raises GridSimError."""
        return SimConfig.load(self.sim)

    @property
    def crowds(self) -> tuple[int, ...]:
        """Number of other cars on each of the scenario's roads."""
        return crowds(self.scenario, self.traffic, self.simulator())

    @property
    def _sees_besides(self) -> str:
        """End of the default policy: a driver of several roads sees the speed limit; in traffic it has mirrors, too."""
        return ("+limit" + "+mirrors" * any(self.crowds)) if len(self.crowds) > 1 else ""

    def curriculum(self) -> CurriculumConfig:
        """The curriculum of a run with these settings: it suits the roads, the car's size, and traffic, if any."""
        special = IN_TRAFFIC if any(self.crowds) else {}
        sim, roads, usual = self.simulator(), roads_of(self.scenario), CurriculumConfig(**special)
        lows = [speed_interval(road, sim)[0] for road in roads]
        above = [(0.8, 0.3) if cars else (2.0, 0.85) for cars in self.crowds]
        pace, champion_pace = (
            tuple(low + more[k] * sim.pace for low, more in zip(lows, above, strict=True)) for k in range(2)
        )
        if self.pace:
            pace, champion_pace = (self.pace + 1.15 * sim.pace,), (self.pace,)
        metres = {name: getattr(usual, name) * sim.unit for name in ("crash_target", "first_target", "last_target")}
        # `usual.rewind` counts control steps of 0.1 s.
        rewind = max(round(usual.rewind * 0.1 * sim.pace / sim.episode.control_period), 1)
        return replace(
            usual, pace=pace, champion_pace=champion_pace, first_maps=usual.first_maps * len(roads),
            **metres, rewind=rewind, slack=usual.slack * sim.pace,
            validation=max(CurriculumConfig.validation, usual.validation // len(roads)),
        )  # fmt: skip

    def extending(self, base: RunSettings) -> Self:
        """These settings, changed for continuing a run that had the settings `base`.

        If the user has raised --generations, car-steps that are only the default are no limit any more; nothing else
        changes.
        """
        return self

    def ended(self, so_far: Mapping[str, Any]) -> bool:
        """Whether a run with these counters (`Learning.counts`, and `solved`) is finished."""
        return bool(so_far["solved"]) or 0 < self.car_steps <= int(so_far["car_steps"])

    def check(self, sim: SimConfig | None = None) -> None:
        """Raises GridSimError if no run can have these settings; its one line says what to change.

        Args: `sim`, the simulator's numbers in place of those that the settings name.
        """
        _check_types(type(self), vars(self))
        check_name(self.scenario)
        sim, roads = sim or self.simulator(), roads_of(self.scenario)
        if not all(0 <= cars <= MAX_TRAFFIC for cars in self.crowds):
            raise GridSimError(f"--traffic must be 0 to {MAX_TRAFFIC}, not {self.traffic}")
        if any(self.crowds) and (without := [road for road in roads if not has_lanes(road)]):
            remedy = "use --traffic 0" + (", or leave it out of --scenario" if len(roads) > 1 else "")
            raise GridSimError(f"--traffic {self.traffic}: {without[0]} has no lanes for traffic; {remedy}")
        check_traffic(max(self.crowds), sim)
        (low, high), *_ = [speed_interval(road, sim) for road in roads]  # of the first road; reads the map files of all
        self._check_range(0, (1 << 63) - 1, "seed")
        self._check_range(0, MAX_STEPS, "car_steps")
        self._check_positive("until")
        if self.pace and len(roads) > 1:
            raise GridSimError(
                f"--pace {self.pace:g}: each of the {len(roads)} roads has a pace of its own; leave it out"
            )
        if self.pace and not low <= self.pace <= high:
            raise GridSimError(f"--pace must be {low:g} to {high:g} on {self.scenario}, not {self.pace:g}")
        spec = PolicySpec.parse(self.policy)
        if "route" in spec.features and not has_lanes(self.scenario):
            raise GridSimError(f"--policy {self.policy}: {self.scenario} has no lanes to follow; leave out +route")
        if spec.observation != self.observation:
            remedy = f"give --observation {spec.observation}, or a policy such as {self.defaults()['policy']}"
            raise GridSimError(f"policy {self.policy} sees the {spec.observation}; {remedy}")
        parameters(sim)  # raises for an unknown model of the vehicle
        policy_buffers(spec, sim)  # raises for a sensor whose rays do not fit the network

    def _check_range(self, least: float, most: float, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            if not least <= value <= most:
                raise GridSimError(f"--{name.replace('_', '-')} must be {least:,} to {most:,}, not {value:,}")

    def _check_positive(self, *names: str) -> None:
        for name in names:
            if not 0.0 < getattr(self, name) < math.inf:
                raise GridSimError(f"--{name.replace('_', '-')} must be above 0, not {getattr(self, name)}")


@dataclass(frozen=True)
class EvolveSettings(RunSettings):
    """What an evolution run depends on."""

    command: ClassVar[str] = "gridsim-evolve"
    extendable: ClassVar[tuple[str, ...]] = ("generations", "car_steps")
    step_name: ClassVar[str] = "generation"
    verb: ClassVar[str] = "evolving"

    compute: int = 1
    """How many times the usual compute: car-steps grow with it, population and validation with its square root. For a
    cluster, about its workers divided by two; the champion depends on this number, not on the workers."""
    policy: Annotated[str, IN_WORDS] = ""
    """Network: mlp: and the sizes of its hidden layers, then in this order +motion to see how fast the cars that rays
    hit approach, +steering its own steering angle, +route where a route leads that it has to follow, +limit the road's
    speed limit, +mirrors how far behind other cars are on either side; by default mlp:64+steering, in traffic
    mlp:128+motion+steering, on several roads with +limit, and +mirrors in traffic (the paper's is mlp:6,7). On the grid
    cnn: with the channels of two convolutions, the units of a dense layer and the number of frames, by default
    cnn:8,16,32@1."""
    actions: Actions = "discrete"
    """What the network decides: discrete, one of the paper's eight actions, or continuous, pedal and wheel."""
    population: Annotated[int, IN_WORDS] = 0
    """Members of a generation; by default 256, in traffic 128, where each drives more episodes."""
    generations: Annotated[int, IN_WORDS] = 0
    """Generations at most; by default any number. A run whose champion reaches --until stops earlier."""
    recombination: Literal["all", "two"] = "all"
    """all: the winners of all tournaments are averaged into one centre (an evolution strategy); two: each child
    has two parents (the classic genetic algorithm)."""
    tournament: int = 4
    """Members of a tournament; more select more strictly."""
    sigma: float = 0.5
    """Standard deviation of mutation; with --recombination all the first one, which then adapts."""
    elites: int = 8
    """With --recombination two: members that are copied unchanged into the next generation."""
    mutation_rate: float = 0.03
    """With --recombination two: share of a child's genes that are mutated."""
    search: Literal["evolution", "random"] = "evolution"
    """evolution, or random: new random genomes in each generation, as a baseline."""
    fitness: Annotated[str, IN_WORDS] = ""
    """An objective of your own: MODULE:FUNCTION or FILE.py:FUNCTION (docs/own.md). The champion is chosen by success,
    up to --until, and then by this; the run goes on to its limit, --generations or --car-steps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "fitness", fitness.absolute(self.fitness))
        if self.actions == "continuous":  # the policy's text goes wherever the network does, and so has to say it
            object.__setattr__(self, "policy", self.policy.removesuffix(CONTINUOUS) + CONTINUOUS)

    def defaults(self) -> dict[str, Any]:
        alone, compute = not any(self.crowds), max(self.compute, 1)  # `check` refuses less than 1
        rays = ("mlp:64+steering" if alone else "mlp:128+motion+steering") + self._sees_besides
        usual = SearchConfig.population if alone else 128
        return {
            "policy": "cnn:8,16,32@1" if self.observation == "grid" else rays,
            "population": round(usual * math.sqrt(compute)),
            "car_steps": 0 if self.generations else 60_000_000 * compute * len(self.crowds),
        }

    @property
    def algorithm(self) -> str:
        return self.search

    @property
    def learner(self) -> str:
        return "two-parents" if (self.search, self.recombination) == ("evolution", "two") else self.search

    def search_config(self) -> SearchConfig:
        """The search's parameters."""
        return SearchConfig(
            self.population, self.curriculum().groups, self.tournament, self.sigma,
            SETTLED if any(self.crowds) else 0, self.elites, self.mutation_rate,
        )  # fmt: skip

    def curriculum(self) -> CurriculumConfig:
        usual = super().curriculum()
        groups = max(1, min(usual.groups, self.population // LEAST_GROUP))
        return replace(usual, groups=groups, validation=round(usual.validation * math.sqrt(self.compute)))

    def extending(self, base: RunSettings) -> Self:
        longer = isinstance(base, EvolveSettings) and self.generations > base.generations
        # As for a new run that is given --generations: the default car-steps do not apply.
        usual = replace(self, generations=0, car_steps=0).car_steps
        return replace(self, car_steps=0) if longer and self.car_steps == base.car_steps == usual else self

    def ended(self, so_far: Mapping[str, Any]) -> bool:
        return super().ended(so_far) or 0 < self.generations <= int(so_far["generation"])

    def check(self, sim: SimConfig | None = None) -> None:
        super().check(sim)
        if PolicySpec.parse(self.policy).actions != self.actions:
            raise GridSimError(f"policy {self.policy} sets pedal and wheel; give --actions continuous, too")
        self._check_range(0, MAX_STEPS, "generations")
        self._check_range(1, 10_000, "compute")
        self._check_range(4, 1_000_000, "population")
        self._check_range(0, 1, "mutation_rate")
        classic = self.recombination == "two" or self.search == "random"
        for name in ("elites", "mutation_rate"):
            if not classic and getattr(self, name) != getattr(EvolveSettings, name):
                raise GridSimError(f"--{name.replace('_', '-')} is for --recombination two; add that, or leave it out")
        self._check_range(0, min(10_000, self.population - 1) if classic else 10_000, "elites")
        self._check_range(1, MAX_STEPS, "tournament")
        self._check_positive("sigma")


@dataclass(frozen=True)
class DqnSettings(RunSettings):
    """What a run of the DQN depends on."""

    command: ClassVar[str] = "gridsim-dqn"
    extendable: ClassVar[tuple[str, ...]] = ("car_steps", "episodes")
    step_name: ClassVar[str] = "evaluation"
    verb: ClassVar[str] = "training"

    policy: Annotated[str, IN_WORDS] = ""
    """Network of the Q function: mlp: and the sizes of its hidden layers, and what else it sees as for gridsim-evolve,
    by default mlp:64,64+steering, on several roads with +limit, and +mirrors in traffic; on the grid cnn: with the
    channels of two convolutions, the units of a dense layer and the number of frames, by default cnn:16,32,256@4."""
    car_steps: int = 40_000_000
    """Car-steps at most; those that are driven at once (some 33,000) and the evaluation after them may exceed it."""
    episodes: Annotated[int, IN_WORDS] = 0
    """Training episodes at most, by default any number; those that are driven at once may exceed it."""
    converged: float = 0.01
    """Stop when the Q values of fixed observations change by less than this share of their spread from one evaluation
    to the next, three times in a row; 0: never."""
    evaluate_every: Annotated[int, IN_WORDS] = 0
    """Car-steps from one evaluation to the next; by default a million, on the grid 250,000."""
    batch: Annotated[int, IN_WORDS] = 0
    """Transitions of one update; by default 256, on the grid 64."""
    updates: Annotated[float, IN_WORDS] = 0.0
    """Updates for each thousand car-steps collected; by default 4, on the grid 16."""
    replay: Annotated[int, IN_WORDS] = 0
    """Observations that the replay buffer holds; by default a million, of grids a hundred thousand."""
    discount: float = 0.99
    """Discount factor of a step."""
    learning_rate: Annotated[float, IN_WORDS] = 0.0
    """Adam's learning rate at the start; it falls to a twentieth over --anneal. By default 0.001, on the grid
    0.0005."""
    anneal: Annotated[int, IN_WORDS] = 0
    """Car-steps over which the learning rate falls; in the first fiftieth, exploration falls from random driving to
    --epsilon. By default 30 million, on the grid 4 million."""
    target_period: Annotated[int, IN_WORDS] = 0
    """Updates from one copy of the target network to the next; by default 200, on the grid 500."""
    epsilon: float = 0.4
    """Final share of random actions in the episode that explores most of those driven at once; the others explore less
    (Horgan et al. 2018)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the learner computes: auto, cpu or cuda."""

    def defaults(self) -> dict[str, Any]:
        # An update on grids takes a hundred times as long as one on rays, so that half an hour is enough for 2 million
        # car-steps, not 400 million.
        if self.observation == "grid":
            return {
                "policy": "cnn:16,32,256@4", "replay": 100_000, "batch": 64, "updates": 16.0, "learning_rate": 5e-4,
                "anneal": 4_000_000, "target_period": 500, "evaluate_every": 250_000,
            }  # fmt: skip
        return {
            "policy": "mlp:64,64+steering" + self._sees_besides,
            "replay": 1_000_000, "batch": 256, "updates": 4.0, "learning_rate": 1e-3,
            "anneal": 30_000_000, "target_period": 200, "evaluate_every": 1_000_000,
        }  # fmt: skip

    @property
    def algorithm(self) -> str:
        return "dqn"

    def ended(self, so_far: Mapping[str, Any]) -> bool:
        return super().ended(so_far) or bool(so_far["converged"]) or 0 < self.episodes <= int(so_far["episodes"])

    def check(self, sim: SimConfig | None = None) -> None:
        super().check(sim)
        if PolicySpec.parse(self.policy).actions == "continuous":
            raise GridSimError(f"policy {self.policy}: the DQN chooses among the eight actions; leave out {CONTINUOUS}")
        self._check_range(1, MAX_STEPS, "evaluate_every", "batch", "anneal", "target_period")
        self._check_range(0, MAX_STEPS, "episodes")
        self._check_range(0, 1, "discount", "epsilon", "converged")
        self._check_positive("updates", "learning_rate")
        self._check_range(0, 1_000_000, "updates")
        # The buffer must hold a batch, and more rows than the network sees frames.
        least = max(self.batch, getattr(PolicySpec.parse(self.policy), "frames", 1) + 1)
        self._check_range(least, 10_000_000, "replay")


SETTINGS: dict[str, type[RunSettings]] = {kind.command: kind for kind in (EvolveSettings, DqnSettings)}


def check_workers(workers: int, patience_s: float) -> None:
    """Raises GridSimError if a run cannot be computed with these values; no result depends on them."""
    if not 0 <= workers <= 10_000:
        raise GridSimError(f"--workers must be 0 to 10,000, not {workers}")
    if not 0.0 <= patience_s < math.inf:
        raise GridSimError(f"--patience must be 0 or more, not {patience_s:g}")


def from_dict(kind: type[S], values: dict[str, Any]) -> S:
    """Settings from what `dataclasses.asdict` made of them, with defaults for what is missing.

    Raises GridSimError for names, types or values that do not fit.
    """
    _check_types(kind, values)
    settings = kind(**values)
    settings.check()
    return settings


def _check_types(kind: type[RunSettings], values: Mapping[str, Any]) -> None:
    """Raises GridSimError for an unknown name, a wrong type, or a word that a setting does not offer."""
    usual, hints = vars(kind()), get_type_hints(kind)
    for name, value in values.items():
        if name not in usual:
            raise GridSimError(f"unknown setting {name!r}, perhaps of another version of GridSim; start a new run")
        wanted, choices = type(usual[name]), get_args(hints[name])
        if name == "traffic" and value in AMOUNTS:
            continue
        if type(value) is not wanted and not (wanted is float and type(value) is int):
            raise GridSimError(f"setting {name!r} must be {wanted.__name__}, not {value!r}")
        if get_origin(hints[name]) is Literal and value not in choices:
            raise GridSimError(f"--{name.replace('_', '-')} must be {' or '.join(choices)}, not {value}")
