"""Batches of cars; what one car does in a control period is in `car.ego`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gridsim.car.ego import DISTANCE, FIELDS, SPEED, STEERING, End, control, look, place, visit_cells
from gridsim.car.vehicle import Action, act, act_continuous
from gridsim.config import Constants, SimConfig, constants
from gridsim.jit import njit
from gridsim.maps.atlas import Atlas, make_atlas, network_of, road_of
from gridsim.maps.map import Map
from gridsim.sensing.rays import fan
from gridsim.traffic.behaviour import Drivers, drivers, flow
from gridsim.traffic.world import FIELDS as TRAFFIC_FIELDS


class Physics(NamedTuple):
    """What all cars share, as kernels read it; arrays are read-only."""

    atlas: Atlas
    constants: Constants
    drivers: Drivers
    fan: np.ndarray


class State(NamedTuple):
    """A batch of cars; arrays with one leading axis, one row a car. Copy the arrays to keep a state."""

    cars: np.ndarray  # float32 [n, ego.FIELDS]
    visits: np.ndarray  # float32 [n, cells], odometer (m) when the car was last in each visit cell of its map
    maps: np.ndarray  # int32 [n], index of the car's map among the simulator's scenarios
    ends: np.ndarray  # uint8 [n], End
    worlds: np.ndarray  # float32 [n, traffic, world.FIELDS], the other cars around each


@njit(nogil=True)
def _place_all(physics, order, runs, which, starts, cars, visits, worlds, ranges, closing):
    """Put cars `which` [k] at `starts` [k, 5], grouped by map as in `_control_all`; fills `ranges` [k, rays]."""
    for row, first, last in runs:
        road = road_of(physics.atlas, row)
        for k in order[first:last]:
            i = which[k]
            world = None if worlds is None else worlds[i]
            place(road, starts[k], cars[i], visits[i])
            look(road, physics.constants, physics.fan, cars[i], world, ranges[k], closing[i])


@njit(nogil=True)
def _control_all(physics, order, runs, actions, target, max_steps, cars, visits, worlds, ends, seen):
    """One control period of every car; one whose episode has ended stands still.

    `order` lists the cars map by map; runs int64 [maps, 3]: a map's row in the atlas, and its cars' range in `order`.
    seen: ranges and closing speeds [n, rays], speeds [n] and progress [n], to be filled.
    """
    constants, drivers = physics.constants, physics.drivers
    ranges, closing, speeds, progress = seen
    for row, first, last in runs:
        road, network = road_of(physics.atlas, row), network_of(physics.atlas, row)
        for i in order[first:last]:
            car = cars[i]
            world = None if worlds is None else worlds[i]
            before = car[DISTANCE]
            if ends[i] == 0:
                if actions.ndim == 1:
                    acceleration, steering = act(constants, actions[i], car[SPEED], car[STEERING])
                else:
                    pedal, wheel = actions[i, 0], actions[i, 1]
                    acceleration, steering = act_continuous(constants, pedal, wheel, car[SPEED], car[STEERING])
                if world is not None:
                    flow(network, drivers, world, car)
                ends[i] = control(road, constants, car, visits[i], world, acceleration, steering, target, max_steps)
            progress[i] = car[DISTANCE] - before
            look(road, constants, physics.fan, car, world, ranges[i], closing[i])
            speeds[i] = car[SPEED]


def _by_map(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cars sorted by their maps `rows` [n]: (order int64 [n], runs int64 [maps, 3]), as `_control_all` reads them."""
    order = np.argsort(rows, kind="stable")
    names, first = np.unique(rows[order], return_index=True)
    return order, np.stack([names, first, np.append(first[1:], len(rows))], axis=1).astype(np.int64)


class Simulator:
    """A batch of cars on one or several maps, each in an episode of its own: arrays in, arrays out.

    A car's behaviour depends only on its own map, start and actions, not on the batch it is in. Maps may be added to
    `scenarios` at any time; a reset refers to them by index. Replace one only before all cars are reset.
    """

    def __init__(
        self,
        scenarios: Sequence[Map],
        cars: int,
        config: SimConfig | None = None,
        target: float | None = None,
        max_steps: int | None = None,
        traffic: int = 0,
    ):
        """Make room for `cars` cars, each with a world of `traffic` other cars.

        `target` (m) and `max_steps` (control steps) are the configuration's unless given.
        Raises: ValueError with one line for an invalid number.
        """
        self.config = config or SimConfig()
        episode = self.config.episode
        self.target = episode.target if target is None else target
        self.max_steps = episode.steps if max_steps is None else max_steps
        if cars < 1:
            raise ValueError(f"a simulator needs 1 car or more, not {cars}")
        if traffic < 0:
            raise ValueError(f"traffic must be 0 cars or more, not {traffic}")
        if not self.target > 0.0 or self.max_steps < 1:
            raise ValueError(f"an episode needs a target above 0 m and 1 step, not {self.target} and {self.max_steps}")
        constants(self.config)  # raises for a wrong configuration
        self.scenarios = list(scenarios)
        rays = self.config.sensors.rays
        self.state = State(
            cars=np.zeros((cars, FIELDS), dtype=np.float32),
            visits=np.zeros((cars, 0), dtype=np.float32),
            maps=np.full(cars, -1, dtype=np.int32),  # -1 before a car's first reset
            ends=np.zeros(cars, dtype=np.uint8),
            worlds=np.full((cars, traffic, TRAFFIC_FIELDS), -1.0, dtype=np.float32),  # all are absent
        )
        #: float32 [n, rays], m/s: closing speeds at the last step or reset, as in `boxes.cast_boxes`.
        self.closing = np.zeros((cars, rays), dtype=np.float32)
        self._physics: Physics | None = None  # made when a kernel first needs it
        self._charted: list[Map] = []  # the maps in the atlas
        self._groups = _by_map(self.state.maps)

    def __getstate__(self) -> dict[str, Any]:
        """Without read-only arrays: their copies would be writable, and kernels would be compiled again for them."""
        return {**vars(self), "_physics": None}

    def __len__(self) -> int:
        return len(self.state.ends)

    def reset(
        self,
        starts: np.ndarray,
        maps: np.ndarray | int = 0,
        cars: np.ndarray | None = None,
        worlds: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Begin episodes.

        Args:
            starts: float32 [k, 5]: x, y (m), heading (rad), speed (m/s), steering (rad).
            maps: indices [k] into `scenarios`, or one for all.
            cars: indices [k] of the cars that begin; None is all of them.
            worlds: float32 [k, traffic, world.FIELDS], the traffic around each car (`world.spawn`); None is no cars.

        Returns: (ranges float32 [k, rays] in m, speeds float32 [k] in m/s).
        Raises: ValueError with one line for a wrong shape, a number that is not finite, or a missing map. Nothing is
        changed then.
        """
        n = len(self)
        cars = np.arange(n) if cars is None else np.asarray(cars, dtype=np.intp)
        starts = np.array(starts, dtype=np.float32)
        maps = np.broadcast_to(np.asarray(maps, dtype=np.int32), cars.shape)
        if starts.shape != (len(cars), 5) or not np.isfinite(starts).all():
            raise ValueError(f"starts must be {len(cars)} rows of finite x, y, heading, speed, steering")
        if maps.size and not 0 <= maps.min() <= maps.max() < len(self.scenarios):
            raise ValueError(f"maps must be indices into the {len(self.scenarios)} scenarios")
        if cars.ndim != 1 or (cars.size and not 0 <= cars.min() <= cars.max() < n):
            raise ValueError(f"cars must be indices from 0 to {n - 1}")
        shape = (len(cars), *self.state.worlds.shape[1:])
        if worlds is not None and np.shape(worlds) != shape:
            raise ValueError(f"traffic must be {shape[0]} worlds of {shape[1]} cars, not {np.shape(worlds)}")
        ranges = np.empty((len(cars), self.config.sensors.rays), dtype=np.float32)
        if not len(cars):
            return ranges, starts[:, 3]
        self.state.worlds[cars] = -1.0 if worlds is None else worlds
        rows = self._chart(maps)
        cells = max(visit_cells(self.scenarios[m].road) for m in np.unique(maps))
        if cells > self.state.visits.shape[1]:
            more = ((0, 0), (0, cells - self.state.visits.shape[1]))
            self.state = self.state._replace(visits=np.pad(self.state.visits, more, constant_values=-1e6))
        state = self.state
        physics, around = self._kernel_physics(), self._kernel_worlds()
        _place_all(physics, *_by_map(rows), cars, starts, state.cars, state.visits, around, ranges, self.closing)
        state.ends[cars] = End.RUNNING
        if (state.maps[cars] != maps).any():
            state.maps[cars] = maps
            self._groups = _by_map(state.maps if n > 1 else rows)
        return ranges, starts[:, 3].copy()

    def _kernel_worlds(self) -> np.ndarray | None:
        return self.state.worlds if self.state.worlds.shape[1] else None

    def _kernel_physics(self) -> Physics:
        if self._physics is None:
            k, rays = constants(self.config), self.config.sensors.rays
            atlas = make_atlas([each.road for each in self._charted], [each.network for each in self._charted])
            self._physics = Physics(atlas, k, drivers(self.config), fan(rays, k.ray_first, k.ray_step))
        return self._physics

    def _chart(self, maps: np.ndarray) -> np.ndarray:
        """Rows of maps [k] in the atlas, which has all scenarios; for one car alone its map, which is not copied."""
        alone = len(self) == 1
        wanted = [self.scenarios[maps[0]]] if alone else self.scenarios
        if [id(scenario) for scenario in wanted] != [id(scenario) for scenario in self._charted]:
            self._charted, self._physics = list(wanted), None
        return np.zeros_like(maps) if alone else maps

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """One control period of every car. A car whose episode has ended stands still until it is reset.

        Args: actions integers [n], 0 to 7 (`vehicle.Action`), or numbers [n, 2], clipped to [-1, 1] (`act_continuous`).
        Returns: (ranges float32 [n, rays] in m, speeds float32 [n] in m/s, progress float32 [n], m of new ground in
        this step, ends uint8 [n], End); the caller owns the arrays.
        Raises: ValueError with one line for invalid actions; RuntimeError before the first reset.
        """
        n, state = len(self), self.state
        if state.maps.min() < 0:
            raise RuntimeError("step() was called before every car was reset; call reset() first")
        if np.shape(actions) not in ((n,), (n, 2)):
            raise ValueError(f"there are {n} cars, not actions of shape {np.shape(actions)}")
        actions = checked_actions(actions)
        ranges = np.empty_like(self.closing)
        speeds, progress = np.empty(n, dtype=np.float32), np.empty(n, dtype=np.float32)
        physics, around, target = self._kernel_physics(), self._kernel_worlds(), np.float32(self.target)
        seen = ranges, self.closing, speeds, progress
        _control_all(
            physics, *self._groups, actions, target, self.max_steps, state.cars, state.visits, around, state.ends, seen
        )
        return ranges, speeds, progress, state.ends.copy()


def views(scenario: Map, cars: np.ndarray, worlds: np.ndarray, config: SimConfig) -> tuple[np.ndarray, np.ndarray]:
    """What cars in states [n, FIELDS] see among traffic [n, others, world.FIELDS].

    Returns: ranges (m) and closing speeds (m/s) of the rays, each float32 [n, rays].
    """
    k = constants(config)
    rays = fan(config.sensors.rays, k.ray_first, k.ray_step)
    ranges = np.empty((len(cars), config.sensors.rays), dtype=np.float32)
    closing = np.zeros_like(ranges)
    for car, world, seen, speeds in zip(cars, worlds, ranges, closing, strict=True):
        look(scenario.road, k, rays, car, world, seen, speeds)
    return ranges, closing


def checked_actions(actions: np.ndarray) -> np.ndarray:
    """Actions [n] as int64, or continuous ones [n, 2] as float32 clipped to [-1, 1]; C-contiguous.

    Raises: ValueError with one line unless they are whole numbers that name actions, or pairs of numbers.
    """
    array = np.asarray(actions)
    if array.ndim == 2:
        if array.dtype.kind not in "fiu":
            raise ValueError(f"continuous actions must be numbers, not {array.dtype}")
        if np.isnan(array).any():
            raise ValueError("continuous actions must be numbers, not nan")
        return np.ascontiguousarray(np.clip(array, -1.0, 1.0), dtype=np.float32)
    wrong = (array < 0) | (array >= len(Action)) if array.dtype.kind in "iu" else np.ones(len(array), dtype=np.bool_)
    if wrong.any():
        raise ValueError(f"actions must be whole numbers from 0 to {len(Action) - 1}, not {array[wrong][0]}")
    return np.ascontiguousarray(array, dtype=np.int64)
