"""Pools of workers: what the learners call, and how their work is cut into pieces."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from cluster import stopping
from cluster.workers.worker import AnyTask, CollectTask, Task
from evolution.dqn.experience import Experience, join
from evolution.episodes.rollout import RESULT
from evolution.search.breeding import RECIPE, Kind
from gridsim.errors import GridSimError
from gridsim.maps.map import Map

BuildMap = Callable[[str, int], Map]  # (scenario, seed) -> map; remembers the latest

LOOK_S = 0.1  # between two looks at whether the run is to be stopped


class PoolError(GridSimError):
    """The workers cannot give a result; the message is one line for the user."""


class Chunk(NamedTuple):
    """Some members (rows), on some of the task's episodes (columns). Of a batch of experience, rows are episodes."""

    rows: slice
    columns: slice


def size(chunk: Chunk) -> int:
    """How many episodes the members of a chunk drive, in all."""
    return (chunk.rows.stop - chunk.rows.start) * (chunk.columns.stop - chunk.columns.start)


class Call(ABC):
    """What is asked of a pool; after that, what came back, and what it took."""

    noun: ClassVar[str]  # what its rows are

    def __init__(self, task: AnyTask, recipes: np.ndarray, asked: Sequence[Chunk], rows: int, columns: int):
        self.task, self.recipes, self.asked = task, recipes, asked
        self.results = np.zeros((rows, columns), RESULT)  # zero where nothing was asked for
        self.warnings: list[str] = []  # a line for each silent worker that was replaced, and for memory that is full
        self.total, self.done = sum(map(size, asked)), 0  # episodes to be driven, and those that are
        self.started = time.perf_counter()
        self.wall_s = 0.0  # from the start until the last result was taken in
        self.busy_s: dict[int, float] = {}  # seconds of work, by the worker's number, which a replacement keeps
        self.retries = 0  # pieces that were sent again because their worker died
        self.bytes_down = self.bytes_up = 0  # sent to workers, recipes mostly, and back; none by threads
        self.broadcast_bytes = 0  # put into Ray's object store: the task and the maps that were new to it

    def progress(self) -> tuple[int, int]:
        """Members (or episodes of experience) that are done, partly evaluated ones in part, and how many there are."""
        rows = len(self.results)
        return (rows * self.done // self.total if self.total else 0), rows

    def work(self, piece: Chunk) -> tuple[np.ndarray, int, int]:
        """Arguments of `Worker.answer` for a piece: its recipes, its first episode and the one after its last."""
        episodes = piece.rows if isinstance(self.task, CollectTask) else piece.columns
        return self.recipes[piece.rows], episodes.start, episodes.stop

    @abstractmethod
    def add(self, worker: int, piece: Chunk, *answer: Any) -> None:
        """Take in what `Worker.answer` returned for a piece."""

    def _count(self, worker: int, piece: Chunk, results: np.ndarray, seconds: float) -> None:
        self.results[piece.rows, piece.columns] = results
        self.done += size(piece)
        self.busy_s[worker] = self.busy_s.get(worker, 0.0) + seconds

    def rows_of(self, piece: Chunk) -> str:
        """A piece in words."""
        return f"{self.noun} {piece.rows.start} to {piece.rows.stop - 1}"

    @abstractmethod
    def identify(self, row: int) -> str:
        """A member with its recipe, or an episode of experience, so that it can be tried again."""


class Outcome(Call):
    """A generation: rows are members, in the order of the recipes, columns the task's episodes.

    Args:
        recipes: RECIPE [n], of the members that are bred and driven.
        asked: which members drive which episodes, the longest first; None is all members on all episodes.
    """

    noun = "members"
    task: Task

    def __init__(self, task: Task, recipes: np.ndarray, asked: Sequence[Chunk] | None = None):
        n, e = len(recipes), len(task.episodes)
        super().__init__(task, recipes, rectangle(n, e) if asked is None else asked, n, e)
        self.rewound = np.zeros((e, 5), np.float32)  # states so many steps before the end as `rewind`
        self.worlds = np.zeros_like(task.worlds)  # the traffic at that time, float32 [episodes, cars, world.FIELDS]

    def add(self, worker: int, piece: Chunk, *answer: Any) -> None:
        results, rewound, worlds, seconds = answer
        if rewound.size:  # only one member drives such an episode
            self.rewound[piece.columns], self.worlds[piece.columns] = rewound[0], worlds[0]
        self._count(worker, piece, results, seconds)

    def identify(self, row: int) -> str:
        recipe = self.recipes[row]
        kind = Kind(int(recipe["kind"])).name.lower()
        parents = f"rows {recipe['a']} and {recipe['b']}"
        return f"member {row} ({kind} of {parents}, seed {recipe['seed']}, key {self.task.key:#x})"


class Collected(Call):
    """A batch of experience: the task's policy drives its episodes. Rows are episodes, in one column."""

    noun = "episodes"
    task: CollectTask

    def __init__(self, task: CollectTask):
        n = len(task.episodes)
        super().__init__(task, np.zeros(0, RECIPE), rectangle(n, 1), n, 1)
        self._parts: dict[int, Experience] = {}  # by their first episodes

    @cached_property
    def experience(self) -> Experience:
        """All transitions, in the order of the episodes."""
        return join([self._parts.pop(first) for first in sorted(self._parts)])

    def add(self, worker: int, piece: Chunk, *answer: Any) -> None:
        experience, results, seconds = answer
        self._parts[piece.rows.start] = experience
        self._count(worker, piece, results[:, None], seconds)

    def identify(self, row: int) -> str:
        return f"episode {row} (key {self.task.keys[row]:#x}, exploration {self.task.epsilons[row]:.3g})"


AnyCall = TypeVar("AnyCall", bound=Call)


def rectangle(rows: int, columns: int) -> list[Chunk]:
    """The first `rows` members on the first `columns` episodes."""
    return [Chunk(slice(0, rows), slice(0, columns))]


class WorkerPool(ABC):
    """Evaluates generations and collects experience, one call at a time.

    A call is started and waited for; its owner may do other work between two waits, for some tens of milliseconds. What
    a call returns depends on its arguments alone, never on the workers. A call that is started while another one is
    under way takes its place.
    Raises: PoolError if what is asked for cannot be done; the pool can be used again.
    """

    workers: int  # how many Ray workers were asked for; 0 for threads of this process
    _call: Call | None = None  # the latest one, unless it failed; others are left undone

    def start(self, call: AnyCall) -> AnyCall:
        """Have a call done. Returns it at once."""
        call.started, self._call = time.perf_counter(), call
        self._start(call)
        return call

    def wait(self, call: Call, timeout_s: float) -> bool:
        """Wait until something comes in, at most `timeout_s`. Returns whether anything is left to be done."""
        ends = time.monotonic() + timeout_s
        while call.done < call.total:
            stopping.check()
            if call is not self._call:
                raise PoolError("another call has taken this one's place, or the pool of workers is closed")
            left_s = ends - time.monotonic()
            try:
                came = self._take_in(call, max(min(left_s, LOOK_S), 0.0))
            except Exception:
                self._call = None
                raise
            call.wall_s = time.perf_counter() - call.started
            if came or left_s <= 0.0:
                break
        return call.done < call.total

    def run(self, call: AnyCall) -> AnyCall:
        """Start a call and wait for all of it."""
        self.start(call)
        while self.wait(call, 1.0):
            pass
        return call

    def evaluate(self, task: Task, recipes: np.ndarray, asked: Sequence[Chunk] | None = None) -> Outcome:
        """Run an `Outcome`."""
        return self.run(Outcome(task, recipes, asked))

    def collect(self, task: CollectTask) -> Collected:
        """Run a `Collected`."""
        return self.run(Collected(task))

    @abstractmethod
    def _start(self, call: Call) -> None:
        """Have a call done in place of the one before."""

    @abstractmethod
    def _take_in(self, call: Call, timeout_s: float) -> bool:
        """Take in what has come; if there is nothing, wait for it, at most `timeout_s`. Returns whether any came."""

    @abstractmethod
    def close(self) -> None:
        """Stop all that the pool started. May be called again, and at any moment."""


def _goals(task: AnyTask) -> np.ndarray:
    """How far each episode may go (m), with a step for a metre: float64 [columns]. A batch of experience has one."""
    goals = np.maximum(np.minimum(task.episodes["target"], task.episodes["steps"]), 1).astype(np.float64)
    return goals[:1] if isinstance(task, CollectTask) else goals


def metres(task: AnyTask, chunk: Chunk) -> float:
    """How far the members of a chunk drive if all of them reach their targets."""
    return float(_goals(task)[chunk.columns].sum()) * (chunk.rows.stop - chunk.rows.start)


def cut(task: AnyTask, asked: Sequence[Chunk], workers: int, least_m: float, most_m: float) -> list[Chunk]:
    """Cut what is asked for into pieces, by the metres that it may take: large ones first, small ones last.

    Each takes half of a worker's share of the rest, so that no worker waits long for the slowest (guided
    self-scheduling, Polychronopoulos and Kuck 1987). It holds whole members, or some episodes of one, so that even a
    single member is shared by all workers. No result depends on the cut.

    Args: the least and the most metres of a piece. A metre takes a small network some microseconds at most.
    """
    goals, pieces = _goals(task), list[Chunk]()
    left = sum(metres(task, block) for block in asked)
    least_m = min(least_m, left / (2 * workers))  # every worker gets some, however little there is
    for rows, columns in asked:
        ends = np.concatenate([[0.0], np.cumsum(goals[columns])])  # metres of one member, up to each episode
        row, column = rows.start, 0
        while row < rows.stop and len(ends) > 1:
            room = min(max(left / (2 * workers), least_m), most_m)
            if column == 0 and (ends[-1] <= room or len(ends) == 2):  # whole members, as many in each as in the next
                parts = math.ceil((rows.stop - row) * ends[-1] / room)
                stop, last = row + max((rows.stop - row) // parts, 1), len(ends) - 1
            else:
                last = int(np.searchsorted(ends, ends[column] + room * (1.0 + 1e-9), side="right")) - 1
                stop, last = row + 1, max(last, column + 1)
            pieces.append(Chunk(slice(row, stop), slice(columns.start + column, columns.start + last)))
            left -= (stop - row) * (ends[last] - ends[column])
            row, column = (stop, 0) if last == len(ends) - 1 else (row, last)
    return pieces


def last_line(error: BaseException) -> str:
    """An exception as one line of text, its type first, whatever its message looks like."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[-1]}" if lines else type(error).__name__
