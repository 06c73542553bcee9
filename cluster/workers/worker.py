"""What one worker does with its share of a task: a plain class that any pool can hold. No Ray in it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evolution.dqn.experience import Experience
from evolution.episodes.collecting import collect
from evolution.episodes.rollout import Limits, evaluate
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import Mutation, breed
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.roads import freeze


@dataclass(frozen=True)
class Task:
    """What all chunks of one generation share; broadcast once. Its arrays become read-only.

    Attributes:
        policy: the network, as in `mlp:6,7`.
        parents: genomes float32 [parents, genes] that the recipes name.
        key: the generation's number for breeding, 64 bits.
        mutation: how children differ from their parents.
        episodes: EPISODE [episodes]; who drives which of them is the call's affair.
        worlds: the traffic that each begins with, float32 [episodes, cars, world.FIELDS].
        maps: (scenario, seed) of each map that `episodes` indexes.
        limits: where an episode ends if nothing happens.
        config: the simulator's.
    """

    policy: str
    parents: np.ndarray
    key: int
    mutation: Mutation
    episodes: np.ndarray
    worlds: np.ndarray
    maps: tuple[tuple[str, int], ...]
    limits: Limits
    config: SimConfig

    def __post_init__(self) -> None:
        # What comes out of the object store is read-only. Numba compiles once more for what is not, so no pool has it.
        freeze(self.parents)
        freeze(self.episodes)
        freeze(self.worlds)


@dataclass(frozen=True)
class CollectTask:
    """What all chunks of a batch of experience share; broadcast once. Its arrays become read-only.

    Attributes:
        policy: the network, as in `mlp:64,64`.
        weights: float32 [genes].
        episodes: EPISODE [episodes].
        worlds: the traffic that each begins with, float32 [episodes, cars, world.FIELDS].
        maps: (scenario, seed) of each map that `episodes` indexes.
        epsilons: float32 [episodes], the share of random actions in each.
        keys: uint64 [episodes], of the random numbers of each.
        limits: where an episode ends if nothing happens.
        config: the simulator's.
    """

    policy: str
    weights: np.ndarray
    episodes: np.ndarray
    worlds: np.ndarray
    maps: tuple[tuple[str, int], ...]
    epsilons: np.ndarray
    keys: np.ndarray
    limits: Limits
    config: SimConfig

    def __post_init__(self) -> None:
        for array in (self.weights, self.episodes, self.worlds, self.epsilons, self.keys):
            freeze(array)  # as a Task's


class Worker:
    """Breeds and drives members, or collects experience. It keeps nothing that a result depends on."""

    def evaluate(
        self, task: Task, maps: Sequence[Map], recipes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """What `rollout.evaluate` returns of recipes RECIPE [n], and the seconds it took (for statistics only).

        `maps` are those of `task.maps`, in that order.
        """
        started = time.perf_counter()
        spec = PolicySpec.parse(task.policy)
        genomes = breed(task.parents, recipes, task.key, spec, task.mutation)
        found = evaluate(spec, genomes, maps, task.episodes, task.limits, task.config, task.worlds)
        return *found, time.perf_counter() - started

    def collect(
        self, task: CollectTask, maps: Sequence[Map], first: int, stop: int
    ) -> tuple[Experience, np.ndarray, float]:
        """Experience and RESULT [stop - first] of the task's episodes from `first` on, and the seconds it took.

        `maps` are those of `task.maps`, in that order.
        """
        started = time.perf_counter()
        these = slice(first, stop)
        experience, results = collect(
            PolicySpec.parse(task.policy),
            task.weights,
            maps,
            task.episodes[these],
            task.epsilons[these],
            task.keys[these],
            task.limits,
            task.config,
            task.worlds[these],
        )
        return experience, results, time.perf_counter() - started
