"""The fitness, and its bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evolution.episodes.rollout import RESULT
from evolution.search.fitness import PACED_ENOUGH, scalar

TARGET = 500.0


def results(distance, paced):
    """RESULT [n, e] of distances and paced distances [n, e]."""
    made = np.zeros(np.shape(distance), dtype=RESULT)
    made["distance"], made["paced"] = distance, paced
    return made


metres = st.floats(0.0, 1000.0, width=32)
episodes = st.lists(st.tuples(metres, st.floats(0.0, 1.0)), min_size=1, max_size=6)  # distance, share that was paced


def test_nothing_is_0_and_the_target_is_1():
    assert scalar(results([[0.0]], [[0.0]]), TARGET).tolist() == [0.0]
    for beyond in (TARGET, 3 * TARGET):
        assert scalar(results([[beyond]], [[beyond]]), TARGET) == pytest.approx([1.0])


@given(drives=episodes, which=st.integers(0, 5), more=st.floats(0.5, 100.0))
def test_further_and_better_paced_is_never_worse(drives, which, more):
    row = results([[d for d, _ in drives]], [[d * share for d, share in drives]])
    further, paced = row.copy(), row.copy()
    k = which % len(drives)
    further["distance"][0, k] += more
    paced["paced"][0, k] += more
    for better in (further, paced):
        assert scalar(better, TARGET)[0] >= scalar(row, TARGET)[0]
    if further["distance"][0, k] < TARGET:
        assert scalar(further, TARGET)[0] > scalar(row, TARGET)[0]
        if paced["paced"][0, k] < PACED_ENOUGH * row["distance"][0, k]:
            assert scalar(paced, TARGET)[0] > scalar(row, TARGET)[0]


def test_the_first_bend_is_worth_as_much_as_a_long_way_later():
    value = scalar(results([[0.0], [20.0], [400.0], [420.0]], [[0.0], [20.0], [400.0], [420.0]]), TARGET)
    assert value[1] - value[0] > 5 * (value[3] - value[2])


def test_a_metre_at_a_speed_within_the_interval_counts_for_more():
    """0.7 of the score is for paced metres, 0.3 for all: 400 m without pace are as good as 120 m with it."""
    value = scalar(results([[400.0], [120.0]], [[0.0], [120.0]]), TARGET)
    assert value[0] == pytest.approx(value[1])


def test_a_fifth_of_the_distance_may_be_outside_the_interval():
    value = scalar(results([[400.0], [400.0], [400.0]], [[400.0], [320.0], [310.0]]), TARGET)
    assert value[0] == value[1] > value[2]


def test_each_episode_may_have_its_own_target():
    drives = np.array([[100.0, 100.0]])
    value = scalar(results(drives, drives), np.array([100.0, 400.0]))
    alone = [scalar(results([[100.0]], [[100.0]]), t)[0] for t in (100.0, 400.0)]
    assert value[0] == pytest.approx(np.mean(alone))
    assert alone[0] == pytest.approx(1.0)
