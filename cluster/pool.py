"""Pools of workers: the protocol that the coordinator knows, and the pool that is this process."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from cluster.worker import Task, Worker
from gridsim.roads import freeze
from gridsim.scenarios import Scenario

BuildMap = Callable[[str, int], Scenario]  # (scenario, seed) -> map; remembers what it built lately
Progress = Callable[[int, int], None]  # (members done, members in all)

SHARES = 5  # chunks for each worker, at least, where there is enough to do
SMALLEST_CHUNK = 4  # members


class PoolError(Exception):
    """No result can be had from the workers; the message is one line for the user."""


class Chunk(NamedTuple):
    """What is sent to a worker at once: some members, on some of the task's episodes."""

    rows: slice
    columns: slice


@dataclass
class Outcome:
    """What one call of `evaluate` brought.

    Attributes:
        results: `task.row` [members, episodes], in the order of the recipes.
        wall_s: seconds from call to return.
        busy_s: seconds that each worker (by its number) was evaluating. A replaced worker's number goes on counting.
        retries: chunks that were sent again because their worker died.
        bytes_down: payload sent to workers, recipes mostly; grows with the population.
        bytes_up: payload sent back.
        broadcast_bytes: put into the object store: the task and the maps that were new to it.
    """

    results: np.ndarray
    wall_s: float = 0.0
    busy_s: dict[int, float] = field(default_factory=dict)
    retries: int = 0
    bytes_down: int = 0
    bytes_up: int = 0
    broadcast_bytes: int = 0
    _done: int = 0

    def members(self) -> int:
        """Members that are done, counting the parts of those that are done in part."""
        return len(self.results) * self._done // self.results.size if self.results.size else 0

    def whole(self) -> bool:
        """Whether every result is there."""
        return self._done >= self.results.size

    def add(self, worker: int, chunk: Chunk, results: np.ndarray, seconds: float) -> None:
        """Take in a chunk's results [rows, columns] and the time that they took."""
        self.results[chunk.rows, chunk.columns] = results
        self._done += results.size
        self.busy_s[worker] = self.busy_s.get(worker, 0.0) + seconds


class WorkerPool(Protocol):
    """Evaluates generations. What it returns depends on task and recipes alone, never on the workers."""

    def workers(self) -> int:
        """Workers that are up now."""

    def evaluate(self, task: Task, recipes: np.ndarray, on_progress: Progress | None = None) -> Outcome:
        """Breed and drive recipes RECIPE [n]. Raises PoolError where that cannot be done."""

    def close(self) -> None:
        """Stop all that the pool started. May be called again, and at any moment."""


class SerialPool:
    """No other process: the worker lives in this one."""

    def __init__(self, build_map: BuildMap, worker_factory: Callable[[], Worker] = Worker):
        self._build_map = build_map
        self._worker = worker_factory()

    def workers(self) -> int:
        return 1

    def evaluate(self, task: Task, recipes: np.ndarray, on_progress: Progress | None = None) -> Outcome:
        started = time.perf_counter()
        recipes = freeze(recipes)
        outcome = new_outcome(task, recipes)
        maps = [self._build_map(*name) for name in task.maps]
        for index, chunk in enumerate(cut(len(recipes), len(task.episodes), 1)):
            try:
                part = of_episodes(task, chunk.columns.start, chunk.columns.stop)
                outcome.add(0, chunk, *self._worker.evaluate(part, maps, recipes[chunk.rows]))
            except Exception as error:
                raise PoolError(f"a worker failed on {describe(index, chunk)}: {last_line(error)}") from error
            if on_progress:
                on_progress(outcome.members(), len(recipes))
        outcome.wall_s = time.perf_counter() - started
        return outcome

    def close(self) -> None:
        pass


def new_outcome(task: Task, recipes: np.ndarray) -> Outcome:
    """An outcome to be filled, its results all zero."""
    return Outcome(np.zeros((len(recipes), len(task.episodes)), dtype=task.row))


def chunks(n: int, workers: int, smallest: int = SMALLEST_CHUNK) -> list[slice]:
    """Cut n members into chunks, about 8 for each worker at 512 members: large ones first, small ones last.

    Each takes half of what would be a worker's share of the rest, so that nobody waits long for the slowest and still
    little is sent (guided self-scheduling, Polychronopoulos and Kuck 1987). Depends on the arguments alone.
    """
    cut: list[slice] = []
    at = 0
    while at < n:
        size = max((n - at) // (2 * workers), smallest)
        cut.append(slice(at, min(at + size, n)))
        at += size
    return cut


def cut(n: int, episodes: int, workers: int, smallest: int = SMALLEST_CHUNK) -> list[Chunk]:
    """Cut n members on so many episodes into chunks. Depends on the arguments alone.

    Many members are cut into groups that drive all episodes; few, as in a race or in validation, one by one and
    across the episodes as well, so that every worker has its share even of one member.
    """
    wanted = SHARES * workers
    if n >= wanted * smallest:
        return [Chunk(rows, slice(0, episodes)) for rows in chunks(n, workers, smallest)]
    size = max(n // wanted, 1)
    rows_of = [slice(at, min(at + size, n)) for at in range(0, n, size)]
    parts = min(-(-wanted // max(len(rows_of), 1)), episodes)
    edges = [episodes * k // parts for k in range(parts + 1)] if parts else []
    return [Chunk(rows, slice(a, b)) for rows in rows_of for a, b in itertools.pairwise(edges)]


def of_episodes(task: Task, first: int, stop: int) -> Task:
    """The task with only some of its episodes."""
    if stop - first == len(task.episodes):
        return task
    return replace(task, episodes=task.episodes[first:stop], worlds=task.worlds[first:stop])


def describe(index: int, chunk: Chunk) -> str:
    """A chunk in words."""
    return f"chunk {index} (members {chunk.rows.start} to {chunk.rows.stop - 1})"


def last_line(error: BaseException) -> str:
    """An exception as one line of text, its type first, whatever its message looks like."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[-1]}" if lines else type(error).__name__
