"""Pools of workers: the protocol that the coordinator knows, and the pool that is this process."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from cluster.worker import Task, Worker
from evolution.rollout import targets
from gridsim.roads import freeze
from gridsim.scenarios import Scenario

BuildMap = Callable[[str, int], Scenario]  # (scenario, seed) -> map; remembers what it built lately
Progress = Callable[[int, int], None]  # (members done, members in all)

PARTS = 4  # as many workers' chunks are a pool's that has one worker and nothing to send: for progress alone
METRE_S = 1e-6  # seconds that a metre of an episode's target takes, before it is known better
WORTH_SENDING_S = 0.005  # of evaluation: several times what it costs to send a chunk and to take in its results
LARGEST_S = 0.5  # of evaluation in one chunk, so that progress is seen and little is lost with a worker
SHARE = 0.8  # of what would be a worker's part of the rest, in one chunk


class PoolError(Exception):
    """No result can be had from the workers; the message is one line for the user."""


class Chunk(NamedTuple):
    """Some members, on some of the task's episodes: what is asked for, and what is sent to a worker at once."""

    rows: slice
    columns: slice


@dataclass
class Outcome:
    """What one call of `evaluate` brought.

    Attributes:
        results: `task.row` [members, episodes], in the order of the recipes; zero where nothing was asked for.
        asked: episodes of members that were asked for.
        wall_s: seconds from call to return.
        busy_s: seconds that each worker (by its number) was evaluating. A replaced worker's number goes on counting.
        retries: chunks that were sent again because their worker died.
        bytes_down: payload sent to workers, recipes mostly; grows with the population.
        bytes_up: payload sent back.
        broadcast_bytes: put into the object store: the task and the maps that were new to it.
    """

    results: np.ndarray
    asked: int
    wall_s: float = 0.0
    busy_s: dict[int, float] = field(default_factory=dict)
    retries: int = 0
    bytes_down: int = 0
    bytes_up: int = 0
    broadcast_bytes: int = 0
    _done: int = 0

    def members(self) -> int:
        """Members that are done, counting the parts of those that are done in part."""
        return len(self.results) * self._done // self.asked if self.asked else 0

    def whole(self) -> bool:
        """Whether every result is there."""
        return self._done >= self.asked

    def add(self, worker: int, chunk: Chunk, results: np.ndarray, seconds: float) -> None:
        """Take in a chunk's results [rows, columns] and the time that they took."""
        self.results[chunk.rows, chunk.columns] = results
        self._done += results.size
        self.busy_s[worker] = self.busy_s.get(worker, 0.0) + seconds


class WorkerPool(Protocol):
    """Evaluates generations. What it returns depends on task and recipes alone, never on the workers."""

    def workers(self) -> int:
        """Workers that are up now."""

    def evaluate(
        self,
        task: Task,
        recipes: np.ndarray,
        on_progress: Progress | None = None,
        asked: Sequence[Chunk] | None = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> Outcome:
        """Breed recipes RECIPE [n] and drive them through the task's episodes.

        Args:
            asked: who is to drive what, the longest episodes first; None is all members on all episodes.
            meanwhile: called once, when the workers are busy.

        Raises: PoolError where that cannot be done.
        """

    def close(self) -> None:
        """Stop all that the pool started. May be called again, and at any moment."""


class SerialPool:
    """No other process: the worker lives in this one."""

    def __init__(self, build_map: BuildMap, worker_factory: Callable[[], Worker] = Worker):
        self._build_map = build_map
        self._worker = worker_factory()

    def workers(self) -> int:
        return 1

    def evaluate(
        self,
        task: Task,
        recipes: np.ndarray,
        on_progress: Progress | None = None,
        asked: Sequence[Chunk] | None = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> Outcome:
        started = time.perf_counter()
        recipes = freeze(recipes)
        asked = everything(task, recipes) if asked is None else asked
        outcome = new_outcome(task, recipes, asked)
        maps = [self._build_map(*name) for name in task.maps]
        if meanwhile:
            meanwhile()
        for index, chunk in enumerate(cut(task, asked, PARTS)):
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


def everything(task: Task, recipes: np.ndarray) -> list[Chunk]:
    """All members on all episodes."""
    return [Chunk(slice(0, len(recipes)), slice(0, len(task.episodes)))]


def size(chunk: Chunk) -> int:
    """Episodes of members in a chunk."""
    return (chunk.rows.stop - chunk.rows.start) * (chunk.columns.stop - chunk.columns.start)


def new_outcome(task: Task, recipes: np.ndarray, asked: Sequence[Chunk]) -> Outcome:
    """An outcome to be filled, its results all zero."""
    results = np.zeros((len(recipes), len(task.episodes)), dtype=task.row)
    return Outcome(results, sum(size(chunk) for chunk in asked))


def metres(task: Task, chunk: Chunk) -> float:
    """How far the members of a chunk drive if all of them reach their targets."""
    return float(targets(task.episodes[chunk.columns], task.limits).sum()) * (chunk.rows.stop - chunk.rows.start)


def cut(task: Task, asked: Sequence[Chunk], workers: int, metre_s: float = METRE_S) -> list[Chunk]:
    """Cut what is asked for into chunks, by the metres to be driven: large ones first, small ones last.

    Each takes most of what would be a worker's share of the rest, so that nobody waits long for the slowest and still
    little is sent (guided self-scheduling, Polychronopoulos and Kuck 1987). It holds whole members, or a part of one's
    episodes where that is enough, so that every worker has its share even of one member. Depends on the arguments
    alone, and no result depends on it.
    """
    chunks: list[Chunk] = []
    left = sum(metres(task, block) for block in asked)
    least = min(WORTH_SENDING_S / metre_s, left / (2 * workers))  # where nothing costs anything, everybody has some
    goals = targets(task.episodes, task.limits)
    for rows, columns in asked:
        mileage = np.concatenate([[0.0], np.cumsum(goals[columns])])  # m, of one member
        row, column = rows.start, 0
        while row < rows.stop and columns.stop > columns.start:
            share = min(max(SHARE * left / workers, least), LARGEST_S / metre_s)
            if column == 0 and share >= mileage[-1]:
                stop = min(row + int(share / mileage[-1]), rows.stop)
                chunks.append(Chunk(slice(row, stop), columns))
                left -= (stop - row) * mileage[-1]
                row = stop
            else:
                stop = int(np.searchsorted(mileage, mileage[column] + share, side="right")) - 1
                stop = min(max(stop, column + 1), len(mileage) - 1)
                chunks.append(Chunk(slice(row, row + 1), slice(columns.start + column, columns.start + stop)))
                left -= mileage[stop] - mileage[column]
                row, column = (row + 1, 0) if stop == len(mileage) - 1 else (row, stop)
    return chunks


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
