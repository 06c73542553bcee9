"""The fitness by which members are ranked: what distance and paced distance are worth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evolution.episodes.fitness import PACED_ENOUGH, scalar
from evolution.episodes.rollout import RESULT

TARGET = 1000.0  # m


def results(distance, paced):
    """RESULT [n, e] of distances and paced distances [n, e]."""
    made = np.zeros(np.shape(distance), dtype=RESULT)
    made["distance"], made["paced"] = distance, paced
    return made


def worth(*drives):
    """The fitness of members with one episode each, given as (metres, paced metres)."""
    distance, paced = np.array(drives, dtype=float).T[:, :, None]
    return scalar(results(distance, paced), TARGET).tolist()


metres = st.floats(0.0, 1000.0, width=32)
episodes = st.lists(st.tuples(metres, st.floats(0.0, 1.0)), min_size=1, max_size=6)  # distance, share that was paced


@given(drives=episodes, which=st.integers(0, 5), more=st.floats(0.5, 100.0))
def test_further_and_better_paced_is_never_worse(drives, which, more):
    row = results([[d for d, _ in drives]], [[d * share for d, share in drives]])
    further, paced = row.copy(), row.copy()
    k = which % len(drives)
    further["distance"][0, k] += more
    paced["paced"][0, k] += more
    for better in (further, paced):
        assert scalar(better, TARGET)[0] >= scalar(row, TARGET)[0]
    if further["distance"][0, k] < TARGET:
        assert scalar(further, TARGET)[0] > scalar(row, TARGET)[0]
        if paced["paced"][0, k] < PACED_ENOUGH * row["distance"][0, k]:
            assert scalar(paced, TARGET)[0] > scalar(row, TARGET)[0]


def test_what_metres_are_worth():
    assert worth((0, 0), (TARGET, TARGET), (3 * TARGET, 3 * TARGET)) == pytest.approx([0.0, 1.0, 1.0], abs=0.0)
    nothing, first_bend, far, further = worth((0, 0), (20, 20), (400, 400), (420, 420))
    assert first_bend - nothing > 5 * (further - far)
    unpaced, paced = worth((400, 0), (120, 120))  # 0.7 of the score is for paced metres, 0.3 for all
    assert unpaced == pytest.approx(paced)
    whole, enough, less = worth((400, 400), (400, 320), (400, 310))  # a fifth may be outside the interval
    assert whole == enough > less
