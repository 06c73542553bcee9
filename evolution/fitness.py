"""The two elements of fitness, their bounds, and how members are ranked by them.

Element one is the distance travelled; element two the distance travelled at a forward speed within the scenario's
interval, so that speed counts only where it is bounded. Both are shares of the episode's target, mostly logarithmic
(the first bend is worth as much as the last kilometre) and in part linear (the last kilometre is worth driving well).
"""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

LINEAR_SHARE = 0.4  # of an element; without it, who crawls through the last kilometre has nearly all
PACED_SHARE = 0.7  # of the scalar's distance that must be driven at a speed within the interval


def elements(results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
    """Fitness elements float64 [n, 2] in [0, 1] of results [n, episodes]: distance and paced distance, as shares."""
    both = [_share(results[name].astype(np.float64), target).mean(axis=1) for name in ("distance", "paced")]
    return np.stack(both, axis=1)


def scalar(results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
    """Scalar fitness float64 [n] in [0, 1] from results [n, episodes]."""
    mixed = (1.0 - PACED_SHARE) * results["distance"].astype(np.float64) + PACED_SHARE * results["paced"]
    return _share(mixed, target).mean(axis=1)


def _share(distance: np.ndarray, target: np.ndarray | float) -> np.ndarray:
    """How much of its target a distance [n, e] is worth, in [0, 1]."""
    bounded = np.clip(distance, 0.0, target)
    return (1.0 - LINEAR_SHARE) * np.log1p(bounded) / np.log1p(target) + LINEAR_SHARE * bounded / target


def pooled(scores: np.ndarray, groups: int) -> np.ndarray:
    """Scores float64 [n], made comparable, of members whose groups (k modulo `groups`) met different episodes.

    Each is what the whole generation has at the member's rank within its group (quantile normalisation), so that as
    many of each group are among the best, whoever met the harder episodes.
    """
    whole = np.sort(scores)
    ranks = (np.arange(len(scores)) + 0.5) / len(scores)
    among = np.empty(len(scores))
    for g in range(groups):
        group = np.arange(g, len(scores), groups)
        order = group[np.argsort(scores[group], kind="stable")]
        among[order] = np.interp((np.arange(len(order)) + 0.5) / len(order), ranks, whole)
    return among


def pareto(values: np.ndarray) -> np.ndarray:
    """Rank key float64 [n] of elements [n, 2], greater is better: front first, crowding within it (Deb et al. 2002).

    Members of a better front have a greater key; within a front the lonelier one has.
    """
    key = np.empty(len(values))
    front = _fronts(values)
    by_front = np.argsort(front, kind="stable")
    for here in np.split(by_front, np.flatnonzero(np.diff(front[by_front])) + 1):
        crowding = np.zeros(len(here))
        for k in range(values.shape[1]):
            order = np.argsort(values[here, k], kind="stable")
            column = values[here[order], k]
            span = column[-1] - column[0]
            gap = np.full(len(here), np.inf)
            if len(here) > 2:
                gap[1:-1] = (column[2:] - column[:-2]) / span if span > 0 else 0.0
            crowding[order] += gap
        # Crowding in [0, 1): below the next better front whatever it is; those at the ends are loneliest of all.
        finite = np.minimum(crowding, 1e6)
        key[here] = -front[here] + finite / (1.0 + finite)
    return key


def _fronts(values: np.ndarray) -> np.ndarray:
    """Front int64 [n] of two elements [n, 2], the best 0: in O(n log n), for generations of any size.

    From the greatest first element down, a member is dominated by a front if and only if the front's latest member has
    as great a second one; fronts are in descending order of that (Jensen 2003).
    """
    front = np.zeros(len(values), dtype=np.int64)
    latest: list[float] = []  # of each front, the negated second element of its latest member
    before: tuple[float, float] | None = None
    at = 0
    for k in np.lexsort((-values[:, 1], -values[:, 0])):
        first, second = float(values[k, 0]), float(values[k, 1])
        if (first, second) != before:  # equals do not dominate each other
            at = bisect_right(latest, -second)
            latest[at : at + 1] = [-second]
            before = first, second
        front[k] = at
    return front
