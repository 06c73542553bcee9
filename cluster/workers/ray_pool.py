"""A pool of Ray actors, on a Ray of our own or on an existing cluster.

Dead actors are replaced here, not by Ray's `max_restarts`, since the pieces that they held have to be sent again either
way. Actors that do not answer for long are replaced, too: Ray may never report that an actor's process is suspended, or
that its machine cannot be reached.
"""

from __future__ import annotations

import itertools
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cluster import stopping
from cluster.workers.pool import LOOK_S, BuildMap, Call, Chunk, PoolError, WorkerPool, cut, last_line
from cluster.workers.ray_session import Session, reason
from cluster.workers.worker import AnyTask, Worker
from evolution.search.breeding import RECIPE
from gridsim.maps.map import Map

# Defaults of --patience. A silent worker is replaced after PATIENCE_S in a Ray of our own, after LONG_PATIENCE_S on a
# cluster. The pool goes on without any worker for LONG_PATIENCE_S at most.
PATIENCE_S, LONG_PATIENCE_S = 60.0, 300.0
MAX_KILLS = 3  # a call fails when so many workers have died over the same piece
MAX_DEATHS = 8  # workers that may die in a row, with no answer in between; in a pool of more than 2 workers 3 for each
QUEUED = 2  # pieces that a worker holds at once, so that it need not wait for the next one
# Least and most metres in a piece. The largest networks need 1 ms for a metre, so less than PATIENCE_S for a piece.
LEAST_M, MOST_M = 5_000.0, 40_000.0
# Least metres in a piece for each worker of the pool: a piece then takes as long as sending one to every other worker.
MANY_M = 400.0


class Actor:
    """A worker's process. It keeps the current task, and the run's maps, of which there are some hundreds at most."""

    def __init__(self, factory: Callable[[], Worker]):
        # A terminal sends Ctrl-C to all its processes. Workers ignore it, as the process with the pool ends them.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._worker, self._shared = factory(), list[Any]()
        self._task: AnyTask
        self._maps: dict[tuple[str, int], Map] = {}  # by scenario and seed

    def ready(self) -> int:
        """The process's id, as the sign that it is up."""
        return os.getpid()

    def run(self, shared: list[Any], recipes: bytes, columns: slice) -> bytes:
        """Do a piece of the task that `shared` refers to.

        Returns: what `Worker.answer` returns, pickled, because Ray sends bytes faster than arrays.
        """
        if shared != self._shared:
            import ray

            self._task, references = ray.get(shared[0])
            lacking = [name for name in references if name not in self._maps]
            self._maps |= dict(zip(lacking, ray.get([references[name] for name in lacking]), strict=True))
            self._shared = shared
        maps = [self._maps[name] for name in self._task.maps]
        return pickle.dumps(self._worker.answer(self._task, maps, np.frombuffer(recipes, RECIPE), columns), 5)


@dataclass
class _Piece:
    call: Call
    chunk: Chunk
    kills: int = 0  # workers that died over it


@dataclass(eq=False)
class _Worker:
    actor: Any
    # For each answer to come, oldest first: a reference to it, and its piece (None for the answer of `Actor.ready`).
    sent: deque[tuple[Any, _Piece | None]]
    pid: int = 0  # of its process; 0 until it is up
    # `time.monotonic` of its last sign of life: an answer, work sent to it while idle, or at first its creation
    heard: float = field(default_factory=time.monotonic)


class RayPool(WorkerPool):
    """Workers as Ray actors of one CPU each. A process can use only one Ray at a time.

    Args: those of `open_pool`; `worker_factory` makes an actor's `Worker`, and must be importable there.
    """

    def __init__(
        self, workers: int, build_map: BuildMap, address: str | None = None, patience_s: float = 0.0,
        worker_factory: Callable[[], Worker] = Worker,
    ):  # fmt: skip
        self.workers, self._build_map, self._address, self._factory = workers, build_map, address, worker_factory
        self._patience_s = patience_s or LONG_PATIENCE_S
        self._silence_s = patience_s or (PATIENCE_S if address is None else LONG_PATIENCE_S)
        self._session = Session()
        self._ray: Any = None  # the module `ray`, once Ray is joined
        self._workers: list[_Worker] = []  # one that dies is replaced
        self._shared = list[Any]()  # one Ray reference, to (the latest task, references to its maps by name)
        self._maps: dict[tuple[str, int], Any] = {}  # references to maps in Ray's store
        self._pieces: deque[_Piece] = deque()  # to be sent
        self._deaths = 0  # of workers since the latest answer

    def open(self) -> None:
        """Start Ray or join it, and wait for a first worker; others join as they come up. Raises PoolError."""
        self._ray = ray = self._session.open(self.workers, self._address, self._patience_s)
        self.workers = self.workers or max(int(ray.available_resources().get("CPU", 0)), 1)
        self._workers = [self._begin() for _ in range(self.workers)]
        while not self.pids():
            stopping.check()
            self._take_in(LOOK_S)

    def pids(self) -> list[int]:
        """Process ids of the workers that are up, on whichever machine they are."""
        return [worker.pid for worker in self._workers if worker.pid]

    def _begin(self) -> _Worker:
        actor = self._ray.remote(num_cpus=1)(Actor).remote(self._factory)
        return _Worker(actor, deque([(actor.ready.remote(), None)]))

    def _start(self, call: Call) -> None:
        self._session.check()
        for name in call.task.maps:
            self._maps[name] = self._maps.get(name) or self._ray.put(self._build_map(*name))
        self._shared = [self._ray.put((call.task, {name: self._maps[name] for name in call.task.maps}))]
        least_m = max(LEAST_M, MANY_M * self.workers)
        self._pieces = deque(_Piece(call, chunk) for chunk in cut(call, self.workers, least_m, max(least_m, MOST_M)))
        self._give()

    def _take_in(self, timeout_s: float) -> None:
        """Take in what has come, replace silent workers, and send what is still to be done."""
        self._session.check()
        try:
            waiting = {worker.sent[0][0]: worker for worker in self._workers if worker.sent}
            if self._ray.wait(list(waiting), timeout=timeout_s)[0]:
                for reference in self._ray.wait(list(waiting), num_returns=len(waiting), timeout=0)[0]:
                    self._receive(waiting[reference])
            for worker in list(self._workers):
                silent_s = time.monotonic() - worker.heard if worker.pid and worker.sent else 0.0
                if silent_s > self._silence_s:
                    self._replace(worker, f"it did not answer for {silent_s:.0f} s (--patience)")
            self._give()
        except self._ray.exceptions.RayError as error:
            raise PoolError(f"Ray failed: {reason(error)}") from error
        if not self.pids() and time.monotonic() - max(worker.heard for worker in self._workers) > self._patience_s:
            total, free = self._ray.cluster_resources().get("CPU", 0), self._ray.available_resources().get("CPU", 0)
            why = f"Ray has {total:g} CPUs, {free:g} of them free, and a worker needs 1"
            raise PoolError(f"there has been no worker for {self._patience_s:g} s (--patience): {why}")

    def _give(self) -> None:
        """Send pieces, each worker a first one before any gets a second one."""
        for held, worker in itertools.product(range(QUEUED), self._workers):
            if self._pieces and worker.pid and len(worker.sent) == held:
                piece = self._pieces.popleft()
                recipes = piece.call.recipes[piece.chunk.rows].tobytes()
                worker.heard = worker.heard if worker.sent else time.monotonic()
                worker.sent.append((worker.actor.run.remote(self._shared, recipes, piece.chunk.columns), piece))

    def _receive(self, worker: _Worker) -> None:
        """Take in the oldest outstanding answer of a worker, or that the worker is dead."""
        (reference, piece), errors = worker.sent[0], self._ray.exceptions
        try:
            answer = self._ray.get(reference)
        except errors.RayError as error:
            cause = error.cause if isinstance(error, errors.RayTaskError) else error
            if isinstance(cause, errors.RayError):  # the worker is dead, or Ray lost an object that it needs
                return self._replace(worker, reason(cause))
            if piece and piece.call is self._call:
                raise PoolError(f"a worker failed on {piece.call.span(piece.chunk)}: {last_line(cause)}") from error
        worker.sent.popleft()
        worker.heard, self._deaths = time.monotonic(), 0
        if piece is None:
            worker.pid = answer
        elif piece.call is self._call:  # an answer to an earlier call is dropped
            piece.call.add(worker.pid, piece.chunk, *pickle.loads(answer))

    def _replace(self, worker: _Worker, why: str) -> None:
        """Replace a worker, and put the pieces that it held back into the queue."""
        at_it = worker.sent[0][1]  # the piece that the worker was at; it had not begun any other piece that it held
        self._pieces.extendleft(piece for _, piece in reversed(worker.sent) if piece and piece.call is self._call)
        self._ray.kill(worker.actor)  # a worker that is out of reach may still be alive
        self._workers[self._workers.index(worker)] = self._begin()
        self._deaths += 1
        if self._call:
            self._call.warnings.append(f"a worker is replaced: {why}")
        if at_it and at_it.call is self._call:
            at_it.kills += 1
            if at_it.kills == MAX_KILLS:
                what = at_it.call.identify(at_it.chunk)
                raise PoolError(f"{MAX_KILLS} workers died over {what}; the last time {why}")
        if self._deaths > max(MAX_DEATHS, MAX_KILLS * self.workers):
            raise PoolError(f"workers keep dying ({self._deaths} in a row); the last time {why}")

    def close(self) -> None:
        self._call, self._workers, self._maps, self._shared = None, [], {}, []
        self._session.close()
