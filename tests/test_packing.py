"""Recipes and results as bits: nothing is lost, nothing that does not fit is cut off, and the default run's are few."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.settings import EvolveSettings
from evolution.breeding import FRESH, RECIPE
from evolution.packing import pack_recipes, pack_results, result_widths, unpack_recipes, unpack_results
from evolution.rollout import EPISODE, RESULT, Limits
from gridsim.config import SimConfig

LIMITS = Limits(150.0, 300)


def episodes_of(targets: list[float], steps: list[int]) -> np.ndarray:
    episodes = np.zeros(len(targets), dtype=EPISODE)
    episodes["target"], episodes["steps"] = targets, steps
    return episodes


def random_results(rng: np.random.Generator, n: int, episodes: np.ndarray) -> np.ndarray:
    """What such episodes may end with, the farthest and the longest among it."""
    results = np.zeros((n, len(episodes)), dtype=RESULT)
    farthest = np.where(episodes["target"] > 0, episodes["target"], LIMITS.target) + 3.0  # a step at 30 m/s
    for name in ("distance", "paced"):
        results[name] = np.floor(rng.choice([0.0, rng.random(), 1.0], results.shape) * farthest * 16) / 16
    steps = np.where(episodes["steps"] > 0, episodes["steps"], LIMITS.steps)
    results["steps"] = np.floor(rng.choice([0.0, rng.random(), 1.0], results.shape) * steps)
    results["end"] = rng.integers(5, size=results.shape)
    return results


@given(
    st.integers(0, 2**32),
    st.integers(0, 40),
    st.lists(st.tuples(st.floats(0.0, 4000.0, width=32), st.integers(0, 65_535)), min_size=1, max_size=20),
)
def test_results_come_back_as_they_were(seed: int, n: int, drives: list[tuple[float, int]]) -> None:
    episodes = episodes_of([target for target, _ in drives], [steps for _, steps in drives])
    results = random_results(np.random.default_rng(seed), n, episodes)
    widths = result_widths(episodes, LIMITS, SimConfig())
    raw = pack_results(results, widths)
    assert raw is not None
    assert len(raw) == n * math.ceil(widths.sum() / 8)
    back = unpack_results(raw, widths)
    assert back.dtype == RESULT
    assert back.tobytes() == results.tobytes()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("distance", 0.01),  # between two sixteenths
        ("distance", 256.0),  # one bit more than 153 m need
        ("distance", -1.0),
        ("distance", math.nan),
        ("distance", math.inf),
        ("distance", 1e30),
        ("paced", 256.0),
        ("steps", 512),
        ("end", 8),
        ("pad", 1),
    ],
)
def test_what_does_not_fit_is_not_cut_off(name: str, value: float) -> None:
    episodes = episodes_of([0.0, 0.0], [0, 0])
    widths = result_widths(episodes, LIMITS, SimConfig())
    results = np.zeros((3, 2), dtype=RESULT)
    assert pack_results(results, widths) is not None
    results[name][2, 1] = value
    assert pack_results(results, widths) is None


@given(st.lists(st.tuples(st.integers(0, FRESH), st.integers(0, FRESH), st.integers(0, 2**32 - 1)), max_size=50))
def test_recipes_come_back_as_they_were(rows: list[tuple[int, int, int]]) -> None:
    recipes = np.array(rows, dtype=RECIPE)
    back = unpack_recipes(pack_recipes(recipes))
    assert back.dtype == RECIPE
    assert back.tobytes() == recipes.tobytes()
    assert not back.flags.writeable


def test_a_plain_copy_of_the_first_parent_is_a_recipe_too() -> None:
    """All of its numbers are zero, and still there is one of it."""
    assert unpack_recipes(pack_recipes(np.zeros(1, dtype=RECIPE))).tolist() == [(0, 0, 0)]


def test_a_child_of_the_default_run_takes_less_than_64_bytes_both_ways() -> None:
    """With the longest episodes that it has, and with validation beside it."""
    settings = EvolveSettings()
    config, sim = settings.curriculum(), SimConfig()
    steps = math.ceil((config.last_target / config.pace + config.slack) / sim.episode.control_period)
    short = math.ceil((config.crash_target / config.pace + config.slack) / sim.episode.control_period)
    episodes = episodes_of(
        [config.last_target] * config.starts + [config.crash_target] * config.crash_starts,
        [steps] * config.starts + [short] * config.crash_starts,
    )
    up = len(pack_results(np.zeros((1, len(episodes)), RESULT), result_widths(episodes, LIMITS, sim)) or b"")
    recipes = np.zeros(settings.population, dtype=RECIPE)
    recipes["a"] = recipes["b"] = settings.parents + settings.elites + config.contenders
    recipes["seed"] = np.arange(1, settings.population + 1)
    down = len(pack_recipes(recipes)) / settings.population
    goal = episodes_of([sim.episode.target], [round(sim.episode.time_limit / sim.episode.control_period)])
    trial_bits = result_widths(goal, LIMITS, sim).sum()
    drives = config.contenders * config.first_validation + config.validation - config.first_validation
    beside = drives * trial_bits / 8 / settings.population
    assert up + down + beside < 62.0
