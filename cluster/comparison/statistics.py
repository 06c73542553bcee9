"""What a few seeds can tell: medians, quartiles, bootstrap intervals, and how far to believe them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

RESAMPLES = 9_999
"""Resamples of a bootstrap interval."""
CONFIDENCE = 0.95
_SEED = 20_190_111  # of the resamples: the same numbers always give the same interval


@dataclass(frozen=True)
class Spread:
    """What is known of a figure from n seeds. All but n are not a number where nothing was measured.

    Attributes:
        n: seeds that were measured.
        median: of them.
        lower, upper: the quartiles (linear interpolation); half of the seeds lie between them.
        low, high: bootstrap interval of the median.
    """

    n: int
    median: float
    lower: float
    upper: float
    low: float
    high: float


def spread(values: Iterable[float]) -> Spread:
    """Median, quartiles and the percentile bootstrap's interval of the median (Efron and Tibshirani 1993, chapter 13).

    What is not finite was not measured and is left out. One value is its own interval, which says nothing.
    """
    found = np.array(sorted(value for value in values if math.isfinite(value)), dtype=np.float64)
    if not len(found):
        return Spread(0, *[math.nan] * 5)
    lower, median, upper = (float(value) for value in np.quantile(found, [0.25, 0.5, 0.75]))
    low, high = float(found.min()), float(found.max())
    if low < high:
        from scipy.stats import bootstrap

        interval = bootstrap(
            (found,), np.median, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="percentile",
            rng=np.random.default_rng(np.random.SeedSequence(_SEED)),
        ).confidence_interval  # fmt: skip
        low, high = float(interval.low), float(interval.high)
    return Spread(len(found), median, lower, upper, low, high)


def span_coverage(n: int) -> float:
    """Probability that the true median lies between the smallest and the largest of n values: 1 - 2^(1-n).

    It lies outside only if all n fall on one side of it, whatever their distribution (David and Nagaraja 2003, 7.1).
    """
    return 1.0 - 2.0 ** (1 - n) if n else 0.0


def separation_by_chance(n: int, m: int) -> float:
    """Probability that all of n values lie on one side of all of m others if both have the same distribution.

    The two-sided p value of the extreme outcome of the rank-sum test, 2 / (n + m choose n); the least it can give.
    """
    return min(1.0, 2.0 / math.comb(n + m, n)) if n and m else 1.0
