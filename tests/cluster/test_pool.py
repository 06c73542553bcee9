"""SerialPool, an actor, and what all pools share: chunks, one-line errors, the same result from any worker."""

import dataclasses
import pickle
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.workers.actor import Actor, Shared
from cluster.workers.pool import (
    METRE_S,
    PARCEL_S,
    WORTH_SENDING_S,
    Chunk,
    Collected,
    Outcome,
    PoolError,
    SerialPool,
    cut,
    last_line,
    metres,
    rectangle,
)
from cluster.workers.worker import CollectTask, Task, Worker
from evolution.dqn.experience import Experience
from evolution.episodes.rollout import EPISODE, RESULT, _rollout
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import RECIPE, Kind, Mutation, _breed
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.scenarios import build
from gridsim.state import TRAFFIC_FIELDS as FIELDS

MAPS = (("seamless", 0), ("seamless", 1))
GROUPS = [Chunk(slice(64 * g, 64 * g + 64), slice(2 * g, 2 * g + 2)) for g in range(8)]
Evaluated = tuple[np.ndarray, np.ndarray, np.ndarray]  # what `Worker.evaluate` returns


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
        experience = Experience(observations, row.astype(np.uint8), row.astype(np.float32), row.astype(np.uint8))
        return experience, results


class Failing(Answering):
    def answer(self, task, maps, recipes, first, stop):
        if 300 in (task.keys[first:stop] if isinstance(task, CollectTask) else recipes["seed"]):
            raise ValueError("300 is\nnot to be had")
        return super().answer(task, maps, recipes, first, stop)


def make_task(maps: tuple[tuple[str, int], ...] = (), episodes: np.ndarray | None = None) -> Task:
    parents = np.random.default_rng(0).standard_normal((8, 311)).astype(np.float32)
    if episodes is None:
        episodes = np.zeros(len(maps) or 2, dtype=EPISODE)
        episodes["start"][:, 4] = np.arange(len(episodes))  # each has a mark of its own, which `Answering` returns
        episodes["target"], episodes["steps"] = 150.0, 300
    worlds = np.zeros((len(episodes), 0, FIELDS), dtype=np.float32)
    return Task("mlp:6,7", episodes, worlds, maps, SimConfig(), parents, 12345, Mutation())


def make_collect_task(n: int) -> CollectTask:
    """Episodes that `Answering` marks by their numbers."""
    policy, keys = "mlp:6,7", np.arange(n, dtype=np.uint64)
    weights, epsilons = np.zeros(PolicySpec.parse(policy).size, dtype=np.float32), np.zeros(n, dtype=np.float32)
    episodes = np.zeros(n, dtype=EPISODE)
    episodes["target"], episodes["steps"] = 150.0, 300
    worlds = np.zeros((n, 0, FIELDS), dtype=np.float32)
    return CollectTask(policy, episodes, worlds, (), SimConfig(), weights, epsilons, keys)


def collect_drive_task(n: int) -> tuple[CollectTask, list[Map]]:
    """A small real task on two maps, and the maps."""
    maps, rng = [build(*name) for name in MAPS], np.random.default_rng(1)
    episodes, worlds = lane_starts(maps, np.arange(n) % 2, rng, 2)
    episodes["target"], episodes["steps"] = 150.0, 300
    weights = (rng.standard_normal(311) * 0.4).astype(np.float32)
    keys, epsilons = rng.integers(1 << 63, size=n, dtype=np.uint64), np.full(n, 0.2, dtype=np.float32)
    return CollectTask("mlp:6,7", episodes, worlds, MAPS, SimConfig(), weights, epsilons, keys), maps


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
    maps = [build(*name) for name in MAPS]
    episodes, _ = lane_starts(maps, np.array([0, 1, 1]), np.random.default_rng(1))
    episodes["target"], episodes["steps"] = 150.0, 300
    return make_task(MAPS, episodes), maps


def goals(*metres: float) -> np.ndarray:
    """Episodes with these targets (m)."""
    episodes = np.zeros(len(metres), dtype=EPISODE)
    episodes["target"] = metres
    return episodes


@given(st.integers(0, 900), st.lists(st.floats(1.0, 2000.0), min_size=1, max_size=60), st.integers(1, 64))
def test_cut_covers_every_episode_of_every_member_once(n: int, targets: list[float], workers: int) -> None:
    """Also where some members drive some episodes and others drive others."""
    e = len(targets)
    two = [Chunk(slice(n // 3, n), slice(e // 2, e)), Chunk(slice(0, n // 3), slice(0, e // 2))]
    for asked in (rectangle(n, e), two):
        wanted, seen = np.zeros((n, e), dtype=int), np.zeros((n, e), dtype=int)
        for part in asked:
            wanted[part] += 1
        for parcel in cut(make_task(episodes=goals(*targets)), asked, workers):
            assert parcel
            for part in parcel:
                assert seen[part].size
                seen[part] += 1
        assert np.array_equal(seen, wanted)


@pytest.mark.parametrize("workers", [1, 2, 4, 16])
@pytest.mark.parametrize(
    ("n", "episodes", "target"), [(512, 12, 400.0), (24, 16, 1000.0), (4, 48, 2000.0), (1, 208, 2000.0)]
)
def test_chunks_let_no_worker_wait_for_the_slowest(workers: int, n: int, episodes: int, target: float) -> None:
    """Simulated with equal metres: from the first worker that runs out to the last, one small chunk passes."""
    task, metre_s = make_task(episodes=goals(*[target] * episodes)), 1e-6
    parts = cut(task, rectangle(n, episodes), workers, [metre_s])
    busy = [0.0] * workers
    for parcel in parts:
        busy[busy.index(min(busy))] += sum(metres(task, part) for part in parcel)
    assert max(busy) - min(busy) <= max(WORTH_SENDING_S / metre_s, PARCEL_S * workers / metre_s, target) + 1e-6
    assert len(parts) <= 16 * workers, "as few as that needs"


def test_one_long_evaluation_beside_many_short_ones_is_shared_among_the_workers() -> None:
    """Validation drives its 2,000 m; most members crash early, so a metre of theirs takes less time."""
    task = make_task(episodes=goals(*[2000.0] * 256, 400.0, 400.0))
    asked, metre_s = [Chunk(slice(0, 1), slice(0, 256)), Chunk(slice(1, 511), slice(256, 258))], [1e-6, 2e-7]
    busy = [0.0, 0.0]
    for parcel in cut(task, asked, 2, metre_s):
        busy[busy.index(min(busy))] += sum(metre_s[part.columns.start // 256] * metres(task, part) for part in parcel)
    assert abs(busy[0] - busy[1]) <= WORTH_SENDING_S


def test_a_parcel_holds_members_of_several_groups() -> None:
    """So that the number of parcels does not grow with the number of groups."""
    task = make_task(episodes=goals(*[400.0] * 16))
    assert len(cut(task, GROUPS, 2, [1e-6] * 8)) == len(cut(task, rectangle(512, 2), 2, [1e-6])) < 16


def test_what_is_asked_for_is_driven_and_nothing_else_and_progress_is_reported() -> None:
    pool, recipes = SerialPool(never_built, Answering), make_recipes(512)
    progress, wanted = [(0, 0)], np.zeros((512, 16))
    for group in GROUPS:
        wanted[group] = recipes["seed"][group.rows, None] * 16.0
    task = make_task(episodes=goals(*[400.0] * 16))
    outcome = pool.evaluate(task, recipes, lambda *done: progress.append(done), GROUPS)
    assert np.array_equal(outcome.results["distance"], wanted)
    assert progress == sorted(progress)
    assert progress[-1] == (512, 512)
    assert len(progress) > 5
    assert (outcome.retries, outcome.bytes_down, outcome.bytes_up, outcome.broadcast_bytes) == (0, 0, 0, 0)
    assert 0 < sum(outcome.busy_s.values()) <= outcome.wall_s
    assert pool.evaluate(make_task(), make_recipes(0)).results.shape == (0, 2)
    for _ in range(2):
        pool.close()


def test_a_first_chunk_takes_no_worker_longer_than_patience_lasts() -> None:
    """Of a large network, 1 ms a metre, before any of it is measured."""
    task = make_task(episodes=goals(100.0, 100.0))
    assert max(metres(task, part) for (part,) in cut(task, rectangle(10_000, 2), 2, [METRE_S])) * 1e-3 < 20
    assert len(cut(task, rectangle(512, 2), 2, [METRE_S])) < 40, "as few as a small network needs"


def test_what_is_to_be_done_meanwhile_is_done_to_its_end() -> None:
    """By both calls, also where there is nothing else to do."""
    pool, left = SerialPool(never_built, Answering), list(range(8))
    pool.evaluate(make_task(), make_recipes(0), meanwhile=lambda: left.pop() > 4)
    assert left == [0, 1, 2, 3]
    pool.collect(make_collect_task(40), meanwhile=lambda: bool(left.pop()))
    assert left == []


@pytest.mark.parametrize("parcels", [0, 1, 5, 1000])
def test_a_call_that_is_stopped_returns_all_that_is_still_to_be_done(parcels: int) -> None:
    pool = SerialPool(never_built, Answering)
    task, recipes = make_task(episodes=goals(*[400.0] * 16)), make_recipes(512)
    whole, begun, stops = pool.evaluate(task, recipes, asked=GROUPS), Outcome(task, recipes, GROUPS), [False] * parcels
    left = pool.work_until(lambda: not stops or stops.pop(), begun, None, None)
    rest = pool.evaluate(task, recipes, asked=left)
    assert begun.done + rest.done == whole.done
    assert (begun.done > 0) == (parcels > 0)
    assert (rest.done > 0) == (parcels < 1000)
    for name in ("distance", "paced"):
        assert (begun.results[name] + rest.results[name] == whole.results[name]).all()


def test_a_lost_member_has_no_results_and_experience_is_in_order() -> None:
    """A member whose first episode came back and whose second kills; an episode of a batch whose end came first."""
    outcome = Outcome(make_task(), make_recipes(3), rectangle(3, 2))
    for rows, columns in ((slice(0, 2), slice(0, 2)), (slice(2, 3), slice(0, 1))):
        outcome.add(0, Chunk(rows, columns), np.ones((), dtype=RESULT), np.zeros(0), np.zeros(0), 0.1)
    assert outcome.done < outcome.total
    outcome.lose(Chunk(slice(2, 3), slice(1, 2)))
    assert outcome.done == outcome.total
    assert outcome.lost.tolist() == [False, False, True]
    assert (outcome.results["distance"] == [[1, 1], [1, 1], [0, 0]]).all()

    task = make_collect_task(10)
    collected = Collected(task)
    for first, stop in ((4, 10), (0, 3)):
        answer = Answering().answer(task, [], make_recipes(0), first, stop)
        collected.add(0, Chunk(slice(first, stop), slice(0, 1)), *answer)
    collected.lose(Chunk(slice(3, 4), slice(0, 1)))
    assert collected.done == collected.total
    assert list(dict.fromkeys(collected.experience.rewards)) == [0, 1, 2, 4, 5, 6, 7, 8, 9]


@pytest.mark.parametrize("what", ["members", "episodes"])
def test_a_failing_worker_ends_in_one_line_that_names_the_chunk(what: str) -> None:
    pool = SerialPool(never_built, Failing)
    with pytest.raises(PoolError) as caught:
        pool.evaluate(make_task(), make_recipes(512)) if what == "members" else pool.collect(make_collect_task(512))
    line = rf"^a worker failed on parcel \d+ \({what} (\d+) to (\d+)\): ValueError: not to be had\Z"
    ((first, last),) = re.findall(line, str(caught.value))
    assert int(first) <= 300 <= int(last)
    assert isinstance(caught.value.__cause__, ValueError)
    assert last_line(MemoryError()) == "MemoryError"


@pytest.mark.parametrize("policy", ["mlp:6,7", "cnn:8,8,8@2"])
def test_chunks_change_nothing_for_the_real_worker(policy: str) -> None:
    """All at once, in the pool's chunks, and one member and episode at a time: the same bits, rewound ones, too."""
    task, maps = drive_task()
    parents = np.random.default_rng(0).standard_normal((8, PolicySpec.parse(policy).size)).astype(np.float32)
    episodes, recipes = task.episodes.copy(), make_recipes(40)
    episodes["rewind"] = 8
    task = dataclasses.replace(task, policy=policy, parents=parents, episodes=episodes)
    for first, kind in ((20, Kind.NEW), (25, Kind.STEP), (30, Kind.MIRRORED), (35, Kind.COPY)):
        recipes["kind"][first : first + 5] = kind
    outcome = SerialPool(lambda *name: maps[MAPS.index(name)]).evaluate(task, recipes)
    whole, rewound, _ = Worker().evaluate(task, maps, recipes)
    assert outcome.results.tobytes() == whole.tobytes()
    for i, e in np.ndindex(whole.shape):
        alone, back, _, seconds = Worker().answer(task, maps, recipes[i : i + 1], e, e + 1)
        assert (alone.tobytes(), back.tobytes()) == (whole[i, e].tobytes(), rewound[i, e].tobytes())
        assert seconds > 0
    assert whole["distance"].max() > 0


# --- Both ends of what is sent to an actor, joined without Ray --------------------------------------------------------


class Megabyte:
    nbytes = 1 << 20


def store() -> Shared:
    """One of maps of a megabyte each, in which references are what they refer to."""
    return Shared(lambda value: value, lambda *_: Megabyte())  # type: ignore[arg-type]


def of(scenario: str, seeds: list[int]) -> Task:
    return make_task(tuple((scenario, seed) for seed in seeds))


def test_the_store_keeps_one_scenarios_maps_and_a_worker_gets_each_once() -> None:
    shared, known = store(), set[tuple[str, int]]()
    for scenario, seeds, new, gone in (
        ("seamless", [0, 1, 2], [0, 1, 2], []),
        ("seamless", [3, 1], [3], []),
        ("city", [3], [3], [0, 1, 2, 3]),
        ("seamless", [0], [0], [3]),  # it was forgotten
    ):
        assert shared.put(of(scenario, seeds)) >> 20 == len(new)
        lacking, forgotten, *refs = shared.update(known)
        assert [seed for _, seed in lacking] == new
        assert sorted(seed for _, seed in forgotten) == gone
        assert len(refs) == 1 + len(new)
    shared.put_maps([("seamless", 0), ("seamless", 7)])  # ahead of the task that needs them
    assert shared.put(of("seamless", [7])) >> 20 == 1
    assert shared.update(known)[0] == [("seamless", 7)]


def test_the_store_forgets_the_maps_that_were_not_used_for_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cluster.workers.actor.MOST_MAPS", 4)
    shared, known = store(), set[tuple[str, int]]()
    for seeds, gone in (([0, 1, 2, 3], []), ([0, 4], [1]), ([0, 1, 2], [3]), ([5, 6, 7], [0, 1, 4])):
        shared.put(of("city", seeds))
        assert {seed for _, seed in shared.update(known)[1]} == set(gone)


def test_an_actor_answers_as_the_serial_pool_does_and_keeps_its_maps_until_they_are_gone() -> None:
    task, maps = drive_task()
    recipes = make_recipes(20)
    wanted = SerialPool(lambda *name: maps[MAPS.index(name)]).evaluate(task, recipes).results
    compiled = [len(kernel.signatures) for kernel in (_breed, _rollout)]
    for array in (task.parents, task.episodes, task.worlds):
        array.setflags(write=False)
    actor = Actor(Worker)

    def run(rows: slice, *update: Any) -> np.ndarray:
        return pickle.loads(actor.run([(recipes[rows].tobytes(), 0, len(task.episodes))], *update))[0][0]

    first = run(slice(0, 8), MAPS, (), pickle.dumps(task, protocol=5), *pickle.loads(pickle.dumps(maps)))
    assert np.concatenate([first, run(slice(8, 20))]).tobytes() == wanted.tobytes()
    assert run(slice(0, 20), (), (), pickle.dumps(task)).tobytes() == wanted.tobytes()
    assert [len(kernel.signatures) for kernel in (_breed, _rollout)] == compiled, "nor for read-only arrays once more"
    with pytest.raises(KeyError):  # it forgets maps when it is to
        run(slice(0, 20), (), MAPS, pickle.dumps(task))
