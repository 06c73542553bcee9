"""Pools of workers: what the learners call, how work is cut into chunks, and the pool within this process."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cluster.workers.worker import CollectTask, Task, Worker
from evolution.dqn.experience import Experience, join
from evolution.episodes.rollout import RESULT, targets
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import RECIPE, Kind
from gridsim.errors import GridSimError
from gridsim.maps.map import Map

BuildMap = Callable[[str, int], Map]  # (scenario, seed) -> map; remembers the latest
Progress = Callable[[int, int], None]  # (members done, members in all), or episodes where experience is collected
Meanwhile = Callable[[], bool | None]  # called while workers are busy, again and again until it returns a false value

SERIAL_PARTS = 4  # in this process a task is cut as for so many workers, only to show progress
METRE_S = 1e-6  # seconds that a metre of an episode takes a small network
UNMEASURED_METRE_S = 3e-5  # the same, assumed for Ray's workers until it is measured: large networks are slower
WORTH_SENDING_S = 0.005  # of evaluation: several times what it costs to send a parcel and to receive its results
PARCEL_S = 0.0004  # of the coordinator's time, for a parcel and its results: many workers get larger parcels
LARGEST_S = 0.5  # of evaluation in one parcel, so that progress is seen and little is lost with a worker
LARGER = 4  # times what is worth sending is the largest parcel, if that is more
SHARE = 0.9  # of a worker's share of the rest, in one parcel


class PoolError(GridSimError):
    """The workers cannot give a result; the message is one line for the user."""


class Chunk(NamedTuple):
    """Some members (rows), on some of the task's episodes (columns)."""

    rows: slice
    columns: slice


Parcel = tuple[Chunk, ...]
"""The chunks that are sent to a worker at once."""


def size(chunk: Chunk) -> int:
    """How many episodes the members of a chunk drive, in all."""
    return (chunk.rows.stop - chunk.rows.start) * (chunk.columns.stop - chunk.columns.start)


@dataclass(kw_only=True)
class Call:
    """What one call of a pool returned, and what it took.

    Attributes:
        results: RESULT, one row per member or, if experience is collected, per episode; zero where nothing was asked
            for and where it was lost.
        lost: bool [rows], those that killed every worker that tried them.
        asked: how many episodes the members were to drive, in all.
        wall_s: seconds from call to return.
        busy_s: seconds that each worker (by its number) was at work. A replacement keeps the number.
        episode_s: seconds of these that each episode took, for all members together, float64 [episodes].
        retries: chunks that were sent again because their worker died.
        bytes_down: payload sent to workers, recipes mostly; grows with the population.
        bytes_up: payload sent back.
        broadcast_bytes: put into the object store: the task and the maps that were new to it.
        warnings: a line for each row that was lost, and for each worker that was replaced because it was silent.
    """

    results: np.ndarray
    lost: np.ndarray
    asked: int
    episode_s: np.ndarray
    wall_s: float = 0.0
    busy_s: dict[int, float] = field(default_factory=dict)
    retries: int = 0
    bytes_down: int = 0
    bytes_up: int = 0
    broadcast_bytes: int = 0
    warnings: list[str] = field(default_factory=list)
    done: int = 0  # of `asked`

    def progress(self) -> tuple[int, int]:
        """Arguments of `Progress`; a member that is done in part counts in part."""
        rows = len(self.results)
        return (rows * self.done // self.asked if self.asked else 0), rows

    def whole(self) -> bool:
        """Whether every result is there."""
        return self.done >= self.asked

    def _count(self, worker: int, chunk: Chunk, seconds: float) -> None:
        self.done += size(chunk)
        self.episode_s[chunk.columns] += seconds / (chunk.columns.stop - chunk.columns.start)
        self.busy_s[worker] = self.busy_s.get(worker, 0.0) + seconds


@dataclass(kw_only=True)
class Outcome(Call):
    """What `evaluate` returned: results RESULT [members, episodes], members in the order of the recipes.

    Attributes:
        rewound: float32 [episodes, 5], for episodes with a `rewind` the state so many steps before the end. Only one
            member drives such an episode.
        worlds: float32 [episodes, cars, world.FIELDS], the traffic at that time.
    """

    rewound: np.ndarray
    worlds: np.ndarray

    def add(
        self, worker: int, chunk: Chunk, results: np.ndarray, rewound: np.ndarray, worlds: np.ndarray, seconds: float
    ) -> None:
        """Take in what `Worker.evaluate` returned for a chunk."""
        self.results[chunk.rows, chunk.columns] = results
        if rewound.size:
            self.rewound[chunk.columns], self.worlds[chunk.columns] = rewound[0], worlds[0]
        self._count(worker, chunk, seconds)

    def lose(self, chunk: Chunk) -> None:
        """Do without a chunk's members: results that they already have do not count either."""
        self.lost[chunk.rows] = True
        self.results[chunk.rows] = np.zeros((), self.results.dtype)
        self.done += size(chunk)


@dataclass(kw_only=True)
class Collected(Call):
    """What `collect` returned: results RESULT [episodes].

    Attributes:
        policy: of the network that drove.
        experience: of all episodes that are not lost, in their order.
    """

    policy: PolicySpec
    _parts: dict[int, Experience] = field(default_factory=dict)  # by their first episodes

    @cached_property
    def experience(self) -> Experience:
        return join(self.policy, [self._parts.pop(first) for first in sorted(self._parts)])

    def add(self, worker: int, chunk: Chunk, experience: Experience, results: np.ndarray, seconds: float) -> None:
        """Take in what `Worker.collect` returned for a chunk."""
        self._parts[chunk.columns.start] = experience
        self.results[chunk.columns] = results
        self._count(worker, chunk, seconds)

    def lose(self, chunk: Chunk) -> None:
        """Do without a chunk's episodes."""
        self.lost[chunk.columns] = True
        self.done += size(chunk)


def new_outcome(task: Task, recipes: np.ndarray, asked: Sequence[Chunk]) -> Outcome:
    """An outcome to be filled, its results all zero."""
    n, e = len(recipes), len(task.episodes)
    return Outcome(
        results=np.zeros((n, e), RESULT),
        lost=np.zeros(n, bool),
        asked=sum(map(size, asked)),
        episode_s=np.zeros(e),
        rewound=np.zeros((e, 5), np.float32),
        worlds=np.zeros_like(task.worlds),
    )


def new_collected(task: CollectTask) -> Collected:
    """A collection to be filled."""
    n = len(task.episodes)
    return Collected(
        results=np.zeros(n, RESULT),
        lost=np.zeros(n, bool),
        asked=n,
        episode_s=np.zeros(n),
        policy=PolicySpec.parse(task.policy),
    )


def rectangle(rows: int, columns: int) -> list[Chunk]:
    """The first `rows` members on the first `columns` episodes."""
    return [Chunk(slice(0, rows), slice(0, columns))]


class WorkerPool(ABC):
    """Evaluates generations and collects experience. What it returns depends on the arguments, never on the workers.

    A call returns only when `meanwhile` is done to its end. What it raises ends the call.
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

        Raises: PoolError if that cannot be done.
        """
        asked = rectangle(len(recipes), len(task.episodes)) if asked is None else asked
        outcome = new_outcome(task, recipes, asked)
        self._work(task, recipes, asked, outcome, on_progress, meanwhile)
        return outcome

    def collect(
        self, task: CollectTask, on_progress: Progress | None = None, meanwhile: Meanwhile | None = None
    ) -> Collected:
        """Drive the task's policy through its episodes and return all transitions.

        Raises: PoolError if that cannot be done.
        """
        collected = new_collected(task)
        asked = rectangle(1, len(task.episodes))
        self._work(task, np.zeros(0, RECIPE), asked, collected, on_progress, meanwhile)
        return collected

    @abstractmethod
    def _work(
        self, task: Task | CollectTask, recipes: np.ndarray, asked: Sequence[Chunk], call: Outcome | Collected,
        on_progress: Progress | None, meanwhile: Meanwhile | None,
    ) -> None:  # fmt: skip
        """Have all that is asked for done, and fill `call`."""

    @abstractmethod
    def close(self) -> None:
        """Stop all that the pool started. May be called again, and at any moment."""


class SerialPool(WorkerPool):
    """Starts no other process: the worker is in this one."""

    def __init__(self, build_map: BuildMap, worker_factory: Callable[[], Worker] = Worker):
        self._build_map = build_map
        self._worker = worker_factory()

    def _work(
        self, task: Task | CollectTask, recipes: np.ndarray, asked: Sequence[Chunk], call: Outcome | Collected,
        on_progress: Progress | None, meanwhile: Meanwhile | None,
    ) -> None:  # fmt: skip
        started = time.perf_counter()
        maps = [self._build_map(*name) for name in task.maps]
        finish(meanwhile)
        for index, parcel in enumerate(cut(task, asked, SERIAL_PARTS)):
            try:
                for chunk in parcel:
                    first, stop = chunk.columns.start, chunk.columns.stop
                    call.add(0, chunk, *self._worker.answer(task, maps, recipes[chunk.rows], first, stop))
            except Exception as error:
                raise PoolError(f"a worker failed on {describe(task, index, parcel)}: {last_line(error)}") from error
            if on_progress:
                on_progress(*call.progress())
        call.wall_s = time.perf_counter() - started

    def close(self) -> None:
        pass


def finish(meanwhile: Meanwhile | None) -> None:
    """Call `meanwhile` until it is done."""
    while meanwhile and meanwhile():
        pass


def metres(task: Task | CollectTask, chunk: Chunk) -> float:
    """How far the members of a chunk drive if all of them reach their targets."""
    return float(targets(task.episodes[chunk.columns], task.limits).sum()) * (chunk.rows.stop - chunk.rows.start)


def cut(
    task: Task | CollectTask, asked: Sequence[Chunk], workers: int, metre_s: Sequence[float] | None = None
) -> list[Parcel]:
    """Cut what is asked for into parcels, by the seconds that it may take: large ones first, small ones last.

    Each takes most of a worker's share of the rest, so that no worker waits long for the slowest, and little is sent
    (guided self-scheduling, Polychronopoulos and Kuck 1987). It holds whole members, or a part of one member's
    episodes, so that even a single member is shared by all workers. The cut depends only on the arguments, and no
    result depends on it.

    Args:
        metre_s: seconds that a metre takes, for each of `asked`; None for METRE_S.
    """
    rates = [METRE_S] * len(asked) if metre_s is None else metre_s
    parcels: list[Parcel] = []
    left = sum(rate * metres(task, block) for rate, block in zip(rates, asked, strict=True))
    worth_s = max(WORTH_SENDING_S, PARCEL_S * workers)  # while one worker computes, all others get their parcels
    least = min(worth_s, left / (2 * workers))  # every worker gets some, however little it costs
    largest = max(LARGEST_S, LARGER * worth_s)
    goals = targets(task.episodes, task.limits)
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
                share = rest / math.ceil(rest / room)  # pieces as even as possible: a small one costs as much to send
                stop = int(np.searchsorted(seconds, seconds[column] + share * (1.0 + 1e-9), side="right")) - 1
                stop = min(max(stop, column + 1), len(seconds) - 1)
                parcels.append((Chunk(slice(row, row + 1), slice(columns.start + column, columns.start + stop)),))
                left -= seconds[stop] - seconds[column]
                row, column = (row + 1, 0) if stop == len(seconds) - 1 else (row, stop)
    return [*parcels, parcel] if parcel else parcels


def describe(task: Task | CollectTask, index: int, parcel: Parcel) -> str:
    """A parcel in words."""
    if isinstance(task, CollectTask):
        spans = [chunk.columns for chunk in parcel]
        return f"parcel {index} (episodes {spans[0].start} to {spans[-1].stop - 1})"
    spans = [chunk.rows for chunk in parcel]
    return f"parcel {index} (members {', '.join(f'{span.start} to {span.stop - 1}' for span in spans)})"


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
