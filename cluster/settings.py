"""What a run was asked to do: the fields are the command's flags, and config.json is them written down."""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from typing import Any, Literal

from evolution.curriculum import CurriculumConfig
from evolution.genetic import GeneticConfig
from evolution.policy import Observation, PolicySpec
from gridsim.scenarios import build, check_name, default_traffic, is_map_file, speed_interval

MAX_POPULATION = 1_000_000
MAX_TRAFFIC = 100
DEFAULT_POLICY: dict[Observation, str] = {"rays": "mlp:6,7", "grid": "cnn:8,16,32@1"}


class SettingsError(ValueError):
    """Settings that make no sense; the message is one line for the user."""


@dataclass(frozen=True)
class EvolveSettings:
    """What an evolution run depends on: two runs with equal settings have the same champion."""

    scenario: str = "seamless"
    """Road to learn to drive on: its name, or a map's file (.yaml of map_server's form, or a picture; docs/maps.md)."""
    traffic: int = -1
    """Other cars on the road; -1: as many as the scenario has by default. A map from a file has no lanes for them."""
    seed: int = 0
    """Seed of every random number of the run."""
    observation: Observation = "rays"
    """What the network sees: 31 ranges, or the occupancy grid; and the speed."""
    policy: str = ""
    """Network: mlp: and the sizes of its hidden layers, by default mlp:6,7; on the grid cnn: with the channels of two
    convolutions, the units of a dense layer and the number of frames, by default cnn:8,16,32@1."""
    population: int = 512
    """Members of a generation."""
    generations: int = 120
    """Generations at most; a run whose champion is solved stops earlier."""
    car_steps: int = 0
    """Car-steps at most, checked after each generation; 0: any number."""
    elites: int = 8
    """Members that go on unmodified."""
    tournament: int = 8
    """Members drawn for each tournament."""
    parents: int = 64
    """Size of the mating pool, which bounds what is sent to the workers."""
    crossover: float = 0.5
    """Share of children with two parents."""
    mutation_rate: float = 0.03
    """Share of a child's genes that are mutated."""
    sigma: float = 0.5
    """Standard deviation of mutation, while episodes are short."""
    bump_rate: float = 0.3
    """Share of children of which one hidden unit's view is changed across neighbouring rays."""
    ranking: Literal["scalar", "pareto"] = "scalar"
    """How members are ranked: by one number, or by non-dominated sorting of the two elements."""
    search: Literal["evolution", "random"] = "evolution"
    """random: new random genomes in every generation, the baseline that evolution must beat."""
    until: float = 0.985
    """Stop when the champion succeeds in this share of validation episodes, at a fair pace; above 1: never."""

    def __post_init__(self) -> None:
        if is_map_file(self.scenario):  # absolute: what is written down is read again from anywhere
            object.__setattr__(self, "scenario", os.path.abspath(self.scenario))
        if self.traffic == -1:
            object.__setattr__(self, "traffic", default_traffic(self.scenario))
        if not self.policy:
            object.__setattr__(self, "policy", DEFAULT_POLICY.get(self.observation, ""))

    def curriculum(self) -> CurriculumConfig:
        """The curriculum of such a run: its paces are those of the scenario, and of traffic where there is any."""
        low, _ = speed_interval(self.scenario)
        if self.traffic:
            return CurriculumConfig(pace=low + 0.8, champion_pace=low + 0.3)
        return CurriculumConfig(pace=low + 2.0, champion_pace=low + 0.85)

    def check(self) -> None:
        """Raises SettingsError, one line that says what to change."""
        try:
            check_name(self.scenario)
            if is_map_file(self.scenario):
                build(self.scenario, 0)  # kept, so that it is read once
        except ValueError as error:
            raise SettingsError(str(error)) from error
        if not 0 <= self.traffic <= MAX_TRAFFIC:
            raise SettingsError(f"--traffic must be 0 to {MAX_TRAFFIC}, not {self.traffic}")
        if self.traffic and is_map_file(self.scenario):
            raise SettingsError(f"--traffic {self.traffic}: {self.scenario} has no lanes for traffic; use --traffic 0")
        if not 0 <= self.seed < 1 << 63:
            raise SettingsError(f"--seed must be 0 or more, not {self.seed}")
        if self.car_steps < 0:
            raise SettingsError(f"--car-steps must be 0 or more, not {self.car_steps}")
        if self.generations < 1:
            raise SettingsError(f"--generations must be 1 or more, not {self.generations}")
        if self.population > MAX_POPULATION:
            raise SettingsError(f"--population must be {MAX_POPULATION:,} or less, not {self.population:,}")
        for name in ("crossover", "mutation_rate", "bump_rate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SettingsError(f"--{name.replace('_', '-')} must be 0 to 1, not {getattr(self, name)}")
        if not 0.0 <= self.sigma < math.inf:
            raise SettingsError(f"--sigma must be 0 or more, not {self.sigma}")
        if not self.until > 0.0:
            raise SettingsError(f"--until must be above 0, not {self.until}")
        try:
            spec = PolicySpec.parse(self.policy)
            GeneticConfig(self.population, self.elites, self.tournament, self.parents, self.crossover).check()
        except ValueError as error:
            raise SettingsError(str(error)) from error
        if spec.observation != self.observation:
            raise SettingsError(
                f"policy {self.policy} sees the {spec.observation}; "
                f"give --observation {spec.observation}, or a policy such as {DEFAULT_POLICY[self.observation]}"
            )


def to_dict(settings: EvolveSettings) -> dict[str, Any]:
    """Plain numbers and strings."""
    return dataclasses.asdict(settings)


def from_dict(values: dict[str, Any]) -> EvolveSettings:
    """The inverse of `to_dict`. Raises SettingsError for names or types that do not fit."""
    fields = {f.name: f for f in dataclasses.fields(EvolveSettings)}
    unknown = sorted(set(values) - set(fields))
    if unknown:
        raise SettingsError(f"unknown setting {unknown[0]!r}")
    defaults = EvolveSettings()
    for name, value in values.items():
        wanted = type(getattr(defaults, name))
        if wanted is float and isinstance(value, int) and not isinstance(value, bool):
            value = values[name] = float(value)
        if type(value) is not wanted:
            raise SettingsError(f"setting {name!r} must be {wanted.__name__}, not {value!r}")
    settings = EvolveSettings(**values)
    if settings.ranking not in ("scalar", "pareto") or settings.search not in ("evolution", "random"):
        raise SettingsError("ranking is scalar or pareto, search is evolution or random")
    if settings.observation not in DEFAULT_POLICY:
        raise SettingsError("observation is rays or grid")
    settings.check()
    return settings
