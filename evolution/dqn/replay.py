"""The replay buffer: a ring of the latest rows of experience, from which transitions are drawn.

A row of `Experience` is a row of the ring, so each observation is stored once, although several n-step transitions use
it. When rows are added, each row with an action gets its n-step return (Sutton 1988; Hessel et al. 2018)

    R_t = sum over k < m of discount^k r_{t+k},   m = min(n, steps to the episode's end),

the row t + m whose observation gives the value of the rest, and the factor of that value: discount^m, or 0 if one of
the m steps ended in COLLISION, IDLE or SUCCESS. After TIME, the value is estimated from the episode's last row.

The oldest rows are overwritten first. A transition needs only its row and later ones, except for the earlier frames of
a stack of grids: rows that have lost some of these are no longer drawn.

Prioritised replay (Schaul et al. 2016) is the proportional variant: a row is drawn with probability p^alpha / sum.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from evolution.dqn.experience import NO_ACTION, Experience, ages, observation_dtype_and_width, unpack
from evolution.networks.policy import CnnSpec, PolicySpec
from gridsim.car.ego import End
from gridsim.counter import GOLDEN, mix
from gridsim.jit import njit
from gridsim.maps.roads import freeze, power_of_two

MAX_CAPACITY = 1 << 30
MAX_N_STEP = 255  # m is stored in a byte
MAX_PRIORITY = 1e30  # within float32's range
_TIME = int(End.TIME)
_U = np.uint64


@dataclass(frozen=True)
class PriorityConfig:
    """Prioritised replay's parameters, by Schaul et al. (2016), "Prioritized Experience Replay", section 3."""

    alpha: float = 0.6  # exponent of priorities; 0 is uniform
    beta: float = 0.4  # exponent of importance weights at the beginning; 1 corrects the bias entirely
    beta_updates: int = 50_000  # over which beta rises linearly to 1
    epsilon: float = 1e-3  # added to an error's size, so that no row has probability 0

    def check(self) -> None:
        """Raises ValueError with one line for invalid parameters."""
        if not 0 <= self.alpha <= 1 or not 0 <= self.beta <= 1:
            raise ValueError(f"alpha and beta of prioritised replay lie in [0, 1], not {self.alpha} and {self.beta}")
        if self.beta_updates < 1:
            raise ValueError(f"beta needs 1 update or more to rise, not {self.beta_updates}")
        if not 1e-6 <= self.epsilon < math.inf:
            raise ValueError(f"epsilon of prioritised replay must be 1e-6 or more, not {self.epsilon}")


class Batch(NamedTuple):
    """Transitions drawn from a `Replay`."""

    observations: np.ndarray  # float32 [n, inputs], the network's inputs at t
    actions: np.ndarray  # int64 [n]
    returns: np.ndarray  # float32 [n], n-step returns from t
    next_observations: np.ndarray  # float32 [n, inputs], at t + m
    bootstraps: np.ndarray  # float32 [n], the factor of the value at t + m
    rows: np.ndarray  # int64 [n], of the ring
    weights: np.ndarray  # float32 [n], importance weights in (0, 1]


@njit(nogil=True)
def _n_step(actions, rewards, ends, factors, returns, ahead, bootstraps):
    """Fill returns, ahead and bootstraps [rows]; factors float64 [n + 1] are the powers of the discount."""
    for t in range(actions.shape[0]):
        total, m, end = 0.0, 0, 0
        if actions[t] != NO_ACTION:
            while end == 0 and m < factors.shape[0] - 1:
                total += factors[m] * rewards[t + m]
                end = ends[t + m]
                m += 1
        returns[t] = total
        ahead[t] = m
        bootstraps[t] = factors[m] if m > 0 and (end == 0 or end == _TIME) else 0.0


@njit
def _uniform(bits):
    """Uniform float64 in [0, 1) from the upper 53 bits: `counter.uniform`'s 24 are too coarse for a million rows."""
    return float(bits >> _U(11)) * (1.0 / (1 << 53))


@njit(nogil=True)
def _draw(ahead, size, key, rows):
    """Fill rows [n] uniformly with rows below `size` that can be drawn (ahead above 0)."""
    key, place = mix(key), _U(0)
    for i in range(rows.shape[0]):
        row = 0
        while True:
            row = int(_uniform(mix(key + place * GOLDEN)) * size)
            place += _U(1)
            if ahead[row] > 0:
                break
        rows[i] = row


@njit(nogil=True)
def _draw_by_priority(tree, key, rows):
    """Fill rows [n] in proportion to the leaves of a sum tree, one from each of n equal parts of the sum.

    tree float64 [2 * leaves]: node k has the children 2 k and 2 k + 1, the root is 1, the leaves are the upper half.
    """
    leaves = tree.shape[0] // 2
    key = mix(key)
    for i in range(rows.shape[0]):
        left_over = (i + _uniform(mix(key + _U(i) * GOLDEN))) / rows.shape[0] * tree[1]
        node = 1
        while node < leaves:
            node *= 2
            # Rounding may leave more than the right child's sum; a child with sum 0 is never entered.
            if left_over >= tree[node] and tree[node + 1] > 0.0:
                left_over -= tree[node]
                node += 1
        rows[i] = node - leaves


@njit(nogil=True)
def _raise_sums(tree, first, last):
    """Recompute the sums over the leaves `first` to `last`, both included."""
    leaves = tree.shape[0] // 2
    low, high = (first + leaves) // 2, (last + leaves) // 2
    while low > 0:
        for node in range(low, high + 1):
            tree[node] = tree[2 * node] + tree[2 * node + 1]
        low, high = low // 2, high // 2


@njit(nogil=True)
def _set_leaves(tree, rows, values):
    """Set some leaves and recompute the sums over them; for repeated rows the last value counts."""
    leaves = tree.shape[0] // 2
    for i in range(rows.shape[0]):
        tree[leaves + rows[i]] = values[i]
    for i in range(rows.shape[0]):
        node = (leaves + rows[i]) // 2
        while node > 0:
            tree[node] = tree[2 * node] + tree[2 * node + 1]
            node //= 2


class Replay:
    """The last `capacity` rows of experience.

    Args:
        spec: the network that uses the observations.
        capacity: rows; an episode of T steps has T + 1 of them.
        n_step: steps of rewards in a return.
        discount: of a control step.
        prioritised: parameters of prioritised replay; None draws rows uniformly.
    Raises: ValueError with one line for invalid arguments.
    """

    def __init__(
        self,
        spec: PolicySpec,
        capacity: int,
        n_step: int,
        discount: float,
        prioritised: PriorityConfig | None = None,
    ):
        if not 2 <= capacity <= MAX_CAPACITY:
            raise ValueError(f"a replay has 2 to {MAX_CAPACITY:,} rows, not {capacity}")
        if not 1 <= n_step <= MAX_N_STEP:
            raise ValueError(f"returns are of 1 to {MAX_N_STEP} steps, not {n_step}")
        if not 0 <= discount <= 1:
            raise ValueError(f"the discount lies in [0, 1], not {discount}")
        if prioritised is not None:
            prioritised.check()
        self.spec, self.capacity, self.n_step, self.discount = spec, capacity, n_step, discount
        self.prioritised = prioritised
        self.added = 0  # rows added in total: the next one's place is added % capacity
        self.transitions = 0  # rows that can be drawn
        self.max_priority = 1.0  # before alpha; the priority of new rows (Schaul et al. 2016, algorithm 1)
        self._frames = spec.frames if isinstance(spec, CnnSpec) else 1
        self._factors = freeze(np.float64(discount) ** np.arange(n_step + 1))
        dtype, width = observation_dtype_and_width(spec)
        # Zeros take no memory before they are written, so a large ring grows as it fills.
        self._observations = np.zeros((capacity, width), dtype=dtype)
        self._actions = np.zeros(capacity, dtype=np.uint8)
        self._returns = np.zeros(capacity, dtype=np.float32)
        self._ahead = np.zeros(capacity, dtype=np.uint8)  # m of each row; 0 if it cannot be drawn
        self._bootstraps = np.zeros(capacity, dtype=np.float32)
        self._ages = np.zeros(capacity, dtype=np.uint8)  # earlier rows of the episode, at most frames - 1
        self._tree = np.zeros(2 * power_of_two(capacity) if prioritised else 0, dtype=np.float64)

    def __len__(self) -> int:
        """Number of rows in the ring."""
        return min(self.added, self.capacity)

    def add(self, experience: Experience) -> None:
        """Append whole episodes, overwriting the oldest rows of a full ring.

        If there are more rows than the capacity, the last ones are kept.
        Raises: ValueError with one line if the experience does not fit this replay's policy.
        """
        self._check(experience)
        rows = len(experience.actions)
        if not rows:
            return
        returns, bootstraps = np.empty(rows, dtype=np.float32), np.empty(rows, dtype=np.float32)
        ahead = np.empty(rows, dtype=np.uint8)
        # Read-only views: arrays read from bytes are read-only, and kernels should be compiled for one kind only.
        columns = (freeze(experience.actions[:]), freeze(experience.rewards[:]), freeze(experience.ends[:]))
        _n_step(*columns, self._factors, returns, ahead, bootstraps)
        before = np.minimum(ages(experience), self._frames - 1).astype(np.uint8)
        kept = min(rows, self.capacity)
        first = (self.added + rows - kept) % self.capacity
        for ring, new in (
            (self._observations, experience.observations),
            (self._actions, experience.actions),
            (self._returns, returns),
            (self._ahead, ahead),
            (self._bootstraps, bootstraps),
            (self._ages, before),
        ):
            _put(ring, first, new[rows - kept :])
        self.added += rows
        lost = self._exclude_incomplete_stacks()
        self.transitions = int(np.count_nonzero(self._ahead[: len(self)]))
        if self.prioritised is not None:
            leaves = self._tree[len(self._tree) // 2 :][: self.capacity]
            leaf = np.float32(self.max_priority**self.prioritised.alpha)
            _put(leaves, first, np.where(ahead[rows - kept :] > 0, leaf, np.float32(0.0)))
            # Rows that wrap round the ring's end are updated in two parts, because the sums between do not change.
            _raise_sums(self._tree, first, min(first + kept, self.capacity) - 1)
            if first + kept > self.capacity:
                _raise_sums(self._tree, 0, first + kept - self.capacity - 1)
            _set_leaves(self._tree, lost, np.zeros(len(lost), dtype=np.float32))

    def _exclude_incomplete_stacks(self) -> np.ndarray:
        """Exclude the oldest rows whose earlier frames are overwritten. Returns: their places, int64."""
        oldest = self.added - len(self)
        places = (oldest + np.arange(min(self._frames - 1, len(self)))) % self.capacity
        torn = places[self._ages[places] > np.arange(len(places))]
        self._ahead[torn] = 0
        return torn

    def sample(self, key: int, batch: int, beta: float = 1.0) -> Batch:
        """Draw transitions, with replacement.

        Args:
            key: in [0, 2^64); the sample depends only on it and on the replay's contents.
            batch: number of transitions.
            beta: exponent of prioritised replay's importance weights, which are divided by the batch's largest, so
                that they only scale updates down.
        Raises: ValueError if there are no transitions.
        """
        if not self.transitions:
            raise ValueError("the replay holds no transition yet; add experience first")
        rows = np.empty(batch, dtype=np.int64)
        if self.prioritised is None:
            _draw(self._ahead, len(self), _U(key), rows)
            weights = np.ones(batch, dtype=np.float32)
        else:
            _draw_by_priority(self._tree, _U(key), rows)
            leaves = self._tree[len(self._tree) // 2 + rows]
            weights = ((leaves.min() / leaves) ** beta).astype(np.float32)
        to = (rows + self._ahead[rows]) % self.capacity
        return Batch(
            unpack(self.spec, self._observations, rows, self._ages[rows]),
            self._actions[rows].astype(np.int64),
            self._returns[rows],
            unpack(self.spec, self._observations, to, self._ages[to]),
            self._bootstraps[rows],
            rows,
            weights,
        )

    def update_priorities(self, rows: np.ndarray, errors: np.ndarray) -> None:
        """Set the priorities of sampled rows int64 [n] from their temporal-difference errors [n], clipped to 1e30.

        Raises: ValueError if errors are not finite or rows cannot be drawn; RuntimeError without prioritised replay.
        """
        if self.prioritised is None:
            raise RuntimeError("this replay draws all rows alike; it has no priorities")
        sizes = np.abs(np.asarray(errors, dtype=np.float64)) + self.prioritised.epsilon
        rows = np.ascontiguousarray(rows, dtype=np.int64)
        if rows.ndim != 1 or sizes.shape != rows.shape or not np.isfinite(sizes).all():
            raise ValueError(f"errors are finite numbers, one for each of {rows.size} rows")
        if not len(rows):
            return
        if rows.min() < 0 or rows.max() >= len(self) or not self._ahead[rows].all():
            raise ValueError("priorities are of rows that can be drawn")
        sizes = np.minimum(sizes, MAX_PRIORITY)
        self.max_priority = max(self.max_priority, float(sizes.max()))
        _set_leaves(self._tree, rows, (sizes**self.prioritised.alpha).astype(np.float32))

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The replay's state as arrays and plain numbers.

        Most arrays are views of the ring: save them before more is added.
        """
        size = len(self)
        arrays = {name: ring[:size] for name, ring in self._rings().items()}
        if self.prioritised is not None:
            # Only the leaves, which float32 represents exactly: the sums follow from them.
            arrays["priorities"] = self._tree[len(self._tree) // 2 :][:size].astype(np.float32)
        return arrays, {"rows_added": self.added, "max_priority": self.max_priority}

    def restore(self, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        """Restore a `state`; other names in it are ignored.

        Raises: ValueError with one line if the state is not one of such a replay; then nothing is changed.
        """
        added, max_priority = meta.get("rows_added"), meta.get("max_priority")
        if type(added) is not int or not 0 <= added < 1 << 62:
            raise ValueError(f"a saved replay's rows_added is not a valid count: {str(added)[:40]!r}")
        if type(max_priority) is not float or not 1 <= max_priority <= MAX_PRIORITY:
            raise ValueError(
                f"a saved replay's max_priority is not in [1, {MAX_PRIORITY:g}]: {str(max_priority)[:40]!r}"
            )
        size = min(added, self.capacity)
        rings = self._rings()
        saved = {name: _column(arrays, name, ring.dtype, (size, *ring.shape[1:])) for name, ring in rings.items()}
        self._check_saved(added, saved)
        if self.prioritised is not None:
            priorities = _column(arrays, "priorities", np.dtype(np.float32), (size,))
            if not np.isfinite(priorities).all() or (priorities < 0).any():
                raise ValueError("a saved replay's priorities are not finite numbers above 0")
            if ((priorities > 0) != (saved["ahead"] > 0)).any():
                raise ValueError("a saved replay has priorities of other rows than it can draw")
            leaves = self._tree[len(self._tree) // 2 :]
            leaves[:size], leaves[size:] = priorities, 0.0
            _raise_sums(self._tree, 0, len(leaves) - 1)
        for name, ring in rings.items():
            ring[:size] = saved[name]
        self.added, self.max_priority = added, max_priority
        self.transitions = int(np.count_nonzero(self._ahead[:size]))

    def _rings(self) -> dict[str, np.ndarray]:
        return {
            "observations": self._observations,
            "actions": self._actions,
            "returns": self._returns,
            "ahead": self._ahead,
            "bootstraps": self._bootstraps,
            "ages": self._ages,
        }

    def _check(self, experience: Experience) -> None:
        """Raises ValueError with one line if experience breaks the format of `evolution.dqn.experience`."""
        dtype, width = observation_dtype_and_width(self.spec)
        observations, actions, rewards, ends = experience
        rows = len(actions)
        for name, array, wanted, shape in (
            ("observations", observations, dtype, (rows, width)),
            ("actions", actions, np.dtype(np.uint8), (rows,)),
            ("rewards", rewards, np.dtype(np.float32), (rows,)),
            ("ends", ends, np.dtype(np.uint8), (rows,)),
        ):
            if array.dtype != wanted or array.shape != shape:
                raise ValueError(
                    f"{name} of {rows} rows of {self.spec} are {wanted} {list(shape)}, "
                    f"not {array.dtype} {list(array.shape)}"
                )
        last = actions == NO_ACTION
        if ((actions >= self.spec.outputs) & ~last).any():
            raise ValueError(f"actions of {self.spec} are 0 to {self.spec.outputs - 1}, or {NO_ACTION}")
        if (ends > _TIME).any() or not np.isfinite(rewards).all():
            raise ValueError(f"an episode's end is 0 to {_TIME}, and its rewards are finite")
        if rows and (not last[-1] or last[0] or ends[-1] or ((ends[:-1] > 0) != last[1:]).any()):
            raise ValueError(f"an episode has its end at its last step, and then a row of action {NO_ACTION}")

    def _check_saved(self, added: int, saved: dict[str, np.ndarray]) -> None:
        """Raises ValueError with one line if rings [size] are inconsistent after `added` rows."""
        size = len(saved["actions"])
        if not size:
            return
        # In the order in which the rows came.
        actions, returns, ahead, bootstraps, before = (
            np.roll(saved[name], -(added % size)) for name in ("actions", "returns", "ahead", "bootstraps", "ages")
        )
        last = actions == NO_ACTION
        row = np.arange(size)
        twice = (last[1:] & last[:-1]).any() or (last[0] and added == size)
        if ((actions >= self.spec.outputs) & ~last).any() or not last[-1] or twice:
            raise ValueError(f"a saved replay's actions are not whole episodes of {self.spec}")
        # Earlier rows of each row's episode that are in the ring; the oldest episode may have had more.
        begins = np.maximum.accumulate(np.where(np.concatenate([[True], last[:-1]]), row, 0))
        more = int(before[0]) if added > size else 0
        if (before != np.minimum(row - begins + np.where(begins == 0, more, 0), self._frames - 1)).any():
            raise ValueError("a saved replay's rows have ages that do not follow from its actions")
        ends = np.flatnonzero(last)
        to_end = ends[np.searchsorted(ends, row)] - row
        torn = (row < self._frames - 1) & (before > row)
        if (ahead != np.where(torn, 0, np.minimum(to_end, self.n_step))).any():
            raise ValueError(f"a saved replay's returns are not those of {self.n_step} steps")
        factors = self._factors.astype(np.float32)[ahead]
        ended = (bootstraps == 0) & (ahead == to_end)
        if ((bootstraps != factors) & ~ended & (ahead > 0)).any() or not np.isfinite(bootstraps).all():
            raise ValueError(f"a saved replay's bootstraps are not those of the discount {self.discount}")
        if not np.isfinite(returns).all():
            raise ValueError("a saved replay's returns are not all finite")


def _put(ring: np.ndarray, first: int, rows: np.ndarray) -> None:
    """Write rows into a ring from `first` on, wrapping round its end."""
    room = len(ring) - first
    ring[first : first + len(rows)] = rows[:room]
    ring[: max(len(rows) - room, 0)] = rows[room:]


def _column(arrays: Mapping[str, np.ndarray], name: str, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """An array of a saved replay. Raises: ValueError with one line if it is missing or has a wrong type or shape."""
    array = arrays.get(name)
    if not isinstance(array, np.ndarray) or array.dtype != dtype or array.shape != shape:
        found = f"{array.dtype} {list(array.shape)}" if isinstance(array, np.ndarray) else "missing"
        raise ValueError(f"a saved replay's {name} are {dtype} {list(shape)}, here {found}")
    return array
