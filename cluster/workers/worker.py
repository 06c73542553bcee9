"""What one worker does with its share of a task: a plain class that any pool can hold. No Ray in it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evolution.dqn.experience import Experience
from evolution.episodes.rollout import collect, evaluate
from evolution.networks.policy import PolicySpec
from evolution.networks.symmetry import space
from evolution.search.breeding import Mutation, breed
from gridsim.config import SimConfig
from gridsim.maps.map import Map


@dataclass(frozen=True)
class _Common:
    """What all chunks of a call share; broadcast once."""

    policy: str  # as in `mlp:6,7`
    episodes: np.ndarray  # EPISODE [episodes]
    worlds: np.ndarray  # the traffic at the start of each episode, float32 [episodes, cars, TRAFFIC_FIELDS]
    maps: tuple[tuple[str, int], ...]  # (scenario, seed) of each map that `episodes` indexes
    config: SimConfig


@dataclass(frozen=True)
class Task(_Common):
    """Members to be bred and driven. The call (`Outcome`) has their recipes, and says which drive which episodes."""

    parents: np.ndarray  # genomes float32 [parents, genes] that the recipes name
    key: int  # seed of the generation's random numbers, 64 bits
    mutation: Mutation  # how children differ from their parents
    comfort: bool = False  # whether results have figures of comfort, which take time


@dataclass(frozen=True)
class CollectTask(_Common):
    """A batch of experience: one network drives all episodes."""

    weights: np.ndarray  # float32 [genes]
    epsilons: np.ndarray  # float32 [episodes], the share of random actions in each
    keys: np.ndarray  # uint64 [episodes], the seed of each episode's random numbers


AnyTask = Task | CollectTask
Evaluated = tuple[np.ndarray, np.ndarray, np.ndarray]  # results, rewound states, rewound traffic


class Worker:
    """Breeds and drives members, or collects experience. It keeps nothing that a result depends on.

    The `maps` of its methods are those of `task.maps`, in that order.
    """

    def answer(self, task: AnyTask, maps: Sequence[Map], recipes: np.ndarray, columns: slice) -> tuple[Any, ...]:
        """Do a chunk: recipes RECIPE [n] (not used by a `CollectTask`), on the episodes `columns` of the task.

        Returns: what `evaluate` or `collect` returns, then the seconds that it took (for statistics only).
        """
        started = time.perf_counter()
        task = replace(task, episodes=task.episodes[columns], worlds=task.worlds[columns])
        if isinstance(task, CollectTask):
            task = replace(task, epsilons=task.epsilons[columns], keys=task.keys[columns])
            found: tuple[Any, ...] = self.collect(task, maps)
        else:
            found = self.evaluate(task, maps, recipes)
        return *found, time.perf_counter() - started

    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        """Breed members from recipes RECIPE [n], and drive them. Returns: as `rollout.evaluate`."""
        spec = PolicySpec.parse(task.policy)
        genomes = breed(task.parents, recipes, task.key, space(spec), task.mutation)
        return evaluate(spec, genomes, maps, task.episodes, task.config, task.worlds, task.comfort)

    def collect(self, task: CollectTask, maps: Sequence[Map]) -> tuple[Experience, np.ndarray]:
        """Drive the task's network and record its experience. Returns: as `rollout.collect`."""
        spec = PolicySpec.parse(task.policy)
        return collect(spec, task.weights, maps, task.episodes, task.epsilons, task.keys, task.config, task.worlds)
