"""Both ends of what is sent to an actor, joined without Ray: maps are put into the store once, and within bounds."""

import pickle

import numpy as np
import pytest
from test_pool import MAPS, Answering, drive_task, make_recipes, make_task

from cluster.workers.actor import Actor, News, Shared
from cluster.workers.pool import Chunk, SerialPool, new_outcome
from cluster.workers.worker import Worker


class Map:
    """A megabyte."""

    def __init__(self, seed: int):
        self.seed = seed

    def arrays(self) -> dict[str, np.ndarray]:
        return {"field": np.zeros(1 << 20, dtype=np.uint8)}


def test_the_store_keeps_a_bounded_number_of_maps() -> None:
    built: list[int] = []

    def build(_: str, seed: int) -> Map:
        built.append(seed)
        return Map(seed)

    shared = Shared(lambda value: value, build, 3 << 20)  # type: ignore[arg-type]
    for seeds in ([0, 1, 2], [0, 1, 2], [3], [0, 1], [4, 5, 6, 7], [7]):
        before = len(built)
        _, sent = shared.put(make_task(tuple(("seamless", seed) for seed in seeds)))
        assert len(shared._maps) <= max(3, len(seeds))
        assert sent >> 20 == len(built) - before, "those that are new to it"
    assert built == [0, 1, 2, 3, 0, 4, 5, 6, 7], "the one that was used longest ago goes first"


def test_a_worker_is_told_of_what_it_lacks_and_of_what_has_gone() -> None:
    shared = Shared(lambda value: value, lambda _, seed: Map(seed), 2 << 20)  # type: ignore[arg-type, return-value]
    known: set[tuple[str, int]] = set()

    def news(*seeds: int) -> News:
        task = make_task(tuple(("seamless", seed) for seed in seeds))
        ref, _ = shared.put(task)
        return shared.news(known, task, ref)

    first = news(0, 1)
    assert [seed for _, seed in first.maps] == [0, 1]
    assert (first.gone, len(first.refs)) == ([], 3)
    assert news(1, 0).maps == []
    third = news(2, 1)
    assert ([seed for _, seed in third.maps], third.gone) == ([2], [("seamless", 0)])
    assert known == {("seamless", 1), ("seamless", 2)}


def test_an_actor_answers_as_the_serial_pool_does_and_keeps_its_maps() -> None:
    task, scenarios = drive_task()
    recipes = make_recipes(20)
    outcome = SerialPool(lambda *name: scenarios[MAPS.index(name)]).evaluate(task, recipes)
    actor = Actor(Worker)
    arrays = [scenario.arrays() for scenario in scenarios]
    episodes = len(task.episodes)
    everything, some, others = (Chunk(slice(*rows), slice(0, episodes)) for rows in ((0, 20), (0, 8), (8, 20)))
    parts, whole = new_outcome(task, recipes, [everything]), new_outcome(task, recipes, [everything])
    parts.add(0, some, *pickle.loads(actor.run(1, recipes[:8].tobytes(), 0, episodes, MAPS, (), task, *arrays)))
    parts.add(0, others, *pickle.loads(actor.run(1, recipes[8:].tobytes(), 0, episodes)))
    whole.add(0, everything, *pickle.loads(actor.run(2, recipes.tobytes(), 0, episodes, (), (), task)))
    assert parts.results.tobytes() == whole.results.tobytes() == outcome.results.tobytes()


def test_a_chunk_of_another_task_is_refused() -> None:
    actor = Actor(Answering)
    with pytest.raises(RuntimeError, match="a chunk of task 1 came to a worker that has task 0"):
        actor.run(1, make_recipes(2).tobytes(), 0, 2)
    actor.run(1, make_recipes(2).tobytes(), 0, 2, (), (), make_task())
    with pytest.raises(RuntimeError, match="a chunk of task 2 came to a worker that has task 1"):
        actor.run(2, make_recipes(2).tobytes(), 0, 2)
