"""Gymnasium: the native vector environment, and the single environment, which is the same thing with one car.

Importing this file registers an id for each scenario, `GridSim/Seamless-v0` and so on; Gymnasium imports it by itself
for `gymnasium.make("gridsim.env:GridSim/Seamless-v0")`. (It reads no plugins' entry points since its 1.0.)

Observation: float32 [rays + 1], the rays' ranges as shares of 50 m and the speed as a share of 30 m/s. Action: one of
`vehicle.Action`. Reward (the paper's): 0.15 f(distance) + 0.15 f(speed) + 0.7 min(S), each in [0, 1]; -1 for a
collision. f(distance) is this step's new ground and f(speed) the forward speed, as shares of what the scenario's upper
speed gives and no more than 1; min(S) is the shortest of the rays.

An episode is a function of its car's seed and of its number alone: after `reset(seed=s)` car i meets the episodes that
a single environment meets after `reset(seed=s + i)`, whatever the other cars do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gridsim.config import SimConfig
from gridsim.counter import GOLDEN, mix
from gridsim.jit import njit
from gridsim.roads import clearance
from gridsim.scenarios import REGISTRY, TRAINING_SEED, Scenario, build, check_name, is_map_file, map_of, starts_at
from gridsim.simulator import DISTANCE, End, Simulator
from gridsim.vehicle import Action

DISTANCE_SHARE, SPEED_SHARE, CLEARANCE_SHARE = 0.15, 0.15, 0.7
CRASH_REWARD = -1.0

_F, _U = np.float32, np.uint64
_NAMES = np.array([end.name.lower() for end in End])
_TIME = int(End.TIME)  # a plain number: comparing arrays with an IntEnum is slow


@njit
def _draw(keys, episodes, which, numbers):
    """Two uniform numbers in [0, 1) for each of cars `which` [k] and its episode: float64 [k, 2]."""
    for k in range(which.shape[0]):
        i = which[k]
        episode = mix(mix(keys[i]) + _U(episodes[i]) * GOLDEN)
        for j in range(2):
            numbers[k, j] = (mix(episode + _U(j + 1) * GOLDEN) >> _U(11)) * (1.0 / (1 << 53))


@njit
def _observe(ranges, speeds, progress, ends, fastest, begun, reach, slowest, limit, dt, observations, rewards):
    """Observations [n, rays + 1] and rewards [n]; `fastest` m/s is the upper speed of each car's scenario."""
    rays = ranges.shape[1]
    for i in range(ranges.shape[0]):
        shortest = reach
        for r in range(rays):
            observations[i, r] = min(ranges[i, r] / reach, _F(1.0))
            shortest = min(shortest, ranges[i, r])
        speed = speeds[i]
        observations[i, rays] = min(max(speed / limit, slowest), _F(1.0))
        if begun[i]:
            rewards[i] = _F(0.0)
        elif ends[i] == 1:
            rewards[i] = _F(CRASH_REWARD)
        else:
            rewards[i] = (
                _F(DISTANCE_SHARE) * min(progress[i] / (fastest[i] * dt), _F(1.0))
                + _F(SPEED_SHARE) * min(max(speed / fastest[i], _F(0.0)), _F(1.0))
                + _F(CLEARANCE_SHARE) * (shortest / reach)
            )


class GridSimVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many cars at once, each in an episode of its own.

    The step after an episode's end begins the next one and does not drive (`AutoresetMode.NEXT_STEP`, which all of
    Gymnasium's wrappers know). info: `distance_m` (new ground of the episode so far), `speed_mps` and `end` (`running`,
    `collision`, `idle`, `success` or `time`), arrays [n]. Collision, idle and success terminate; `time`, the time
    limit, truncates.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012, Gymnasium's own form

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scenario: str = "seamless",
        maps: int | Sequence[Scenario] = 8,
        map_seed: int = TRAINING_SEED,
        max_episode_steps: int | None = None,
        config: SimConfig | None = None,
    ):
        """Maps are built when an episode first needs them.

        Args:
            num_envs: cars.
            scenario: name in the registry of scenarios, or a map's file (`gridsim.maps`), which is one map.
            maps: how many maps the episodes are drawn from, or the maps themselves.
            map_seed: seed of the first of them; the others' follow.
            max_episode_steps: time limit in control steps; None is the configuration's.
            config: vehicle, sensors and episode.
        Raises: ValueError with one line where an argument makes no sense.
        """
        check_name(scenario)
        if map_seed < 0:
            raise ValueError(f"map_seed must be 0 or more, not {map_seed}")
        self.num_envs = num_envs
        self.config = config or SimConfig()
        self.scenario = scenario
        if isinstance(maps, int) and is_map_file(scenario):
            maps = [build(scenario, map_seed, self.config)] * min(maps, 1)
        given = [] if isinstance(maps, int) else list(maps)
        self._seeds = [map_seed + k for k in range(maps)] if isinstance(maps, int) else [s.seed for s in given]
        if not self._seeds:
            raise ValueError("an environment needs 1 map or more")
        self.simulator = Simulator(given, num_envs, self.config, max_steps=max_episode_steps)
        self._index = {seed: k for k, seed in enumerate(self._seeds) if given}  # of each map among the simulator's
        low = np.zeros(self.config.sensors.rays + 1, dtype=np.float32)
        low[-1] = self._slowest = _F(-self.config.vehicle.reverse_limit / self.config.vehicle.speed_limit)
        self.single_observation_space = Box(low, np.ones_like(low))
        self.single_action_space = Discrete(len(Action))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        #: float32 [n, rays], m: the ranges that the last observations were made of.
        self.ranges = np.zeros((num_envs, self.config.sensors.rays), dtype=np.float32)
        self._keys: np.ndarray | None = None  # uint64 [n], each car's seed; None before the first reset
        self._episodes = np.zeros(num_envs, dtype=np.uint64)  # number of each car's episode since it was seeded
        self._fastest = np.ones(num_envs, dtype=np.float32)  # m/s, upper speed of each car's scenario
        self._started = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode for every car.

        Args:
            seed: car i is seeded with seed + i; without a seed the cars go on to their next episodes.
            options: `map_seed`, one for all cars or one each: the map of these episodes; `start`, [5] or [n, 5]: x, y
                (m), heading (rad), speed (m/s), steering (rad). What follows these episodes is drawn as ever.
        Returns: (observations float32 [n, rays + 1], info).
        Raises: ValueError with one line for an option that is unknown or makes no sense.
        """
        options = dict(options or {})
        map_seed, start = options.pop("map_seed", None), options.pop("start", None)
        if options:
            raise ValueError(f"unknown option {next(iter(options))!r}; there are: map_seed, start")
        self._started = False
        super().reset(seed=seed)
        if seed is not None or self._keys is None:
            first = int(self.np_random.integers(1 << 63)) if seed is None else seed
            self._keys = _U(first % (1 << 64)) + np.arange(self.num_envs, dtype=np.uint64)
            self._episodes[:] = 0
        else:
            self._episodes += _U(1)
        if map_seed is not None:
            self._keep_own_maps()
        maps, starts = self._episode(np.arange(self.num_envs), map_seed, start)
        ranges, speeds = self.simulator.reset(starts, maps)
        self._fastest[:] = self._upper_speeds(maps)
        self._started = True
        progress, begun = np.zeros(self.num_envs, dtype=np.float32), np.ones(self.num_envs, dtype=np.bool_)
        observations, _ = self._observe(ranges, speeds, progress, self.simulator.state.ends, begun)
        return observations, self._info(speeds, self.simulator.state.ends)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of every car, or the beginning of its next episode where the last step ended one.

        Args: actions integers [n], `vehicle.Action`; of no effect where an episode begins.
        Returns: (observations float32 [n, rays + 1], rewards float32 [n], terminations bool [n], truncations bool [n],
        info).
        Raises: gymnasium.error.ResetNeeded before the first reset; ValueError with one line for anything but an action
        for each car.
        """
        if not self._started:
            raise ResetNeeded("step() was called before reset()")
        begun = self.simulator.state.ends != 0
        ranges, speeds, progress, ends = self.simulator.step(actions)
        if begun.any():
            which = np.flatnonzero(begun)
            self._episodes[which] += _U(1)
            maps, starts = self._episode(which)
            ranges[which], speeds[which] = self.simulator.reset(starts, maps, which)
            ends[which] = End.RUNNING
            self._fastest[which] = self._upper_speeds(maps)
        observations, rewards = self._observe(ranges, speeds, progress, ends, begun)
        truncations = ends == _TIME
        terminations = (ends != 0) ^ truncations
        return observations, rewards, terminations, truncations, self._info(speeds, ends)

    def _keep_own_maps(self) -> None:
        """Forget the maps that were asked for by a reset and are not among those that episodes are drawn from."""
        kept = [seed for seed in self._seeds if seed in self._index]
        self.simulator.scenarios[:] = [self.simulator.scenarios[self._index[seed]] for seed in kept]
        self._index = {seed: k for k, seed in enumerate(kept)}

    def _map(self, seed: int) -> int:
        """Index among the simulator's scenarios of the map of a seed, built where it is not there yet."""
        seed = map_of(self.scenario, seed)
        if seed not in self._index:
            self.simulator.scenarios.append(build(self.scenario, seed, self.config))
            self._index[seed] = len(self.simulator.scenarios) - 1
        return self._index[seed]

    def _upper_speeds(self, maps: np.ndarray) -> np.ndarray:
        """Upper speed (m/s) of the scenario of each of maps [k]."""
        return np.array([s.road.speed_high for s in self.simulator.scenarios], dtype=np.float32)[maps]

    def _episode(self, which: np.ndarray, map_seed: Any = None, start: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """The maps [k] and starts [k, 5] of the present episodes of cars `which`, drawn unless they are given."""
        numbers = np.empty((len(which), 2))
        _draw(self._keys, self._episodes, which, numbers)
        if map_seed is None:
            drawn = (numbers[:, 0] * len(self._seeds)).astype(np.intp)
            index = {k: self._map(self._seeds[k]) for k in np.unique(drawn)}
            maps = np.array([index[k] for k in drawn])
        else:
            seeds = np.asarray(map_seed)
            if seeds.dtype.kind not in "iu" or seeds.shape not in ((), which.shape) or seeds.min() < 0:
                raise ValueError(f"map_seed must be a whole number from 0, or {len(which)} of them, not {map_seed!r}")
            maps = np.array([self._map(int(seed)) for seed in np.broadcast_to(seeds, which.shape)])
        starts = np.empty((len(which), 5), dtype=np.float32)
        if start is None:
            for m in np.unique(maps):
                of = np.flatnonzero(maps == m)
                starts[of] = starts_at(self.simulator.scenarios[m], numbers[of, 1])
        else:
            starts[:] = self._checked_start(start, maps)
        return maps, starts

    def _checked_start(self, start: Any, maps: np.ndarray) -> np.ndarray:
        """A caller's start, float32 [n, 5]."""
        vehicle = self.config.vehicle
        try:
            starts = np.broadcast_to(np.asarray(start, dtype=np.float32), (len(maps), 5))
        except (TypeError, ValueError):
            raise ValueError(
                f"start must be x, y, heading, speed, steering, or {len(maps)} rows of these, not {start!r}"
            ) from None
        if not np.isfinite(starts).all():
            raise ValueError(f"start must be five finite numbers, not {start!r}")
        for m, (x, y, _, speed, steering) in zip(maps, starts, strict=True):
            if not -vehicle.reverse_limit <= speed <= vehicle.speed_limit:
                raise ValueError(f"a start's speed must be within the car's limits, not {speed:g} m/s")
            if abs(steering) > np.radians(vehicle.steering_limit) + 1e-6:
                raise ValueError(f"a start's steering must be within the car's limits, not {steering:g} rad")
            if clearance(self.simulator.scenarios[m].road, x, y) < 0.0:
                raise ValueError(f"a start must be on the road, not at {x:g} m, {y:g} m")
        return starts

    def _observe(
        self, ranges: np.ndarray, speeds: np.ndarray, progress: np.ndarray, ends: np.ndarray, begun: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Observations [n, rays + 1] and rewards [n] of a step."""
        n, rays = ranges.shape
        observations, rewards = np.empty((n, rays + 1), dtype=np.float32), np.empty(n, dtype=np.float32)
        _observe(
            ranges,
            speeds,
            progress,
            ends,
            self._fastest,
            begun,
            _F(self.config.sensors.range),
            self._slowest,
            _F(self.config.vehicle.speed_limit),
            _F(self.config.episode.control_period),
            observations,
            rewards,
        )
        self.ranges = ranges
        return observations, rewards

    def _info(self, speeds: np.ndarray, ends: np.ndarray) -> dict[str, Any]:
        """Distance, speed and end of every car, in Gymnasium's form: each with a mask of whose it is."""
        all_of_them = np.ones(self.num_envs, dtype=np.bool_)
        return {
            "distance_m": self.simulator.state.cars[:, DISTANCE].copy(),
            "speed_mps": speeds,
            "end": _NAMES[ends],
            "_distance_m": all_of_them,
            "_speed_mps": all_of_them,
            "_end": all_of_them,
        }


class GridSimEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One car: a `GridSimVectorEnv` of one without its automatic resets; arguments, spaces, reward and info are its."""

    metadata = {"render_modes": []}  # noqa: RUF012, Gymnasium's own form

    def __init__(
        self,
        scenario: str = "seamless",
        *,
        maps: int | Sequence[Scenario] = 8,
        map_seed: int = TRAINING_SEED,
        max_episode_steps: int | None = None,
        config: SimConfig | None = None,
    ):
        self.cars = GridSimVectorEnv(
            1, scenario=scenario, maps=maps, map_seed=map_seed, max_episode_steps=max_episode_steps, config=config
        )
        self._seeded = False
        self.observation_space = self.cars.single_observation_space
        self.action_space = self.cars.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; see `GridSimVectorEnv.reset`. Returns: (observation float32 [rays + 1], info)."""
        super().reset(seed=seed)
        if seed is None and not self._seeded:
            seed = int(self.np_random.integers(1 << 63))
        self._seeded = True
        observations, info = self.cars.reset(seed=seed, options=options)
        return observations[0], self._own(info)

    def step(self, action: np.int64 | int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period. Returns: (observation float32 [rays + 1], reward, terminated, truncated, info).

        Raises: gymnasium.error.ResetNeeded before a reset and after an episode's end; ValueError with one line for
        anything but an action.
        """
        if self.cars.simulator.state.ends[0] != End.RUNNING:
            raise ResetNeeded("step() was called after the episode's end; call reset() first")
        observations, rewards, terminations, truncations, info = self.cars.step(np.asarray(action)[None])
        return observations[0], float(rewards[0]), bool(terminations[0]), bool(truncations[0]), self._own(info)

    @staticmethod
    def _own(info: dict[str, Any]) -> dict[str, Any]:
        return {key: value[0].item() for key, value in info.items() if not key.startswith("_")}


def env_id(scenario: str) -> str:
    """Gymnasium's id of a scenario: `GridSim/Seamless-v0`."""
    return f"GridSim/{''.join(part.capitalize() for part in scenario.split('_'))}-v0"


for _name in REGISTRY:
    gymnasium.register(
        id=env_id(_name),
        entry_point="gridsim.env:GridSimEnv",
        vector_entry_point="gridsim.env:GridSimVectorEnv",
        kwargs={"scenario": _name},
    )
