"""Stable-Baselines3 on the vector environment and in processes of its own."""

import doctest

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from gridsim.envs import sb3
from gridsim.envs.env import RENDER_SIZE
from gridsim.envs.sb3 import SB3VecEnv


def test_it_tells_sb3_what_the_vector_environment_tells():
    cars = SB3VecEnv("GridSim/Curved-v0", num_envs=4, max_episode_steps=20)
    own = gymnasium.make_vec("GridSim/Curved-v0", 4, autoreset_mode=AutoresetMode.SAME_STEP, max_episode_steps=20)
    cars.seed(3)
    observations, (expected, _) = cars.reset(), own.reset(seed=3)
    returns = np.zeros(4)
    for step in range(1, 41):
        np.testing.assert_array_equal(observations, expected)
        observations, rewards, dones, infos = cars.step(np.full(4, 4))  # none: nobody ends before the time
        expected, own_rewards, terminated, truncated, info = own.step(np.full(4, 4))
        np.testing.assert_array_equal(rewards, own_rewards)
        np.testing.assert_array_equal(dones, terminated | truncated)
        returns += rewards
        for i in np.flatnonzero(dones):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"] == truncated[i]
            assert not infos[i]["is_success"]
            assert infos[i]["episode"]["r"] == pytest.approx(returns[i], abs=1e-4)
            assert infos[i]["episode"]["l"] <= min(step, 20)
            returns[i] = 0.0
    cars.close()
    own.close()


def test_its_learners_learn_on_rays_and_pictures():
    """PPO on rays is docs/api.md's example, and run with it."""
    few = SB3VecEnv("GridSim/Curved-v0", num_envs=4)
    assert DQN("MlpPolicy", few, buffer_size=1000, learning_starts=50).learn(200).num_timesteps >= 200
    pictures = SB3VecEnv("GridSim/Curved-v0", num_envs=4, observation="image")
    assert PPO("CnnPolicy", pictures, n_steps=8, batch_size=16, n_epochs=1).learn(64).num_timesteps == 64
    grids = SB3VecEnv("GridSim/Curved-v0", num_envs=4, observation="grid", frames=2, max_episode_steps=5)
    assert PPO("MultiInputPolicy", grids, n_steps=8, batch_size=16, n_epochs=1).learn(64).num_timesteps == 64


def test_options_are_the_next_resets():
    cars = SB3VecEnv("GridSim/Curved-v0", num_envs=2, maps=1)
    own = gymnasium.make_vec("GridSim/Curved-v0", 2, maps=1)
    cars.seed(3)
    cars.set_options([{"map_seed": 1}, {"map_seed": 2}])
    np.testing.assert_array_equal(cars.reset(), own.reset(seed=3, options={"map_seed": [1, 2]})[0])
    np.testing.assert_array_equal(cars.reset(), own.reset()[0])  # seeds and options are used once
    cars.set_options([{"map_seed": 1}, {}])
    with pytest.raises(ValueError, match=r"^[^\n]*option[^\n]*$"):
        cars.reset()


@pytest.mark.usefixtures("dummy")
def test_sb3_renders_a_window_and_pictures():
    import pygame

    window = SB3VecEnv("GridSim/Curved-v0", num_envs=2, maps=1, render_mode="human")
    window.reset()
    assert window.render() is window.render("human") is None
    assert pygame.display.get_init()
    with pytest.raises(NotImplementedError, match=r"call \.cars\.look"):
        window.env_method("look")
    window.close()
    assert not pygame.display.get_init()
    pictures = SB3VecEnv("GridSim/Curved-v0", num_envs=2, maps=1, render_mode="rgb_array")
    pictures.reset()
    both = pictures.get_images()
    np.testing.assert_array_equal(pictures.env_method("render", indices=1), both[1:])
    shown = pictures.render()
    assert shown is not None
    assert shown.shape == (2 * RENDER_SIZE[1], RENDER_SIZE[0], 3)


def test_the_modules_example_runs():
    done = doctest.testmod(sb3)
    assert (done.attempted, done.failed) == (4, 0)


def test_sb3s_own_processes_find_the_environment_by_its_modules_name():
    """They have not imported gridsim; what stands before the colon tells Gymnasium to."""
    cars = make_vec_env("gridsim:GridSim/Curved-v0", 2, seed=3, env_kwargs={"maps": 1}, vec_env_cls=SubprocVecEnv)
    own = gymnasium.make_vec("GridSim/Curved-v0", 2, maps=1)
    np.testing.assert_array_equal(cars.reset(), own.reset(seed=3)[0])
    np.testing.assert_array_equal(cars.step(np.zeros(2, dtype=int))[0], own.step(np.zeros(2, dtype=int))[0])
    cars.close()
