"""The two elements of fitness, and the scalar by which members are ranked.

Element one is the distance travelled; element two is the distance travelled at a forward speed within the scenario's
interval. Both are relative to the episode's target, on a scale that is mostly logarithmic (the first bend is worth as
much as the last kilometre) and partly linear (so that the last kilometre still counts).
"""

from __future__ import annotations

import numpy as np

LINEAR_SHARE = 0.4  # of an element; without it, a slow last kilometre would cost almost nothing
PACED_SHARE = 0.7  # weight of the paced distance in the scalar; the rest is for the distance


def elements(results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
    """Fitness elements float64 [n, 2] in [0, 1] of results [n, episodes]: distance and paced distance."""
    both = [_share(results[name].astype(np.float64), target).mean(axis=1) for name in ("distance", "paced")]
    return np.stack(both, axis=1)


def scalar(results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
    """Scalar fitness float64 [n] in [0, 1] of results [n, episodes]."""
    mixed = (1.0 - PACED_SHARE) * results["distance"].astype(np.float64) + PACED_SHARE * results["paced"]
    return _share(mixed, target).mean(axis=1)


def _share(distance: np.ndarray, target: np.ndarray | float) -> np.ndarray:
    """The value in [0, 1] of distances [n, e], relative to their target."""
    bounded = np.clip(distance, 0.0, target)
    return (1.0 - LINEAR_SHARE) * np.log1p(bounded) / np.log1p(target) + LINEAR_SHARE * bounded / target
