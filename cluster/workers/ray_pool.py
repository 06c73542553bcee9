"""A pool of Ray actors, on a Ray of its own or on an existing cluster.

What differs from Ray's own habits, and why:

* A Ray of our own goes without dashboard server, autoscaler monitor and log monitor, none of which a run uses: they
  cost a second at the start, another one at the end, and 1.5 core-seconds of the workers' time (`ray_session`).
* Ray is started by a thread, so that the caller can load kernels meanwhile. The thread lives until `close`: the kernel
  kills Ray's processes when their parent *thread* dies, and so they die with us whatever kills us.
* Actors are replaced by this pool and not by Ray's `max_restarts`: what was sent has to be sent again either way, and
  `dispatch` has to know who died of what.
* Ray says nothing of a worker that is stopped, or whose host is cut off, for half a minute or for ever. Idle workers
  take copies of what it holds; it gets nothing new before it has answered, and after `patience_s` it is replaced.
"""

from __future__ import annotations

import importlib
import logging
import math
import os
import pickle
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cluster.workers.actor import Actor, Name, Shared
from cluster.workers.dispatch import BACKOFF_S, MAX_KILLS, Dispatch
from cluster.workers.pool import (
    FINER,
    METRE_S,
    NOBODY,
    BuildMap,
    Chunk,
    Collected,
    Meanwhile,
    Outcome,
    PoolError,
    Progress,
    all_episodes,
    cut,
    describe,
    everything,
    finish,
    identify,
    last_line,
    metres,
    new_collected,
    new_outcome,
)
from cluster.workers.ray_address import (
    ENVIRONMENT,
    STORE_BYTES,
    abandon,
    end_at_once,
    no_interrupt,
    store_bytes,
)
from cluster.workers.ray_errors import failed_as_it_began, is_to_blame, reason
from cluster.workers.ray_metrics import RunMetrics
from cluster.workers.ray_session import capacity, check_address, forget_token, join, start_own
from cluster.workers.worker import CollectTask, Task, Worker
from evolution.episodes.rollout import Limits

CONNECT_S = 60.0
PATIENCE_S, CLUSTER_PATIENCE_S = 60.0, 300.0  # a cluster may be growing
MUTE = 10.0  # times what its chunk should take at most, in which a worker that is only slow has answered
FIRST_S = 600.0  # added to patience for a worker's first answer: it may have to compile the kernels
MAX_DEATHS = 24  # of workers in a row, without an answer in between: two members that kill cost fewer
MAX_FAILED_STARTS = 3  # in a row, each by an exception, while nobody else is up
MAX_PAUSE_S = 5.0  # before a worker that did not come up is started again
MAP_BYTES = 512 << 20  # of maps kept there: those of training and validation, or they are sent every generation


@dataclass
class _Slot:
    """One worker's place; who dies in it is replaced."""

    number: int
    actor: Any = None
    hello: Any = None  # the answer that says it is up, then that it is prepared; None once it is
    pid: int = 0
    serial: int = 0  # of the last task that it was told of
    maps: set[Name] = field(default_factory=set)  # that it was told of
    sent: deque[tuple[int, Any]] = field(default_factory=deque)  # (serial of the task, answer), oldest first
    heard: float = 0.0  # when it last answered, or was given something to do; until its first answer FIRST_S later
    start_at: float = 0.0  # where there is no actor


@dataclass
class _Call:
    """What is being done."""

    task: Task | CollectTask
    task_ref: Any
    dispatch: Dispatch
    recipes: np.ndarray
    brought: Outcome | Collected


class RayPool:
    """Workers as Ray actors of one CPU each. One pool at a time in a process.

    Args:
        workers: how many. On a cluster the first one that is up starts, the others join as they come.
        build_map: builds a map, here, once; workers see it in shared memory.
        address: an existing cluster's (`host:port` or `auto`); None for a Ray of our own.
        worker_factory: makes what evaluates; must be importable in the workers.
        patience_s: how long there may be no worker at all, or none may answer; default 60 s, on a cluster 300 s.
        run: the run's name, for the cluster's metrics.

    Raises PoolError at once where nothing answers at `address`; all else that goes wrong is raised by its calls.
    """

    def __init__(
        self, workers: int, build_map: BuildMap, address: str | None = None,
        worker_factory: Callable[[], Worker] = Worker, patience_s: float | None = None, run: str = "",
    ):  # fmt: skip
        if workers < 1:
            raise ValueError(f"a RayPool needs 1 worker or more, not {workers}")
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        self.address = None if address is None else check_address(address)
        self._asked = workers
        self._build_map = build_map
        self._factory = worker_factory
        self._patience_s = patience_s or (PATIENCE_S if address is None else CLUSTER_PATIENCE_S)
        self._run = run
        self._metrics: RunMetrics | None = None
        self._slots: list[_Slot] = []
        self._serial = 0
        self._failed_starts, self._last_words = 0, ""
        self._metre_s: dict[tuple[type, Limits], float] = {}  # what a metre of such tasks took the last time
        self._session: str | None = None  # folder of our own Ray's logs
        self._failure: BaseException | None = None
        self._starting = self._leaving = self._connected = self._troubled = False
        self._booted, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._boot, name="ray", daemon=True)
        self._thread.start()

    def workers(self) -> int:
        return len(self.pids())

    def pids(self) -> list[int]:
        """Process ids of the workers that are up, on whichever machine they are."""
        return [slot.pid for slot in self._slots if slot.pid]

    def evaluate(
        self, task: Task, recipes: np.ndarray, on_progress: Progress | None = None,
        asked: Sequence[Chunk] | None = None, meanwhile: Meanwhile | None = None,
    ) -> Outcome:  # fmt: skip
        asked = everything(task, recipes) if asked is None else asked
        outcome = new_outcome(task, recipes, asked)
        self._work(task, asked, 1, recipes, outcome, on_progress, meanwhile)
        return outcome

    def collect(
        self, task: CollectTask, on_progress: Progress | None = None, meanwhile: Meanwhile | None = None
    ) -> Collected:
        collected = new_collected(task)
        self._work(task, all_episodes(task), FINER, NOBODY, collected, on_progress, meanwhile)
        return collected

    def _work(
        self, task: Task | CollectTask, asked: Sequence[Chunk], finer: int, recipes: np.ndarray,
        brought: Outcome | Collected, on_progress: Progress | None, meanwhile: Meanwhile | None,
    ) -> None:  # fmt: skip
        """Have what is asked for done, in chunks `finer` times as small as they need be, and fill `brought`."""
        started = time.perf_counter()
        self._wait_for_ray()
        kind = type(task), task.limits
        metre_s = self._metre_s.get(kind, METRE_S)
        whole = sum(metres(task, block) for block in asked)

        def expected_s(part: Chunk) -> float:
            done, total = brought.progress()
            if not done:
                return metres(task, part) * metre_s if kind in self._metre_s else math.inf
            return metres(task, part) * max(metre_s, sum(brought.busy_s.values()) * total / (done * whole))

        parts = cut(task, asked, finer * self._asked, metre_s)
        dispatch = Dispatch(parts, isinstance(task, CollectTask), expected_s)
        self._serial += 1
        task_ref, brought.broadcast_bytes = self._shared.put(task)
        call = _Call(task, task_ref, dispatch, recipes, brought)
        nobody_since = time.monotonic()

        while not dispatch.finished():
            now = time.monotonic()
            for slot in self._slots:
                if slot.actor is None and slot.start_at <= now:
                    self._start(slot)
                elif slot.pid and now - slot.heard > self._patience_s:
                    self._replace_if_mute(slot, call, now - slot.heard)
            idle = [slot.number for slot in self._slots if slot.pid and not slot.hello and not slot.sent]
            for number, chunk in dispatch.give(idle, now):
                self._send(self._slots[number], chunk, call)
            if meanwhile and self.pids() and not meanwhile():
                meanwhile = None
            waiting = {slot.hello or slot.sent[0][1]: slot for slot in self._slots if slot.hello or slot.sent}
            answered = self._answered(waiting, bool(meanwhile and self.pids()), dispatch.pause_s(now))
            for slot in answered:
                if slot.hello:
                    self._greet(slot, call)
                elif self._hear(slot, call) and on_progress:
                    on_progress(*brought.progress())
            if self._metrics:
                self._metrics.gauge(dispatch.waiting(), self.workers())
            if self.pids():
                nobody_since = time.monotonic()
            elif time.monotonic() - nobody_since > self._patience_s:
                why = capacity() + self._last_words
                raise PoolError(f"there has been no worker for {self._patience_s:g} s (--patience): {why}")
        finish(meanwhile)
        if whole > 0.0:
            self._metre_s[kind] = max(sum(brought.busy_s.values()) / whole, 1e-9)
        brought.wall_s = time.perf_counter() - started
        if self._metrics:
            self._metrics.count(int(brought.results["steps"].sum()), brought.retries, len(brought.warnings))

    def _send(self, slot: _Slot, chunk: int, call: _Call) -> None:
        part = call.dispatch.parts[chunk]
        columns, raw = part.columns, call.recipes[part.rows].tobytes()
        if not slot.sent:
            slot.heard = max(slot.heard, time.monotonic())
        answered = slot.actor.run.remote(self._serial, raw, columns.start, columns.stop, *self._news(slot, call))
        slot.sent.append((self._serial, answered))
        call.brought.bytes_down += len(raw)

    def _news(self, slot: _Slot, call: _Call) -> list[Any]:
        """What a worker has to be told of the task, which then counts as told."""
        if slot.serial == self._serial:
            return []
        slot.serial = self._serial
        maps, gone, refs = self._shared.news(slot.maps, call.task, call.task_ref)
        return [maps, gone, *refs]

    def _answered(self, waiting: dict[Any, _Slot], busy: bool, pause_s: float) -> list[_Slot]:
        """All who have something to say: with many workers a look costs more than an answer.

        Where nobody has, and we are not busy, wait for the next, a second at most.
        """
        import ray

        timeout_s = 0.0 if busy else min(1.0, pause_s)
        if not waiting:
            time.sleep(min(timeout_s, BACKOFF_S))
            return []
        ready, _ = ray.wait(list(waiting), num_returns=len(waiting), timeout=0.0)
        if not ready and timeout_s > 0.0:
            ready, _ = ray.wait(list(waiting), num_returns=1, timeout=timeout_s)
        return [waiting[ref] for ref in ready]

    def _hear(self, slot: _Slot, call: _Call) -> bool:
        """Take in a worker's oldest answer, or its death. Returns whether anything was brought."""
        import ray

        serial, ref = slot.sent[0]
        try:
            raw = ray.get(ref)
        except ray.exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, BaseException) else error
            if cause is not error and isinstance(cause, ray.exceptions.RayError):  # it could not get what it needs
                return self._bury(slot, call, reason(cause), is_to_blame(cause))
            if serial == self._serial:
                at = call.dispatch.at(slot.number)
                what = describe(call.task, at, call.dispatch.parts[at])
                raise PoolError(f"a worker failed on {what}: {last_line(cause)}") from error
        except ray.exceptions.RayError as error:
            return self._bury(slot, call, reason(error), is_to_blame(error))
        slot.sent.popleft()
        slot.heard = time.monotonic()
        # What an earlier call has left is nobody's any more: a second copy, or what was interrupted.
        chunk = call.dispatch.answered(slot.number, slot.heard) if serial == self._serial else None
        if chunk is not None:
            call.brought.add(slot.number, call.dispatch.parts[chunk], *pickle.loads(raw))
            call.brought.bytes_up += len(raw)
        return chunk is not None

    def _bury(self, slot: _Slot, call: _Call, reason: str, blamed: bool = True) -> bool:
        """Replace a worker, and see to it that what it held is done. Returns whether anything is lost."""
        dispatch, brought = call.dispatch, call.brought
        lost = [dispatch.parts[chunk] for chunk in dispatch.died(slot.number, time.monotonic(), blamed)]
        brought.retries = dispatch.retries
        for part in lost:
            brought.lose(part)
        if lost:
            who = identify(call.task, lost[0], call.recipes)
            brought.warnings.append(
                f"{who} killed its worker {MAX_KILLS} times and is lost; the last time {reason}{self._logs()}"
            )
        if dispatch.deaths > max(MAX_DEATHS, MAX_KILLS * self._asked):
            raise PoolError(
                f"workers die whatever they are given, {dispatch.deaths} in a row; the last time {reason}{self._logs()}"
            )
        self._replace(slot)
        return bool(lost)

    def _replace_if_mute(self, slot: _Slot, call: _Call, silent_s: float) -> None:
        """Replace a worker that owes an answer, and has been silent for longer than its chunk could take."""
        import ray

        ref = slot.hello or (slot.sent[0][1] if slot.sent else None)
        if ref is None or silent_s <= MUTE * call.dispatch.expected_s(slot.number):
            return
        if not ray.wait([ref], timeout=0.0)[0]:  # it may have been us who did not listen
            self._bury(slot, call, f"it did not answer for {silent_s:.0f} s")

    def close(self) -> None:
        if self._closed.is_set():
            return
        with no_interrupt():  # a second Ctrl-C must not leave half of it behind
            self._leaving = True
            if self._starting and not (self.address is None and abandon(self._thread, self._booted)):
                self._booted.wait(CONNECT_S)
            if self._connected:
                import ray

                for slot in self._slots:
                    self._kill(slot)
                ray.shutdown(wait_for_processes=True)
                forget_token()
                if self._session and not self._troubled:
                    shutil.rmtree(self._session, ignore_errors=True)  # Ray itself never clears up its logs
            self._slots = []
            self._closed.set()
            if self._connected:
                self._thread.join(1.0)

    def _boot(self) -> None:
        """Bring up Ray and ask it for the workers; then wait, since Ray's processes die with this thread."""
        try:
            import ray

            if ray.is_initialized():
                raise PoolError("Ray is in use in this process already; close the other pool first")
            logging.getLogger("ray").setLevel(logging.CRITICAL)
            ray_worker: Any = importlib.import_module("ray._private.worker")
            ray_worker._worker_logs_enabled = False  # else it prints each worker's death, `log_to_driver` or not
            map_bytes = MAP_BYTES
            self._starting = True
            if self._leaving:
                return
            if self.address is None:
                store = store_bytes()
                map_bytes = store * MAP_BYTES // STORE_BYTES
                self._session = start_own(self._asked, store)
            else:
                join(self.address)
            self._connected = True
            end_at_once()
            self._shared = Shared(ray.put, self._build_map, map_bytes)
            self._actor_class = ray.remote(num_cpus=1)(Actor)
            if self.address and ray_worker.global_worker.node.metrics_agent_port > 0:
                self._metrics = RunMetrics(importlib.import_module("ray.util.metrics"), self._run)
            self._slots = [_Slot(number) for number in range(self._asked)]
            for slot in self._slots:
                self._start(slot)
        except BaseException as error:
            self._failure = error
        finally:
            self._booted.set()
        self._closed.wait()

    def _wait_for_ray(self) -> None:
        if self._closed.is_set():
            raise PoolError("the pool of workers is closed")
        if not self._booted.wait(CONNECT_S):
            raise PoolError(f"Ray did not come up within {CONNECT_S:g} s")
        if isinstance(self._failure, PoolError):
            raise self._failure
        if self._failure:
            where = f"could not join the Ray cluster at {self.address}" if self.address else "Ray could not be started"
            raise PoolError(f"{where}: {reason(self._failure)}") from self._failure

    def _start(self, slot: _Slot) -> None:
        slot.actor = self._actor_class.remote(self._factory, own_process=True)
        slot.hello = slot.actor.hello.remote()

    def _replace(self, slot: _Slot, pause_s: float = 0.0) -> None:
        self._troubled = True
        self._kill(slot)  # it may be alive and merely out of reach
        self._slots[slot.number] = _Slot(slot.number, start_at=time.monotonic() + pause_s)
        if not pause_s:
            self._start(self._slots[slot.number])

    def _kill(self, slot: _Slot) -> None:
        import ray

        if slot.actor is not None:
            ray.kill(slot.actor)

    def _greet(self, slot: _Slot, call: _Call) -> None:
        """A worker is up and is to be prepared, or it is prepared, or it could not start."""
        import ray

        try:
            slot.pid = ray.get(slot.hello)
        except ray.exceptions.RayError as error:
            if not is_to_blame(error):
                return self._replace(slot)
            self._failed_starts += 1
            self._last_words = f"; the last one: {reason(error)}{self._logs()}"
            if failed_as_it_began(error) and self._failed_starts >= MAX_FAILED_STARTS and not self.pids():
                raise PoolError(f"no worker can be started: {reason(error)}{self._logs()}") from error
            self._replace(slot, min(BACKOFF_S * 2.0**self._failed_starts, MAX_PAUSE_S))
        else:
            slot.heard, self._failed_starts, self._last_words = time.monotonic() + FIRST_S, 0, ""
            prepared = slot.serial > 0
            slot.hello = None if prepared else slot.actor.prepare.remote(self._serial, *self._news(slot, call))

    def _logs(self) -> str:
        return f" (logs: {self._session}/logs)" if self._session else ""
