"""The curriculum: the episodes of each generation, and validation, which chooses the champion.

Episodes begin short, since at first the best members drive into the first bend at full speed, and their length doubles
when the leader (the best genome known before a generation) succeeds. Once there are crashes, half of the episodes, in
traffic most of them, start shortly before a crash of an earlier leader. There is most to learn where half of the
members crash again, so such starts are the likeliest. Each group of members has episodes of its own, so that selection
uses many although each member drives few. With several roads, the episodes are on each of them in turn.

The state is arrays and numbers; random numbers depend only on (seed, generation).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from evolution.episodes.rollout import EPISODE
from evolution.episodes.starts import Episodes, lane_starts
from evolution.search.base import SearchConfig
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.parts import HELD_OUT_SEED, TRAINING_SEED, VALIDATION_SEED, road_number, seed_on
from gridsim.state import TERMINATES, End

HELD_OUT_SEEDS = range(HELD_OUT_SEED, HELD_OUT_SEED + 16)  # of maps
HELD_OUT_EPISODES = 64
VALIDATION_SEEDS = range(VALIDATION_SEED, VALIDATION_SEED + 48)  # of maps
FINAL_SEEDS = range(VALIDATION_SEED + 48, VALIDATION_SEED + 96)  # of maps, to choose champions when runs end unsolved
LEAST_CRASH_WEIGHT = 0.05  # floor of the weight 4p(1 - p) of a crash start, p the share of members that fail there


@dataclass(frozen=True)
class CurriculumConfig:
    """The curriculum's parameters."""

    maps: int = 128  # training maps
    first_maps: int = 4  # training maps that the first generation uses; each later generation uses one more
    groups: int = SearchConfig.groups  # of members, each with episodes of its own
    starts: int = 1  # new episodes for each group and generation
    crash_starts: int = 1  # short episodes for each group and generation that start before a crash of a recent leader
    crash_target: float = 120.0  # m, target of crash starts, or the current target if that is less
    crash_memory: int = 24  # crashes that are remembered
    crowd: float = 2.0  # factor on the number of other cars in training, for more encounters over the same distance
    rewind: int = 40  # control steps from a crash start to the crash
    leader_episodes: int = 16  # episodes of the leader in each generation
    leader_stretch: float = 2.5  # target of the leader's episodes, relative to the members'
    first_target: float = 150.0  # m, target of the first episodes
    last_target: float = 400.0  # m, largest target of members' episodes; more starts teach as much as longer episodes
    growth: float = 0.6  # share of the leader's episodes that must reach the members' target before it doubles
    # Of each road, m/s: mean speed that a training episode's time limit requires. The default is for `seamless`.
    pace: tuple[float, ...] = (7.0,)
    slack: float = 3.0  # s, added to the time limit that follows from `pace`
    # The leader is validated only if recent leaders' mean success rate is at least this, and at least the champion's.
    promising: float = 0.5
    latest: int = 4  # generations whose leaders' success rates are averaged for `promising`
    validation_share: float = 0.25  # share of validation in all car-steps, above which leaders are not validated
    validation: int = 256  # episodes of validation on each road
    champion_pace: tuple[float, ...] = (5.85,)  # of each road, m/s: mean speed below which success counts for less


# What differs in traffic. There, crashes become rare long before the search has learned all that it could from them, so
# most episodes start before one of many crashes. Validation is long enough to tell 1 % of failures from 2 %.
IN_TRAFFIC: dict[str, Any] = {
    "starts": 1,
    "crash_starts": 8,
    "crash_memory": 512,
    "leader_episodes": 64,
    "validation": 1024,
}


def spread_starts(
    build: Callable[[int], Map], seeds: range, episodes: int, crowds: Sequence[int], config: SimConfig, room: int = 0
) -> Episodes:
    """Episodes with the full target and time limit: `episodes` on each road, one road after the other.

    A road's episodes take turns on its maps of `seeds`, and do not depend on the other roads. Args: `build` makes the
    map of a seed; `crowds`, the number of other cars on each road; `room`, the least number of cars in the arrays, as
    in `lane_starts`.
    """
    used, roads = np.arange(episodes) % len(seeds), list[Episodes]()
    for k, traffic in enumerate(crowds):
        rng = np.random.default_rng(np.random.SeedSequence([seeds.start, episodes]))
        maps = [seed_on(k, len(crowds), seed) for seed in seeds]
        starts = lane_starts([build(seed) for seed in maps], used, rng, traffic, config, max(room, *crowds))
        roads.append(Episodes(maps, *starts))
    return reduce(Episodes.and_then, roads)


class Curriculum:
    """The curriculum of one run: its target, crashes, training maps and validation."""

    def __init__(
        self, config: CurriculumConfig, seed: int, build: Callable[[int], Map], sim: SimConfig,
        crowds: Sequence[int] = (0,),
    ):  # fmt: skip
        """Args: `build` makes the map of a seed; `crowds`, the usual number of other cars on each road."""
        self.config, self.seed, self.build, self.sim = config, seed, build, sim
        self.roads, self.crowds = len(crowds), crowds
        self.training_crowds = [round(config.crowd * cars) for cars in crowds]
        self.goal, self.period = sim.episode.target, sim.episode.control_period
        self.target = min(config.first_target, self.goal)
        self.crashes, self.crash_worlds = self._starts([], np.zeros(0, dtype=int), np.random.default_rng(0))
        self.failures = np.zeros(0)  # [crashes], moving average of the share of members that fail there
        self._validation: dict[range, Episodes] = {}
        rng, seeds = np.random.default_rng(np.random.SeedSequence([seed, 11])), VALIDATION_SEED - TRAINING_SEED
        own = TRAINING_SEED + rng.choice(seeds // self.roads, config.maps, replace=False)
        # The k-th training map is of road k modulo the number of roads.
        self.map_seeds = [seed_on(k % self.roads, self.roads, each) for k, each in enumerate(own.tolist())]

    def _rng(self, generation: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.seed, generation, 12, purpose]))

    def _starts(
        self, seeds: Sequence[int], maps: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Training episodes and their traffic; `maps` [e] gives the map of each as an index into `seeds`."""
        cars, room = [self.training_crowds[road_number(seed, self.roads)] for seed in seeds], max(self.training_crowds)
        return lane_starts([self.build(seed) for seed in seeds], maps, rng, cars, self.sim, room)

    def maps_in_use(self, generation: int) -> int:
        """Number of training maps in use."""
        return min(self.config.maps, self.config.first_maps + generation)

    def _limit(self, episodes: np.ndarray, seeds: Sequence[int], target: float) -> None:
        """Set the target (m) of training episodes EPISODE [e], and the time limits that follow from it and the pace.

        Args: `seeds`, of the maps that the episodes index.
        """
        pace = np.array(self.config.pace)[[road_number(seeds[m], self.roads) for m in episodes["map"]]]
        episodes["target"] = target
        episodes["steps"] = np.ceil((target / pace + self.config.slack) / self.period)

    def _some_maps(self, generation: int, count: int, rng: np.random.Generator, first: int) -> np.ndarray:
        """Training maps [count] as indices into `map_seeds`; without repetition if there are enough.

        The k-th one is of road first + k, modulo the number of roads.
        """
        roads, maps = (first + np.arange(count)) % self.roads, np.empty(count, dtype=np.int64)
        for road in np.unique(roads):
            n, of = len(range(road, self.maps_in_use(generation), self.roads)), roads == road
            maps[of] = road + self.roads * rng.choice(n, of.sum(), replace=of.sum() > n)
        return maps

    def _new_starts(self, maps: np.ndarray, rng: np.random.Generator) -> Episodes:
        """Episodes with new starts on training maps [e]."""
        used, local = np.unique(maps, return_inverse=True)
        seeds = [self.map_seeds[m] for m in used]
        return Episodes(seeds, *self._starts(seeds, local, rng))

    def episodes(self, generation: int) -> Episodes:
        """A generation's episodes, group by group: for each group its new starts, then its crash starts, if any."""
        config, rng = self.config, self._rng(generation, 0)
        # If a group has too few new starts for all roads, other groups and the next generations have the other roads.
        firsts = [(generation + group) * config.starts for group in range(config.groups)]
        maps = [self._some_maps(generation, config.starts, rng, first) for first in firsts]
        fresh = self._new_starts(np.concatenate(maps), rng)
        self._limit(fresh.rows, fresh.maps, self.target)
        if not len(self.crashes) or not config.crash_starts:
            return fresh
        chosen = self._choose_crashes(generation)
        crashes = self.crashes[chosen]
        self._limit(crashes, self.map_seeds, min(config.crash_target, self.target))
        seeds = [self.map_seeds[m] for m in crashes["map"]]
        used = sorted({*fresh.maps, *seeds})
        fresh.rows["map"] = np.searchsorted(used, np.take(fresh.maps, fresh.rows["map"]))
        crashes["map"] = np.searchsorted(used, seeds)
        worlds = self._by_group(fresh.worlds, self.crash_worlds[chosen])
        return Episodes(used, self._by_group(fresh.rows, crashes), worlds)

    def _choose_crashes(self, generation: int) -> np.ndarray:
        """Choose a generation's crash starts, group by group, as indices into `crashes`.

        Crashes where half of the members failed again are the likeliest.
        """
        count = self.config.groups * self.config.crash_starts
        weights = np.maximum(4.0 * self.failures * (1.0 - self.failures), LEAST_CRASH_WEIGHT)
        rng, shares = self._rng(generation, 1), weights / weights.sum()
        return rng.choice(len(weights), count, replace=count > len(weights), p=shares)

    def learn_from_members(self, generation: int, results: Sequence[np.ndarray]) -> None:
        """Learn how hard the crash starts of a generation's `episodes` are, from each group's RESULT [members, e].

        Call it before `learn_from_leader`, which changes the crashes.
        """
        if not len(self.crashes) or not self.config.crash_starts:
            return
        chosen = self._choose_crashes(generation).reshape(len(results), -1)
        self.failures = self.failures.copy()  # a checkpoint may still be writing the old array
        for crashes, result in zip(chosen, results, strict=True):
            failed = (result["end"][:, -len(crashes) :] != End.SUCCESS).mean(axis=0)
            self.failures[crashes] = (self.failures[crashes] + failed) / 2.0

    def _by_group(self, *kinds: np.ndarray) -> np.ndarray:
        """Divide each of the arrays [e, ...] among the groups, and concatenate them group by group."""
        n = self.config.groups
        parts = [kind.reshape(n, len(kind) // n, *kind.shape[1:]) for kind in kinds]
        return np.concatenate(np.concatenate(parts, axis=1))

    def starts(self, batch: int, count: int, purpose: int = 3) -> Episodes:
        """`count` new full episodes on the training maps, seeded by `batch` and `purpose` (by default, the DQN's)."""
        rng = self._rng(batch, purpose)
        return self._new_starts(self._some_maps(batch, count, rng, batch * count), rng)

    def leader_episodes(self, generation: int) -> Episodes:
        """The episodes that the leader drives in a generation, with `rewind` set so that crashes give crash starts."""
        episodes = self.starts(generation, self.config.leader_episodes, purpose=2)
        self._limit(episodes.rows, episodes.maps, min(self.config.leader_stretch * self.target, self.goal))
        episodes.rows["rewind"] = self.config.rewind
        return episodes

    def learn_from_leader(
        self, episodes: Episodes, results: np.ndarray, rewound: np.ndarray, worlds: np.ndarray
    ) -> None:
        """Remember the leader's crashes; raise the target if a share of at least `growth` of its episodes reaches it.

        Crashes are terminating ends after more than 10 steps. Args: `episodes`, those of `leader_episodes`; `results`
        RESULT [e]; `rewound`, the states `rewind` steps before their ends, as starts float32 [e, 8]; `worlds`, the
        traffic at that time, float32 [e, cars, TRAFFIC_FIELDS].
        """
        crashed = TERMINATES[results["end"]] & (results["steps"] > 10)
        if crashed.any():
            new = np.zeros(np.count_nonzero(crashed), dtype=EPISODE)
            seeds = np.array(episodes.maps)[episodes.rows["map"][crashed]]
            new["map"] = [self.map_seeds.index(seed) for seed in seeds]
            new["start"] = rewound[crashed]
            kept = self.config.crash_memory
            self.crashes = np.concatenate([self.crashes, new])[-kept:]
            self.crash_worlds = np.concatenate([self.crash_worlds, worlds[crashed]])[-kept:]
            self.failures = np.concatenate([self.failures, np.full(len(new), 0.5)])[-kept:]
        if (results["distance"] >= self.target).mean() >= self.config.growth:
            self.target = min(2.0 * self.target, self.config.last_target, self.goal)

    def validation(self, seeds: range = VALIDATION_SEEDS) -> Episodes:
        """Validation's episodes on maps of `seeds`, the same for all runs of a scenario with the same traffic.

        A call of the pool may hold them beside training episodes, so their arrays have room for as many cars as those.
        """
        if seeds not in self._validation:
            episodes, room = self.config.validation, max(self.training_crowds)
            self._validation[seeds] = spread_starts(self.build, seeds, episodes, self.crowds, self.sim, room)
        return self._validation[seeds]

    def validation_scores(self, results: np.ndarray) -> np.ndarray:
        """Scores in [0, 1] on each road, float64 [roads], from a member's results in validation, RESULT [e].

        A score is the success rate, multiplied by mean speed / champion_pace if this ratio is below 1.
        """
        on_each = results.reshape(self.roads, -1)
        metres = on_each["distance"].astype(np.float64).sum(axis=1)
        speed = metres / np.maximum(on_each["steps"].sum(axis=1) * self.period, 1e-9)
        return success_rate(on_each) * np.minimum(speed / np.array(self.config.champion_pace), 1.0)


def success_rate(results: np.ndarray) -> np.ndarray:
    """Share of episodes [n] that reached their target, from results [n, e]."""
    return (results["end"] == End.SUCCESS).mean(axis=1)
