"""Both ends of sending work to an actor: tasks and maps go into an object store once, chunks are sent. No Ray.

For a reference that is an argument of its own, an actor gets the value, read-only and without a copy.
"""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cluster.workers.pool import BuildMap
from cluster.workers.tickets import Tickets
from cluster.workers.worker import AnyTask, Worker
from evolution.search.breeding import RECIPE
from gridsim.maps.map import Map

Name = tuple[str, int]
"""A map's scenario and seed."""

Work = tuple[bytes, int, int]
"""A chunk: its members' recipes, its first episode and the one after its last."""

MOST_MAPS = 256
"""Maps kept in the object store, of 2 MiB at most. A run uses fewer; several runs one after another would fill it."""

INLINE = 1 << 16
"""Bytes of a task up to which each worker is sent its own copy: through the object store it takes 1 ms longer."""


class Actor:
    """Runs in a worker's process: holds the current task and its maps, answers chunks."""

    def __init__(self, factory: Callable[[], Worker]):
        self._worker = factory()
        self._task: AnyTask
        self._maps: dict[Name, Map] = {}
        self._tickets: Tickets | None = None

    def hello(self) -> int:
        """The process's id. It then ignores Ctrl-C, which a terminal sends to all: the coordinator ends its workers."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return os.getpid()

    def prepare(self, *update: Any) -> int:
        """Take up a first task and load its kernels with an empty chunk: if this crashes, no member is blamed."""
        self.run([(b"", 0, 0)], *update)
        return os.getpid()

    def run(self, work: Sequence[Work], *update: Any) -> bytes:
        """What `Worker.answer` returns for each piece of work, pickled: Ray is slower with arrays than with bytes.

        `update` comes from `Shared.update`, for an actor that does not have the task yet.
        """
        self._update(*update)
        return pickle.dumps(self._answer(work), protocol=5)

    def take(self, path: str, serial: int, parcels: bytes, *update: Any) -> bytes:
        """Do those of a task's parcels that this actor gets from the queue at `path`: what `run` does, by index."""
        self._update(*update)
        self._tickets = self._tickets or Tickets(path)
        works: list[Sequence[Work]] = pickle.loads(parcels)
        answers = {index: self._answer(works[index]) for index in self._tickets.take(serial)}
        return pickle.dumps(answers, protocol=5)

    def _answer(self, work: Sequence[Work]) -> list[tuple[Any, ...]]:
        mine = [self._maps[name] for name in self._task.maps]
        return [
            self._worker.answer(self._task, mine, np.frombuffer(recipes, RECIPE), first, stop)
            for recipes, first, stop in work
        ]

    def _update(
        self, names: Sequence[Name] = (), gone: Sequence[Name] = (), shared: bytes | None = None, *maps: Any
    ) -> None:
        if shared is not None:
            self._maps |= dict(zip(names, maps, strict=True))
            for name in gone:
                self._maps.pop(name, None)
            self._task = pickle.loads(shared)


class Shared:
    """The coordinator's end: the latest task, and maps of its scenario in the store, where `put` puts them."""

    def __init__(self, put: Callable[[Any], Any], build_map: BuildMap):
        self._put, self._build_map = put, build_map
        self._maps: dict[Name, Any] = {}  # references; the latest used ones last
        self._sent = 0  # bytes of maps since the last task
        self._names: tuple[Name, ...] = ()  # of the latest task's maps
        self._task: Any = None  # the latest one, pickled, or a reference to that

    def put(self, task: AnyTask) -> int:
        """Put a task, unless it is small, and its maps. Returns: the bytes of all arrays put since the last task."""
        scenarios = {scenario for scenario, _ in task.maps}
        self._maps = {name: ref for name, ref in self._maps.items() if name[0] in scenarios}
        self.put_maps(task.maps)
        self._maps = dict(list(self._maps.items())[-MOST_MAPS:])
        sent, self._sent = self._sent, 0
        data = pickle.dumps(task, protocol=5)
        self._names, self._task = task.maps, data if len(data) <= INLINE else self._put(data)
        return sent + sum(value.nbytes for value in vars(task).values() if isinstance(value, np.ndarray))

    def put_maps(self, names: Sequence[Name]) -> None:
        """Put those of these maps that are new."""
        for name in names:
            if name in self._maps:
                self._maps[name] = self._maps.pop(name)
            else:
                road_map = self._build_map(*name)
                self._maps[name] = self._put(road_map)
                self._sent += road_map.nbytes

    def update(self, known: set[Name]) -> list[Any]:
        """What an actor with the maps `known` needs to take up the task; `known` is updated to what it then has.

        Returns: the names of the maps that it lacks, those to forget, the task or a reference to it, and references to
        the maps.
        """
        gone = [name for name in known if name not in self._maps]  # the store keeps what an actor holds
        lacking = [name for name in dict.fromkeys(self._names) if name not in known]
        known.difference_update(gone)
        known.update(lacking)
        return [lacking, gone, self._task, *(self._maps[name] for name in lacking)]
