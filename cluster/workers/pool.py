"""Pools of workers: what the learners call, how work is cut into chunks, and the pool within this process."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from cluster.workers.worker import AnyTask, CollectTask, Task, Worker
from evolution.dqn.experience import Experience, join
from evolution.episodes.rollout import RESULT
from evolution.search.breeding import RECIPE, Kind
from gridsim.errors import GridSimError
from gridsim.maps.map import Map

BuildMap = Callable[[str, int], Map]  # (scenario, seed) -> map; remembers the latest
Progress = Callable[[int, int], None]  # (members done, members in all), or episodes where experience is collected
Meanwhile = Callable[[], bool | None]  # called while workers are busy, again and again until it returns a false value

SERIAL_PARTS = 4  # in this process a task is cut as for so many workers, only to show progress
METRE_S = 3e-5  # assumed seconds for a metre of an episode, until they are measured; small networks take a thirtieth
WORTH_SENDING_S = 0.005  # of evaluation: several times what it costs to send a parcel and to receive its results
PARCEL_S = 0.0004  # of the coordinator's time, for a parcel and its results: many workers get larger parcels
LARGEST_S = 0.5  # of evaluation in one parcel, so that progress is seen and little is lost with a worker
LARGER = 4  # times what is worth sending is the largest parcel, if that is more
SHARE = 0.9  # of a worker's share of the rest, in one parcel


class PoolError(GridSimError):
    """The workers cannot give a result; the message is one line for the user."""


class Chunk(NamedTuple):
    """Some members (rows), on some of the task's episodes (columns). Of a batch of experience, rows are episodes."""

    rows: slice
    columns: slice


Parcel = tuple[Chunk, ...]
"""The chunks that are sent to a worker at once."""


def size(chunk: Chunk) -> int:
    """How many episodes the members of a chunk drive, in all."""
    return (chunk.rows.stop - chunk.rows.start) * (chunk.columns.stop - chunk.columns.start)


class Call(ABC):
    """One call of a pool: what is asked for, as in `WorkerPool.evaluate`, what it returned, and what it took."""

    noun: ClassVar[str]  # what its rows are

    def __init__(self, task: AnyTask, recipes: np.ndarray, asked: Sequence[Chunk], rows: int, columns: int):
        self.task, self.recipes, self.asked = task, recipes, asked
        self.results = np.zeros((rows, columns), RESULT)  # zero where nothing was asked for and where it was lost
        self.lost = np.zeros(rows, bool)  # those that killed every worker that tried them
        self.wall_s = 0.0  # from call to return
        self.busy_s: dict[int, float] = {}  # seconds of work, by the worker's number, which a replacement keeps
        self.episode_s = np.zeros(columns)  # seconds of these that each column took, for all rows together
        self.retries = 0  # parcels that were sent again because their worker died or failed
        self.bytes_down = self.bytes_up = 0  # payload sent to workers, recipes mostly, and back
        self.broadcast_bytes = 0  # put into the object store: the task and the maps that were new to it
        self.warnings: list[str] = []  # a line for each row that was lost, and for each silent worker that was replaced
        self.total, self.done = sum(map(size, asked)), 0  # episodes to be driven, and those that are, or are lost

    def work(self, chunk: Chunk) -> tuple[np.ndarray, int, int]:
        """Arguments of `Worker.answer` for a chunk: its recipes, its first episode and the one after its last."""
        episodes = chunk.rows if isinstance(self.task, CollectTask) else chunk.columns
        return self.recipes[chunk.rows], episodes.start, episodes.stop

    @abstractmethod
    def add(self, worker: int, chunk: Chunk, *answer: Any) -> None:
        """Take in what `Worker.answer` returned for a chunk."""

    def _count(self, worker: int, chunk: Chunk, results: np.ndarray, seconds: float) -> None:
        self.results[chunk.rows, chunk.columns] = results
        self.done += size(chunk)
        self.episode_s[chunk.columns] += seconds / (chunk.columns.stop - chunk.columns.start)
        self.busy_s[worker] = self.busy_s.get(worker, 0.0) + seconds

    def lose(self, chunk: Chunk) -> None:
        """Do without a chunk's rows: results that they already have do not count either."""
        self.lost[chunk.rows] = True
        self.results[chunk.rows] = np.zeros((), self.results.dtype)
        self.done += size(chunk)

    def progress(self) -> tuple[int, int]:
        """Arguments of `Progress`; a member that is done in part counts in part."""
        rows = len(self.results)
        return (rows * self.done // self.total if self.total else 0), rows

    def failure(self, index: int, parcel: Parcel, error: BaseException) -> PoolError:
        """What to raise where a worker raised an error on a parcel."""
        spans = ", ".join(f"{chunk.rows.start} to {chunk.rows.stop - 1}" for chunk in parcel)
        return PoolError(f"a worker failed on parcel {index} ({self.noun} {spans}): {last_line(error)}")

    @abstractmethod
    def identify(self, row: int) -> str:
        """A member with its recipe, or an episode of experience, so that it can be tried again."""


class Outcome(Call):
    """What `evaluate` returned: rows are members, in the order of the recipes, columns episodes."""

    noun = "members"
    task: Task

    def __init__(self, task: Task, recipes: np.ndarray, asked: Sequence[Chunk]):
        super().__init__(task, recipes, asked, len(recipes), len(task.episodes))
        self.rewound = np.zeros((len(task.episodes), 5), np.float32)  # states so many steps before the end as `rewind`
        self.worlds = np.zeros_like(task.worlds)  # the traffic at that time, float32 [episodes, cars, world.FIELDS]

    def add(self, worker: int, chunk: Chunk, *answer: Any) -> None:
        results, rewound, worlds, seconds = answer
        if rewound.size:  # only one member drives such an episode
            self.rewound[chunk.columns], self.worlds[chunk.columns] = rewound[0], worlds[0]
        self._count(worker, chunk, results, seconds)

    def identify(self, row: int) -> str:
        recipe = self.recipes[row]
        kind = Kind(int(recipe["kind"])).name.lower()
        parents = f"rows {recipe['a']} and {recipe['b']}"
        return f"member {row} ({kind} of {parents}, seed {recipe['seed']}, key {self.task.key:#x})"


class Collected(Call):
    """What `collect` returned: rows are episodes, in one column."""

    noun = "episodes"
    task: CollectTask

    def __init__(self, task: CollectTask):
        n = len(task.episodes)
        super().__init__(task, np.zeros(0, RECIPE), rectangle(n, 1), n, 1)
        self._parts: dict[int, Experience] = {}  # by their first episodes

    @cached_property
    def experience(self) -> Experience:
        """Of all episodes that are not lost, in their order."""
        return join([self._parts.pop(first) for first in sorted(self._parts)])

    def add(self, worker: int, chunk: Chunk, *answer: Any) -> None:
        experience, results, seconds = answer
        self._parts[chunk.rows.start] = experience
        self._count(worker, chunk, results[:, None], seconds)

    def identify(self, row: int) -> str:
        return f"episode {row} (key {self.task.keys[row]:#x}, exploration {self.task.epsilons[row]:.3g})"


def rectangle(rows: int, columns: int) -> list[Chunk]:
    """The first `rows` members on the first `columns` episodes."""
    return [Chunk(slice(0, rows), slice(0, columns))]


class WorkerPool(ABC):
    """Evaluates generations and collects experience. What it returns depends on the arguments, never on the workers.

    A call returns only when `meanwhile` is done to its end. What it raises ends the call.
    Raises: PoolError if what is asked for cannot be done.
    """

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
            asked: which members drive which episodes, the longest first; None is all members on all episodes.
            meanwhile: what to do here while workers are busy.
        """
        outcome = Outcome(task, recipes, rectangle(len(recipes), len(task.episodes)) if asked is None else asked)
        self._work(outcome, on_progress, meanwhile)
        return outcome

    def collect(
        self, task: CollectTask, on_progress: Progress | None = None, meanwhile: Meanwhile | None = None
    ) -> Collected:
        """Drive the task's policy through its episodes and return all transitions."""
        collected = Collected(task)
        self._work(collected, on_progress, meanwhile)
        return collected

    def expect(self, maps: Sequence[tuple[str, int]]) -> None:  # noqa: B027 - there may be nothing to do
        """Prepare for maps (scenario, seed) that the next calls may need; to be called while the workers are busy."""

    @abstractmethod
    def _work(self, call: Call, on_progress: Progress | None, meanwhile: Meanwhile | None) -> None:
        """Have all that is asked for done, and fill `call`."""

    def close(self) -> None:  # noqa: B027 - there may be nothing to do
        """Stop all that the pool started. May be called again, and at any moment."""


class SerialPool(WorkerPool):
    """Starts no other process: the worker is in this one."""

    def __init__(self, build_map: BuildMap, worker_factory: Callable[[], Worker] = Worker):
        self._build_map = build_map
        self._worker = worker_factory()

    def _work(self, call: Call, on_progress: Progress | None, meanwhile: Meanwhile | None) -> None:
        started = time.perf_counter()
        self.work_until(lambda: False, call, on_progress, meanwhile)
        call.wall_s = time.perf_counter() - started

    def work_until(
        self, stop: Callable[[], bool], call: Call, on_progress: Progress | None, meanwhile: Meanwhile | None
    ) -> list[Chunk]:
        """Do what a call asks for, until `stop` returns true before a parcel. Returns what is still to be done."""
        maps = [self._build_map(*name) for name in call.task.maps]
        finish(meanwhile)
        parcels = cut(call.task, call.asked, SERIAL_PARTS)
        for index, parcel in enumerate(parcels):
            if stop():
                return [chunk for parcel in parcels[index:] for chunk in parcel]
            try:
                for chunk in parcel:
                    call.add(0, chunk, *self._worker.answer(call.task, maps, *call.work(chunk)))
            except Exception as error:
                raise call.failure(index, parcel, error) from error
            if on_progress:
                on_progress(*call.progress())
        return []


def finish(meanwhile: Meanwhile | None) -> None:
    """Call `meanwhile` until it is done."""
    while meanwhile and meanwhile():
        pass


def _goals(task: AnyTask) -> np.ndarray:
    """Target (m) of each column: float64 [columns]. All episodes of a batch of experience have the same."""
    goals = task.episodes["target"].astype(np.float64)
    return goals[:1] if isinstance(task, CollectTask) else goals


def metres(task: AnyTask, chunk: Chunk) -> float:
    """How far the members of a chunk drive if all of them reach their targets."""
    return float(_goals(task)[chunk.columns].sum()) * (chunk.rows.stop - chunk.rows.start)


def cut(
    task: AnyTask, asked: Sequence[Chunk], workers: int, metre_s: Sequence[float] | None = None,
    worth_s: float | None = None,
) -> list[Parcel]:  # fmt: skip
    """Cut what is asked for into parcels, by the seconds that it may take: large ones first, small ones last.

    Each takes most of a worker's share of the rest, so that no worker waits long for the slowest, and little is sent
    (guided self-scheduling, Polychronopoulos and Kuck 1987). It holds whole members, or a part of one member's
    episodes, so that even a single member is shared by all workers. The cut depends only on the arguments, and no
    result depends on it.

    Args:
        metre_s: seconds that a metre takes, for each of `asked`; None for METRE_S.
        worth_s: the least seconds of evaluation in a parcel; None for what pays when the coordinator sends each.
    """
    rates = [METRE_S] * len(asked) if metre_s is None else metre_s
    parcels: list[Parcel] = []
    left = sum(rate * metres(task, block) for rate, block in zip(rates, asked, strict=True))
    if worth_s is None:
        worth_s = max(WORTH_SENDING_S, PARCEL_S * workers)  # while one worker computes, all others get their parcels
    least = min(worth_s, left / (2 * workers))  # every worker gets some, however little it costs
    largest = max(LARGEST_S, LARGER * worth_s)
    goals = _goals(task)
    parcel: Parcel = ()  # not yet full
    room = 0.0  # seconds left in it
    for rate, (rows, columns) in zip(rates, asked, strict=True):
        seconds = rate * np.concatenate([[0.0], np.cumsum(goals[columns])])  # of one member, up to each episode
        row, column = rows.start, 0
        while row < rows.stop and columns.stop > columns.start:
            if not parcel:
                room = min(max(SHARE * left / workers, least), largest)
            if column == 0 and room >= seconds[-1]:
                stop = min(row + max(int(room / seconds[-1]), 1), rows.stop)
                parcel = (*parcel, Chunk(slice(row, stop), columns))
                room -= (stop - row) * seconds[-1]
                left -= (stop - row) * seconds[-1]
                row = stop
            elif parcel:
                parcels.append(parcel)
                parcel = ()
            else:
                rest = seconds[-1] - seconds[column]
                piece = rest / math.ceil(rest / room)  # all as even as possible: a small one costs as much to send
                stop = int(np.searchsorted(seconds, seconds[column] + piece * (1.0 + 1e-9), side="right")) - 1
                stop = min(max(stop, column + 1), len(seconds) - 1)
                parcels.append((Chunk(slice(row, row + 1), slice(columns.start + column, columns.start + stop)),))
                left -= seconds[stop] - seconds[column]
                row, column = (row + 1, 0) if stop == len(seconds) - 1 else (row, stop)
    return [*parcels, parcel] if parcel else parcels


def last_line(error: BaseException) -> str:
    """An exception as one line of text, its type first, whatever its message looks like."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[-1]}" if lines else type(error).__name__
