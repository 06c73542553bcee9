"""The Gymnasium environments' pictures and films, the maps that they share, and copies of them."""

import contextlib
import copy
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

from gridsim import simulator
from gridsim.car.vehicle import Action
from gridsim.envs.env import RENDER_SIZE, GridSimEnv
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
    shown = pygame.surfarray.array3d(window.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, picture)

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
def test_a_copied_environment_goes_on_alike_with_the_same_kernels(
    single: bool, clone: Any, observation: str, frames: int
) -> None:
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
