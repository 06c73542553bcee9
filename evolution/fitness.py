"""The two elements of fitness, their bounds, and how members are ranked by them.

Element one is the distance travelled; element two the distance travelled at a forward speed within the scenario's
interval, so that speed counts only where it is bounded. The scalar is logarithmic: the first bend is worth as much as
the last kilometre.
"""

from __future__ import annotations

import numpy as np

LINEAR_SHARE = 0.3
PACED_SHARE = 0.7  # of the scalar's distance that must be driven at a speed within the interval


def elements(results: np.ndarray, target: float) -> np.ndarray:
    """Fitness elements float64 [n, 2] in [0, 1] from results [n, episodes]: means of log distance, log paced distance."""
    both = np.stack([results["distance"], results["paced"]], axis=-1).astype(np.float64)
    return (np.log1p(np.clip(both, 0.0, target)) / np.log1p(target)).mean(axis=1)


def scalar(results: np.ndarray, target: float) -> np.ndarray:
    """Scalar fitness float64 [n] in [0, 1] from results [n, episodes]."""
    mixed = (1.0 - PACED_SHARE) * results["distance"].astype(np.float64) + PACED_SHARE * results["paced"]
    mixed = np.clip(mixed, 0.0, target)
    w = LINEAR_SHARE
    return ((1.0 - w) * np.log1p(mixed) / np.log1p(target) + w * mixed / target).mean(axis=1)


def pareto(values: np.ndarray) -> np.ndarray:
    """Rank key float64 [n] of elements [n, k], greater is better: front first, crowding within it (Deb et al. 2002).

    Members of a better front have a greater key; within a front the lonelier one has.
    """
    n = len(values)
    key = np.empty(n)
    better = (values[:, None, :] >= values[None, :, :]).all(axis=2)
    dominates = better & ~better.T
    dominated_by = dominates.sum(axis=0)
    left = np.ones(n, dtype=bool)
    front = 0
    while left.any():
        here = np.flatnonzero(left & (dominated_by == 0))
        crowding = np.zeros(len(here))
        for k in range(values.shape[1]):
            order = np.argsort(values[here, k], kind="stable")
            column = values[here[order], k]
            span = column[-1] - column[0]
            gap = np.full(len(here), np.inf)
            if len(here) > 2:
                gap[1:-1] = (column[2:] - column[:-2]) / span if span > 0 else 0.0
            crowding[order] += gap
        key[here] = -front + crowding / (1.0 + crowding) if np.isfinite(crowding).all() else -front + np.where(
            np.isinf(crowding), 0.999, np.minimum(crowding, 1e9) / (1.0 + np.minimum(crowding, 1e9)) * 0.998
        )
        left[here] = False
        dominated_by = dominated_by - dominates[here].sum(axis=0)
        front += 1
    return key
