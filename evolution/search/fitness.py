"""The two elements of fitness, their bounds, and how members are ranked by them.

Element one is the distance travelled; element two the distance travelled at a forward speed within the scenario's
interval, so that speed counts only where it is bounded. Both are shares of the episode's target, mostly logarithmic
(the first bend is worth as much as the last kilometre) and in part linear (the last kilometre is worth driving well).
"""

from __future__ import annotations

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
