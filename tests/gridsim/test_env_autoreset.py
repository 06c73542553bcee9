"""Gymnasium's three autoreset modes: the same episodes, and each mode as Gymnasium's own vector environment has it."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from driving import SENSING, drive
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from gridsim.envs.env import GridSimEnv, GridSimVectorEnv
from gridsim.maps.map import Map

N, STEPS = 4, 70


def made(maps: dict[str, list[Map]], mode: AutoresetMode, **options: Any) -> GridSimVectorEnv:
    return GridSimVectorEnv(N, scenario="city", maps=maps["city"], max_episode_steps=25, autoreset_mode=mode, **options)


def same(ours: Any, theirs: Any) -> None:
    """Equal arrays, or dictionaries and sequences of such."""
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys()
        for name in ours:
            same(ours[name], theirs[name])
    elif isinstance(ours, tuple) or (isinstance(ours, np.ndarray) and ours.dtype == object):
        for a, b in zip(ours, theirs, strict=True):
            same(a, b)
    else:
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(("observation", "frames"), SENSING)
@pytest.mark.parametrize("mode", AutoresetMode)
def test_each_mode_is_that_of_gymnasiums_own_vector_environment(
    maps: dict[str, list[Map]], mode: AutoresetMode, observation: str, frames: int
) -> None:
    options: dict[str, Any] = {"observation": observation, "frames": frames}
    options |= {"scenario": "city", "maps": maps["city"], "max_episode_steps": 25}
    native = GridSimVectorEnv(N, autoreset_mode=mode.value, **options)
    synced = gymnasium.vector.SyncVectorEnv([lambda: GridSimEnv(**options)] * N, autoreset_mode=mode)
    assert native.metadata["autoreset_mode"] is mode
    seeds: list[int | None] = [40, 7, 40, 3]
    ours: tuple[Any, ...] = native.reset(seed=seeds)
    theirs: tuple[Any, ...] = synced.reset(seed=seeds)
    assert ours[0] in native.observation_space
    same(ours, theirs)
    ended = 0
    for row in drive(native, STEPS, seed=2):
        ours, theirs = native.step(row), synced.step(row)
        same(ours, theirs)
        over = ours[2] | ours[3]
        ended += over.sum()
        if mode is AutoresetMode.DISABLED and over.any():
            each = [None, 5, None, None]
            ours, theirs = (env.reset(seed=each, options={"reset_mask": over}) for env in (native, synced))
            same(ours, theirs)
    assert ended > N


def test_a_car_that_has_ended_must_be_reset(maps: dict[str, list[Map]]) -> None:
    env = made(maps, AutoresetMode.DISABLED)
    some = np.array([True, False, False, True])
    with pytest.raises(ResetNeeded, match="first reset of all"):
        env.reset(options={"reset_mask": some})
    env.reset(seed=1)
    for _ in range(25):
        *_, info = env.step(np.full(N, 4))
        if info["end"].any():
            break
    with pytest.raises(ResetNeeded, match="reset_mask"):
        env.step(np.full(N, 4))
    env.reset(options={"reset_mask": info["end"] != 0})
    env.step(np.full(N, 4))


@pytest.mark.parametrize("mask", [[True] * N, np.ones(N), np.ones(3, dtype=bool), np.zeros(N, dtype=bool), "all"])
def test_a_wrong_mask_is_refused(maps: dict[str, list[Map]], mask: Any) -> None:
    env = made(maps, AutoresetMode.DISABLED)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="reset_mask must be an array of 4 bools"):
        env.reset(options={"reset_mask": mask})
    env.step(np.full(N, 4))


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, 3, -4], [1, 2, 3, 0.5], "abcd"])
def test_wrong_seeds_are_refused(maps: dict[str, list[Map]], seed: Any) -> None:
    with pytest.raises(ValueError, match="seed must be a whole number from 0, or 4 of them"):
        made(maps, AutoresetMode.NEXT_STEP).reset(seed=seed)
