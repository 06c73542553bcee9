"""Gymnasium: the native vector environment, and the single environment, which is the same thing with one car.

`import gridsim` registers an id for each scenario, `GridSim/Seamless-v0` and so on.

Observation: `rays`, float32 [rays + 1], the rays' ranges as shares of 50 m and the speed as a share of 30 m/s, and with
`motion` between them how fast a car that a ray meets comes closer, float32 [rays], as a share of 30 m/s, and with
`steering` at the end the steering angle as a share of 27 degrees; or `grid`, uint8 [80, 80], the occupancy grid of
`gridsim.sensing.grid`, and with `frames` above 1 [frames, 80, 80], the newest last. Action: `discrete`, one of
`vehicle.Action`, or `continuous`, float32 [2] in [-1, 1], pedal and wheel of `vehicle.act_continuous`. Reward: the
paper's, within [-1, 1], see `gridsim.car.reward`.

An episode is a function of its car's seed and of its number alone: after `reset(seed=s)` car i meets the episodes that
a single environment meets after `reset(seed=s + i)`, whatever the other cars do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gridsim.car.ego import DISTANCE, SPEED, STEERING, End
from gridsim.car.reward import reward
from gridsim.car.vehicle import Action
from gridsim.config import SimConfig
from gridsim.counter import GOLDEN, mix
from gridsim.envs.simulator import Simulator
from gridsim.jit import njit
from gridsim.maps.map import Map, starts_at
from gridsim.maps.roads import clearance
from gridsim.maps.scenarios import TRAINING_SEED, build, check_name, default_traffic, is_map_file, map_of
from gridsim.sensing.grid import CELLS, grid_table, grids, push_frames
from gridsim.traffic.world import LANE

if TYPE_CHECKING:
    from gridsim.view.render import Renderer, Window

RENDER_FPS, RENDER_SIZE = 10, (640, 480)  # a picture a control period: true speed

_F, _U = np.float32, np.uint64
_NAMES = np.array([end.name.lower() for end in End])
_TIME = int(End.TIME)  # a plain number: comparing arrays with an IntEnum is slow


@njit
def _draw(keys, episodes, which, numbers, drawn):
    """For cars `which` [k] in their episodes: two numbers in [0, 1), float64 [k, 2], and the traffic's key [k]."""
    for k in range(which.shape[0]):
        i = which[k]
        episode = mix(mix(keys[i]) + _U(episodes[i]) * GOLDEN)
        drawn[k] = mix(episode + _U(3) * GOLDEN)
        for j in range(2):
            numbers[k, j] = (mix(episode + _U(j + 1) * GOLDEN) >> _U(11)) * (1.0 / (1 << 53))


@njit
def _observe(ranges, closing, speeds, progress, ends, fastest, begun, reach, slowest, limit, dt, observations, rewards):
    """Observations [n, rays + 1], if not None, and rewards [n]; `fastest` m/s: upper speed of each car's scenario."""
    rays = ranges.shape[1]
    for i in range(ranges.shape[0]):
        speed = speeds[i]
        if observations is not None:
            for r in range(rays):
                observations[i, r] = min(ranges[i, r] / reach, _F(1.0))
            if closing is not None:
                for r in range(rays):
                    observations[i, rays + r] = min(max(closing[i, r] / limit, _F(-1.0)), _F(1.0))
            last = rays if closing is None else 2 * rays
            observations[i, last] = min(max(speed / limit, slowest), _F(1.0))
        if begun[i]:
            rewards[i] = _F(0.0)
        else:
            rewards[i] = reward(ranges[i], reach, speed, progress[i], ends[i], fastest[i], dt)


class GridSimVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many cars at once, each in an episode of its own.

    The step after an episode's end begins the next one and does not drive (`AutoresetMode.NEXT_STEP`, which all of
    Gymnasium's wrappers know). info: `distance_m` (new ground of the episode so far), `speed_mps` and `end` (`running`,
    `collision`, `idle`, `success` or `time`), arrays [n]. Collision, idle and success terminate; `time`, the time
    limit, truncates.
    """

    metadata = {  # noqa: RUF012, Gymnasium's own form
        "render_modes": ["rgb_array", "human"],
        "render_fps": RENDER_FPS,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scenario: str = "seamless",
        maps: int | Sequence[Map] = 8,
        map_seed: int = TRAINING_SEED,
        traffic: int | None = None,
        observation: Literal["rays", "grid"] = "rays",
        frames: int = 1,
        motion: bool = False,
        steering: bool = False,
        actions: Literal["discrete", "continuous"] = "discrete",
        render_mode: Literal["rgb_array", "human"] | None = None,
        max_episode_steps: int | None = None,
        config: SimConfig | None = None,
    ):
        """Maps are built when an episode first needs them.

        Args:
            num_envs: cars.
            scenario: name in the registry of scenarios, or a map's file (`gridsim.maps.files`), which is one map.
            maps: how many maps the episodes are drawn from, or the maps themselves.
            map_seed: seed of the first of them; the others' follow.
            traffic: other cars in each car's world; None is as many as the scenario has by default.
            observation: `rays` or `grid`.
            frames: grids that make an observation, 1 to 16.
            motion: whether rays also tell the motion of what they meet.
            steering: whether the steering angle is told beside them.
            actions: `discrete` or `continuous`.
            render_mode: `rgb_array`, or `human`, a window that follows the first car.
            max_episode_steps: time limit in control steps; None is the configuration's.
            config: vehicle, sensors and episode.
        Raises: ValueError with one line where an argument makes no sense.
        """
        check_name(scenario)
        for name, value, known in (
            ("observation", observation, ("rays", "grid")),
            ("actions", actions, ("discrete", "continuous")),
            ("render_mode", render_mode, (None, "rgb_array", "human")),
        ):
            if value not in known:
                raise ValueError(f"{name} must be {' or '.join(str(k) for k in known)}, not {value!r}")
        if not 1 <= frames <= 16 or (frames > 1 and observation == "rays"):
            raise ValueError(f"frames must be 1 to 16, and more than 1 only for observation='grid', not {frames}")
        for name, asked in (("motion", motion), ("steering", steering)):
            if asked and observation == "grid":
                raise ValueError(f"{name} is seen beside rays; leave it out with observation='grid'")
        if traffic and is_map_file(scenario):
            raise ValueError(f"{scenario} has no lanes for traffic; use traffic=0")
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
        self.traffic = default_traffic(scenario) if traffic is None else traffic
        self.simulator = Simulator(given, num_envs, self.config, max_steps=max_episode_steps, traffic=self.traffic)
        self._index = {seed: k for k, seed in enumerate(self._seeds) if given}  # of each map among the simulator's
        self.render_mode = render_mode
        self._views: dict[int, Renderer] = {}  # by map
        self._window: Window | None = None
        self._paths: list[list[np.ndarray]] = [[] for _ in range(num_envs)]  # where each car has been, for pictures
        self._motion, self._steering = motion, steering
        rays = self.config.sensors.rays
        self._width = (2 if motion else 1) * rays + 1 + steering
        low = np.zeros(self._width, dtype=np.float32)
        low[rays:] = -1.0
        self._slowest = _F(-self.config.vehicle.reverse_limit / self.config.vehicle.speed_limit)
        low[self._width - 1 - steering] = self._slowest
        self._table = grid_table(self.config) if observation == "grid" else None
        self._stack = np.zeros((num_envs, frames, CELLS, CELLS), dtype=np.uint8) if observation == "grid" else None
        self.single_observation_space = Box(low, np.ones_like(low))
        if observation == "grid":
            shape = (CELLS, CELLS) if frames == 1 else (frames, CELLS, CELLS)
            self.single_observation_space = Box(0, 255, shape, dtype=np.uint8)
        self.single_action_space: Discrete | Box = Discrete(len(Action))
        if actions == "continuous":
            self.single_action_space = Box(-1.0, 1.0, (2,), dtype=np.float32)
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
        maps, starts, keys = self._episode(np.arange(self.num_envs), map_seed, start)
        ranges, speeds = self.simulator.reset(starts, maps, keys=keys)
        self._fastest[:] = self._upper_speeds(maps)
        self._started = True
        progress, begun = np.zeros(self.num_envs, dtype=np.float32), np.ones(self.num_envs, dtype=np.bool_)
        observations, _ = self._observe(ranges, speeds, progress, self.simulator.state.ends, begun)
        return observations, self._info(speeds, self.simulator.state.ends)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of every car, or the beginning of its next episode where the last step ended one.

        Args: actions integers [n], `vehicle.Action`, or continuous ones [n, 2]; of no effect where an episode begins.
        Returns: (observations, rewards float32 [n], terminations bool [n], truncations bool [n],
        info).
        Raises: gymnasium.error.ResetNeeded before the first reset; ValueError with one line for anything but an action
        for each car.
        """
        if not self._started:
            raise ResetNeeded("step() was called before reset()")
        begun = self.simulator.state.ends != 0
        if np.shape(actions) != self.action_space.shape:
            each = f"{self.num_envs} cars, each with an action of {self.single_action_space}"
            raise ValueError(f"there are {each}, not actions of shape {np.shape(actions)}")
        ranges, speeds, progress, ends = self.simulator.step(actions)
        if begun.any():
            which = np.flatnonzero(begun)
            self._episodes[which] += _U(1)
            maps, starts, keys = self._episode(which)
            ranges[which], speeds[which] = self.simulator.reset(starts, maps, which, keys)
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

    def _episode(
        self, which: np.ndarray, map_seed: Any = None, start: Any = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Maps [k], starts [k, 5] and traffic's keys [k] of the present episodes of cars `which`, drawn or given."""
        numbers, keys = np.empty((len(which), 2)), np.empty(len(which), dtype=np.uint64)
        _draw(self._keys, self._episodes, which, numbers, keys)
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
        return maps, starts, keys

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
        """Observations and rewards [n] of a step."""
        n = len(ranges)
        rewards = np.empty(n, dtype=np.float32)
        observations = np.empty((n, self._width), dtype=np.float32) if self._table is None else None
        _observe(
            ranges,
            self.simulator.closing if self._motion else None,
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
        if self.render_mode is not None:
            self._remember(begun)
        if observations is None:
            return self._grids(begun), rewards
        if self._steering:
            limit = np.radians(self.config.vehicle.steering_limit)
            observations[:, -1] = np.clip(self.simulator.state.cars[:, STEERING] / limit, -1.0, 1.0)
        return observations, rewards

    def _grids(self, begun: np.ndarray) -> np.ndarray:
        """Occupancy grids of the present ranges, stacked if so asked; the caller's own."""
        assert self._table is not None
        assert self._stack is not None
        now = grids(self._table, self.ranges)
        if self._stack.shape[1] == 1:
            return now
        push_frames(self._stack, now, begun)
        return self._stack.copy()

    # ---------------------------------------------------------------------------------------------------- pictures

    def _remember(self, begun: np.ndarray) -> None:
        """Keep where cars are; where an episode has begun, where it was is forgotten. Shows the window."""
        for path, car, new in zip(self._paths, self.simulator.state.cars, begun, strict=True):
            if new:
                path.clear()
            path.append(car[:2].copy())
        if self.render_mode == "human":
            from gridsim.view.render import Window

            if self._window is None:
                self._window = Window(RENDER_SIZE)
            if not self._window.closed:
                self._window.show(self._picture(0), RENDER_FPS)
                self._window.keys()  # a window whose events nobody takes is shown as one that hangs
                if self._window.closed:  # by whoever watched: drive on unseen
                    self._window.close()

    def _picture(self, i: int) -> np.ndarray:
        """What car i's world looks like: uint8 [height, width, 3]."""
        from gridsim.view.render import Renderer  # here, because nothing else needs pygame

        state = self.simulator.state
        m = int(state.maps[i])
        view = self._views.get(m)
        if view is None or view.scenario is not self.simulator.scenarios[m]:
            view = self._views[m] = Renderer(self.simulator.scenarios[m], RENDER_SIZE, config=self.config)
        others = state.worlds[i][state.worlds[i][:, LANE] >= 0.0]
        speed, distance = float(state.cars[i, SPEED]), float(state.cars[i, DISTANCE])
        return view.draw(
            state.cars[i],
            boxes=others,
            ranges=self.ranges[i] if self._table is None else None,
            grid=None if self._table is None else grids(self._table, self.ranges[i : i + 1])[0],
            path=np.array(self._paths[i]),
            text=f"{speed:.1f} m/s    {distance:,.0f} m",
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture uint8 [height, width, 3] of each car's world with `rgb_array`; a window is drawn by step and reset.

        Raises: gymnasium.error.ResetNeeded before the first reset.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render_mode; use gymnasium.make(id, render_mode='rgb_array')")
            return None
        if not self._started:
            raise ResetNeeded("render() was called before reset()")
        if self.render_mode == "human":
            return None
        return tuple(self._picture(i) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None

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


class GridSimEnv(gymnasium.Env[np.ndarray, Any]):
    """One car: a `GridSimVectorEnv` of one without its automatic resets; arguments, spaces, reward and info are its."""

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": RENDER_FPS}  # noqa: RUF012, Gymnasium's own form

    def __init__(
        self, scenario: str = "seamless", *, render_mode: Literal["rgb_array", "human"] | None = None, **options: Any
    ):
        self.cars = GridSimVectorEnv(1, scenario=scenario, render_mode=render_mode, **options)
        self.render_mode = render_mode
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

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period. Returns: (observation, reward, terminated, truncated, info).

        Raises: gymnasium.error.ResetNeeded before a reset and after an episode's end; ValueError with one line for
        anything but an action.
        """
        if self.cars.simulator.state.ends[0] != End.RUNNING:
            raise ResetNeeded("step() was called after the episode's end; call reset() first")
        observations, rewards, terminations, truncations, info = self.cars.step(np.asarray(action)[None])
        return observations[0], float(rewards[0]), bool(terminations[0]), bool(truncations[0]), self._own(info)

    def render(self) -> np.ndarray | None:
        """A picture uint8 [height, width, 3] with `rgb_array`; None with `human`, whose window step and reset draw."""
        pictures = self.cars.render()
        return pictures[0] if pictures else None

    def close(self) -> None:
        """Close the window."""
        self.cars.close()

    @staticmethod
    def _own(info: dict[str, Any]) -> dict[str, Any]:
        return {key: value[0].item() for key, value in info.items() if not key.startswith("_")}
