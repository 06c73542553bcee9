"""Gymnasium environments: the native vector environment, and a single environment that wraps it with one car.

Observation (50 m, 30 m/s and 27 degrees are the default configuration's limits):

* `rays`, float32 [rays + 1]: the rays' ranges as shares of 50 m and the speed as a share of 30 m/s. Optional features
  (`gridsim.sensing.observation`) make it longer. `motion` inserts, between ranges and speed, the closing speed of the
  car that each ray hits, float32 [rays], as a share of 30 m/s (0 if it hits none). After the speed, `steering` appends
  the steering angle as a share of 27 degrees, `route` four points of a route ahead, float32 [8]
  (`gridsim.sensing.route`), `limit` the road's speed limit as a share of 30 m/s, and `mirrors` how far behind the next
  cars are on the right and on the left, float32 [2], as shares of 20 m with any configuration (1 if there is none).
* `grid`, a dictionary: `grid`, uint8 [frames, 80, 80], the latest occupancy grids (`gridsim.sensing.grid`), the newest
  last, and `speed`, float32 [1], as a share of 30 m/s.
* `image`, the grid alone, uint8 [frames, 80, 80]: channels first, as convolutional policies expect.

Action: `discrete`, one of `vehicle.Action`, or `continuous`, float32 [2], pedal and wheel of `vehicle.act_continuous`,
clipped to [-1, 1]. Reward: the paper's, within [-1, 1], see `gridsim.car.reward`. Idling (by default, 1.5 s without
progress) ends an episode without a penalty: its last step is rewarded like any other.

Unless `reset` names them, an episode's map and start, and its traffic, depend only on its car's seed and on how many
episodes the car had since it was seeded: after `reset(seed=s)`, car i gets the episodes that a single environment gets
after `reset(seed=s + i)`, whatever the other cars do.
"""

from __future__ import annotations

import copy
import dataclasses
import sys
from collections.abc import Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any, Literal, TypeGuard

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gridsim.car.vehicle import Action
from gridsim.config import SimConfig
from gridsim.envs.draws import Draws
from gridsim.envs.observing import Observer, row
from gridsim.jit import U
from gridsim.maps.map import Map
from gridsim.maps.parts import TRAINING_SEED, roads_of
from gridsim.maps.scenarios import Traffic, check_name, crowds, full_name, has_lanes
from gridsim.sensing.grid import MAX_FRAMES
from gridsim.sensing.observation import OPTIONAL
from gridsim.sensing.route import points_ahead
from gridsim.simulator import Simulator
from gridsim.state import DISTANCE, LANE, SPEED, TERMINATES, TRUNCATES, End
from gridsim.view.display import has_display

if TYPE_CHECKING:
    from gridsim.view.render import Renderer, Window

RENDER_SIZE = (640, 480)  # pixels, width and height

_SUCCESS = int(End.SUCCESS)  # a plain number: comparing arrays with an IntEnum is slow


class GridSimVectorEnv(VectorEnv[Any, np.ndarray, np.ndarray]):
    """Many cars at once, each in its own episode.

    `autoreset_mode` says when the next episode begins. `NEXT_STEP`: in the step after the end; in that step the car
    does not drive. `SAME_STEP`: in the step of the end; info then has the ended episodes' last observations as
    `final_obs`, an array of objects, and their last info as `final_info`. `DISABLED`: when the caller resets the cars
    whose episodes have ended, by `reset(options={"reset_mask": mask})`, or all cars, by `reset()`.

    info, arrays [n]: `distance_m` (new ground of the episode so far), `speed_mps`, `is_success` and `end`, the number
    of a `state.End`, whose docstring says which ends terminate and which truncate.
    """

    metadata = {  # noqa: RUF012, Gymnasium's own form
        "render_modes": ["rgb_array", "human"],
        "render_fps": 1.0 / SimConfig().episode.control_period,  # a picture per control step: real time
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    _window: Window | None = None  # on the class: Gymnasium before 1.3 also closes environments whose __init__ failed

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scenario: str = "seamless",
        maps: int | Sequence[Map] = 8,
        map_seed: int = TRAINING_SEED,
        traffic: Traffic | tuple[int, ...] | None = None,
        observation: Literal["rays", "grid", "image"] = "rays",
        frames: int = 1,
        actions: Literal["discrete", "continuous"] = "discrete",
        render_mode: Literal["rgb_array", "human"] | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        config: SimConfig | str | None = None,
        **features: bool,
    ):
        """Maps are built when an episode first needs them; of a file or folder, the first map is built at once.

        All environments of a process share the maps of the same scenario, seed and configuration.

        Args:
            scenario: a road's name, `all`, a map's file (which is one map), a folder or pattern of three or more such
                files, or several of these, separated by commas.
            maps: how many maps the episodes are drawn from (fewer if there are fewer files), or the maps themselves.
            map_seed: seed of the first map; the others' seeds follow. It is not used if the maps themselves are given.
            traffic: how many other cars there are around each car: usual, heavy, a number, or a tuple with a number for
                each of several roads; None means the scenario's default, which for several roads is usual.
            frames: grids in an observation, 1 to 8; it must be 1 with `rays`.
            render_mode: None for no pictures, `rgb_array`, or `human`, a window that follows the first car. The
                environment's `metadata["render_modes"]` has `human` if there is a display or if it is asked for here.
            max_episode_steps: time limit in control steps; None means the configuration's.
            autoreset_mode: an `AutoresetMode`, or its value, such as `SameStep`.
            config: a SimConfig, or what `SimConfig.load` takes: a preset's name or a YAML file; None is `default`.
            features: which optional features (`gridsim.sensing.observation.OPTIONAL`) are observed besides the rays,
                each True or False, such as motion=True.
        """
        check_name(scenario := full_name(scenario))
        for name, value, known in (
            ("observation", observation, ("rays", "grid", "image")),
            ("actions", actions, ("discrete", "continuous")),
            ("render_mode", render_mode, (None, "rgb_array", "human")),
        ):
            if value not in known:
                raise ValueError(f"{name} must be {' or '.join(str(k) for k in known)}, not {value!r}")
        if not 1 <= frames <= MAX_FRAMES or (frames > 1 and observation == "rays"):
            raise ValueError(f"frames must be 1 to {MAX_FRAMES}, and more than 1 only for grids, not {frames}")
        if unknown := features.keys() - OPTIONAL:
            raise ValueError(f"unknown option {min(unknown)!r}; features of rays are {' and '.join(OPTIONAL)}")
        seen = tuple(name for name in OPTIONAL if features.get(name))
        if seen and observation != "rays":
            raise ValueError(f"{' and '.join(seen)}: only for rays; leave them out with observation={observation!r}")
        self.num_envs, self.config = num_envs, SimConfig.load(config or "default")
        cars = traffic if isinstance(traffic, tuple) else crowds(scenario, traffic, self.config)
        if len(cars) != len(roads := roads_of(scenario)) or min(cars) < 0:
            raise ValueError(f"traffic must be a number of other cars for each of {len(roads)} roads, not {traffic}")
        if not has_lanes(scenario) and (any(cars) or "route" in seen):
            raise ValueError(f"{scenario} has no lanes for traffic or a route; use traffic=0, and not route=True")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array", "human"] if render_mode == "human" or has_display() else ["rgb_array"],
            "render_fps": 1.0 / self.config.episode.control_period,
            "autoreset_mode": self.autoreset_mode,
        }
        self.simulator = Simulator(num_envs, self.config, None, max_episode_steps, max(cars), seen)
        self._draws = Draws(num_envs, scenario, maps, map_seed, cars, self.config)
        self.render_mode = render_mode
        self._views: dict[Map, Renderer] = {}
        self._paths: list[list[np.ndarray]] = [[] for _ in range(num_envs)]  # where each car has been, for pictures
        self._observer = Observer(self.simulator, observation, frames)
        self.single_observation_space = self._observer.space
        continuous = actions == "continuous"
        self.single_action_space = Box(-1.0, 1.0, (2,), dtype=np.float32) if continuous else Discrete(len(Action))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seeded = self._started = False

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_views": {}, "_window": None}  # a copy has its own renderers and its own window

    def reset(
        self, *, seed: int | np.integer | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode for every car, or for those of `reset_mask`.

        Args:
            seed: car i is seeded with seed + i, or with seed[i]; without a seed a car goes on to its next episode, or
                in the very first reset gets a random seed.
            options: `map_seed`, one for all cars or one each: the map of these episodes; `start`, [5] or [n, 5]: x, y
                (m), heading (rad), speed (m/s), steering (rad); `reset_mask`, bool [n]: which cars to reset,
                given only after a first reset of all. Later episodes are drawn as usual.
        Returns: (observations of all cars, info, whose masks say which cars were reset; the others' values are 0).
        """
        known, options = ("map_seed", "start", "reset_mask"), options or {}
        for name in options:
            if name not in known:
                raise ValueError(f"unknown option {name!r}; there are: {', '.join(known)}")
        map_seed, start, mask = map(options.get, known)
        if mask is None:
            mask = np.ones(self.num_envs, dtype=np.bool_)
        elif not (isinstance(mask, np.ndarray) and (mask.dtype, mask.shape) == (bool, (self.num_envs,)) and mask.any()):
            raise ValueError(f"reset_mask must be an array of {self.num_envs} bools, at least one of them true")
        elif not self._started:
            raise ResetNeeded("reset_mask was given before the first reset of all cars")
        which = np.flatnonzero(mask)
        self._started &= len(which) < self.num_envs
        self._seed(seed, which)
        self._begin(which, map_seed, start)
        if map_seed is not None:  # keep no renderers of maps that may not be used again
            driven = set(self.simulator.maps.values())
            self._views = {road_map: view for road_map, view in self._views.items() if road_map in driven}
        self._started = True
        self._note(which, mask)
        return self._observer.look(), {name: part * mask for name, part in self._info().items()}

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of every car, or the beginning of its next episode, as `autoreset_mode` says.

        Args: actions integers [n], `vehicle.Action`, or continuous ones [n, 2]; a car whose episode ended in an earlier
        step does not use its action.
        Returns: (observations, rewards float32 [n], terminations bool [n], truncations bool [n], info).
        Raises: gymnasium.error.ResetNeeded before the first reset, and with `DISABLED` if an episode has ended.
        """
        if not self._started:
            raise ResetNeeded("step() was called before reset()")
        begun = self.simulator.ends != 0
        if self.autoreset_mode is AutoresetMode.DISABLED and begun.any():
            over = f"episodes of {begun.sum()} of {self.num_envs} cars"
            raise ResetNeeded(f"step() was called after the end of the {over}; call reset() with a reset_mask first")
        if np.shape(actions) != self.action_space.shape:
            each = f"{self.num_envs} cars, each with an action of {self.single_action_space}"
            raise ValueError(f"there are {each}, not actions of shape {np.shape(actions)}")
        rewards = self.simulator.step(actions)
        if begun.any():
            self._begin_next(np.flatnonzero(begun))
        self._note(slice(None), begun)
        observations, info, ends = self._observer.look(), self._info(), self.simulator.ends
        terminations, truncations = TERMINATES[ends], TRUNCATES[ends]
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ends.any():
            info = self._begin_anew(observations, info, ends != 0)
        return observations, rewards, terminations, truncations, info

    def _seed(self, seed: int | np.integer | Sequence[int | None] | None, which: np.ndarray) -> None:
        """Seed cars `which`; those without a seed go on to their next episodes, at first with random seeds."""
        n, draws = self.num_envs, self._draws
        seeds: list[Any] = (
            list(seed) if np.iterable(seed) else [int(seed) + i if _is_seed(seed) else seed for i in range(n)]
        )
        if len(seeds) != n or not all(s is None or _is_seed(s) for s in seeds):
            raise ValueError(f"seed must be a whole number from 0, or {n} of them, not {seed!r}")
        if not np.iterable(seed):
            super().reset(seed=seeds[0])
        if self._seeded:
            draws.numbers[which] += U(1)
        else:
            draws.keys[:] = U(self.np_random.integers(1 << 63)) + np.arange(n, dtype=np.uint64)
            self._seeded = True
        for i in which:
            if seeds[i] is not None:
                draws.keys[i], draws.numbers[i] = int(seeds[i]) % (1 << 64), 0

    def _begin(self, which: np.ndarray, map_seed: Any = None, start: Any = None) -> None:
        """Begin the current episodes of cars `which`."""
        maps, starts, worlds = self._draws.draw(which, map_seed, start)
        if map_seed is not None and len(which) == self.num_envs:
            self.simulator.forget_maps()
        self.simulator.reset(maps, starts, which, worlds)

    def _begin_next(self, which: np.ndarray) -> None:
        """Begin the next episodes of cars `which`."""
        self._draws.numbers[which] += U(1)
        self._begin(which)

    def _begin_anew(self, observations: Any, info: dict[str, Any], over: np.ndarray) -> dict[str, Any]:
        """Begin the next episodes of the cars that `over` bool [n] marks.

        Writes their first observations to `observations`. Returns: all cars' info after that, with the ended episodes'
        last observations and info as `final_obs` and `final_info`.
        """
        which = np.flatnonzero(over)
        last = np.full(self.num_envs, None, dtype=object)
        for i in which.tolist():
            last[i] = copy.deepcopy(row(observations, i))
        self._begin_next(which)
        self._note(which, over)
        seen = self._observer.look(which)
        if isinstance(seen, dict):
            for name, part in seen.items():
                observations[name][which] = part
        else:
            observations[which] = seen
        final = {name: value * over for name, value in info.items()}
        return self._info() | {"final_obs": last, "_final_obs": over, "final_info": final, "_final_info": over.copy()}

    def _note(self, which: np.ndarray | slice, begun: np.ndarray) -> None:
        """Add what cars `which` sense to their frames. With a render_mode, add each car's place to its path.

        With `human`, also draw the window.
        Args: `begun` bool [n], whether a car's episode has just begun.
        """
        self._observer.take(begun[which], which)
        if self.render_mode is None:
            return
        for path, car, new in zip(self._paths, self.simulator.cars, begun, strict=True):
            if new:
                path.clear()
            path.append(car[:2].copy())
        if self.render_mode == "human":
            from gridsim.view.render import Window

            if self._window is None:
                self._window = Window(RENDER_SIZE)
            if not self._window.closed:
                self._window.show(self._picture(0), self.metadata["render_fps"])
                self._window.keys()  # reads events: else the window seems hung and cannot be closed by the user

    def _picture(self, i: int) -> np.ndarray:
        """A picture of car i and the road around it: uint8 [height, width, 3]."""
        from gridsim.view.render import Renderer  # here, because only pictures need it

        car, world, road_map = self.simulator.cars[i], self.simulator.worlds[i], self.simulator.maps[i]
        if road_map not in self._views:
            self._views[road_map] = Renderer(road_map, RENDER_SIZE, config=self.config)
        text = f"{car[SPEED]:.1f} m/s    {car[DISTANCE]:,.0f} m"
        boxes, path = world[world[:, LANE] >= 0.0], np.array(self._paths[i])
        route = points_ahead(road_map, car[None])[0]
        return self._views[road_map].draw(car, boxes, self.simulator.ranges[i], path, (text,), route)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """With `rgb_array`, a picture uint8 [height, width, 3] for each car; else None: step and reset draw `human`."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render_mode; use gymnasium.make(id, render_mode='rgb_array')")
            return None
        if not self._started:
            raise ResetNeeded("render() was called before reset()")
        if self.render_mode == "human":
            return None
        return tuple(self._picture(i) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None

    def _info(self) -> dict[str, Any]:
        """Distance, speed, success and end of every car; in Gymnasium's form, each with a mask of cars."""
        cars, ends = self.simulator.cars, self.simulator.ends.copy()
        info: dict[str, Any] = {"distance_m": cars[:, DISTANCE].copy(), "speed_mps": cars[:, SPEED].copy()}
        info |= {"is_success": ends == _SUCCESS, "end": ends}
        everyone = np.ones(self.num_envs, dtype=np.bool_)
        return info | {f"_{name}": everyone for name in info}


def _is_seed(seed: Any) -> TypeGuard[int]:
    """Whether a value is a whole number from 0, of Python or NumPy."""
    return isinstance(seed, Integral) and int(seed) >= 0


class GridSimEnv(gymnasium.Env[Any, Any]):
    """One car: a `GridSimVectorEnv` of one, with the same arguments except `num_envs` and `autoreset_mode`.

    Spaces and reward are those of one car; info has plain numbers and no masks. There are no automatic resets.
    """

    metadata = {name: GridSimVectorEnv.metadata[name] for name in ("render_modes", "render_fps")}  # noqa: RUF012

    def __init__(self, scenario: str = "seamless", **options: Any):
        if "autoreset_mode" in options:
            raise ValueError("autoreset_mode is for vector environments; a single one is reset by its caller")
        self.cars = GridSimVectorEnv(1, scenario=scenario, autoreset_mode=AutoresetMode.DISABLED, **options)
        self.render_mode = self.cars.render_mode
        self.metadata = {name: self.cars.metadata[name] for name in self.metadata}
        self._spec: EnvSpec | None = None
        self.observation_space = self.cars.single_observation_space
        self.action_space = self.cars.single_action_space

    @property
    def spec(self) -> EnvSpec | None:
        """The specification by which `gymnasium.make` made this environment, with its time limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # gymnasium.make gives `max_episode_steps` only to its TimeLimit wrapper, after it has set `spec`. The simulator
        # gets the same limit, so that `info["end"]` tells when time is up.
        maker, simulator = sys._getframe(1), self.cars.simulator
        if maker.f_code is gymnasium.make.__code__:
            named = maker.f_locals  # if a later Gymnasium renames these variables, only the wrapper has the limit
            asked = named.get("max_episode_steps") or getattr(named.get("env_spec"), "max_episode_steps", None)
            if asked is not None and asked > 0:
                simulator.max_steps = asked
        self._spec = spec and dataclasses.replace(spec, max_episode_steps=simulator.max_steps)

    def reset(
        self, *, seed: int | np.integer | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see `GridSimVectorEnv.reset`. Returns: (observation, info)."""
        if seed is not None and not _is_seed(seed):
            raise ValueError(f"seed must be a whole number from 0, not {seed!r}")
        super().reset(seed=None if seed is None else int(seed))
        observations, info = self.cars.reset(seed=seed, options=options)
        return row(observations, 0), self._own(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One control period. Returns: (observation, reward, terminated, truncated, info)."""
        if self.cars.simulator.ends[0] != End.RUNNING:
            raise ResetNeeded("step() was called after the episode's end; call reset() first")
        observations, rewards, terminations, truncations, info = self.cars.step(np.asarray(action)[None])
        return row(observations, 0), float(rewards[0]), bool(terminations[0]), bool(truncations[0]), self._own(info)

    def render(self) -> np.ndarray | None:
        pictures = self.cars.render()
        return pictures[0] if pictures else None

    def close(self) -> None:
        self.cars.close()

    @staticmethod
    def _own(info: dict[str, Any]) -> dict[str, Any]:
        return {key: value[0].item() for key, value in info.items() if not key.startswith("_")}
