"""What all pools share: the same bits from threads and from Ray's workers, one-line errors, and how work is cut."""

import contextlib
import dataclasses
import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from commands import wait_until
from hypothesis import given
from hypothesis import strategies as st
from searching import to_bytes

from cluster import stopping
from cluster.workers.open import open_pool
from cluster.workers.pool import Chunk, Collected, Outcome, PoolError, WorkerPool, cut, size
from cluster.workers.threads import ThreadPool
from cluster.workers.worker import CollectTask, Evaluated, Task, Worker
from evolution.dqn.experience import Experience
from evolution.episodes.rollout import EPISODE, RESULT, _rollout
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import RECIPE, Kind, Mutation, _breed
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.scenarios import build
from gridsim.state import TRAFFIC_FIELDS

MAPS = (("seamless", 0), ("seamless", 1))


class Answering(Worker):
    """A stand-in that answers at once: each result is a function of the recipe and the episode."""

    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        results = np.zeros((len(recipes), len(task.episodes)), dtype=RESULT)
        results["distance"] = recipes["seed"][:, None] * 16.0 + task.episodes["start"][:, 4]
        results["paced"] = task.parents[recipes["a"], 0][:, None]
        return results, np.zeros(0), np.zeros(0)  # nothing is rewound

    def collect(self, task: CollectTask, maps: Sequence[Map]) -> tuple[Experience, np.ndarray]:
        """Episodes of key % 5 steps whose rows are all marked by their keys."""
        keys = task.keys
        results = np.zeros(len(keys), dtype=RESULT)
        results["steps"] = keys % 5
        row = np.repeat(keys, results["steps"] + 1)
        observations = np.repeat(row[:, None], PolicySpec.parse(task.policy).inputs, axis=1).astype(np.int16)
        return Experience(observations, row.astype(np.uint8), row.astype(np.float32), row.astype(np.uint8)), results


def make_task(maps: tuple[tuple[str, int], ...] = (), episodes: np.ndarray | None = None) -> Task:
    parents = np.random.default_rng(0).standard_normal((8, 311)).astype(np.float32)
    if episodes is None:
        episodes = goals(*[150.0] * (len(maps) or 2))
    worlds = np.zeros((len(episodes), 0, TRAFFIC_FIELDS), dtype=np.float32)
    return Task("mlp:6,7", episodes, worlds, maps, SimConfig(), parents, 12345, Mutation())


def make_collect_task(n: int) -> CollectTask:
    """Episodes that `Answering` marks by their numbers."""
    weights, epsilons, worlds = (np.zeros(shape, dtype=np.float32) for shape in (311, n, (n, 0, TRAFFIC_FIELDS)))
    keys = np.arange(n, dtype=np.uint64)
    return CollectTask("mlp:6,7", goals(*[150.0] * n), worlds, (), SimConfig(), weights, epsilons, keys)


def collect_drive_task(n: int) -> CollectTask:
    rng = np.random.default_rng(1)
    episodes, worlds = lane_starts([build(*name) for name in MAPS], np.arange(n) % 2, rng, 2)
    episodes["target"], episodes["steps"] = 150.0, 300
    weights = (rng.standard_normal(311) * 0.4).astype(np.float32)
    keys, epsilons = rng.integers(1 << 63, size=n, dtype=np.uint64), np.full(n, 0.2, dtype=np.float32)
    return CollectTask("mlp:6,7", episodes, worlds, MAPS, SimConfig(), weights, epsilons, keys)


def make_recipes(n: int) -> np.ndarray:
    """Two copies first, then children of two parents."""
    recipes, number = np.zeros(n, dtype=RECIPE), np.arange(n)
    recipes["kind"], recipes["seed"] = np.where(number < 2, Kind.COPY, Kind.CROSS), np.where(number < 2, 0, number)
    recipes["a"], recipes["b"] = number % 8, number * 3 % 8
    return recipes


def never_built(name: str, seed: int) -> Map:
    raise AssertionError(f"nobody asked for {name} {seed}")


def drive_task() -> tuple[Task, list[Map]]:
    """A small real task on two maps, with states to go back to, and the maps."""
    maps = [build(*name) for name in MAPS]
    episodes, _ = lane_starts(maps, np.array([0, 1, 1]), np.random.default_rng(1))
    episodes["target"], episodes["steps"] = 150.0, 300
    return make_task(MAPS, episodes), maps


def goals(*metres: float) -> np.ndarray:
    """Episodes with these targets (m), each with a mark of its own, which `Answering` returns."""
    episodes = np.zeros(len(metres), dtype=EPISODE)
    episodes["target"], episodes["steps"] = metres, np.maximum(metres, 1)
    episodes["start"][:, 4] = np.arange(len(metres))
    return episodes


# --- Every pool -------------------------------------------------------------------------------------------------------


@pytest.fixture(
    scope="module",
    params=[(1, 0), (3, 0), pytest.param((0, 2), marks=pytest.mark.e2e)],
    ids=["1 thread", "3 threads", "2 workers"],
)
def pool(request: pytest.FixtureRequest) -> Iterator[WorkerPool]:
    threads, workers = request.param
    with contextlib.closing(ThreadPool(build, threads) if threads else open_pool(workers, None, 0.0, build)) as pool:
        yield pool


def test_every_pool_returns_the_same_bits(pool: WorkerPool) -> None:
    """As the worker itself does, all at once, of what is asked for and nothing else; `wait` says when all is there."""
    (task, maps), recipes, collecting = drive_task(), make_recipes(200), collect_drive_task(60)
    episodes = task.episodes.copy()
    episodes["rewind"][1] = 8
    alone = dataclasses.replace(task, episodes=episodes)
    whole, _, _ = Worker().evaluate(task, maps, recipes)
    _, back, _ = Worker().evaluate(alone, maps, recipes[:1])
    experience, results = Worker().collect(collecting, maps)
    compiled = [len(kernel.signatures) for kernel in (_breed, _rollout)]
    for array in (task.parents, task.episodes, task.worlds, recipes):
        array.setflags(write=False)  # as they are where Ray has brought them
    for _ in range(2):
        call, seen = pool.start(Outcome(task, recipes)), [0]
        while pool.wait(call, 5.0):
            seen.append(call.progress()[0])
        assert call.results.tobytes() == whole.tobytes()
        assert (call.progress(), seen) == ((200, 200), sorted(seen))
        assert (min(call.busy_s.values()) > 0, call.warnings) == (True, [])
        assert pool.run(Outcome(alone, recipes[:1])).rewound[1].tobytes() == back[0, 0].tobytes()
        collected = pool.run(Collected(collecting))
        assert to_bytes(collected.experience) == to_bytes(experience)
        assert collected.results[0].tobytes() == results.tobytes()
    asked = [Chunk(slice(0, 10), slice(1, 3)), Chunk(slice(10, 200), slice(0, 1))]
    wanted = np.zeros_like(whole)
    for part in asked:
        wanted[part] = whole[part]
    assert pool.run(Outcome(task, recipes, asked)).results.tobytes() == wanted.tobytes()
    assert pool.run(Outcome(task, make_recipes(0))).results.shape == (0, 3)
    assert [len(kernel.signatures) for kernel in (_breed, _rollout)] == compiled


def test_a_call_that_fails_or_is_stopped_leaves_no_trace(pool: WorkerPool, monkeypatch: pytest.MonkeyPatch) -> None:
    (task, maps), collecting = drive_task(), collect_drive_task(10)
    bad = task.episodes.copy()
    bad["steps"][1] = 0
    said = r"^a worker failed on members \d+ to \d+: ValueError: an episode has 1 to \S+ steps, not 0\Z"
    with pytest.raises(PoolError, match=said):
        pool.run(Outcome(dataclasses.replace(task, episodes=bad), make_recipes(30)))
    bad = np.zeros_like(collecting.episodes)
    with pytest.raises(PoolError, match=r"^a worker failed on episodes \d+ to \d+: ValueError: an episode has "):
        pool.run(Collected(dataclasses.replace(collecting, episodes=bad)))
    first = pool.start(Outcome(task, make_recipes(300)))
    with monkeypatch.context() as patch:
        patch.setattr(stopping, "_asked_at", 0.0)
        with pytest.raises(stopping.Stopped):
            pool.wait(first, 1.0)
    second = pool.run(Outcome(task, make_recipes(50)))
    assert second.results.tobytes() == Worker().evaluate(task, maps, make_recipes(50))[0].tobytes()
    with pytest.raises(PoolError, match="another call has taken this one's place"):
        pool.run(first) if first.done == first.total else pool.wait(first, 1.0)


# --- Without processes ------------------------------------------------------------------------------------------------


class Gated(Answering):
    """Begins pieces, and ends none before the gate is opened."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.gate = threading.Event()

    def evaluate(self, task, maps, recipes):
        self.begun.append(len(recipes))
        self.gate.wait(60)
        return super().evaluate(task, maps, recipes)


def test_threads_end_within_one_piece_and_leave_the_rest() -> None:
    worker = Gated()
    pool = ThreadPool(never_built, 2, lambda: worker)
    call = pool.start(Outcome(make_task(episodes=goals(*[400.0] * 16)), make_recipes(20_000)))
    wait_until(lambda: len(worker.begun) == 2)
    closing = threading.Thread(target=pool.close)
    closing.start()
    wait_until(lambda: pool._call is None)
    worker.gate.set()
    closing.join(60)
    pool.close()
    assert (call.done, len(worker.begun)) == (0, 2), "of 6,400 pieces each thread began one"
    with pytest.raises(PoolError, match="or the pool of workers is closed"):
        pool.wait(call, 1.0)


@given(st.integers(0, 900), st.lists(st.floats(1.0, 2000.0), min_size=1, max_size=60), st.integers(1, 64))
def test_cut_covers_every_episode_of_every_member_once(n: int, targets: list[float], workers: int) -> None:
    e = len(targets)
    two = [Chunk(slice(n // 3, n), slice(e // 2, e)), Chunk(slice(0, n // 3), slice(0, e // 2))]
    for asked in (None, two):
        call = Outcome(make_task(episodes=goals(*targets)), make_recipes(n), asked)
        wanted, seen = np.zeros((n, e), dtype=int), np.zeros((n, e), dtype=int)
        for part in call.asked:
            wanted[part] += 1
        for part in cut(call, workers, 5e3, 2e4):
            assert seen[part].size
            seen[part] += 1
        assert np.array_equal(seen, wanted)


@pytest.mark.parametrize("workers", [1, 2, 4, 16])
@pytest.mark.parametrize(("n", "episodes", "target"), [(512, 12, 400.0), (24, 16, 1e3), (4, 48, 2e3), (1, 208, 2e3)])
def test_pieces_let_no_worker_wait_for_the_slowest(workers: int, n: int, episodes: int, target: float) -> None:
    """Simulated with equal metres: from the first worker that runs out to the last, one small piece passes."""
    pieces = cut(Outcome(make_task(episodes=goals(*[target] * episodes)), make_recipes(n)), workers, 5e3, 2e4)
    metres, busy = [target * size(piece) for piece in pieces], [0.0] * workers
    for each in metres:
        busy[busy.index(min(busy))] += each
    assert max(busy) - min(busy) <= max(5e3, target * episodes if n > 1 else target) + 1e-6
    assert max(metres) <= 2e4 + target, "so that it is stopped soon"
    assert sum(busy) / len(pieces) >= min(4e3, sum(busy) / (3 * workers)), "as few as that needs"
    assert metres[0] >= metres[-1], "large ones first"
