"""A pool of Ray actors, on a Ray of our own or on an existing cluster.

Dead actors are replaced here and not by Ray's `max_restarts`: what they held has to be sent again either way. Ray may
never report one that is stopped or whose host is cut off, so that one which is silent for long is replaced as well.
"""

from __future__ import annotations

import itertools
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Container
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cluster import stopping
from cluster.workers import ray_session
from cluster.workers.address import check_address
from cluster.workers.pool import LOOK_S, BuildMap, Call, Chunk, PoolError, WorkerPool, cut, last_line
from cluster.workers.worker import AnyTask, Worker
from evolution.search.breeding import RECIPE
from gridsim.maps.map import Map

Name = tuple[str, int]  # a map's scenario and seed

PATIENCE_S, LONG_PATIENCE_S = 60.0, 300.0  # for a worker on this machine, and on a cluster, which may be growing
MAX_KILLS = 3  # workers that a piece may cost
MAX_DEATHS = 8  # of workers in a row, without an answer in between; three times as many as there are, if that is more
QUEUED = 2  # pieces that a worker is sent, so that it need not wait for the next one
MOST_MAPS = 256  # that are kept, of 2 MiB at most. A run uses fewer; several runs one after another would fill memory
LEAST_M, MOST_M = 5_000.0, 40_000.0  # metres in a piece; the largest networks take 1 ms for each, so less than patience
MANY_M = 400.0  # metres in the smallest piece for each worker: while one computes, all others get their pieces


class Actor:
    """A worker's process. It holds the current task, and the maps that were used last."""

    def __init__(self, factory: Callable[[], Worker]):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all; the coordinator ends its workers
        self._worker, self._serial = factory(), 0
        self._task: AnyTask
        self._maps: dict[Name, Map] = {}

    def ready(self) -> int:
        """The process's id."""
        return os.getpid()

    def run(self, serial: int, shared: list[Any], recipes: bytes, first: int, stop: int) -> bytes:
        """What `Worker.answer` returns for a piece of a task, pickled: Ray is slower with arrays than with bytes.

        Args: `shared` holds a reference to the task and references to its maps. Of these the actor gets what it lacks.
        """
        if serial != self._serial:
            import ray

            self._serial = 0  # should anything be missing
            self._task, references = ray.get(shared[0])
            lacking = [name for name in references if name not in self._maps]
            bounded(self._maps, references)
            self._maps |= dict(zip(lacking, ray.get([references[name] for name in lacking]), strict=True))
            self._serial = serial
        maps = [self._maps[name] for name in self._task.maps]
        return pickle.dumps(self._worker.answer(self._task, maps, np.frombuffer(recipes, RECIPE), first, stop), 5)


def bounded(maps: dict[Name, Any], used: Container[Name]) -> None:
    """Forget those maps that are not used now, if there are many."""
    for name in [name for name in maps if len(maps) > MOST_MAPS and name not in used]:
        del maps[name]


@dataclass
class _Piece:
    call: Call
    chunk: Chunk
    kills: int = 0  # workers that died over it


@dataclass
class _Slot:
    """One worker's place; a worker that dies is replaced."""

    number: int
    actor: Any
    sent: deque[tuple[Any, _Piece | None]]  # references to its answers, oldest first; the first one says that it is up
    pid: int = 0  # once it is up
    heard: float = field(default_factory=time.monotonic)  # last sign of life: an answer, or work sent to it while idle


class RayPool(WorkerPool):
    """Workers as Ray actors of one CPU each. One pool at a time in a process.

    Args:
        workers: how many; on a cluster, 0 is as many as it has CPUs free.
        address: an existing cluster's (`host:port` or `auto`); None for a Ray of our own.
        patience_s: how long to go on without any worker, or wait for a silent one; 0 is `LONG_PATIENCE_S`, but for a
            silent one on this machine `PATIENCE_S`.
        worker_factory: makes what evaluates; must be importable in the workers.
    """

    def __init__(
        self, workers: int, build_map: BuildMap, address: str | None = None, patience_s: float = 0.0,
        worker_factory: Callable[[], Worker] = Worker,
    ):  # fmt: skip
        self.workers, self._build_map, self._address, self._factory = workers, build_map, address, worker_factory
        self._patience_s = patience_s or LONG_PATIENCE_S
        self._silence_s = patience_s or (PATIENCE_S if address is None else LONG_PATIENCE_S)
        self._own, self._variables = ray_session.OwnRay(), list[str]()
        self._ray: Any = None  # once it is connected
        self._slots: list[_Slot] = []
        self._serial, self._shared = 0, list[Any]()  # of the latest task: its number, and a reference to it
        self._maps: dict[Name, Any] = {}  # references to maps in Ray's store
        self._pieces: deque[_Piece] = deque()  # to be sent
        self._deaths, self._last_death = 0, ""  # of workers since the latest answer

    def open(self) -> None:
        """Start Ray or join it, and wait for a first worker; others join as they come up. Raises PoolError."""
        own = self._address is None
        self._variables = ray_session.prepare(own)
        address = self._address and check_address(self._address)
        ray_session.join(address or self._own.start(self.workers, self._patience_s))
        import ray

        self._ray = ray
        self.workers = self.workers or max(int(ray.available_resources().get("CPU", 0)), 1)
        self._slots = [self._begin(number) for number in range(self.workers)]
        self._alone_since = time.monotonic()
        while not self.pids():
            stopping.check()
            self._look(LOOK_S)

    def pids(self) -> list[int]:
        """Process ids of the workers that are up, on whichever machine they are."""
        return [slot.pid for slot in self._slots if slot.pid]

    def _begin(self, number: int) -> _Slot:
        actor = self._ray.remote(num_cpus=1)(Actor).remote(self._factory)
        return _Slot(number, actor, deque([(actor.ready.remote(), None)]))

    def _start(self, call: Call) -> None:
        if not self._ray:
            raise PoolError("the pool of workers is closed")
        self._own.check()
        task = call.task
        bounded(self._maps, task.maps)
        for name in [name for name in dict.fromkeys(task.maps) if name not in self._maps]:
            road_map = self._build_map(*name)
            self._maps[name] = self._ray.put(road_map)
            call.broadcast_bytes += road_map.nbytes
        self._shared = [self._ray.put((task, {name: self._maps[name] for name in task.maps}))]
        call.broadcast_bytes += sum(value.nbytes for value in vars(task).values() if isinstance(value, np.ndarray))
        least_m = max(LEAST_M, MANY_M * self.workers)
        pieces = cut(task, call.asked, self.workers, least_m, max(least_m, MOST_M))
        self._pieces = deque(_Piece(call, chunk) for chunk in pieces)
        self._serial, self._alone_since = self._serial + 1, time.monotonic()
        self._give()

    def _take_in(self, call: Call, timeout_s: float) -> bool:
        done = call.done
        try:
            self._look(timeout_s)
        except self._ray.exceptions.RayError as error:
            raise PoolError(f"Ray failed: {ray_session.reason(error)}") from error
        return call.done > done

    def _look(self, timeout_s: float) -> None:
        """Take in what has come, or wait for it; replace silent workers, and send what is still to be done."""
        self._own.check()
        waiting = {slot.sent[0][0]: slot for slot in self._slots if slot.sent}
        if self._ray.wait(list(waiting), timeout=timeout_s)[0]:
            for reference in self._ray.wait(list(waiting), num_returns=len(waiting), timeout=0)[0]:
                self._receive(waiting[reference])
        for slot in self._slots:
            silent_s = time.monotonic() - slot.heard if slot.pid and slot.sent else 0.0
            if silent_s > self._silence_s:
                self._bury(slot, f"it did not answer for {silent_s:.0f} s (--patience)")
        self._give()
        if self.pids():
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > self._patience_s:
            total, free = self._ray.cluster_resources().get("CPU", 0), self._ray.available_resources().get("CPU", 0)
            why = f"Ray has {total:g} CPUs, {free:g} of them free, and a worker needs 1"
            why += f"; the last one that ended: {self._last_death}" if self._last_death else ""
            raise PoolError(f"there has been no worker for {self._patience_s:g} s (--patience): {why}")

    def _give(self) -> None:
        """Send pieces, each worker a first one before any gets a second one."""
        for held, slot in itertools.product(range(QUEUED), self._slots):
            if self._pieces and slot.pid and len(slot.sent) == held:
                piece = self._pieces.popleft()
                recipes, first, stop = piece.call.work(piece.chunk)
                piece.call.bytes_down += recipes.nbytes
                slot.heard = slot.heard if slot.sent else time.monotonic()
                answer = slot.actor.run.remote(self._serial, self._shared, recipes.tobytes(), first, stop)
                slot.sent.append((answer, piece))

    def _receive(self, slot: _Slot) -> None:
        """Take in a worker's oldest answer, or its death."""
        (reference, piece), errors = slot.sent[0], self._ray.exceptions
        try:
            answer = self._ray.get(reference)
        except errors.RayError as error:
            cause = error.cause if isinstance(error, errors.RayTaskError) else error
            if isinstance(cause, errors.RayError):  # it is dead, or lacks what it needs
                return self._bury(slot, ray_session.reason(cause))
            if piece and piece.call is self._call:
                said = f"a worker failed on {piece.call.rows_of(piece.chunk)}: {last_line(cause)}"
                slot.sent.popleft()
                raise PoolError(said) from error
        slot.sent.popleft()
        slot.heard, self._deaths = time.monotonic(), 0
        if piece is None:
            slot.pid = answer
        elif piece.call is self._call:  # else it is of an earlier one
            piece.call.bytes_up += len(answer)
            piece.call.add(slot.number, piece.chunk, *pickle.loads(answer))

    def _bury(self, slot: _Slot, reason: str) -> None:
        """Replace a worker, and have what it held done by another one."""
        at_it = slot.sent[0][1]  # it had not begun with what else it held
        held = [piece for _, piece in slot.sent if piece and piece.call is self._call]
        self._ray.kill(slot.actor)  # it may be alive and merely out of reach
        self._slots[slot.number] = self._begin(slot.number)
        self._pieces.extendleft(reversed(held))
        self._deaths, self._last_death = self._deaths + 1, reason
        if self._call:
            self._call.warnings.append(f"a worker is replaced: {reason}")
        for piece in held:
            piece.call.retries += 1
            piece.kills += piece is at_it
            if piece.kills == MAX_KILLS:
                rows, first = piece.call.rows_of(piece.chunk), piece.call.identify(piece.chunk.rows.start)
                raise PoolError(f"{MAX_KILLS} workers died over {rows} (first: {first}); the last time {reason}")
        if self._deaths > max(MAX_DEATHS, MAX_KILLS * self.workers):
            raise PoolError(f"workers keep dying ({self._deaths} in a row); the last time {reason}")

    def close(self) -> None:
        self._call, self._ray, self._slots, self._maps, self._shared = None, None, [], {}, []
        ray_session.leave()
        self._own.close()
        while self._variables:
            os.environ.pop(self._variables.pop(), None)
