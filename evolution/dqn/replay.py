"""The replay buffer: a ring of the latest rows of experience, from which transitions are drawn uniformly.

A row of `Experience` is a row of the ring, so that each observation is stored once. A transition is a row with an
action and the row after it. The value of the latter counts unless the step terminated the episode (`state.End`).
A row of a grid is no longer drawn once an earlier frame of its stack is overwritten.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from evolution.dqn.experience import NO_ACTION, Experience, ages, empty, unpack
from evolution.networks.policy import CnnSpec, PolicySpec
from gridsim.counter import GOLDEN, mix, uniform64
from gridsim.jit import U, njit
from gridsim.state import TERMINATES


class Batch(NamedTuple):
    """Transitions drawn from a `Replay`."""

    observations: np.ndarray  # float32 [n, inputs], the network's inputs
    actions: np.ndarray  # int64 [n]
    rewards: np.ndarray  # float32 [n]
    next_observations: np.ndarray  # float32 [n, inputs]
    discounts: np.ndarray  # float32 [n], the factor of the value of the next observation


@njit(nogil=True)
def _draw(drawable, size, key, rows):
    """Fill `rows` [n] with indices of drawable rows below `size`, drawn uniformly with replacement."""
    key, place = mix(key), U(0)
    for i in range(rows.shape[0]):
        row = 0
        while True:
            row = int(uniform64(mix(key + place * GOLDEN)) * size)
            place += U(1)
            if drawable[row]:
                break
        rows[i] = row


class Replay:
    """The last `capacity` rows of experience for a network, and the discount of a control step."""

    def __init__(self, spec: PolicySpec, capacity: int, discount: float):
        self.spec, self.capacity, self.discount = spec, capacity, discount
        self.added = 0  # rows added in total: the next one's place is added % capacity
        self.transitions = 0  # rows that can be drawn
        self._earlier_frames = spec.frames - 1 if isinstance(spec, CnnSpec) else 0
        age = np.empty(capacity, dtype=np.uint8)  # rows of its episode that precede a row, at most `_earlier_frames`
        self._rings = {**empty(spec, capacity)._asdict(), "ages": age}  # takes memory only as it fills
        self._drawable = np.zeros(capacity, dtype=np.bool_)

    def __len__(self) -> int:
        """Number of rows in the ring."""
        return min(self.added, self.capacity)

    def add(self, experience: Experience) -> None:
        """Append whole episodes, which overwrite the oldest rows; of more rows than `capacity`, the last are kept."""
        rows = len(experience.actions)
        kept = min(rows, self.capacity)
        first = (self.added + rows - kept) % self.capacity
        new = experience._asdict() | {"ages": np.minimum(ages(experience), self._earlier_frames)}
        for name, ring in self._rings.items():
            _put(ring, first, new[name][rows - kept :])
        _put(self._drawable, first, experience.actions[rows - kept :] != NO_ACTION)
        self.added += rows
        self._exclude_incomplete_stacks()

    def _exclude_incomplete_stacks(self) -> None:
        """Exclude from drawing those of the oldest rows whose earlier frames are overwritten; count `transitions`."""
        oldest = self.added - len(self)
        places = (oldest + np.arange(min(self._earlier_frames, len(self)))) % self.capacity
        self._drawable[places[self._rings["ages"][places] > np.arange(len(places))]] = False
        self.transitions = int(np.count_nonzero(self._drawable[: len(self)]))

    def sample(self, key: int, batch: int) -> Batch:
        """Draw `batch` transitions with replacement. They depend only on `key`, in [0, 2^64), and on what is stored.

        Raises: ValueError if there are none.
        """
        if not self.transitions:
            raise ValueError("the replay holds no transition yet; add experience first")
        rows = np.empty(batch, dtype=np.int64)
        _draw(self._drawable, len(self), U(key), rows)
        after = (rows + 1) % self.capacity
        observations, actions, rewards, ends, age = self._rings.values()
        return Batch(
            unpack(self.spec, observations, rows, age[rows]),
            actions[rows].astype(np.int64),
            rewards[rows],
            unpack(self.spec, observations, after, age[after]),
            np.where(TERMINATES[ends[rows]], 0.0, self.discount).astype(np.float32),
        )

    def state(self) -> dict[str, np.ndarray]:
        """The replay's state as arrays, which are views of the ring: save them before more is added."""
        return {name: ring[: len(self)] for name, ring in self._rings.items()} | {"added": np.array(self.added)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore a `state` of a replay of the same capacity and network."""
        self.added = int(arrays["added"])
        for name, ring in self._rings.items():
            ring[: len(self)] = arrays[name]
        self._drawable[: len(self)] = arrays["actions"] != NO_ACTION
        self._exclude_incomplete_stacks()


def _put(ring: np.ndarray, first: int, rows: np.ndarray) -> None:
    """Write rows into a ring from `first` on, wrapping round its end."""
    room = len(ring) - first
    ring[first : first + len(rows)] = rows[:room]
    ring[: max(len(rows) - room, 0)] = rows[room:]
