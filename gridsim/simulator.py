"""Batches of cars; what one car does in a control period is in `gridsim.step`."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numba.core import event

from gridsim.car.reward import reward
from gridsim.car.vehicle import Action
from gridsim.config import SimConfig, constants
from gridsim.jit import leaf, njit, row_of
from gridsim.maps.atlas import Atlas, make_atlas, network_of, road_of
from gridsim.maps.map import Map
from gridsim.sensing.imperfections import Delays, History, new_history
from gridsim.sensing.observation import encoding
from gridsim.sensing.route import check_lanes
from gridsim.state import CAR_FIELDS, DISTANCE, POSE, SPEED, START_FIELDS, TRAFFIC_FIELDS, End
from gridsim.step import Simulation, look, obey, parameters, place, simulations_on, step, visit_cells

# Once an atlas has this many maps, adding another removes those on which there are no cars. A generated map takes some
# 2 MB, a map from a file up to 70 MB.
MOST_MAPS = 256


Physics = tuple[Atlas, tuple[Any, ...]]  # several maps, and the `step.parameters`


@njit
def _on_map(physics, row):
    """The Simulation of the map in a row of the atlas."""
    return Simulation(road_of(physics[0], row), network_of(physics[0], row), *physics[1])


@leaf
def _look(simulation, i, cars, worlds, seen, histories):
    """Have car i look around; args as in `_control_all`."""
    ranges, closing, observations = seen
    look(simulation, cars[i], row_of(worlds, i), ranges[i], closing[i], observations[i], row_of(histories, i))


@leaf
def _control(simulation, i, discrete, commands, limits, ends, rewards, cars, visits, worlds, seen, histories):
    """One control period of car i; args as in `_control_all`."""
    constants, car = simulation.constants, cars[i]
    before, runs_on = car[DISTANCE], ends[i] == 0
    if runs_on:
        history = row_of(histories, i)
        acceleration, steering = obey(constants, car, history, discrete, commands[i, 0], commands[i, 1])
        ends[i] = step(simulation, car, visits[i], row_of(worlds, i), acceleration, steering, *limits)
    _look(simulation, i, cars, worlds, seen, histories)
    if runs_on:
        gained, fastest = car[DISTANCE] - before, simulation.road.speed_high
        rewards[i] = reward(seen[0][i], constants.ray_range, car[SPEED], gained, ends[i], fastest, constants.dt)


@njit(nogil=True)
def _place_all(physics, order, runs, which, starts, cars, visits, worlds, seen, histories):
    """Put cars `which` [k] at `starts` [k, 5 or 8] and sense.

    Args as in `_control_all`, but `order` holds positions in `which` and `starts`.
    """
    for row, first, last in runs:
        simulation = _on_map(physics, row)
        for k in order[first:last]:
            place(simulation, starts[k], cars[which[k]], visits[which[k]])
            _look(simulation, which[k], cars, worlds, seen, histories)


@njit(nogil=True)
def _control_all(
    physics, order, runs, discrete, commands, limits, ends, rewards, cars, visits, worlds, seen, histories
):  # fmt: skip
    """One control period of every car in `order`; a car whose episode has ended stands still.

    Args: `order` int64 [k], indices of cars, sorted by map; `runs` int64 [maps, 3], for each map with cars its row in
    the atlas and the range of its cars in `order`; `commands` float32 [n, 2], `discrete` or not, as of `step.obey`;
    `limits`, target (m) and maximum of control steps.
    Writes, for these cars: `rewards` [n]; `seen`: ranges and closing speeds [n, rays] and observations [n, values].
    Updates `ends`, `cars`, `visits`, `worlds` and `histories`.
    """
    for row, first, last in runs:
        simulation = _on_map(physics, row)
        for i in order[first:last]:
            _control(simulation, i, discrete, commands, limits, ends, rewards, cars, visits, worlds, seen, histories)


class _Notice(event.Listener):
    """Says why a first `reset` and `step` take so long. Commands that train say so themselves (`cluster.run`)."""

    def on_start(self, event: Any) -> None:
        if (event.data or {}).get("dispatcher") is _place_all:
            said = "compiling the simulator for drives of this kind, once (first reset and step: up to a minute)"
            logging.getLogger("gridsim").warning(said)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Notice())


def _by_map(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cars sorted by their maps' rows [n] in the atlas: (order int64 [n], runs int64 [maps, 3]) of `_control_all`."""
    cars = np.bincount(rows + 1)  # number on each map; before its first reset, a car's row is -1
    used, last = cars.nonzero()[0], cars.cumsum()
    return rows.argsort(kind="stable"), np.stack([used - 1, (last - cars)[used], last[used]], axis=1)


class Simulator:
    """A batch of cars, each in an episode of its own, on a map that cars may share: arrays in, arrays out.

    What a car does depends only on its own map, start, traffic and actions. Attributes, which steps and resets change:
        cars: float32 [n, CAR_FIELDS].
        visits: float32 [n, cells], odometer (m) when the car was last in each visit cell of its map; -1e6 for never.
        ends: uint8 [n], End.
        worlds: float32 [n, traffic, TRAFFIC_FIELDS], the other cars around each.
        ranges: float32 [n, rays], m, after the last step or reset.
        closing: float32 [n, rays], m/s, closing speeds along the rays; [n, 0] if the features lack `motion`.
        observations: float32 [n, values], what networks see (`sensing.observation`).
    """

    def __init__(
        self,
        cars: int,
        config: SimConfig | None = None,
        target: float | None = None,
        max_steps: int | None = None,
        traffic: int = 0,
        features: tuple[str, ...] = (),
    ):
        """Make room for `cars` cars, each with a world of `traffic` other cars.

        Observations have these `features` of `sensing.observation.OPTIONAL`, and those that all have. `target` (m) and
        `max_steps` (control steps) are the configuration's unless given.
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
        self.features = features
        values = encoding(features, constants(self.config)).first[-1]  # raises for a wrong configuration
        self.cars = np.zeros((cars, CAR_FIELDS), dtype=np.float32)
        self.visits = np.zeros((cars, 0), dtype=np.float32)
        self.ends = np.zeros(cars, dtype=np.uint8)
        self.worlds = np.full((cars, traffic, TRAFFIC_FIELDS), -1.0, dtype=np.float32)  # all are absent
        self.ranges = np.zeros((cars, self.config.sensors.rays), dtype=np.float32)
        self.closing = np.zeros((cars, self.config.sensors.rays * ("motion" in features)), dtype=np.float32)
        self.observations = np.zeros((cars, values), dtype=np.float32)
        self._physics: Physics | None = None  # None: made when a kernel needs it next
        self._starts = np.zeros((cars, POSE), dtype=np.float32)
        self._drawn: dict[int, tuple[Any, ...]] = {}  # cars' own `parameters`, if vehicles are randomised
        # Readings and commands of all cars (`History`), for each Delays that a car has.
        self._histories: dict[Delays, History | None] = {}
        self.maps: dict[int, Map] = {}  # the map of each car that was reset
        self._row_of: dict[Map, int] = {}  # row of each map in the atlas
        self._rows = np.full(cars, -1)  # row of each car's map in the atlas
        self._groups = _by_map(self._rows)

    def __getstate__(self) -> dict[str, Any]:
        """State without read-only arrays: copies would be writable, and kernels would be compiled again for them."""
        return {**vars(self), "_physics": None, "_drawn": {}}

    def __len__(self) -> int:
        return len(self.ends)

    def reset(
        self,
        maps: Map | Sequence[Map],
        starts: np.ndarray,
        cars: np.ndarray | None = None,
        worlds: np.ndarray | None = None,
    ) -> None:
        """Begin episodes.

        Args:
            maps: the map of each car [k], or one for all.
            starts: float32 [k, 5]: x, y (m), heading (rad), speed (m/s), steering (rad); or [k, 8], to
                continue a drive (`state.START_FIELDS`).
            cars: indices [k] of the cars that begin; None is all of them.
            worlds: float32 [k, traffic, TRAFFIC_FIELDS], the traffic around each car (`world.spawn`); None is no cars.
        """
        cars = np.arange(len(self)) if cars is None else cars
        maps = [maps] * len(cars) if isinstance(maps, Map) else maps
        starts, traffic = starts.astype(np.float32), (len(cars), *self.worlds.shape[1:])
        if len(maps) != len(cars) or starts.shape not in [(len(cars), fields) for fields in (POSE, START_FIELDS)]:
            raise ValueError(f"there are {len(cars)} cars, not {len(maps)} maps and starts of shape {starts.shape}")
        if worlds is not None and worlds.shape != traffic:
            raise ValueError(f"traffic must be {traffic[0]} worlds of {traffic[1]} cars, not {worlds.shape}")
        self.ends[cars] = End.RUNNING
        self.worlds[cars] = -1.0 if worlds is None else worlds
        self._put_on(cars, maps)
        cells = max(visit_cells(each.road) for each in set(maps))
        if cells > self.visits.shape[1]:
            more = ((0, 0), (0, cells - self.visits.shape[1]))
            self.visits = np.pad(self.visits, more, constant_values=-1e6)
        self._starts[cars] = starts[:, :POSE]
        self._drawn = {i: drawn for i, drawn in self._drawn.items() if i not in cars}
        for batch in self._batches(cars):
            _place_all(*batch, cars, starts, *self._arrays(batch[0]))

    def forget_maps(self) -> None:
        """Have the next reset remove maps on which there are no cars."""
        self._row_of = {}

    def _arrays(self, physics: Physics) -> tuple[Any, ...]:
        """State of all cars as kernels read it; worlds are None without traffic, histories if nothing is imperfect."""
        worlds, seen = self.worlds if self.worlds.shape[1] else None, (self.ranges, self.closing, self.observations)
        histories = None
        *_, delays, _ = physics[1]
        if delays:
            if delays not in self._histories:
                self._histories[delays] = new_history(delays, self.ranges.shape[1], (len(self),))
            histories = self._histories[delays]
        return self.cars, self.visits, worlds, seen, histories

    def _batches(self, cars: np.ndarray | None = None) -> Iterator[tuple[Physics, np.ndarray, np.ndarray]]:
        """Split cars [k], by default all, into batches with the same physics; each randomised vehicle is a batch.

        Yields: (physics, `order`, `runs`), the last two as in `_control_all`, but `order` holds positions in `cars`.
        """
        if self._physics is None:
            atlas = make_atlas([each.road for each in self._row_of], [each.network for each in self._row_of])
            self._physics = atlas, parameters(self.config, self.features)
        if not self.config.randomise:
            yield self._physics, *(self._groups if cars is None else _by_map(self._rows[cars]))
            return
        for k, i in enumerate(range(len(self)) if cars is None else cars.tolist()):
            if i not in self._drawn:
                self._drawn[i] = parameters(self.config, self.features, self._starts[i])
            yield (self._physics[0], self._drawn[i]), np.array([k]), np.array([[self._rows[i], 0, 1]])

    def _put_on(self, cars: np.ndarray, maps: Sequence[Map]) -> None:
        """Put cars [k] on maps [k]. If any of these is new, add them to the atlas.

        When it adds maps, and the atlas has MOST_MAPS or this simulator only one car, it removes maps without cars.
        """
        for each in set(maps):
            check_lanes(each, self.features)
        self.maps.update(zip(cars.tolist(), maps, strict=True))
        before = self._rows.copy()
        if not set(maps) <= self._row_of.keys():
            kept = self._row_of if len(self) > 1 and len(self._row_of) < MOST_MAPS else ()
            wanted = dict.fromkeys([*kept, *self.maps.values()])
            self._row_of, self._physics = {each: row for row, each in enumerate(wanted)}, None
            cars, maps = np.array([*self.maps]), [*self.maps.values()]
        self._rows[cars] = [self._row_of[each] for each in maps]
        if (self._rows != before).any():
            self._groups = _by_map(self._rows)

    def step(self, actions: np.ndarray) -> np.ndarray:
        """One control period of every car. A car whose episode has ended stands still until it is reset.

        Args: actions integers [n], 0 to 7 (`vehicle.Action`), or numbers [n, 2], clipped to [-1, 1] (`act_continuous`).
        Returns: the rewards float32 [n], 0 where no episode was going on.
        """
        if self._rows.min() < 0:
            raise RuntimeError("step() was called before every car was reset; call reset() first")
        if np.shape(actions) not in ((len(self),), (len(self), 2)):
            raise ValueError(f"there are {len(self)} cars, not actions of shape {np.shape(actions)}")
        discrete, commands = _commands(actions)
        rewards = np.zeros(len(self), dtype=np.float32)
        limits = np.float32(self.target), self.max_steps
        for batch in self._batches():
            _control_all(*batch, discrete, commands, limits, self.ends, rewards, *self._arrays(batch[0]))
        return rewards


@njit
def _views(simulation, cars, worlds, closing, ranges, observations, history):
    for i in range(cars.shape[0]):
        look(simulation, cars[i], worlds[i], ranges[i], closing, observations[i], history)


def views(
    scenario: Map,
    cars: np.ndarray,
    worlds: np.ndarray,
    config: SimConfig,
    features: tuple[str, ...] = (),
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """What a car sees in states [n, CAR_FIELDS] among traffic [n, others, TRAFFIC_FIELDS].

    If readings come late, the states must be those of one drive, step by step from its start; else they may be any.
    `start`: of the drive, if its vehicle is drawn.
    Returns: ranges (m) of the rays, float32 [n, rays], and observations with these features, float32 [n, values].
    """
    if len(cars) != len(worlds):
        raise ValueError(f"each of {len(cars)} states needs its own traffic, not {len(worlds)} of them")
    simulation = simulations_on([scenario], config, features, start)[0]
    ranges = np.empty((len(cars), config.sensors.rays), dtype=np.float32)
    observations = np.empty((len(cars), simulation.encoding.first[-1]), dtype=np.float32)
    closing = np.zeros(config.sensors.rays * ("motion" in features), dtype=np.float32)
    history = new_history(simulation.delays, config.sensors.rays)
    _views(simulation, cars, worlds, closing, ranges, observations, history)
    return ranges, observations


def _commands(actions: np.ndarray) -> tuple[bool, np.ndarray]:
    """True for discrete actions [n], False for continuous ones [n, 2]; and the commands of `step.obey`, float32 [n, 2].

    Commands of both kinds have one type, or kernels would be compiled twice. Raises: ValueError.
    """
    array = np.asarray(actions)
    if array.ndim == 2:
        if array.dtype.kind not in "fiu" or np.isnan(array).any():
            raise ValueError("continuous actions must be numbers, and not nan")
        return False, np.ascontiguousarray(np.clip(array, -1.0, 1.0), dtype=np.float32)
    wrong = (array < 0) | (array >= len(Action)) if array.dtype.kind in "iu" else np.ones(len(array), dtype=np.bool_)
    if wrong.any():
        raise ValueError(f"actions must be whole numbers from 0 to {len(Action) - 1}, not {array[wrong][0]}")
    commands = np.zeros((len(array), 2), dtype=np.float32)
    commands[:, 0] = array
    return True, commands
