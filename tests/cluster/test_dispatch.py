"""Which parcel goes where when workers die: simulated, by random events, without Ray or a clock."""

import random
from collections import Counter, deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.workers.dispatch import MAX_KILLS, QUEUE, Dispatch
from cluster.workers.pool import Chunk


def new(*sizes: int) -> Dispatch:
    """Of parcels of so many whole members, on one episode; from the second member on in a chunk of their own."""
    ends = [sum(sizes[: k + 1]) for k in range(len(sizes))]
    spans = [(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    parcels = [
        tuple(Chunk(slice(a, b), slice(0, 1)) for a, b in ((first, first + 1), (first + 1, stop)) if a < b)
        for first, stop in spans
    ]
    return Dispatch(parcels)


class World:
    """Workers that hold what they were given, and die of killers. They answer in the order in which they were given."""

    def __init__(self, dispatch: Dispatch, workers: int, killers: set[int]):
        self.dispatch, self.killers = dispatch, killers
        self.queues: dict[int, deque[int]] = {worker: deque() for worker in range(workers)}
        self.answered: Counter[int] = Counter()  # members
        self.lost: set[int] = set()
        self.suspects: set[int] = set()  # members that a dead worker held
        self.deaths = self.in_a_row = 0

    def units(self, *parcels: int) -> list[int]:
        parts = [part for parcel in parcels for part in self.dispatch.parcels[parcel]]
        return [unit for part in parts for unit in range(part.rows.start, part.rows.stop)]

    def give(self) -> None:
        """Nothing is queued with a suspect, so that the next time it is clear which killed."""
        idle = [worker for worker, queue in self.queues.items() if not queue]
        for worker, parcel in self.dispatch.give(idle):
            queue = self.queues[worker]
            queue.append(parcel)
            assert len(queue) <= (1 if self.suspects.intersection(self.units(*queue)) else QUEUE)

    def bury(self, worker: int, blamed: bool = True) -> None:
        self.deaths += 1
        self.in_a_row += blamed
        self.suspects.update(self.units(*self.queues[worker]))
        self.queues[worker].clear()
        self.lost.update(self.units(*self.dispatch.died(worker, blamed)))
        assert self.dispatch.deaths == self.in_a_row

    def work(self, worker: int) -> None:
        """The worker does its first parcel, or dies of it."""
        units = self.units(self.queues[worker][0])
        if self.killers.intersection(units):
            self.bury(worker)
        else:
            assert self.dispatch.answered(worker) == self.queues[worker].popleft()
            self.answered.update(units)
            self.in_a_row = 0
            assert self.dispatch.deaths == 0


@given(
    sizes=st.lists(st.integers(1, 40), min_size=1, max_size=12),
    workers=st.integers(1, 5),
    killers=st.sets(st.integers(0, 200), max_size=3),
    chance=st.sampled_from([0.0, 0.02, 0.2]),
    seed=st.integers(0, 1 << 32),
)
def test_everything_is_answered_once_but_those_that_kill(
    sizes: list[int], workers: int, killers: set[int], chance: float, seed: int
) -> None:
    """Whatever dies by chance: each of those that kill is lost, alone, and nobody else."""
    killers &= set(range(sum(sizes)))
    rng = random.Random(seed)
    world = World(new(*sizes), workers, killers)
    chances = 2  # no member can be unlucky three times
    for _ in range(20_000):
        if world.dispatch.finished():
            break
        world.give()
        worker = rng.choice([worker for worker, queue in world.queues.items() if queue])  # nothing is forgotten
        if chances and rng.random() < chance:
            chances -= 1
            world.bury(worker)
        elif rng.random() < chance:
            world.bury(worker, blamed=False)
        else:
            world.work(worker)
    assert world.dispatch.finished()
    assert world.lost == killers
    assert world.answered == Counter(set(range(sum(sizes))) - killers)


@pytest.mark.parametrize("size", [1, 2, 100, 3000])
def test_finding_the_killer_of_a_chunk_costs_few_workers(size: int) -> None:
    world = World(new(size), 1, {size // 3})
    while not world.dispatch.finished():
        world.give()
        world.work(0)
    assert world.lost == {size // 3}
    assert world.deaths == world.dispatch.retries + 1 == (MAX_KILLS if size == 1 else 2 * MAX_KILLS - 1)


def test_a_parcel_whose_hosts_go_away_is_neither_split_nor_lost() -> None:
    dispatch = new(3)
    for _ in range(2 * MAX_KILLS):
        assert list(dispatch.give([0])) == [(0, 0)]
        assert dispatch.died(0, blamed=False) == []
    assert list(dispatch.give([0])) == [(0, 0)]
    assert dispatch.answered(0) == 0
    assert dispatch.finished()


def test_a_member_cut_in_parts_is_lost_as_a_whole() -> None:
    """Validation gives one member's episodes to many workers: they are lost together."""
    parts = [(Chunk(slice(0, 1), slice(k, k + 1)),) for k in range(4)] + [(Chunk(slice(1, 2), slice(0, 4)),)]
    dispatch = Dispatch(parts)
    assert [parcel for _, parcel in dispatch.give([0, 1, 2])] == [0, 1, 2]
    assert dispatch.answered(2) == 2
    for _ in range(MAX_KILLS - 1):
        assert dispatch.died(0) == []
        assert [parcel for _, parcel in dispatch.give([0])] == [0]
    assert dispatch.died(0) == [0, 1, 3]
    assert dispatch.answered(1) is None, "it is not asked for any more"
    assert list(dispatch.give([0, 1])) == [(0, 4)]
    assert dispatch.answered(0) == 4
    assert dispatch.finished()


def test_the_worker_with_the_smallest_parcel_is_the_first_to_get_another() -> None:
    """Parcels come largest first: a small one behind the largest would be the last to be done."""
    assert list(new(*[5] * 9).give([0, 1, 2])) == [(0, 0), (1, 1), (2, 2), (2, 3), (1, 4), (0, 5)]
