"""The two elements, their bounds, the scalar, and Pareto ranking against brute force."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evolution.fitness import elements, pareto, pooled, scalar
from evolution.rollout import RESULT

TARGET = 500.0


def results(distance, paced):
    """RESULT [n, e] of distances and paced distances [n, e]."""
    made = np.zeros(np.shape(distance), dtype=RESULT)
    made["distance"], made["paced"] = distance, paced
    return made


metres = st.floats(0.0, 1000.0, width=32)
episodes = st.lists(st.tuples(metres, st.floats(0.0, 1.0)), min_size=1, max_size=6)


def one(drives):
    """One member's results [1, e] of (distance, share of it that was paced)."""
    return results([[d for d, _ in drives]], [[d * share for d, share in drives]])


# --- Elements and scalar ---------------------------------------------------------------------------------------------


@given(drives=episodes, target=st.floats(1.0, 2000.0))
def test_everything_is_a_share(drives, target):
    row = one(drives)
    assert elements(row, target).shape == (1, 2)
    assert scalar(row, target).shape == (1,)
    for value in (*elements(row, target)[0], scalar(row, target)[0]):
        assert 0.0 <= value <= 1.0 + 1e-12


def test_nothing_is_0_and_the_target_is_1():
    assert elements(results([[0.0]], [[0.0]]), TARGET).tolist() == [[0.0, 0.0]]
    assert scalar(results([[0.0]], [[0.0]]), TARGET).tolist() == [0.0]
    for beyond in (TARGET, 3 * TARGET):
        assert elements(results([[beyond]], [[beyond]]), TARGET) == pytest.approx(np.ones((1, 2)))
        assert scalar(results([[beyond]], [[beyond]]), TARGET) == pytest.approx([1.0])


@given(drives=episodes, which=st.integers(0, 5), more=st.floats(0.5, 100.0))
def test_further_and_better_paced_is_never_worse(drives, which, more):
    row = one(drives)
    further, paced = row.copy(), row.copy()
    k = which % len(drives)
    further["distance"][0, k] += more
    paced["paced"][0, k] += more
    for better, element in ((further, 0), (paced, 1)):
        assert scalar(better, TARGET)[0] >= scalar(row, TARGET)[0]
        assert elements(better, TARGET)[0, element] >= elements(row, TARGET)[0, element]
        assert elements(better, TARGET)[0, 1 - element] == elements(row, TARGET)[0, 1 - element]
    if further["distance"][0, k] < TARGET:
        assert scalar(further, TARGET)[0] > scalar(row, TARGET)[0]
        assert elements(further, TARGET)[0, 0] > elements(row, TARGET)[0, 0]


def test_pace_counts():
    """The same way at a speed within the interval is worth more than outside of it."""
    ranked = scalar(results([[100.0]] * 3, [[0.0], [50.0], [100.0]]), TARGET)
    assert (np.diff(ranked) > 0.05).all()


def test_the_first_bend_is_worth_as_much_as_a_long_way_later():
    value = scalar(results([[0.0], [20.0], [400.0], [420.0]], [[0.0], [20.0], [400.0], [420.0]]), TARGET)
    assert value[1] - value[0] > 5 * (value[3] - value[2])


def test_an_element_is_the_mean_over_episodes():
    drives = [[10.0, 200.0], [40.0, 600.0]]
    both = elements(results(drives, drives), TARGET)
    single = [[elements(results([[d]], [[d]]), TARGET)[0] for d in row] for row in drives]
    assert both == pytest.approx(np.mean(single, axis=1))


def test_each_episode_may_have_its_own_target():
    drives = np.array([[100.0, 100.0]])
    value = elements(results(drives, drives), np.array([100.0, 400.0]))
    alone = [elements(results([[100.0]], [[100.0]]), t)[0, 0] for t in (100.0, 400.0)]
    assert value[0, 0] == pytest.approx(np.mean(alone))
    assert alone[0] == pytest.approx(1.0)


# --- Pareto ----------------------------------------------------------------------------------------------------------


def fronts_by_brute_force(values):
    """Front of each member (0 is best): whom nobody left dominates, again and again."""
    front, left, k = {}, set(range(len(values))), 0
    while left:
        here = {
            i for i in left if not any((values[j] >= values[i]).all() and (values[j] > values[i]).any() for j in left)
        }
        front.update(dict.fromkeys(here, k))
        left -= here
        k += 1
    return np.array([front[i] for i in range(len(values))])


def crowding_by_brute_force(values):
    """Deb et al. 2002: the sum over elements of the normalised gap between a member's two neighbours."""
    crowding = np.zeros(len(values))
    for column in values.T:
        for i, v in enumerate(column):
            below, above = column[column < v], column[column > v]
            if not below.size or not above.size:
                crowding[i] = np.inf
            else:
                crowding[i] += (above.min() - below.max()) / np.ptp(column)
    return crowding


@settings(max_examples=60, derandomize=True)
@given(n=st.integers(1, 40), seed=st.integers(0, 10_000))
def test_pareto_is_brute_force(n, seed):
    values = np.random.default_rng(seed).random((n, 2))
    key, front = pareto(values), fronts_by_brute_force(values)
    assert key.shape == (n,)
    assert np.isfinite(key).all()
    for f in range(front.max() + 1):
        here = np.flatnonzero(front == f)
        assert f == 0 or key[here].max() < key[front == f - 1].min()
        crowding = crowding_by_brute_force(values[here])
        for a in range(len(here)):
            for b in range(len(here)):
                if crowding[a] > crowding[b] + 1e-9:
                    assert key[here[a]] > key[here[b]]


@settings(max_examples=60, derandomize=True)
@given(rows=st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=30))
def test_fronts_hold_with_ties_and_equals(rows):
    values = np.array(rows, dtype=float)
    key, front = pareto(values), fronts_by_brute_force(values)
    assert np.isfinite(key).all()
    for f in range(front.max()):
        assert key[front == f].min() > key[front == f + 1].max()


def test_a_large_generation_is_ranked_without_comparing_all_with_all():
    """Every pair of 50,000 would be 2.5 billion comparisons, and 5 GB of their outcomes."""
    tracemalloc.start()
    key = pareto(np.random.default_rng(0).random((50_000, 2)))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.isfinite(key).all()
    assert peak < 100 << 20


def test_the_ends_of_a_front_are_loneliest():
    values = np.array([[0.0, 1.0], [0.1, 0.9], [0.2, 0.8], [0.6, 0.4], [1.0, 0.0], [0.05, 0.05]])
    key = pareto(values)
    assert set(np.argsort(-key)[:2]) == {0, 4}
    assert np.argsort(-key)[2] == 3  # the one with the widest gap about it
    assert key.argmin() == 5  # dominated


@given(
    scores=st.lists(st.integers(0, 1000), min_size=8, max_size=60).map(lambda k: np.array(k) / 1000.0),
    groups=st.integers(1, 4),
)
def test_pooled_scores_keep_the_order_within_a_group_and_know_no_better_group(scores, groups):
    among = pooled(scores, groups)
    whole = [among[g::groups] for g in range(groups)]
    for g in range(groups):
        order = np.argsort(scores[g::groups], kind="stable")
        assert (np.diff(whole[g][order]) >= -1e-12).all()
    assert scores.min() - 1e-12 <= among.min()
    assert among.max() <= scores.max() + 1e-12
    if len(scores) % groups == 0:  # as many in each: the same values in all of them
        for one_group in whole[1:]:
            np.testing.assert_array_equal(np.sort(one_group), np.sort(whole[0]))


def test_pooled_scores_of_one_group_are_what_they_were():
    scores = np.random.default_rng(4).random(33)
    np.testing.assert_allclose(pooled(scores, 1), scores, rtol=1e-12)


def test_half_of_the_best_come_from_either_of_two_groups():
    rng = np.random.default_rng(5)
    scores = np.where(np.arange(64) % 2, 10.0, 0.0) + rng.random(64)  # the second group met the easier ones
    best = np.argsort(-pooled(scores, 2), kind="stable")[:16]
    assert (best % 2).sum() == 8
    assert set(best[best % 2 == 1] // 2) == set(np.argsort(-scores[1::2])[:8])
