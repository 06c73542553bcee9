"""Which chunk goes where when workers die, stall and come back: simulated, by random events, without Ray or a clock."""

import random
from collections import Counter, deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.workers.dispatch import BACKOFF_S, LATE, LATE_S, MAX_BACKOFF_S, MAX_KILLS, QUEUE, Dispatch
from cluster.workers.pool import Chunk


def rows(*sizes: int) -> list[Chunk]:
    """Chunks of so many whole members, on one episode."""
    ends = [sum(sizes[: k + 1]) for k in range(len(sizes))]
    return [Chunk(slice(end - size, end), slice(0, 1)) for end, size in zip(ends, sizes, strict=True)]


def columns(*sizes: int) -> list[Chunk]:
    """Chunks of so many episodes of one member."""
    return [Chunk(slice(0, 1), chunk.rows) for chunk in rows(*sizes)]


def new(parts: list[Chunk], by_episode: bool = False, expected_s: float = 0.1) -> Dispatch:
    return Dispatch(parts, by_episode, lambda _: expected_s)


class World:
    """Workers that hold what they were given, and die of killers. They answer in the order in which they were given."""

    def __init__(self, dispatch: Dispatch, workers: int, killers: set[int], by_episode: bool):
        self.dispatch, self.killers, self.by_episode = dispatch, killers, by_episode
        self.queues: dict[int, deque[int]] = {worker: deque() for worker in range(workers)}
        self.now = 0.0
        self.brought: Counter[tuple[int, int]] = Counter()  # (member, episode)
        self.lost: set[tuple[int, int]] = set()
        self.deaths = 0

    def units(self, part: Chunk) -> range:
        span = part.columns if self.by_episode else part.rows
        return range(span.start, span.stop)

    def cells(self, part: Chunk) -> list[tuple[int, int]]:
        return [
            (r, c) for r in range(part.rows.start, part.rows.stop) for c in range(part.columns.start, part.columns.stop)
        ]

    def give(self) -> list[tuple[int, int]]:
        idle = [worker for worker, queue in self.queues.items() if not queue]
        given = list(self.dispatch.give(idle, self.now))
        for worker, chunk in given:
            self.queues[worker].append(chunk)
            assert len(self.queues[worker]) <= QUEUE
        return given

    def bury(self, worker: int, blamed: bool = True) -> None:
        self.deaths += 1
        self.queues[worker].clear()
        for chunk in self.dispatch.died(worker, self.now, blamed):
            self.lost.update(self.cells(self.dispatch.parts[chunk]))

    def work(self, worker: int) -> None:
        """The worker does what it is at, or dies of it."""
        chunk = self.queues[worker].popleft()
        part = self.dispatch.parts[chunk]
        if self.killers & set(self.units(part)):
            self.bury(worker)
            return
        settled = self.dispatch.answered(worker, self.now)
        assert settled in (chunk, None)
        if settled is not None:
            self.brought.update(self.cells(part))

    def busy(self) -> list[int]:
        return [worker for worker, queue in self.queues.items() if queue]


@given(
    by_episode=st.booleans(),
    sizes=st.lists(st.integers(1, 40), min_size=1, max_size=12),
    workers=st.integers(1, 5),
    killers=st.sets(st.integers(0, 200), max_size=3),
    chance=st.sampled_from([0.0, 0.02, 0.2]),
    seed=st.integers(0, 1 << 32),
)
def test_everything_is_brought_once_but_those_that_kill(
    by_episode: bool, sizes: list[int], workers: int, killers: set[int], chance: float, seed: int
) -> None:
    """Whatever dies by chance, stalls or answers twice: each of those that kill is lost, alone, and nobody else."""
    parts = columns(*sizes) if by_episode else rows(*sizes)
    killers &= set(range(sum(sizes)))
    rng = random.Random(seed)
    world = World(new(parts, by_episode), workers, killers, by_episode)
    chances = 2  # no member can be unlucky three times
    for _ in range(20_000):
        if world.dispatch.finished():
            break
        world.give()
        world.now += rng.choice([0.01, 0.5, 3.0])
        busy = world.busy()
        if not busy:
            assert world.dispatch.waiting(), "nothing is forgotten"
            assert world.dispatch.pause_s(world.now) <= MAX_BACKOFF_S or world.give()
            continue
        worker = rng.choice(busy)
        if chances and rng.random() < chance:
            chances -= 1
            world.bury(worker)
        elif rng.random() < chance:
            world.bury(worker, blamed=False)
        else:
            world.work(worker)
    assert world.dispatch.finished()
    lost = {cell[1 if by_episode else 0] for cell in world.lost}
    assert lost == killers
    assert set(world.brought) | world.lost == {cell for part in parts for cell in world.cells(part)}
    assert set(world.brought).isdisjoint(world.lost)
    assert set(world.brought.values()) <= {1}


@pytest.mark.parametrize("size", [1, 2, 3, 100, 3000])
def test_narrowing_a_chunk_down_to_its_killer_costs_few_workers(size: int) -> None:
    world = World(new(rows(size)), 1, {size // 3}, False)
    while not world.dispatch.finished():
        world.now += 10.0
        world.give()
        world.work(0)
    assert world.lost == {(size // 3, 0)}
    assert world.deaths == world.dispatch.retries + 1
    assert world.deaths <= (3 if size == 1 else 8)


def test_a_member_cut_in_parts_is_lost_as_a_whole() -> None:
    """Validation gives one member's episodes to many: what another has, or is at, goes with it."""
    parts = [*rows(1)] + [Chunk(slice(0, 1), slice(k, k + 1)) for k in (1, 2, 3)] + [Chunk(slice(1, 2), slice(0, 4))]
    dispatch = new(parts)
    assert [chunk for _, chunk in dispatch.give([0, 1, 2], 0.0)] == [0, 1, 2]
    assert dispatch.answered(2, 0.1) == 2
    for _ in range(MAX_KILLS - 1):
        assert dispatch.died(0, 0.2) == []
        assert [chunk for _, chunk in dispatch.give([0], 5.0)] == [0]
    assert dispatch.died(0, 5.1) == [0, 1, 3]
    assert dispatch.answered(1, 5.2) is None, "it is not asked for any more"
    assert list(dispatch.give([0, 1], 5.3)) == [(0, 4)]
    assert dispatch.answered(0, 5.4) == 4
    assert dispatch.finished()


@pytest.mark.parametrize("kills", [False, True])
def test_a_member_s_long_chunk_is_cut_before_it_is_lost(kills: bool) -> None:
    """Of 256 episodes: who is unlucky twice in such a long one is not so in a short one, too; who kills goes on."""
    long = Chunk(slice(4, 5), slice(100, 356))
    dispatch = new([long, *rows(1)])
    for now in (0.0, 1.0):
        assert list(dispatch.give([0], now)) == [(0, 0)]
        assert dispatch.died(0, now + 0.3) == []
    deaths, lost = 2, []
    pieces: list[Chunk] = []
    while not dispatch.finished():
        ((_, chunk),) = dispatch.give([0], 100.0 * (deaths + len(pieces)))
        if kills and dispatch.parts[chunk].rows == long.rows:
            lost = dispatch.died(0, 100.0 * (deaths + len(pieces)))
            deaths += 1
        else:
            assert dispatch.answered(0, 0.0) == chunk
            pieces.append(dispatch.parts[chunk])
    if kills:
        assert deaths == 2 + MAX_KILLS
        assert all(dispatch.parts[chunk].rows == long.rows for chunk in lost)
        assert len(lost) == 16
        assert len(pieces) == 1
    else:
        assert [piece.columns for piece in pieces if piece.rows == long.rows] == [
            slice(first, first + 16) for first in range(100, 356, 16)
        ]


def test_the_first_time_at_once_then_after_pauses_that_double() -> None:
    dispatch, now, pauses = new(rows(1, 1)), 100.0, []
    for _ in range(8):
        while not (given := list(dispatch.give([0], now))):
            pauses.append(dispatch.pause_s(now))
            now += pauses[-1]
        assert given == [(0, 0)] or dispatch.answered(0, now) == 1
        if given == [(0, 0)]:
            assert dispatch.died(0, now, blamed=False) == []
    assert pauses[:5] == [BACKOFF_S * 2**k for k in range(5)]
    assert dispatch.deaths == 0
    assert dispatch.retries >= 6


def test_who_waits_does_not_hold_up_the_others() -> None:
    dispatch = new(rows(1, 1))
    for _ in range(2):
        assert list(dispatch.give([0], 1.0)) == [(0, 0)]
        dispatch.died(0, 1.0, blamed=False)
    assert list(dispatch.give([0], 1.0)) == [(0, 1)]
    assert dispatch.pause_s(1.0) == pytest.approx(BACKOFF_S)


def test_nothing_is_queued_with_a_suspect() -> None:
    """So that the next time it is clear who killed. What waited behind a dead worker's chunk is a suspect too."""
    dispatch = new(rows(*[5] * 9))
    assert [chunk for _, chunk in dispatch.give([0, 1], 0.0)] == [0, 1, 2, 3]
    dispatch.died(0, 0.1)
    assert list(dispatch.give([0], 0.1)) == [(0, 0)]
    assert list(dispatch.give([], 0.2)) == []
    assert dispatch.answered(1, 0.2) == 1
    assert dispatch.answered(1, 0.3) == 3
    assert list(dispatch.give([1], 0.3)) == [(1, 2)]
    assert dispatch.answered(0, 0.4) == 0
    assert list(dispatch.give([0], 0.4)) == [(0, 4), (0, 5)]


def test_the_last_chunks_go_to_who_has_nothing_to_do() -> None:
    dispatch = new(rows(*[5] * 5))
    given = list(dispatch.give([0, 1], 0.0))
    assert given == [(0, 0), (1, 1), (0, 2)], "two are left for two workers"


class TestStragglers:
    """Two workers, a chunk each, and one behind the first's; the second has answered, the first has not."""

    def stalled(self, expected_s: float = 0.1) -> Dispatch:
        """Worker 0 holds chunks 0 and 2, and the others are done."""
        dispatch = new(rows(5, 5, 5, 5, 5), expected_s=expected_s)
        assert list(dispatch.give([0, 1], 0.0)) == [(0, 0), (1, 1), (0, 2)]
        assert dispatch.answered(1, 0.1) == 1
        assert list(dispatch.give([1], 0.1)) == [(1, 3)]
        assert dispatch.answered(1, 0.2) == 3
        assert list(dispatch.give([1], 0.2)) == [(1, 4)]
        assert dispatch.answered(1, 0.3) == 4
        return dispatch

    def test_idle_workers_take_copies_of_what_is_late_and_of_what_waits_behind_it(self) -> None:
        dispatch = self.stalled()
        assert list(dispatch.give([1], LATE_S)) == []
        late = LATE_S + 0.1
        assert list(dispatch.give([1, 2, 3], late)) == [(1, 0), (2, 2)]
        assert list(dispatch.give([3], late + 9.0)) == [], "one extra copy each"
        assert dispatch.answered(1, late + 0.1) == 0
        assert dispatch.answered(2, late + 0.1) == 2
        assert dispatch.finished()
        assert dispatch.retries == 0
        assert dispatch.answered(0, late + 9.0) is None, "the first answer counts"
        assert dispatch.died(0, late + 9.1) == []
        assert dispatch.finished()

    def test_what_was_expected_to_take_longer_is_not_late_yet(self) -> None:
        dispatch = self.stalled(expected_s=2.0)
        assert list(dispatch.give([1], LATE * 2.0)) == []
        assert list(dispatch.give([1], LATE * 2.0 + 0.1)) == [(1, 0)]

    def test_the_slow_one_may_still_be_first(self) -> None:
        dispatch = self.stalled()
        assert list(dispatch.give([1], 3.0)) == [(1, 0)]
        assert dispatch.answered(0, 3.1) == 0
        assert list(dispatch.give([], 3.2)) == []
        assert dispatch.answered(0, 3.3) == 2
        assert dispatch.finished(), "the copy is not waited for"
        assert dispatch.answered(1, 4.0) is None

    def test_a_chunk_whose_copy_goes_on_is_not_sent_again(self) -> None:
        dispatch = self.stalled()
        assert list(dispatch.give([1], 3.0)) == [(1, 0)]
        assert dispatch.died(0, 3.1) == []
        assert list(dispatch.give([0], 3.1)) == [(0, 2)], "what waited behind it is"
        assert dispatch.died(1, 3.2) == []
        assert dispatch.waiting() > 0, "now it is, in pieces: it was there twice"

    def test_nobody_is_late_while_there_is_something_else_to_do(self) -> None:
        dispatch = new(rows(5, 5))
        assert list(dispatch.give([0], 0.0)) == [(0, 0)]
        assert list(dispatch.give([1, 2], 9.0)) == [(1, 1), (2, 0)]
        dispatch = new(rows(5, 5))
        assert list(dispatch.give([0], 0.0)) == [(0, 0)]
        assert list(dispatch.give([1], 9.0)) == [(1, 1)]
        assert list(dispatch.give([], 9.0)) == []


def test_deaths_in_a_row_are_counted_until_somebody_answers() -> None:
    dispatch = new(rows(9, 9, 9))
    for k in range(4):
        list(dispatch.give([0], 10.0 * k))
        dispatch.died(0, 10.0 * k)
        assert dispatch.deaths == k + 1
    list(dispatch.give([0], 100.0))
    dispatch.answered(0, 100.1)
    assert dispatch.deaths == 0
