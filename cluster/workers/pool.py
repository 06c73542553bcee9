"""Pools of workers: what the learners call, and how their work is cut into pieces."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
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
from gridsim.state import START_FIELDS

BuildMap = Callable[[str, int], Map]  # (scenario, seed) -> map; pools ask for a map repeatedly, so it keeps its maps

LOOK_S = 0.1  # s between two looks at whether the run is to be stopped


class PoolError(GridSimError):
    """The workers cannot give a result; the message is one line for the user."""


class Chunk(NamedTuple):
    """Some members (rows), on some of the task's episodes (columns). A batch of experience is one row."""

    rows: slice
    columns: slice


def size(chunk: Chunk) -> int:
    """How many episodes the members of a chunk drive, in all."""
    return (chunk.rows.stop - chunk.rows.start) * (chunk.columns.stop - chunk.columns.start)


class Call(ABC):
    """What a pool is asked to do, and, as it comes in, the result."""

    noun: ClassVar[str]
    axis: ClassVar[int]  # the axis of a chunk that `noun` counts: 0 rows, 1 columns

    def __init__(self, task: AnyTask, recipes: np.ndarray, asked: Sequence[Chunk] | None, rows: int):
        columns = len(task.episodes)
        self.task, self.recipes = task, recipes
        self.asked = [Chunk(slice(0, rows), slice(0, columns))] if asked is None else asked
        self.results = np.zeros((rows, columns), RESULT)  # zero where nothing was asked for or nothing has come yet
        self.warnings: list[str] = []  # a line for each worker that was replaced
        self.total, self.done = sum(map(size, self.asked)), 0  # numbers of episodes: to be driven, and driven
        self.busy_s: dict[int, float] = defaultdict(float)  # seconds of work by each worker, for statistics only

    def progress(self) -> tuple[int, int]:
        """How many members (or episodes of experience) are done, and how many there are.

        The first number is estimated from the share of episodes that are driven.
        """
        n = self.results.shape[self.axis]
        return (n * self.done // self.total if self.total else 0), n

    @abstractmethod
    def add(self, worker: int, piece: Chunk, *answer: Any) -> None:
        """Take in what `Worker.answer` returned for a piece."""

    def _count(self, worker: int, piece: Chunk, results: np.ndarray, seconds: float) -> None:
        self.results[piece] = results
        self.done += size(piece)
        self.busy_s[worker] += seconds

    def span(self, piece: Chunk) -> str:
        """Which members or episodes a piece holds, in words."""
        return f"{self.noun} {piece[self.axis].start} to {piece[self.axis].stop - 1}"

    @abstractmethod
    def identify(self, piece: Chunk) -> str:
        """A piece in words, with the numbers by which its first member, or first episode, can be tried again."""


class Outcome(Call):
    """The evaluation of members. Rows are members, in the order of the recipes; columns are the task's episodes.

    Args:
        recipes: RECIPE [n], of the members that are bred and driven.
        asked: which members drive which episodes, chunks of long episodes first; None: all drive all.
    """

    noun, axis = "members", 0
    task: Task

    def __init__(self, task: Task, recipes: np.ndarray, asked: Sequence[Chunk] | None = None):
        super().__init__(task, recipes, asked, len(recipes))
        # Of episodes with `rewind`: the state so many steps before the end (of shorter ones, at the start), [episodes,
        # START_FIELDS], and the traffic then, [episodes, cars, TRAFFIC_FIELDS]. Zero for other episodes.
        self.rewound, self.worlds = np.zeros((len(task.episodes), START_FIELDS), np.float32), np.zeros_like(task.worlds)

    def add(self, worker: int, piece: Chunk, *answer: Any) -> None:
        results, rewound, worlds, seconds = answer
        if rewound.size:  # the piece's episodes have `rewind`; only one member (the leader) drives such episodes
            self.rewound[piece.columns], self.worlds[piece.columns] = rewound[0], worlds[0]
        self._count(worker, piece, results, seconds)

    def identify(self, piece: Chunk) -> str:
        row = piece.rows.start
        recipe = self.recipes[row]
        kind = Kind(int(recipe["kind"])).name.lower()
        parents = f"rows {recipe['a']} and {recipe['b']}"
        first = f"member {row} ({kind} of {parents}, seed {recipe['seed']}, key {self.task.key:#x})"
        return f"{self.span(piece)} (first: {first})"


class Collected(Call):
    """A batch of experience. The task's network, the only row, drives the task's episodes, the columns."""

    noun, axis = "episodes", 1
    task: CollectTask

    def __init__(self, task: CollectTask):
        super().__init__(task, np.zeros(0, RECIPE), None, 1)
        self._parts: dict[int, Experience] = {}  # experience of each piece, by the index of its first episode

    @cached_property
    def experience(self) -> Experience:
        """All experience, in the order of the episodes. To be read only when the call is done: it is joined once."""
        return join([self._parts.pop(first) for first in sorted(self._parts)])

    def add(self, worker: int, piece: Chunk, *answer: Any) -> None:
        self._parts[piece.columns.start], results, seconds = answer
        self._count(worker, piece, results, seconds)

    def identify(self, piece: Chunk) -> str:
        e, task = piece.columns.start, self.task
        first = f"episode {e} (key {task.keys[e]:#x}, exploration {task.epsilons[e]:.3g})"
        return f"{self.span(piece)} (first: {first})"


AnyCall = TypeVar("AnyCall", bound=Call)


class WorkerPool(ABC):
    """Evaluates generations and collects experience, one call at a time.

    `start` begins a call, and `wait` is then called until it returns False. Between two waits the caller may do other
    work, but only for some tens of milliseconds: a Ray worker holds two pieces, and gets more only in `wait`. A call's
    results depend on its arguments alone, never on the workers. A call that is started while another one is under way
    replaces that one. Raises: PoolError if a call cannot be done; the pool can still be used for others.
    """

    workers: int  # number of Ray workers; 0 if the workers are threads of this process
    _call: Call | None = None  # the latest call, unless it failed; the pool does not finish earlier ones

    def start(self, call: AnyCall) -> AnyCall:
        """Begin a call, and return it without waiting for results. Its maps are built first, if they are not yet."""
        self._call = call
        self._start(call)
        return call

    def wait(self, call: Call, timeout_s: float) -> bool:
        """Wait until something comes in, at most `timeout_s`. Returns whether anything is left to be done."""
        if call.done < call.total:
            stopping.check()
            if call is not self._call:
                raise PoolError("another call has taken this one's place, or the pool of workers is closed")
            try:
                self._take_in(timeout_s)
            except Exception:
                self._call = None
                raise
        return call.done < call.total

    def run(self, call: AnyCall) -> AnyCall:
        """Start a call and wait for all of it."""
        self.start(call)
        while self.wait(call, LOOK_S):
            pass
        return call

    @abstractmethod
    def _start(self, call: Call) -> None:
        """Begin a call, in place of the one before."""

    @abstractmethod
    def _take_in(self, timeout_s: float) -> None:
        """Take in what has come for `_call`; if there is nothing, wait for it, at most `timeout_s`."""

    @abstractmethod
    def close(self) -> None:
        """Stop all that the pool started. May be called again, and at any moment."""


def cut(call: Call, workers: int, least_m: float, most_m: float) -> list[Chunk]:
    """Cut a call's chunks into pieces, by the metres that these may take to drive: large ones first, small ones last.

    A piece has at most half of one worker's share of the metres that are left, so that no worker waits long for the
    slowest (guided self-scheduling, Polychronopoulos and Kuck 1987), or `least_m` if that is more. It holds one or more
    members with all episodes of their chunk, or one member with some of them: so all workers can share even a single
    member. No result depends on the cut.

    Args: `least_m`, lowered if there are too few metres for all workers; `most_m`, metres in a piece, at most, unless
    one episode has more. A metre takes a small network some microseconds at most.
    """
    episodes = call.task.episodes
    goals = np.maximum(np.minimum(episodes["target"], episodes["steps"]), 1).astype(np.float64)  # a step counts as 1 m

    def metres(chunk: Chunk) -> float:
        return (chunk.rows.stop - chunk.rows.start) * float(goals[chunk.columns].sum())

    pieces, rest = list[Chunk](), [chunk for chunk in reversed(call.asked) if size(chunk)]
    left = sum(map(metres, rest))
    least_m = min(least_m, left / (2 * workers))  # every worker gets some, however little there is
    while rest:
        rows, columns = piece = rest.pop()
        room, wanted = min(max(left / (2 * workers), least_m), most_m), metres(piece)
        if wanted <= room * (1.0 + 1e-9) or size(piece) == 1:
            pieces.append(piece)
            left -= wanted
        elif rows.stop - rows.start > 1:
            middle = rows.start + max(int((rows.stop - rows.start) * room / wanted), 1)
            rest += [Chunk(slice(middle, rows.stop), columns), Chunk(slice(rows.start, middle), columns)]
        else:
            middle = columns.start + max(int((columns.stop - columns.start) * room / wanted), 1)
            rest += [Chunk(rows, slice(middle, columns.stop)), Chunk(rows, slice(columns.start, middle))]
    return pieces


def last_line(error: BaseException) -> str:
    """An exception as one line of text: its type, and the last line of its message that is not empty."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[-1]}" if lines else type(error).__name__
