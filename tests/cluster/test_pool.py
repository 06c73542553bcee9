"""SerialPool and what all pools share: chunks, one-line errors, the same result from any number of workers."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence

import numpy as np
import pytest
from driving import to_bytes
from hypothesis import given
from hypothesis import strategies as st

from cluster.workers.pool import (
    CHUNK_S,
    METRE_S,
    NOBODY,
    WORTH_SENDING_S,
    Chunk,
    PoolError,
    SerialPool,
    answer,
    cut,
    everything,
    identify,
    last_line,
    metres,
    new_collected,
    new_outcome,
)
from cluster.workers.worker import CollectTask, Task, Worker
from evolution.dqn.experience import Experience
from evolution.episodes.rollout import EPISODE, RESULT, Limits, no_traffic
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import RECIPE, Kind, Mutation
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.scenarios import build
from gridsim.traffic.world import FIELDS

MAPS = (("seamless", 0), ("seamless", 1))
Evaluated = tuple[np.ndarray, np.ndarray, np.ndarray, float]  # what `Worker.evaluate` returns


class Answering(Worker):
    """A stand-in that answers at once: each result is a function of the recipe and the episode."""

    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        started = time.perf_counter()
        results = np.zeros((len(recipes), len(task.episodes)), dtype=RESULT)
        results["distance"] = recipes["seed"][:, None] * 16.0 + task.episodes["start"][:, 4]
        results["paced"] = task.parents[recipes["a"], 0][:, None]
        results["steps"] = sum(m.seed for m in maps)
        back = task.episodes["start"][task.episodes["rewind"] > 0]
        rewound = np.repeat(back[None], len(recipes), axis=0)
        worlds = np.repeat(task.worlds[task.episodes["rewind"] > 0][None], len(recipes), axis=0)
        return results, rewound, worlds, time.perf_counter() - started

    def collect(
        self, task: CollectTask, maps: Sequence[Map], first: int, stop: int
    ) -> tuple[Experience, np.ndarray, float]:
        """Episodes of key % 5 steps whose rows are all marked by their keys."""
        started = time.perf_counter()
        keys = task.keys[first:stop]
        results = np.zeros(len(keys), dtype=RESULT)
        results["steps"] = keys % 5
        row = np.repeat(keys, results["steps"] + 1)
        observations = np.repeat(row[:, None], PolicySpec.parse(task.policy).inputs, axis=1).astype(np.int16)
        experience = Experience(observations, row.astype(np.uint8), row.astype(np.float32), row.astype(np.uint8))
        return experience, results, time.perf_counter() - started


class Failing(Answering):
    """Answers until it meets a member that it cannot bear."""

    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        if 300 in recipes["seed"]:
            raise ValueError("member 300 is\nnot to be had")
        return super().evaluate(task, maps, recipes)

    def collect(
        self, task: CollectTask, maps: Sequence[Map], first: int, stop: int
    ) -> tuple[Experience, np.ndarray, float]:
        if 300 in task.keys[first:stop]:
            raise ValueError("episode 300 is\nnot to be had")
        return super().collect(task, maps, first, stop)


def make_task(maps: tuple[tuple[str, int], ...] = (), episodes: np.ndarray | None = None) -> Task:
    parents = np.random.default_rng(0).standard_normal((8, 311)).astype(np.float32)
    if episodes is None:
        episodes = np.zeros(len(maps) or 2, dtype=EPISODE)
        episodes["start"][:, 4] = np.arange(len(episodes))  # each has a mark of its own, which `Answering` returns
    return Task(
        "mlp:6,7",
        parents,
        12345,
        Mutation(),
        episodes,
        no_traffic(len(episodes)),
        maps,
        Limits(150.0, 300),
        SimConfig(),
    )


def make_collect_task(n: int) -> CollectTask:
    """Episodes that `Answering` marks by their numbers."""
    policy, keys = "mlp:6,7", np.arange(n, dtype=np.uint64)
    weights, epsilons = np.zeros(PolicySpec.parse(policy).size, dtype=np.float32), np.zeros(n, dtype=np.float32)
    episodes = np.zeros(n, dtype=EPISODE)
    return CollectTask(policy, weights, episodes, no_traffic(n), (), epsilons, keys, Limits(150.0, 300), SimConfig())


def collect_drive_task(n: int) -> tuple[CollectTask, list[Map]]:
    """A small real task on two maps, and the maps."""
    scenarios = [build(*name) for name in MAPS]
    rng = np.random.default_rng(1)
    episodes, worlds = lane_starts(scenarios, np.arange(n) % 2, rng, 2)
    weights = (rng.standard_normal(311) * 0.4).astype(np.float32)
    keys, epsilons = rng.integers(1 << 63, size=n, dtype=np.uint64), np.full(n, 0.2, dtype=np.float32)
    limits = Limits(150.0, 300)
    return CollectTask("mlp:6,7", weights, episodes, worlds, MAPS, epsilons, keys, limits, SimConfig()), scenarios


def make_recipes(n: int) -> np.ndarray:
    """Two copies first, then children of two parents."""
    recipes = np.zeros(n, dtype=RECIPE)
    recipes["kind"] = Kind.CROSS
    recipes["seed"] = np.arange(n)
    recipes["a"] = np.arange(n) % 8
    recipes["b"] = np.arange(n) * 3 % 8
    recipes["kind"][:2], recipes["seed"][:2] = Kind.COPY, 0
    return recipes


def never_built(name: str, seed: int) -> Map:
    raise AssertionError(f"nobody asked for {name} {seed}")


def drive_task() -> tuple[Task, list[Map]]:
    """A small real task on two maps, and the maps."""
    scenarios = [build(*name) for name in MAPS]
    episodes, _ = lane_starts(scenarios, np.array([0, 1, 1]), np.random.default_rng(1))
    return make_task(MAPS, episodes), scenarios


def goals(*metres: float) -> np.ndarray:
    """Episodes with these targets (m)."""
    episodes = np.zeros(len(metres), dtype=EPISODE)
    episodes["target"] = metres
    return episodes


@given(st.integers(0, 900), st.lists(st.floats(1.0, 2000.0), min_size=1, max_size=60), st.integers(1, 64))
def test_cut_covers_every_episode_of_every_member_once(n: int, targets: list[float], workers: int) -> None:
    """Also where some members drive some episodes and others drive others."""
    task = make_task(episodes=goals(*targets))
    half = len(targets) // 2
    for asked in (
        everything(task, make_recipes(n)),
        [Chunk(slice(n // 3, n), slice(half, len(targets))), Chunk(slice(0, n // 3), slice(0, half))],
    ):
        wanted, seen = np.zeros((n, len(targets)), dtype=int), np.zeros((n, len(targets)), dtype=int)
        for rows, columns in asked:
            wanted[rows, columns] += 1
        for rows, columns in cut(task, asked, workers):
            assert rows.stop > rows.start
            assert columns.stop > columns.start
            seen[rows, columns] += 1
        assert np.array_equal(seen, wanted)


@pytest.mark.parametrize("workers", [1, 2, 4, 16])
@pytest.mark.parametrize(
    ("n", "episodes", "target"), [(512, 12, 400.0), (24, 16, 1000.0), (4, 48, 2000.0), (1, 208, 2000.0)]
)
def test_chunks_let_nobody_wait_for_the_slowest(workers: int, n: int, episodes: int, target: float) -> None:
    """Simulated with equal metres: from the first worker that runs out to the last, one small chunk passes."""
    task = make_task(episodes=goals(*[target] * episodes))
    parts = cut(task, everything(task, make_recipes(n)), workers)
    busy = [0.0] * workers
    for part in parts:
        busy[busy.index(min(busy))] += metres(task, part)
    assert max(busy) - min(busy) <= max(WORTH_SENDING_S / METRE_S, CHUNK_S * workers / METRE_S, target) + 1e-6
    assert len(parts) <= 16 * workers, "as few as that needs"


def test_no_members_no_results() -> None:
    outcome = SerialPool(never_built, Answering).evaluate(make_task(), make_recipes(0))
    assert outcome.results.shape == (0, 2)


def test_results_are_in_the_recipes_order_and_progress_is_told() -> None:
    told: list[tuple[int, int]] = []
    pool = SerialPool(never_built, Answering)
    recipes = make_recipes(512)
    outcome = pool.evaluate(make_task(), recipes, lambda done, of: told.append((done, of)))
    assert np.array_equal(outcome.results["distance"][:, 1], recipes["seed"] * 16.0 + 1)
    assert told == sorted(told)
    assert told[-1] == (512, 512)
    assert len(told) > 5
    assert (outcome.retries, outcome.bytes_down, outcome.bytes_up, outcome.broadcast_bytes) == (0, 0, 0, 0)
    assert 0 < sum(outcome.busy_s.values()) <= outcome.wall_s


def test_only_what_is_asked_for_is_driven_while_something_else_is_done() -> None:
    recipes, done = make_recipes(20), []
    asked = [Chunk(slice(15, 20), slice(1, 2)), Chunk(slice(0, 10), slice(0, 1))]
    pool = SerialPool(never_built, Answering)
    outcome = pool.evaluate(make_task(), recipes, asked=asked, meanwhile=lambda: done.append(1))
    wanted = np.zeros((20, 2))
    wanted[15:, 1], wanted[:10, 0] = recipes["seed"][15:] * 16.0 + 1, recipes["seed"][:10] * 16.0
    assert np.array_equal(outcome.results["distance"], wanted)
    assert outcome.whole()
    assert outcome.members() == 20
    assert done == [1]


def test_what_is_to_be_done_meanwhile_is_done_to_its_end() -> None:
    """By both calls, also where there is nothing else to do; and what it raises ends the call."""
    pool = SerialPool(never_built, Answering)
    for count in (0, 40):
        for call in (
            lambda of: pool.evaluate(make_task(), make_recipes(count), meanwhile=of),  # noqa: B023
            lambda of: pool.collect(make_collect_task(count), meanwhile=of),  # noqa: B023
        ):
            left = [1, 2, 3, 4]
            assert call(lambda: bool(left.pop() and left)).whole()  # noqa: B023
            assert left == []
    with pytest.raises(KeyboardInterrupt):
        pool.collect(make_collect_task(9), meanwhile=interrupted)


def interrupted() -> None:
    raise KeyboardInterrupt


def test_experience_is_in_the_episodes_order() -> None:
    collected = SerialPool(never_built, Answering).collect(make_collect_task(100))
    wanted = np.repeat(np.arange(100), np.arange(100) % 5 + 1)
    assert (collected.experience.rewards == wanted).all()
    assert (collected.experience.observations == wanted[:, None]).all()
    assert (collected.results["steps"] == np.arange(100) % 5).all()
    assert len(SerialPool(never_built, Answering).collect(make_collect_task(0)).experience.actions) == 0


def test_a_worker_that_fails_to_collect_ends_in_one_line_that_names_the_episodes() -> None:
    with pytest.raises(
        PoolError, match=r"^a worker failed on chunk \d+ \(episodes \d+ to \d+\): ValueError: not to be"
    ):
        SerialPool(never_built, Failing).collect(make_collect_task(512))


def test_experience_from_any_worker_in_any_order_is_the_same() -> None:
    """And what a task holds is read-only."""
    task, scenarios = collect_drive_task(9)
    whole = SerialPool(lambda *name: scenarios[name[1]]).collect(task)
    collected = new_collected(task)
    for first, stop in ((5, 9), (0, 2), (2, 5)):
        brought = answer(Worker(), task, scenarios, NOBODY, first, stop)
        collected.add(first, Chunk(slice(0, 1), slice(first, stop)), *brought)
    assert collected.whole()
    assert to_bytes(collected.experience) == to_bytes(whole.experience)
    assert collected.results.tobytes() == whole.results.tobytes()
    assert set(collected.busy_s) == {0, 2, 5}
    assert all(not array.flags.writeable for array in (task.weights, task.episodes, task.worlds, task.keys))


def test_who_is_lost_has_nothing_not_even_what_was_there() -> None:
    """A member whose first episode came back and whose second kills; and an episode of a batch."""
    task, recipes = make_task(), make_recipes(3)
    outcome = new_outcome(task, recipes, everything(task, recipes))
    none, nobody = np.zeros((2, 0, 5), dtype=np.float32), np.zeros((2, 0, 0, FIELDS), dtype=np.float32)
    outcome.add(0, Chunk(slice(0, 2), slice(0, 2)), np.ones((2, 2), dtype=RESULT), none, nobody, 0.1)
    outcome.add(0, Chunk(slice(2, 3), slice(0, 1)), np.ones((1, 1), dtype=RESULT), none[:1], nobody[:1], 0.1)
    assert not outcome.whole()
    outcome.lose(Chunk(slice(2, 3), slice(1, 2)))
    assert outcome.whole()
    assert outcome.lost.tolist() == [False, False, True]
    assert (outcome.results["distance"] == [[1, 1], [1, 1], [0, 0]]).all()

    task_of_10 = make_collect_task(10)
    collected = new_collected(task_of_10)
    for first, stop in ((4, 10), (0, 3)):
        part = Answering().collect(task_of_10, [], first, stop)
        collected.add(0, Chunk(slice(0, 1), slice(first, stop)), *part)
    collected.lose(Chunk(slice(0, 1), slice(3, 4)))
    assert collected.whole()
    assert np.flatnonzero(collected.lost).tolist() == [3]
    assert sorted(set(collected.experience.rewards)) == [0, 1, 2, 4, 5, 6, 7, 8, 9]


def rewound_task() -> tuple[Task, list[Map]]:
    """A small real task; of its last two episodes the states before their ends are wanted back."""
    scenarios = [build(*name) for name in MAPS]
    episodes, worlds = lane_starts(scenarios, np.array([0, 1, 1, 0]), np.random.default_rng(1), 2)
    episodes["rewind"][2:] = 5, 9
    parents = np.random.default_rng(0).standard_normal((8, 311)).astype(np.float32)
    limits = Limits(150.0, 300)
    return Task("mlp:6,7", parents, 12345, Mutation(), episodes, worlds, MAPS, limits, SimConfig()), scenarios


def test_states_before_the_end_are_those_of_the_one_who_drove_there() -> None:
    """The last member drives the last two episodes, which ask for them; alone and in parts."""
    task, scenarios = rewound_task()
    recipes = make_recipes(6)
    asked = [Chunk(slice(5, 6), slice(2, 4)), Chunk(slice(0, 5), slice(0, 2))]
    outcome = SerialPool(lambda *name: scenarios[name[1]]).evaluate(task, recipes, asked=asked)
    results, rewound, worlds, _ = Worker().evaluate(task, scenarios, recipes[5:])
    assert outcome.rewound.shape == (4, 5)
    assert outcome.worlds.shape == task.worlds.shape
    assert (outcome.rewound[:2] == 0.0).all()
    assert (outcome.worlds[:2] == 0.0).all()
    assert outcome.rewound[2:].tobytes() == rewound[0].tobytes()
    assert outcome.worlds[2:].tobytes() == worlds[0].tobytes()
    assert outcome.results[5, 2:].tobytes() == results[0, 2:].tobytes()
    assert (outcome.rewound[2:, :2] != 0.0).all()

    taken = new_outcome(task, recipes, asked)
    for rows, columns in ((slice(5, 6), slice(3, 4)), (slice(0, 5), slice(0, 2)), (slice(5, 6), slice(2, 3))):
        brought = answer(Worker(), task, scenarios, recipes[rows], columns.start, columns.stop)
        taken.add(0, Chunk(rows, columns), *brought)
    assert taken.whole()
    for name in ("results", "rewound", "worlds"):
        assert getattr(taken, name).tobytes() == getattr(outcome, name).tobytes()


def test_a_member_is_told_by_its_recipe() -> None:
    recipes = make_recipes(9)
    recipes["kind"][8] = Kind.MIRRORED
    told = [identify(make_task(), Chunk(slice(k, k + 1), slice(0, 2)), recipes) for k in (1, 7, 8)]
    assert told == [
        "member 1 (copy of rows 1 and 3, seed 0, key 0x3039)",
        "member 7 (cross of rows 7 and 5, seed 7, key 0x3039)",
        "member 8 (mirrored of rows 0 and 0, seed 8, key 0x3039)",
    ]


def test_a_failing_worker_ends_in_one_line_that_names_the_chunk() -> None:
    pool = SerialPool(never_built, Failing)
    with pytest.raises(PoolError) as caught:
        pool.evaluate(make_task(), make_recipes(512))
    text = str(caught.value)
    assert "\n" not in text
    first, last = (int(word.strip(")")) for word in text.split("members ")[1].split(":")[0].split(" to "))
    assert first <= 300 <= last
    assert text.endswith("ValueError: not to be had")
    assert isinstance(caught.value.__cause__, ValueError)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("one\n\n two \n"), "ValueError: two"),
        (KeyError("x"), "KeyError: 'x'"),
        (MemoryError(), "MemoryError"),
    ],
)
def test_last_line(error: Exception, line: str) -> None:
    assert last_line(error) == line


def test_chunks_change_nothing_for_the_real_worker() -> None:
    """All at once, in the pool's chunks, and member by member: the same bits."""
    task, scenarios = drive_task()
    recipes = make_recipes(40)
    for first, kind in ((20, Kind.NEW), (25, Kind.STEP), (30, Kind.MIRRORED), (35, Kind.COPY)):
        recipes["kind"][first : first + 5] = kind
    known = dict(zip(MAPS, scenarios, strict=True))
    outcome = SerialPool(lambda *name: known[name]).evaluate(task, recipes)
    whole, _, _, seconds = Worker().evaluate(task, scenarios, recipes)
    single = np.concatenate([Worker().evaluate(task, scenarios, recipes[i : i + 1])[0] for i in range(40)])
    assert outcome.results.tobytes() == whole.tobytes() == single.tobytes()
    assert whole["distance"].max() > 0
    assert seconds > 0


def test_every_input_of_the_kernels_is_read_only() -> None:
    """As it is when it comes out of an object store: Numba would compile once more for anything else."""
    seen: list[np.ndarray] = []

    class Looking(Answering):
        def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
            seen.extend([task.parents, task.episodes, recipes])
            seen.extend(value for value in maps[0].road if isinstance(value, np.ndarray))
            return super().evaluate(task, maps, recipes)

    SerialPool(build, Looking).evaluate(make_task(MAPS[:1]), make_recipes(20))
    assert len(seen) > 3
    assert all(not array.flags.writeable and array.flags.c_contiguous for array in seen)


def test_closing_twice_is_fine() -> None:
    pool = SerialPool(never_built, Answering)
    assert pool.workers() == 1
    pool.close()
    pool.close()


def test_the_serial_pool_needs_no_ray(root: os.PathLike) -> None:
    code = "import sys, cluster.workers.pool; print('ray' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=60)
    assert done.stdout == "False\n"
