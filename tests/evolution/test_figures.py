"""Figures of how well a network drives."""

import numpy as np
import pytest

from cluster.text import km_per_collision
from evolution.episodes.figures import summarise
from evolution.episodes.rollout import RESULT
from gridsim.state import End


@pytest.mark.parametrize(
    ("ends", "km", "words"),
    [
        ((End.SUCCESS, End.COLLISION, End.COLLISION, End.TIME), 2.25, "2.25"),
        ((End.SUCCESS, End.SUCCESS, End.IDLE, End.TIME), 4.5, "more than 4.5"),
    ],
)
def test_kilometres_per_collision_of_a_champion_without_one_are_more_than_it_drove(ends, km, words):
    results = np.zeros(4, dtype=RESULT)
    results["end"], results["distance"] = ends, (2000.0, 500.0, 1000.0, 1000.0)
    figures = summarise(results, 0.1)
    assert figures["km_per_collision"] == pytest.approx(km)
    assert km_per_collision(figures) == words
