"""What a few seeds tell: medians, bootstrap intervals, probabilities."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.comparison.statistics import separation_by_chance, span_coverage, spread


def test_median_and_quartiles():
    found = spread([3.0, 1.0, 2.0])
    assert (found.n, found.median, found.lower, found.upper) == (3, 2.0, 1.5, 2.5)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_bootstrap_of_few_seeds_is_their_span(n):
    values = np.random.default_rng(n).normal(size=n)
    found = spread(values)
    assert (found.low, found.high) == (values.min(), values.max())


@pytest.mark.parametrize("n", [7, 9, 11])
def test_bootstrap_against_the_exact_distribution_of_a_resamples_median(n):
    """The median of a resample is at most the k-th value if more than half of n draws are among the first k."""

    def at_most(k):
        return sum(math.comb(n, j) * (k / n) ** j * (1 - k / n) ** (n - j) for j in range(n // 2 + 1, n + 1))

    values = np.arange(1.0, n + 1)
    found = spread(np.random.default_rng(0).permutation(values))
    assert found.low == next(k for k in values if at_most(k) > 0.025)
    assert found.high == next(k for k in values if at_most(k) >= 0.975)
    assert found == spread(values)


def test_what_was_not_measured_is_left_out():
    assert spread([math.nan, 4.0, math.inf]) == spread([4.0])
    assert spread([4.0]).low == spread([4.0]).high == 4.0
    nothing = spread([math.nan])
    assert nothing.n == 0
    assert math.isnan(nothing.median)


@given(st.lists(st.integers(-100, 100), min_size=1, max_size=6))
def test_spread_is_ordered(values):
    found = spread(values)
    assert min(values) <= found.low <= found.median <= found.high <= max(values)
    assert found.lower <= found.median <= found.upper


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_probabilities_against_all_outcomes(n):
    sides = list(itertools.product([False, True], repeat=n))  # of the median, on which each value lies
    assert span_coverage(n) == pytest.approx(sum(len(set(side)) == 2 for side in sides) / len(sides))
    ranks = list(itertools.combinations(range(2 * n), n))
    apart = [r for r in ranks if max(r) == n - 1 or min(r) == n]
    assert separation_by_chance(n, n) == pytest.approx(len(apart) / len(ranks))
