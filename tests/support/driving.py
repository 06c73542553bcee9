"""What the tests of environments ask them for, and do in them."""

import numpy as np

from evolution.dqn.experience import Experience
from gridsim.car.vehicle import Action
from gridsim.envs.env import GridSimVectorEnv

SENSING = [("rays", 1), ("grid", 1), ("grid", 4), ("image", 1)]


def drive(env: GridSimVectorEnv, steps: int, seed: int) -> np.ndarray:
    """Random actions for all cars of a vector environment, that mostly speed up: [steps, n, ...]."""
    rng = np.random.default_rng(seed)
    if env.action_space.dtype == np.float32:
        return rng.uniform([-0.2, -0.3], [1.0, 0.3], (steps, env.num_envs, 2)).astype(np.float32)
    return rng.choice([Action.ACCELERATE, Action.NONE, Action.LEFT, Action.RIGHT], (steps, env.num_envs))


def to_bytes(experience: Experience) -> bytes:
    return b"".join(array.tobytes() for array in experience)
