"""The environments' pictures, films, maps and copies, and Stable-Baselines3 on them."""

import contextlib
import copy
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordVideo
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from gridsim import simulator
from gridsim.car.vehicle import Action
from gridsim.envs.env import RENDER_SIZE, GridSimEnv
from gridsim.envs.sb3 import SB3VecEnv
from gridsim.maps.map import Map
from gridsim.view.render import Window

# --- pictures


@pytest.mark.usefixtures("dummy")
def test_a_window_shows_what_the_pictures_show_until_it_is_closed(maps: dict[str, list[Map]]) -> None:
    import pygame

    options: dict[str, Any] = {"scenario": "city", "maps": maps["city"]}
    human, array = GridSimEnv(render_mode="human", **options), GridSimEnv(render_mode="rgb_array", **options)
    for env in (human, array):
        env.reset(seed=5)
        for _ in range(3):
            env.step(Action.ACCELERATE)
    assert human.render() is None
    picture: Any = array.render()
    assert picture.dtype == np.uint8
    assert picture.shape == (RENDER_SIZE[1], RENDER_SIZE[0], 3)
    (window,) = Window._open
    np.testing.assert_array_equal(pygame.surfarray.array3d(window.get_surface()).swapaxes(0, 1), picture)

    pygame.event.post(pygame.event.Event(pygame.QUIT))
    human.step(Action.ACCELERATE)
    assert not pygame.display.get_init()
    human.step(Action.ACCELERATE)  # drives on, unseen
    human.close()
    human.close()


@pytest.mark.usefixtures("dummy")
def test_a_window_that_is_closed_leaves_the_others_open_with_their_own_keys() -> None:
    import pygame

    picture = np.full((24, 32, 3), 7, dtype=np.uint8)
    with contextlib.closing(Window((32, 24))) as first, contextlib.closing(Window((32, 24))) as second:
        Window((32, 24)).close()
        first.show(picture, 1000.0)
        one, other = Window._open
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_n, window=other))
        pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=one))
        assert first.keys() == (set(), set())
        assert (first.closed, second.closed) == (True, False)
        first.close()
        second.show(picture, 1000.0)
        np.testing.assert_array_equal(pygame.surfarray.array3d(other.get_surface()).swapaxes(0, 1), picture)
        assert second.keys() == ({"n"}, {"n"})
    assert not pygame.display.get_init()


def test_record_video_films_in_real_time(tmp_path: Path) -> None:
    plain = gymnasium.make("GridSim/Highway-v0", maps=1, render_mode="rgb_array", max_episode_steps=6)
    env: Any = RecordVideo(plain, str(tmp_path / "films"))
    assert env.frames_per_sec == 10
    env.reset(seed=0)
    for _ in range(6):
        env.step(int(Action.ACCELERATE))
    env.close()
    assert len(list(tmp_path.glob("films/*.mp4"))) == 1


# --- maps and copies


@pytest.mark.parametrize(("observation", "frames"), [("rays", 1), ("grid", 4)])
@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("single", [True, False])
def test_a_copy_goes_on_alike_with_the_same_kernels(single: bool, clone: Any, observation: str, frames: int) -> None:
    options: Any = {"maps": 2, "observation": observation, "frames": frames, "render_mode": "rgb_array"}
    name = "GridSim/City-v0"
    env: Any = gymnasium.make(name, **options) if single else gymnasium.make_vec(name, num_envs=3, **options)
    env.action_space.seed(1)
    row = [env.action_space.sample() for _ in range(12)]
    env.reset(seed=5)
    env.step(row[0])
    env.render()
    compiled = len(simulator._control_all.signatures)
    other = clone(env)
    for action in row[1:]:
        ours, theirs = env.step(action), other.step(action)
        assert repr(ours) == repr(theirs)
        np.testing.assert_equal(ours, theirs)
        if single and (ours[2] or ours[3]):
            break
    np.testing.assert_array_equal(env.render(), other.render())
    np.testing.assert_equal(env.reset(), other.reset())
    assert len(simulator._control_all.signatures) == compiled


# --- Stable-Baselines3 -----------------------------------------------------------------------------------------------


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
    np.testing.assert_array_equal(pictures.env_method("render", indices=1), pictures.get_images()[1:])
    shown = pictures.render()
    assert shown is not None
    assert shown.shape == (2 * RENDER_SIZE[1], RENDER_SIZE[0], 3)


def test_sb3s_own_processes_find_the_environment_by_its_modules_name():
    """They have not imported gridsim; what stands before the colon tells Gymnasium to."""
    cars = make_vec_env("gridsim:GridSim/Curved-v0", 2, seed=3, env_kwargs={"maps": 1}, vec_env_cls=SubprocVecEnv)
    own = gymnasium.make_vec("GridSim/Curved-v0", 2, maps=1)
    np.testing.assert_array_equal(cars.reset(), own.reset(seed=3)[0])
    np.testing.assert_array_equal(cars.step(np.zeros(2, dtype=int))[0], own.step(np.zeros(2, dtype=int))[0])
    cars.close()
