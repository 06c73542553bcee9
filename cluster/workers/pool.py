"""Pools of workers: the protocol that the coordinator knows, and the pool that is this process."""

from __future__ import annotations

import math
import mmap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from cluster.workers.worker import CollectTask, Task, Worker
from evolution.dqn.experience import Experience, join
from evolution.episodes.rollout import RESULT, targets
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import RECIPE, Kind
from gridsim.errors import GridSimError
from gridsim.maps.map import Map
from gridsim.maps.roads import freeze

BuildMap = Callable[[str, int], Map]  # (scenario, seed) -> map; remembers what it built lately
Progress = Callable[[int, int], None]  # (members done, members in all), or episodes where experience is collected
Meanwhile = Callable[[], bool | None]  # something to do; called until it returns something false

PARTS = 4  # as many workers' chunks are a pool's that has one worker and nothing to send: for progress alone
METRE_S = 1e-6  # seconds that a metre of an episode's target takes, before it is known better
WORTH_SENDING_S = 0.005  # of evaluation: several times what it costs to send a chunk and to take in its results
CHUNK_S = 0.0004  # of the coordinator's time, for a chunk and its results: who has many workers sends larger ones
LARGEST_S = 0.5  # of evaluation in one chunk, so that progress is seen and little is lost with a worker
LARGER = 4  # times what is worth sending, where that is more
WHOLE = 0.6  # of a member's metres, from which on it is not cut
SHARE = 0.8  # of what would be a worker's part of the rest, in one chunk
LARGE_BYTES = 16 << 20  # of results, that are kept column by column
NOBODY = np.zeros(0, RECIPE)  # the recipes where experience is collected
FINER = 2  # times as many workers' chunks experience is cut into: who crashes is done long before its target


class PoolError(GridSimError):
    """No result can be had from the workers; the message is one line for the user."""


class Chunk(NamedTuple):
    """Some members, on some of the task's episodes: what is asked for, and what is sent to a worker at once."""

    rows: slice
    columns: slice


@dataclass(kw_only=True)
class Cost:
    """What one call of a pool took.

    Attributes:
        wall_s: seconds from call to return.
        busy_s: seconds that each worker (by its number) was at work. A replaced worker's number goes on counting.
        retries: chunks that were sent again because their worker died.
        bytes_down: payload sent to workers, recipes mostly; grows with the population.
        bytes_up: payload sent back.
        broadcast_bytes: put into the object store: the task and the maps that were new to it.
        warnings: a line for each member, or episode of experience, that was lost since it kills its worker.
    """

    wall_s: float = 0.0
    busy_s: dict[int, float] = field(default_factory=dict)
    retries: int = 0
    bytes_down: int = 0
    bytes_up: int = 0
    broadcast_bytes: int = 0
    warnings: list[str] = field(default_factory=list)
    _done: int = 0

    def _count(self, worker: int, done: int, seconds: float) -> None:
        self._done += done
        self.busy_s[worker] = self.busy_s.get(worker, 0.0) + seconds


@dataclass
class Outcome(Cost):
    """What one call of `evaluate` brought, and what it took.

    Attributes:
        results: RESULT [members, episodes], in the order of the recipes; zero where nothing was asked for, and for who
            was lost.
        lost: bool [members], who killed every worker that tried.
        asked: episodes of members that were asked for.
        rewound: float32 [episodes, 5], of episodes with a `rewind` the state so many steps before the end. One member
            alone drives such an episode.
        worlds: float32 [episodes, cars, world.FIELDS], the traffic of then.
    """

    results: np.ndarray
    lost: np.ndarray
    asked: int
    rewound: np.ndarray
    worlds: np.ndarray

    def members(self) -> int:
        """Members that are done, counting the parts of those that are done in part."""
        return len(self.results) * self._done // self.asked if self.asked else 0

    def progress(self) -> tuple[int, int]:
        """What `Progress` is told."""
        return self.members(), len(self.results)

    def whole(self) -> bool:
        """Whether every result is there."""
        return self._done >= self.asked

    def add(
        self, worker: int, chunk: Chunk, results: np.ndarray, rewound: np.ndarray, worlds: np.ndarray, seconds: float
    ) -> None:
        """Take in what a chunk brought (`Worker.evaluate`) and the time that it took."""
        self.results[chunk.rows, chunk.columns] = results
        if rewound.size:
            self.rewound[chunk.columns], self.worlds[chunk.columns] = rewound[0], worlds[0]
        self._count(worker, results.size, seconds)

    def lose(self, chunk: Chunk) -> None:
        """Do without a chunk's members: nothing of them counts, not even what is there."""
        self.lost[chunk.rows] = True
        self.results[chunk.rows] = np.zeros((), self.results.dtype)
        self._done += size(chunk)


@dataclass
class Collected(Cost):
    """What one call of `collect` brought, and what it took.

    Attributes:
        policy: whose experience it is.
        results: RESULT [episodes]; zero where one was lost.
        lost: bool [episodes], which killed every worker that tried.
        experience: of all episodes but those, in their order.
    """

    policy: PolicySpec
    results: np.ndarray
    lost: np.ndarray
    _parts: dict[int, Experience] = field(default_factory=dict)  # by their first episodes

    @cached_property
    def experience(self) -> Experience:
        return join(self.policy, [self._parts.pop(first) for first in sorted(self._parts)])

    def progress(self) -> tuple[int, int]:
        """What `Progress` is told."""
        return self._done, len(self.results)

    def whole(self) -> bool:
        """Whether every episode is there."""
        return self._done >= len(self.results)

    def add(self, worker: int, chunk: Chunk, experience: Experience, results: np.ndarray, seconds: float) -> None:
        """Take in a chunk's experience, its results [episodes] and the time that they took."""
        self._parts[chunk.columns.start] = experience
        self.results[chunk.columns] = results
        self._count(worker, len(results), seconds)

    def lose(self, chunk: Chunk) -> None:
        """Do without a chunk's episodes."""
        self.lost[chunk.columns] = True
        self._done += size(chunk)


def answer(
    worker: Worker, task: Task | CollectTask, maps: Sequence[Map], recipes: np.ndarray, first: int, stop: int
) -> tuple[Any, ...]:
    """What a worker says to a chunk: what `Outcome.add` and `Collected.add` take in, the seconds last.

    Recipes RECIPE [n] are a `Task`'s; `first` and `stop` say which of the task's episodes.
    """
    if isinstance(task, CollectTask):
        return worker.collect(task, maps, first, stop)
    return worker.evaluate(of_episodes(task, first, stop), maps, freeze(recipes))


class WorkerPool(Protocol):
    """Evaluates generations and collects experience. What it returns depends on the arguments, never on the workers.

    `meanwhile` is called again and again while workers are busy, until it returns something false; a call returns no
    sooner than that. What it raises ends the call.
    """

    def workers(self) -> int:
        """Workers that are up now."""

    def evaluate(
        self,
        task: Task,
        recipes: np.ndarray,
        on_progress: Progress | None = None,
        asked: Sequence[Chunk] | None = None,
        meanwhile: Meanwhile | None = None,
    ) -> Outcome:
        """Breed recipes RECIPE [n] and drive them through the task's episodes.

        Args:
            asked: who is to drive what, the longest episodes first; None is all members on all episodes.
            meanwhile: what to do here while workers are busy.

        Raises: PoolError where that cannot be done.
        """

    def collect(
        self, task: CollectTask, on_progress: Progress | None = None, meanwhile: Meanwhile | None = None
    ) -> Collected:
        """Drive the task's policy through its episodes and bring all that it met.

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
        meanwhile: Meanwhile | None = None,
    ) -> Outcome:
        asked = everything(task, recipes) if asked is None else asked
        outcome = new_outcome(task, recipes, asked)
        self._work(task, asked, recipes, outcome, on_progress, meanwhile)
        return outcome

    def collect(
        self, task: CollectTask, on_progress: Progress | None = None, meanwhile: Meanwhile | None = None
    ) -> Collected:
        collected = new_collected(task)
        self._work(task, all_episodes(task), NOBODY, collected, on_progress, meanwhile)
        return collected

    def _work(
        self, task: Task | CollectTask, asked: Sequence[Chunk], recipes: np.ndarray, brought: Outcome | Collected,
        on_progress: Progress | None, meanwhile: Meanwhile | None,
    ) -> None:  # fmt: skip
        started = time.perf_counter()
        maps = [self._build_map(*name) for name in task.maps]
        finish(meanwhile)
        for index, chunk in enumerate(cut(task, asked, PARTS)):
            rows, columns = chunk
            try:
                brought.add(0, chunk, *answer(self._worker, task, maps, recipes[rows], columns.start, columns.stop))
            except Exception as error:
                raise PoolError(f"a worker failed on {describe(task, index, chunk)}: {last_line(error)}") from error
            if on_progress:
                on_progress(*brought.progress())
        brought.wall_s = time.perf_counter() - started

    def close(self) -> None:
        pass


def everything(task: Task, recipes: np.ndarray) -> list[Chunk]:
    """All members on all episodes."""
    return [Chunk(slice(0, len(recipes)), slice(0, len(task.episodes)))]


def all_episodes(task: CollectTask) -> list[Chunk]:
    """All episodes of the one member that there is."""
    return [Chunk(slice(0, 1), slice(0, len(task.episodes)))]


def size(chunk: Chunk) -> int:
    """Episodes of members in a chunk."""
    return (chunk.rows.stop - chunk.rows.start) * (chunk.columns.stop - chunk.columns.start)


def new_outcome(task: Task, recipes: np.ndarray, asked: Sequence[Chunk]) -> Outcome:
    """An outcome to be filled, its results all zero."""
    results = _zeros((len(recipes), len(task.episodes)), RESULT)
    rewound = np.zeros((len(task.episodes), 5), dtype=np.float32)
    lost = np.zeros(len(recipes), dtype=bool)
    return Outcome(results, lost, sum(size(chunk) for chunk in asked), rewound, np.zeros_like(task.worlds))


def _zeros(shape: tuple[int, int], dtype: np.dtype) -> np.ndarray:
    """Zeros, column by column, of which no page takes memory before it is written to.

    Where a large generation is driven beside a few members' validation, most of the array is nobody's: at population
    100,000 it is 320 MB, of which 14 are used. NumPy's own would ask for pages too large for that.
    """
    size = shape[0] * shape[1] * dtype.itemsize
    if size < LARGE_BYTES:
        return np.zeros(shape, dtype)
    room = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):  # Linux
        room.madvise(mmap.MADV_NOHUGEPAGE)
    return np.ndarray(shape, dtype, buffer=room, order="F")


def new_collected(task: CollectTask) -> Collected:
    """A collection to be filled."""
    n = len(task.episodes)
    return Collected(PolicySpec.parse(task.policy), np.zeros(n, dtype=RESULT), np.zeros(n, dtype=bool))


def finish(meanwhile: Meanwhile | None) -> None:
    """Do what is left to do."""
    while meanwhile and meanwhile():
        pass


def metres(task: Task | CollectTask, chunk: Chunk) -> float:
    """How far the members of a chunk drive if all of them reach their targets."""
    return float(targets(task.episodes[chunk.columns], task.limits).sum()) * (chunk.rows.stop - chunk.rows.start)


def cut(task: Task | CollectTask, asked: Sequence[Chunk], workers: int, metre_s: float = METRE_S) -> list[Chunk]:
    """Cut what is asked for into chunks, by the metres to be driven: large ones first, small ones last.

    Each takes most of what would be a worker's share of the rest, so that nobody waits long for the slowest and still
    little is sent (guided self-scheduling, Polychronopoulos and Kuck 1987). It holds whole members, or a part of one's
    episodes where that is enough, so that every worker has its share even of one member. Depends on the arguments
    alone, and no result depends on it.
    """
    chunks: list[Chunk] = []
    left = sum(metres(task, block) for block in asked)
    worth_s = max(WORTH_SENDING_S, CHUNK_S * workers)  # while one is at its chunk, all others get theirs
    least = min(worth_s / metre_s, left / (2 * workers))  # where nothing costs anything, everybody has some
    largest = max(LARGEST_S, LARGER * worth_s) / metre_s
    goals = targets(task.episodes, task.limits)
    for rows, columns in asked:
        mileage = np.concatenate([[0.0], np.cumsum(goals[columns])])  # m, of one member
        row, column = rows.start, 0
        while row < rows.stop and columns.stop > columns.start:
            share = min(max(SHARE * left / workers, least), largest)
            if column == 0 and share >= WHOLE * mileage[-1]:
                stop = min(row + max(int(share / mileage[-1]), 1), rows.stop)
                chunks.append(Chunk(slice(row, stop), columns))
                left -= (stop - row) * mileage[-1]
                row = stop
            else:
                rest = mileage[-1] - mileage[column]
                share = rest / math.ceil(rest / share)  # pieces as even as may be: a small one costs as much to send
                stop = int(np.searchsorted(mileage, mileage[column] + share * (1.0 + 1e-9), side="right")) - 1
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


def describe(task: Task | CollectTask, index: int, chunk: Chunk) -> str:
    """A chunk in words."""
    if isinstance(task, CollectTask):
        return f"chunk {index} (episodes {chunk.columns.start} to {chunk.columns.stop - 1})"
    return f"chunk {index} (members {chunk.rows.start} to {chunk.rows.stop - 1})"


def identify(task: Task | CollectTask, chunk: Chunk, recipes: np.ndarray) -> str:
    """The one member, or episode, of a chunk: with its recipe (of `recipes`), so that it can be tried again."""
    if isinstance(task, CollectTask):
        k = chunk.columns.start
        return f"episode {k} (key {task.keys[k]:#x}, exploration {task.epsilons[k]:.3g})"
    recipe = recipes[chunk.rows][0]
    kind = Kind(int(recipe["kind"])).name.lower()
    rows = f"rows {recipe['a']} and {recipe['b']}"
    return f"member {chunk.rows.start} ({kind} of {rows}, seed {recipe['seed']}, key {task.key:#x})"


def last_line(error: BaseException) -> str:
    """An exception as one line of text, its type first, whatever its message looks like."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[-1]}" if lines else type(error).__name__
