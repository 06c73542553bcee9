"""Stable-Baselines3's learners on the vector environment."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from stable_baselines3 import DQN, PPO

from gridsim.envs.sb3 import SB3VecEnv


def test_it_tells_sb3_what_the_vector_environment_tells():
    sb3 = SB3VecEnv("GridSim/Curved-v0", num_envs=4, max_episode_steps=20)
    own = gymnasium.make_vec("GridSim/Curved-v0", 4, autoreset_mode=AutoresetMode.SAME_STEP, max_episode_steps=20)
    sb3.seed(3)
    observations, (expected, _) = sb3.reset(), own.reset(seed=3)
    returns = np.zeros(4)
    for step in range(1, 41):
        np.testing.assert_array_equal(observations, expected)
        actions = np.full(4, 4)  # none: nobody ends before the time
        observations, rewards, dones, infos = sb3.step(actions)
        expected, own_rewards, terminated, truncated, info = own.step(actions)
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
    sb3.close()
    own.close()


def test_its_learners_learn_on_rays_and_pictures():
    rays = SB3VecEnv("GridSim/Curved-v0", num_envs=64, steering=True)
    model = PPO("MlpPolicy", rays, n_steps=16, batch_size=256, n_epochs=1).learn(2048)
    assert model.num_timesteps == 2048
    few = SB3VecEnv("GridSim/Curved-v0", num_envs=4)
    assert DQN("MlpPolicy", few, buffer_size=1000, learning_starts=50).learn(200).num_timesteps >= 200
    pictures = SB3VecEnv("GridSim/Curved-v0", num_envs=4, observation="image")
    assert PPO("CnnPolicy", pictures, n_steps=8, batch_size=16, n_epochs=1).learn(64).num_timesteps == 64
