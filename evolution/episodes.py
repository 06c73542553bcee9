"""Which episodes a generation meets: starts on lanes from a seed, and how the task grows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evolution.rollout import EPISODE
from gridsim.scenarios import Scenario, sample_starts


def lane_starts(scenarios: Sequence[Scenario], maps: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Episodes EPISODE [len(maps)] that start uniformly over the lanes of `scenarios[maps[k]]`, at rest."""
    episodes = np.zeros(len(maps), dtype=EPISODE)
    episodes["map"] = maps
    for m in np.unique(maps):
        of = np.flatnonzero(episodes["map"] == m)
        episodes["start"][of] = sample_starts(scenarios[m], len(of), rng)
    return episodes
