"""The fitness by which members are ranked.

It has two elements: the distance travelled, and the paced distance, travelled at a forward speed within the scenario's
interval. Their weighted mean is relative to the episode's target, on a scale that is mostly logarithmic (the first bend
is worth as much as the last kilometre) and partly linear.
"""

from __future__ import annotations

import numpy as np

LINEAR_SHARE = 0.4  # share of the score that is linear in the distance; on a log scale, the last km counts for little
PACED_SHARE = 0.7  # weight of the paced distance in the weighted mean; the rest is the weight of the distance
PACED_ENOUGH = 0.8  # if this share of the distance is paced, all counts as paced: braking for others costs nothing


def scalar(results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
    """Scalar fitness float64 [n] in [0, 1] of results [n, episodes]; `target` (m) is one number or [episodes]."""
    distance = results["distance"].astype(np.float64)
    paced = np.minimum(results["paced"] / PACED_ENOUGH, distance)
    bounded = np.clip((1.0 - PACED_SHARE) * distance + PACED_SHARE * paced, 0.0, target)
    shares = (1.0 - LINEAR_SHARE) * np.log1p(bounded) / np.log1p(target) + LINEAR_SHARE * bounded / target
    return shares.mean(axis=1)
