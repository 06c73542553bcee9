"""How the episodes of cars are drawn.

Map, start and traffic depend only on a car's seed and the episode's number, unless a reset gives the map or the start.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from gridsim.config import SimConfig
from gridsim.counter import GOLDEN, mix, uniform64
from gridsim.jit import U, njit
from gridsim.maps.map import Map, starts_at
from gridsim.maps.parts import is_map_file, road_number, seed_of_map
from gridsim.maps.roads import clearance
from gridsim.maps.scenarios import build
from gridsim.traffic.world import empty_worlds, spawn

#: Maps by scenario, seed and configuration, shared by all environments of this process while one of them uses the map.
_SHARED: WeakValueDictionary[tuple[str, int, SimConfig], Map] = WeakValueDictionary()


@njit
def _draw(keys, episodes, which, numbers, drawn):
    """Draw for the current episodes of cars `which` [k].

    Writes: `numbers` float64 [k, 2], random numbers in [0, 1) for the map and the start; `drawn` uint64 [k], the key
    of the traffic.
    """
    for k in range(which.shape[0]):
        i = which[k]
        episode = mix(mix(keys[i]) + U(episodes[i]) * GOLDEN)
        drawn[k] = mix(episode + U(3) * GOLDEN)
        for j in range(2):
            numbers[k, j] = uniform64(mix(episode + U(j + 1) * GOLDEN))


class Draws:
    """Draws the map, start and traffic of each episode, for a batch of cars.

    Attributes:
        keys: uint64 [n], each car's seed.
        numbers: uint64 [n], number of each car's current episode; 0 is its first one after it was seeded.
    """

    def __init__(
        self, cars: int, scenario: str, maps: int | Sequence[Map], map_seed: int, crowds: tuple[int, ...],
        config: SimConfig,
    ):  # fmt: skip
        """Draw from these `maps`; or, if `maps` is a number, from that many maps with seeds from `map_seed` on.

        Then maps are built when first needed. If `scenario` is a path, the first is built at once, and there may be
        fewer, as each file is one map. Args: `crowds`, the number of other cars on each of the scenario's roads.
        """
        self.scenario, self.crowds, self.config = scenario, crowds, config
        given = [] if isinstance(maps, int) else maps
        if isinstance(maps, int):
            self._seeds = list(dict.fromkeys(seed_of_map(scenario, map_seed + k) for k in range(maps)))
        else:
            self._seeds = [each.seed for each in maps]
        self._own = {each.seed: each for each in given}  # maps of `_seeds`, given or built so far
        if not self._seeds:
            raise ValueError("an environment needs 1 map or more")
        if not given and is_map_file(scenario):
            self._map(self._seeds[0])  # raises at once if a map's file cannot be read
        if len(set(self._seeds)) < len(self._seeds):
            raise ValueError("maps that are given need different seeds, by which episodes name them")
        self.keys = np.zeros(cars, dtype=np.uint64)
        self.numbers = np.zeros(cars, dtype=np.uint64)

    def draw(
        self, which: np.ndarray, map_seed: Any = None, start: Any = None
    ) -> tuple[list[Map], np.ndarray, np.ndarray]:
        """Maps [k], starts [k, 5] and traffic [k, cars, TRAFFIC_FIELDS] of the current episodes of cars `which` [k].

        `cars` is the largest number in `crowds`; on roads with fewer cars, the rest are absent. `map_seed` and `start`
        (as in `GridSimVectorEnv.reset`), if given, replace what would be drawn.
        """
        numbers, keys = np.empty((len(which), 2)), np.empty(len(which), dtype=np.uint64)
        _draw(self.keys, self.numbers, which, numbers, keys)
        if map_seed is None:
            seeds = [self._seeds[k] for k in (numbers[:, 0] * len(self._seeds)).astype(np.intp)]
        else:
            given, every = np.asarray(map_seed), self.keys.shape
            if given.dtype.kind not in "iu" or given.shape not in ((), every) or given.min() < 0:
                raise ValueError(f"map_seed must be a whole number from 0, or {every[0]} of them, not {map_seed!r}")
            seeds = np.broadcast_to(given, every)[which].tolist()
        found = {seed: self._map(seed) for seed in dict.fromkeys(seeds)}
        maps = [found[seed] for seed in seeds]
        starts = np.empty((len(which), 5), dtype=np.float32)
        if start is not None:
            starts[:] = self._checked_start(start, which, maps)
        worlds = empty_worlds(len(which), max(self.crowds))
        on_each: defaultdict[int, list[int]] = defaultdict(list)
        for k, seed in enumerate(seeds):
            on_each[seed].append(k)
        for seed, of in on_each.items():
            cars = self.crowds[road_number(seed, len(self.crowds))]
            if start is None:
                starts[of] = starts_at(found[seed], numbers[of, 1])
            if cars:
                worlds[of, :cars] = spawn(found[seed].network, starts[of], cars, keys[of], self.config)
        return maps, starts, worlds

    def _map(self, seed: int) -> Map:
        """The map with a seed, built if missing; kept only if its seed is one of those that episodes are drawn from."""
        if seed not in self._own:  # `seed_of_map` looks at files, which would slow down each reset
            seed = seed_of_map(self.scenario, seed)
        if seed in self._own:
            return self._own[seed]
        key = self.scenario, seed, self.config
        found = _SHARED[key] = _SHARED.get(key) or build(*key)
        if seed in self._seeds:
            self._own[seed] = found
        return found

    def _checked_start(self, start: Any, which: np.ndarray, maps: list[Map]) -> np.ndarray:
        """The starts of cars `which` [k] from what a caller gave as `start`, checked: float32 [k, 5]."""
        vehicle, cars = self.config.vehicle, len(self.keys)
        try:
            starts = np.broadcast_to(np.asarray(start, dtype=np.float32), (cars, 5))[which]
        except (TypeError, ValueError):
            form = f"x, y, heading, speed, steering, or {cars} rows of these"
            raise ValueError(f"start must be {form}, not {start!r}") from None
        if not np.isfinite(starts).all():
            raise ValueError(f"start must be five finite numbers, not {start!r}")
        for road_map, (x, y, _, speed, steering) in zip(maps, starts, strict=True):
            fast = not -vehicle.reverse_limit <= speed <= vehicle.speed_limit
            if fast or abs(steering) > np.radians(vehicle.steering_limit) + 1e-6:
                limits = "speed and steering must be within the car's limits"
                raise ValueError(f"a start's {limits}, not {speed:g} m/s and {steering:g} rad")
            if clearance(road_map.road, x, y) < 0.0:
                raise ValueError(f"a start must be on the road, not at {x:g} m, {y:g} m")
        return starts
