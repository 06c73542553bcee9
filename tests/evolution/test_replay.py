"""The replay: transitions by an oracle, what is drawn and how often, exact restore."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evolution.dqn.experience import NO_ACTION, Experience, empty, join
from evolution.dqn.replay import Replay
from evolution.networks.policy import PolicySpec
from gridsim.state import End

RAYS, GRID, FRAME = (PolicySpec.parse(text) for text in ("mlp:3", "cnn:8,8,8@4", "cnn:8,8,8@1"))
TERMINAL = (End.COLLISION, End.IDLE)  # as in the environment (test_env.py)


def episode(rewards, end, first=0, spec=RAYS):
    """An episode whose row t has the observation `first + t`, by which a row is known again, and the action t % 8."""
    steps = len(rewards)
    number = np.arange(first, first + steps + 1)
    observations = empty(spec, steps + 1).observations
    observations[:] = 0
    if spec is RAYS:
        observations[:, 0] = number
    else:
        observations[:, 0], observations[:, 1] = number % 3, number // 3 % 3  # in the first cells of each frame
        observations[:, -2:] = number.astype("<i2").view(np.uint8).reshape(-1, 2)
    actions = np.append(np.arange(steps) % 8, NO_ACTION).astype(np.uint8)
    ends = np.zeros(steps + 1, dtype=np.uint8)
    ends[steps - 1] = end
    return Experience(observations, actions, np.append(rewards, 0).astype(np.float32), ends)


def numbers(observations, spec=RAYS):
    """What `episode` numbered the rows."""
    return np.rint(observations[:, 0 if spec is RAYS else -1] * 4096).astype(int)


REWARDS = st.lists(st.integers(-9, 9), min_size=1, max_size=12)
EPISODES = st.lists(st.tuples(REWARDS, st.sampled_from([*TERMINAL, End.SUCCESS, End.TIME])), min_size=1, max_size=4)


def expected(parts, capacity, frames):
    """Textbook: {number of a row: (reward, factor of the next value)} of what can be drawn."""
    rows = sum(len(part.actions) for part in parts)
    found, first = {}, 0
    for part in parts:
        steps = len(part.actions) - 1
        for t in range(steps):
            if first + max(t - frames + 1, 0) >= rows - capacity:
                over = t == steps - 1 and part.ends[t] in TERMINAL
                found[first + t] = float(part.rewards[t]), 0.0 if over else 0.9
        first += steps + 1
    return found


def stacked(spec, row, starts):
    """The first and the fifth cell of each frame of a row's observation, as the network sees them."""
    start = starts[np.searchsorted(starts, row, side="right") - 1]
    seen = np.array([max(row - back, start) for back in range(spec.frames)[::-1]])
    codes = np.array([0, 127, 255]) / 255
    return np.stack([codes[seen % 3], codes[seen // 3 % 3]], axis=1)


@settings(max_examples=60)
@given(
    adds=st.lists(EPISODES, min_size=1, max_size=6),
    capacity=st.integers(2, 40),
    spec=st.sampled_from([RAYS, GRID, FRAME]),
)
def test_after_every_add_it_holds_what_the_textbook_holds(adds, capacity, spec):
    replay = Replay(spec, capacity, 0.9)
    parts, first = [], 0
    for added in adds:
        new = []
        for rewards, end in added:
            new.append(episode(rewards, end, first, spec))
            first += len(rewards) + 1
        replay.add(join(new))
        parts += new
        known = expected(parts, capacity, getattr(spec, "frames", 1))
        assert len(replay) == min(first, capacity)
        assert replay.transitions == len(known)
        if not known:
            with pytest.raises(ValueError, match="no transition yet"):
                replay.sample(0, 4)
            continue
        batch = replay.sample(first, 64)
        where = numbers(batch.observations, spec)
        assert np.array_equal(batch.actions, np.concatenate([part.actions for part in parts])[where])
        oracle = [known[number] for number in where]  # a KeyError: what was drawn should not be
        assert batch.rewards.tolist() == [reward for reward, _ in oracle]
        assert batch.discounts == pytest.approx([discount for _, discount in oracle])
        assert (numbers(batch.next_observations, spec) == where + 1).all()
        if spec is not RAYS:
            starts = np.cumsum([0] + [len(part.actions) for part in parts])
            for observations, rows in ((batch.observations, where), (batch.next_observations, where + 1)):
                for inputs, row in zip(observations, rows, strict=True):
                    assert inputs[:-1].reshape(-1, 6400)[:, [0, 4]] == pytest.approx(stacked(spec, row, starts))
        # What is restored draws the same, and goes on as the first does.
        again, goes_on = Replay(spec, capacity, 0.9), copy.deepcopy(replay)
        again.restore(replay.state())
        for _ in range(2):
            np.testing.assert_equal(goes_on.sample(7, 32), again.sample(7, 32))
            for replica in (goes_on, again):
                replica.add(episode([3, 1, 4, 1, 5, 9], End.SUCCESS, first, spec))
            if not again.transitions:
                break


def test_draws_are_uniform_and_each_key_has_its_own():
    """Of a ring that has gone round: rows of four episodes, the oldest cut."""
    replay, first = Replay(RAYS, 64, 0.9), 0
    for steps in (29, 1, 2, 54):
        replay.add(episode(np.arange(steps) % 5, End.TIME, first))
        first += steps + 1
    counts = np.unique(numbers(replay.sample(11, 60_000).observations), return_counts=True)[1]
    assert len(counts) == replay.transitions < replay.capacity
    assert stats.chisquare(counts).pvalue > 0.001
    drawn = [numbers(replay.sample(key, 16).observations).tolist() for key in (0, 1, 2, 1, 2**64 - 1)]
    assert drawn[1] == drawn[3]
    assert len({tuple(rows) for rows in drawn}) == 4
