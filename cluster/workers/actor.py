"""What an actor is told and what it does: tasks and maps are put into an object store once, chunks are sent. No Ray.

An actor gets the values of references that it is given as arguments of their own, read-only and without a copy.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from cluster.workers.pool import BuildMap, answer
from cluster.workers.worker import CollectTask, Task, Worker
from evolution.search.breeding import RECIPE
from gridsim.maps.map import Map

Name = tuple[str, int]
"""Of a map: scenario and seed."""


class News(NamedTuple):
    """What a worker needs to take up a task."""

    maps: list[Name]  # that it lacks
    gone: list[Name]  # that it need not keep
    refs: list[Any]  # to the task, and to the maps that it lacks


class Actor:
    """Runs in a worker's process: holds the present task and its maps, answers chunks.

    Args:
        factory: makes the worker.
        own_process: whether nothing else lives in the process, which then ignores Ctrl-C.
    """

    def __init__(self, factory: Callable[[], Worker], own_process: bool = False):
        # Ctrl-C goes to every process of the terminal; whether the workers stop is the coordinator's business.
        if own_process:
            with contextlib.suppress(ValueError):
                signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._worker = factory()
        self._serial = 0
        self._task: Task | CollectTask | None = None
        self._maps: dict[Name, Map] = {}

    def hello(self) -> int:
        return os.getpid()

    def prepare(self, serial: int, *news: Any) -> int:
        """Take up a first task and load its kernels, of nobody: who dies of that has not died of a chunk."""
        self.run(serial, b"", 0, 0, *news)
        return os.getpid()

    def run(
        self, serial: int, payload: bytes, first: int, stop: int,
        names: Sequence[Name] = (), gone: Sequence[Name] = (), task: Task | CollectTask | None = None, *maps: Any,
    ) -> bytes:  # fmt: skip
        """What `pool.answer` says to the recipes `payload`, pickled: Ray is slower with arrays than with bytes.

        `names` and all after it are for a worker that does not have the task yet.
        """
        if task is not None:
            self._maps |= {name: Map.from_arrays(arrays) for name, arrays in zip(names, maps, strict=True)}
            for name in gone:
                self._maps.pop(name, None)
            self._task, self._serial = task, serial
        if self._task is None or serial != self._serial:
            raise RuntimeError(f"a chunk of task {serial} came to a worker that has task {self._serial}")
        mine = [self._maps[name] for name in self._task.maps]
        recipes = np.frombuffer(payload, RECIPE)
        return pickle.dumps(answer(self._worker, self._task, mine, recipes, first, stop), protocol=5)


class Shared:
    """The coordinator's side of it: the maps in the object store, the least used of which are let go.

    Args:
        put: puts something into the store; returns its reference.
        build_map: builds a map.
        most_bytes: of maps that are kept.
    """

    def __init__(self, put: Callable[[Any], Any], build_map: BuildMap, most_bytes: int):
        self._put, self._build_map, self._most_bytes = put, build_map, most_bytes
        self._maps: OrderedDict[Name, tuple[Any, int]] = OrderedDict()  # references and bytes

    def put(self, task: Task | CollectTask) -> tuple[Any, int]:
        """Put a task, and those of its maps that are not there yet. Returns its reference, and how many bytes."""
        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(task, protocol=5, buffer_callback=buffers.append)
        sent = len(head) + sum(buffer.raw().nbytes for buffer in buffers)
        for name in task.maps:
            if name not in self._maps:
                arrays = self._build_map(*name).arrays()
                size = sum(array.nbytes for array in arrays.values())
                self._maps[name] = self._put(arrays), size
                sent += size
            self._maps.move_to_end(name)
        used = sum(size for _, size in self._maps.values())
        while used > self._most_bytes and len(self._maps) > len(set(task.maps)):
            used -= self._maps.popitem(last=False)[1][1]
        return self._put(task), sent

    def news(self, known: set[Name], task: Task | CollectTask, ref: Any) -> News:
        """What a worker with the maps `known` needs to take up a task; from then on it has that."""
        # A map in use stays in the object store: those that are let go here have to be let go there.
        gone = [name for name in known if name not in self._maps]
        lacking = [name for name in dict.fromkeys(task.maps) if name not in known]
        known.difference_update(gone)
        known.update(lacking)
        return News(lacking, gone, [ref, *(self._maps[name][0] for name in lacking)])
