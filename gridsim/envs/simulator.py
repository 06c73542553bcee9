"""Batches of cars: state, reset and step, arrays in and arrays out.

What one car does in a control period is in `ego.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gridsim.car.ego import DISTANCE, FIELDS, SPEED, STEERING, End, control, look, place
from gridsim.car.vehicle import Action, act, act_continuous
from gridsim.config import Constants, SimConfig, constants
from gridsim.jit import njit
from gridsim.maps.atlas import Atlas, make_atlas, network_of, road_of
from gridsim.maps.map import Map
from gridsim.maps.roads import VISIT_CELL, Road
from gridsim.sensing.rays import SIMD_RAYS, fan
from gridsim.traffic.behaviour import Drivers, drivers, flow
from gridsim.traffic.world import FIELDS as TRAFFIC_FIELDS
from gridsim.traffic.world import check_worlds, spawn

_F = np.float32
_ZERO = _F(0.0)

ACTIONS = len(Action)


@njit
def _place_some(road, constants, fan, order, which, starts, cars, visits, worlds, beams, ranges, closing):
    for k in order:
        i = which[k]
        place(road, starts[k], cars[i], visits[i])
        if worlds is not None:
            look(road, constants, fan, cars[i], worlds[i], beams, ranges[k], closing[i])
        else:
            look(road, constants, fan, cars[i], None, beams, ranges[k], None)


@njit(nogil=True)
def _place_all(atlas, constants, fan, order, runs, which, starts, cars, visits, worlds, ranges, closing):
    """Put cars `which` [k] at `starts` [k, 5], on maps as `_control_all` says; `ranges` [k, rays] is what they see."""
    beams = np.empty((3, SIMD_RAYS), dtype=np.float32)
    for row, first, last in runs:
        road = road_of(atlas, row)
        _place_some(
            road, constants, fan, order[first:last], which, starts, cars, visits, worlds, beams, ranges, closing
        )


@njit
def _control_some(
    road,
    network,
    constants,
    drivers,
    fan,
    order,
    actions,
    target,
    max_steps,
    cars,
    visits,
    worlds,
    ends,
    beams,
    ranges,
    closing,
    speeds,
    progress,
):
    for i in order:
        car = cars[i]
        progress[i] = _ZERO
        if ends[i] == 0:
            before = car[DISTANCE]
            if actions.ndim == 1:
                acceleration, steering = act(constants, actions[i], car[SPEED], car[STEERING])
            else:
                acceleration, steering = act_continuous(constants, actions[i, 0], actions[i, 1], car[STEERING])
            if worlds is not None:
                flow(network, drivers, worlds[i], car)
                car[STEERING] = steering
                ends[i] = control(road, constants, car, visits[i], worlds[i], acceleration, target, max_steps)
            else:
                car[STEERING] = steering
                ends[i] = control(road, constants, car, visits[i], None, acceleration, target, max_steps)
            progress[i] = car[DISTANCE] - before
        if worlds is not None:
            look(road, constants, fan, car, worlds[i], beams, ranges[i], closing[i])
        else:
            look(road, constants, fan, car, None, beams, ranges[i], None)
        speeds[i] = car[SPEED]


@njit(nogil=True)
def _control_all(
    atlas,
    constants,
    drivers,
    fan,
    order,
    runs,
    actions,
    target,
    max_steps,
    cars,
    visits,
    worlds,
    ends,
    ranges,
    closing,
    speeds,
    progress,
):
    """One control period of every car; who has ended stands still.

    Cars are taken in `order`; runs int64 [maps, 3] says which map of the atlas a stretch of it is on: row, from, to.
    """
    beams = np.empty((3, SIMD_RAYS), dtype=np.float32)
    for row, first, last in runs:
        _control_some(
            road_of(atlas, row),
            network_of(atlas, row),
            constants,
            drivers,
            fan,
            order[first:last],
            actions,
            target,
            max_steps,
            cars,
            visits,
            worlds,
            ends,
            beams,
            ranges,
            closing,
            speeds,
            progress,
        )


def _by_map(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cars sorted by their maps `rows` [n]: (order int64 [n], runs int64 [maps, 3]), as `_control_all` reads them."""
    order = np.argsort(rows, kind="stable")
    names, first = np.unique(rows[order], return_index=True)
    return order, np.stack([names, first, np.append(first[1:], len(rows))], axis=1).astype(np.int64)


@dataclass(frozen=True)
class State:
    """A batch of cars; arrays with one leading axis, one row a car. Copy the arrays to keep a state.

    Attributes:
        cars: float32 [n, FIELDS], the fields above.
        visits: float32 [n, cells], odometer (m) when the car was last in each visit cell of its map.
        maps: int32 [n], index of the car's map among the simulator's scenarios.
        ends: uint8 [n], End.
        worlds: float32 [n, traffic, world.FIELDS], the other cars around each.
    """

    cars: np.ndarray
    visits: np.ndarray
    maps: np.ndarray
    ends: np.ndarray
    worlds: np.ndarray


class Simulator:
    """A batch of cars on one or several maps, each in an episode of its own: arrays in, arrays out.

    What a car does depends on its own map, start and actions alone, not on the batch it is in. Maps may be added to
    `scenarios` at any time; a reset names them by index. Replace one only before all cars are reset.
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
        """Make room for `cars` cars; `target` (m) and `max_steps` (control steps) are the configuration's unless given.

        Each car has a world of its own, with `traffic` other cars in it.

        Raises: ValueError with one line where a number makes no sense.
        """
        self.config = config or SimConfig()
        episode = self.config.episode
        self.target = episode.target if target is None else target
        self.max_steps = round(episode.time_limit / episode.control_period) if max_steps is None else max_steps
        if cars < 1:
            raise ValueError(f"a simulator needs 1 car or more, not {cars}")
        if traffic < 0:
            raise ValueError(f"there are 0 other cars or more, not {traffic}")
        if not self.target > 0.0 or self.max_steps < 1:
            raise ValueError(f"an episode has a target above 0 m and 1 step, not {self.target} and {self.max_steps}")
        self._limit = _F(self.target)
        self.scenarios = list(scenarios)
        self._constants: Constants = constants(self.config)
        self._drivers: Drivers = drivers(self.config)
        self._fan = fan(self.config.sensors.rays, self._constants.ray_first, self._constants.ray_step)
        self.state = State(
            cars=np.zeros((cars, FIELDS), dtype=np.float32),
            visits=np.zeros((cars, 0), dtype=np.float32),
            maps=np.full(cars, -1, dtype=np.int32),
            ends=np.zeros(cars, dtype=np.uint8),
            worlds=np.zeros((cars, traffic, TRAFFIC_FIELDS), dtype=np.float32),
        )
        #: float32 [n, rays]: m/s at which what each ray last met came closer over ground; 0 for the road's edge.
        self.closing = np.zeros((cars, self.config.sensors.rays), dtype=np.float32)
        self._atlas: Atlas | None = None  # maps that cars are on; None before the first reset
        self._shown: list[Map] = []  # what the atlas shows
        self._rows = np.full(cars, -1, dtype=np.int64)  # each car's map in the atlas, -1 before its first reset
        self._order, self._runs = _by_map(self._rows)

    def __getstate__(self) -> dict[str, Any]:
        """Without arrays that are read-only: copies of them are not, and kernels would be compiled anew for these."""
        return {**vars(self), "_atlas": None, "_fan": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._fan = fan(self.config.sensors.rays, self._constants.ray_first, self._constants.ray_step)
        self._lay_out()

    def __len__(self) -> int:
        return len(self.state.ends)

    def reset(
        self,
        starts: np.ndarray,
        maps: np.ndarray | int = 0,
        cars: np.ndarray | None = None,
        keys: np.ndarray | int = 0,
        worlds: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Begin episodes.

        Args:
            starts: float32 [k, 5]: x, y (m), heading (rad), speed (m/s), steering (rad).
            maps: indices [k] into `scenarios`, or one for all.
            cars: indices [k] of the cars that begin; None is all of them.
            keys: uint64 [k], or one for all, from which the traffic around each is spawned.
            worlds: float32 [k, traffic, world.FIELDS], the traffic itself in place of keys.

        Returns: (ranges float32 [k, rays] in m, speeds float32 [k] in m/s).
        Raises: ValueError with one line for a wrong shape, a number that is not finite, a map that is not there, or
        traffic that is on no lane of its map (`world.check_worlds`). Nothing is changed then.
        """
        n = len(self)
        cars = np.arange(n) if cars is None else np.asarray(cars, dtype=np.intp)
        starts = np.array(starts, dtype=np.float32)
        maps = np.broadcast_to(np.asarray(maps, dtype=np.int32), cars.shape)
        if starts.shape != (len(cars), 5) or not np.isfinite(starts).all():
            raise ValueError(f"starts must be {len(cars)} rows of finite x, y, heading, speed, steering")
        if maps.size and not 0 <= maps.min() <= maps.max() < len(self.scenarios):
            raise ValueError(f"a start names a map that is not among the {len(self.scenarios)} there are")
        if cars.ndim != 1 or (cars.size and not 0 <= cars.min() <= cars.max() < n):
            raise ValueError(f"cars must be indices from 0 to {n - 1}")
        ranges = np.empty((len(cars), self.config.sensors.rays), dtype=np.float32)
        if not len(cars):
            return ranges, starts[:, 3]
        traffic = self._traffic(starts, maps, keys, worlds) if self.state.worlds.shape[1] else None
        rows = self._chart(maps, everyone=len(cars) == n)
        cells = max(_visit_cells(self.scenarios[m].road) for m in np.unique(maps))
        if cells > self.state.visits.shape[1]:
            visits = np.full((n, cells), -1e6, dtype=np.float32)
            visits[:, : self.state.visits.shape[1]] = self.state.visits
            self.state = replace(self.state, visits=visits)
        state = self.state
        if traffic is not None:
            state.worlds[cars] = traffic
        _place_all(
            self._atlas,
            self._constants,
            self._fan,
            *_by_map(rows),
            cars,
            starts,
            state.cars,
            state.visits,
            self._traffic_or_none(),
            ranges,
            self.closing,
        )
        state.maps[cars] = maps
        state.ends[cars] = End.RUNNING
        if (self._rows[cars] != rows).any():
            self._rows[cars] = rows
            self._order, self._runs = _by_map(self._rows)
        return ranges, starts[:, 3].copy()

    def _traffic_or_none(self) -> np.ndarray | None:
        """The worlds as kernels take them."""
        return self.state.worlds if self.state.worlds.shape[1] else None

    def _traffic(
        self, starts: np.ndarray, maps: np.ndarray, keys: np.ndarray | int, worlds: np.ndarray | None
    ) -> np.ndarray:
        """The traffic [k, traffic, FIELDS] that episodes begin with."""
        count = self.state.worlds.shape[1]
        if worlds is not None:
            worlds = np.asarray(worlds, dtype=np.float32)
            if worlds.shape != (len(starts), count, TRAFFIC_FIELDS):
                raise ValueError(f"traffic must be {len(starts)} worlds of {count} cars, not {worlds.shape}")
            for m in np.unique(maps):
                check_worlds(worlds[maps == m], self.scenarios[m].network)
            return worlds
        keys = np.broadcast_to(np.asarray(keys, dtype=np.uint64), maps.shape)
        spawned = np.empty((len(starts), count, TRAFFIC_FIELDS), dtype=np.float32)
        for m in np.unique(maps):
            of = np.flatnonzero(maps == m)
            spawned[of] = spawn(self.scenarios[m].network, starts[of], count, keys[of], self.config.traffic)
        return spawned

    def _chart(self, maps: np.ndarray, everyone: bool) -> np.ndarray:
        """Rows int64 [k] in the atlas of maps [k]. It is made anew if one is missing, of these alone for `everyone`.

        One car alone is always on an atlas of one map, which is no copy.
        """
        wanted = {m: self.scenarios[m] for m in np.unique(maps).tolist()}
        shown = [] if len(self) == 1 else self._shown
        missing = [scenario for scenario in wanted.values() if not any(scenario is other for other in shown)]
        if missing:
            self._shown = list(wanted.values()) if everyone else shown + missing
            self._lay_out()
        row = {id(scenario): k for k, scenario in enumerate(self._shown)}
        return np.array([row[id(wanted[m])] for m in maps.tolist()], dtype=np.int64)

    def _lay_out(self) -> None:
        """Make the atlas of the maps that it shows."""
        if self._shown:
            self._atlas = make_atlas([shown.road for shown in self._shown], [shown.network for shown in self._shown])

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """One control period of every car. A car whose episode has ended stands still until it is reset.

        Args: actions integers [n], 0 to 7 (`vehicle.Action`), or numbers [n, 2], clipped to [-1, 1] (`act_continuous`).
        Returns: (ranges float32 [n, rays] in m, speeds float32 [n] in m/s, progress float32 [n], m of new ground in
        this step, ends uint8 [n], End); arrays of the caller's own.
        Raises: ValueError with one line for anything but an action for each car; RuntimeError before the first reset.
        """
        n = len(self)
        if self._runs[0, 0] < 0:
            raise RuntimeError("step() was called before every car was reset; call reset() first")
        actions = checked_actions(actions, n)
        state = self.state
        ranges = np.empty((n, self.config.sensors.rays), dtype=np.float32)
        speeds, progress = np.empty(n, dtype=np.float32), np.empty(n, dtype=np.float32)
        _control_all(
            self._atlas,
            self._constants,
            self._drivers,
            self._fan,
            self._order,
            self._runs,
            actions,
            self._limit,
            self.max_steps,
            state.cars,
            state.visits,
            self._traffic_or_none(),
            state.ends,
            ranges,
            self.closing,
            speeds,
            progress,
        )
        return ranges, speeds, progress, state.ends.copy()


@njit(nogil=True)
def _views(road, constants, fan, cars, worlds, ranges):
    beams = np.empty((3, SIMD_RAYS), dtype=np.float32)
    for i in range(cars.shape[0]):
        look(road, constants, fan, cars[i], worlds[i], beams, ranges[i], None)


def views(scenario: Map, cars: np.ndarray, worlds: np.ndarray, config: SimConfig) -> np.ndarray:
    """Ranges float32 [n, rays] (m) that cars in states [n, FIELDS] see among traffic [n, others, world.FIELDS]."""
    k = constants(config)
    ranges = np.empty((len(cars), config.sensors.rays), dtype=np.float32)
    rays = fan(config.sensors.rays, k.ray_first, k.ray_step)
    _views(scenario.road, k, rays, np.ascontiguousarray(cars), np.ascontiguousarray(worlds), ranges)
    return ranges


def _visit_cells(road: Road) -> int:
    """Number of visit cells of a map."""
    return int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)


def checked_actions(actions: np.ndarray, n: int) -> np.ndarray:
    """Actions int64 [n], or continuous ones float32 [n, 2] clipped to [-1, 1]; C-contiguous.

    Raises: ValueError with one line unless they are n whole numbers that name actions, or n pairs of numbers.
    """
    array = np.asarray(actions)
    if array.shape == (n, 2):
        if array.dtype.kind not in "fiu":
            raise ValueError(f"continuous actions must be numbers, not {array.dtype}")
        if np.isnan(array).any():
            raise ValueError("continuous actions must be numbers, not nan")
        return np.ascontiguousarray(np.clip(array, -1.0, 1.0), dtype=np.float32)
    if array.shape != (n,):
        raise ValueError(f"there are {n} cars, not actions of shape {array.shape}")
    if array.dtype.kind not in "iu":
        wrong = f"{array.dtype} ({array[0]!s} is the first)"
        raise ValueError(f"actions must be whole numbers from 0 to {ACTIONS - 1}, not {wrong}")
    array = np.ascontiguousarray(array, dtype=np.int64)
    if array.view(np.uint64).max() >= ACTIONS:  # what is below 0 is far above
        wrong = array[(array < 0) | (array >= ACTIONS)][0]
        raise ValueError(f"actions must be whole numbers from 0 to {ACTIONS - 1}, not {wrong}")
    return array
