"""Both ends of what is sent to an actor, joined without Ray: each map is put into the store once."""

import pickle
from typing import Any

import numpy as np
import pytest
from test_pool import MAPS, drive_task, make_recipes, make_task

from cluster.workers.actor import Actor, Shared
from cluster.workers.pool import SerialPool
from cluster.workers.worker import Worker


class Map:
    """A megabyte."""

    def arrays(self) -> dict[str, np.ndarray]:
        return {"field": np.zeros(1 << 20, dtype=np.uint8)}


def test_the_store_keeps_one_scenarios_maps_and_a_worker_gets_each_once() -> None:
    built: list[int] = []

    def build(_: str, seed: int) -> Map:
        built.append(seed)
        return Map()

    shared = Shared(lambda value: value, build)  # type: ignore[arg-type]
    known: set[tuple[str, int]] = set()
    for scenario, seeds, new, gone in (
        ("seamless", [0, 1, 2], [0, 1, 2], []),
        ("seamless", [3, 1], [3], []),
        ("city", [3], [3], [0, 1, 2, 3]),
    ):
        task = make_task(tuple((scenario, seed) for seed in seeds))
        before = len(built)
        ref, sent = shared.put(task)
        assert built[before:] == new
        assert sent >> 20 == len(new)
        lacking, forgotten, *refs = shared.update(known, task, ref)
        assert [seed for _, seed in lacking] == new
        assert sorted(seed for _, seed in forgotten) == gone
        assert len(refs) == 1 + len(new)


def test_an_actor_answers_as_the_serial_pool_does_and_keeps_its_maps_until_they_are_gone() -> None:
    task, maps = drive_task()
    recipes = make_recipes(20)
    wanted = SerialPool(lambda *name: maps[MAPS.index(name)]).evaluate(task, recipes).results
    actor = Actor(Worker)

    def run(rows: slice, *update: Any) -> np.ndarray:
        return pickle.loads(actor.run([(recipes[rows].tobytes(), 0, len(task.episodes))], *update))[0][0]

    first = run(slice(0, 8), MAPS, (), pickle.dumps(task), *(each.arrays() for each in maps))
    assert np.concatenate([first, run(slice(8, 20))]).tobytes() == wanted.tobytes()
    assert run(slice(0, 20), (), (), pickle.dumps(task)).tobytes() == wanted.tobytes()
    with pytest.raises(KeyError):  # it forgets maps when it is to
        run(slice(0, 20), (), MAPS, pickle.dumps(task))
