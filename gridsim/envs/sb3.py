"""GridSim's vector environment as Stable-Baselines3's VecEnv: SB3's learners at the speed of the compiled loop.

>>> from stable_baselines3 import PPO
>>> from gridsim.envs.sb3 import SB3VecEnv
>>> cars = SB3VecEnv("GridSim/Curved-v0", num_envs=64, steering=True)
>>> PPO("MlpPolicy", cars, n_steps=32).learn(2048).num_timesteps
2048
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv


class SB3VecEnv(VecEnv):
    """The vector environment `gymnasium.make_vec(id, num_envs, ...)` as a VecEnv."""

    def __init__(self, id: str, num_envs: int, **options: Any):
        self.cars: Any = gymnasium.make_vec(id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **options)
        self.render_mode = self.cars.render_mode
        super().__init__(num_envs, self.cars.single_observation_space, self.cars.single_action_space)
        self.metadata = self.cars.metadata  # SB3's default has no frame rate; its videos would have 30 frames/s

    def reset(self) -> Any:
        """Begin an episode of each car, with the seeds and options set since the last reset. Returns: observations."""
        names = self._options[0].keys()
        if any(own.keys() != names for own in self._options):
            raise ValueError("set_options must name the same options for every car")
        options = {name: [own[name] for own in self._options] for name in names}
        observations, _ = self.cars.reset(seed=self._seeds, options=options)
        self._reset_seeds()
        self._reset_options()
        self._rewards, self._steps = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=int)
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        """One control period. Returns: observations, rewards, dones, infos.

        Where an episode ends, its info has `terminal_observation`, `TimeLimit.truncated`, `is_success`, and `episode`
        (return `r`, length `l`), which SB3 logs; the observation is the next episode's first. Other infos are empty.
        """
        observations, rewards, terminated, truncated, info = self.cars.step(self._actions)
        dones = terminated | truncated
        self._rewards += rewards
        self._steps += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones).tolist():
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(info["final_info"]["is_success"][i]),
                "episode": {"r": float(self._rewards[i]), "l": int(self._steps[i])},
            }
        self._rewards[dones], self._steps[dones] = 0.0, 0
        return observations, rewards, dones, infos

    def close(self) -> None:
        self.cars.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return list(self.cars.render() or ())

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.cars, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.cars, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call `render`, as SB3 does for a window. Raises: NotImplementedError for any other method."""
        if method_name == "render":
            pictures = self.cars.render() or [None] * self.num_envs
            return [pictures[i] for i in self._get_indices(indices)]
        raise NotImplementedError(f"cars are not separate environments; call .cars.{method_name}")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
