"""A fitness of one's own: distance, less what is uncomfortable.

gridsim-evolve --fitness examples/own_fitness.py:soft --generations 120
"""

import numpy as np

from evolution.episodes.fitness import scalar

HARSH = 5.0  # m2/s4, mean square of the lateral acceleration that costs everything
WEIGHT = 0.2


def soft(results: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Scores [members] of results [members, episodes]: the usual fitness, less what is harsh, of which those
    who drive far are charged most.
    """
    driven = np.minimum(scalar(results, targets), 1.0)
    harsh = np.minimum(results["lateral"].mean(axis=1, dtype=np.float64) / HARSH, 1.0)
    return driven - WEIGHT * driven**2 * harsh
