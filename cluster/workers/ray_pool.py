"""A pool of Ray actors, on a Ray of its own or on an existing cluster.

What differs from Ray's defaults, and why:

* Ray is started by a thread. Until a first worker is up, which takes seconds, this process does the work itself
  (`begin_here`). The thread lives until `close`: the system kills Ray's processes when their parent *thread* dies, and
  so they die with us, whatever kills us.
* Actors are replaced by this pool and not by Ray's `max_restarts`: what was sent has to be sent again either way, and
  `dispatch` has to know which chunk killed which worker.
* Where a call takes little time, the workers of this machine take its parcels from a queue (`tickets`), with one call
  of Ray's each. What a worker had taken when it died or failed is then sent in parcels, as on a cluster.
* For half a minute, or forever, Ray does not report a worker that is stopped, or whose host is cut off. A worker that
  has not answered for `patience_s` is replaced, and what it held is sent to another one.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from cluster.workers import ray_session
from cluster.workers.actor import Actor, Name, Shared, Work
from cluster.workers.cores import cores
from cluster.workers.dispatch import MAX_KILLS, Dispatch
from cluster.workers.pool import (
    METRE_S,
    BuildMap,
    Call,
    Chunk,
    Meanwhile,
    Parcel,
    PoolError,
    Progress,
    SerialPool,
    WorkerPool,
    cut,
    finish,
    metres,
)
from cluster.workers.tickets import Tickets
from cluster.workers.worker import AnyTask, CollectTask, Worker

CONNECT_S = 60.0
PATIENCE_S = 60.0  # for an answer of a worker on this machine
LONG_PATIENCE_S = 300.0  # for an answer on a cluster, and for a first worker: a cluster may be growing
MAX_DEATHS = 24  # of workers in a row, without an answer in between: two members that kill workers cause fewer
QUEUED_S = 0.5  # of evaluation per worker, up to which parcels are queued: progress shows only as a worker ends
WORTH_QUEUING_S = 0.002  # of evaluation: a parcel from the queue costs next to nothing
CORES = cores()
FROM_QUEUE: Parcel = ()  # tells a worker to take its parcels from the queue
FINER = 2  # times as many chunks of experience: an untrained driver crashes long before its target


@dataclass
class _Slot:
    """One worker's place; a worker that dies is replaced."""

    number: int
    actor: Any
    hello: Any  # the answer that says it is up, then that it is prepared; None after that
    pid: int = 0
    serial: int = 0  # of the last task that it was sent
    maps: set[Name] = field(default_factory=set)  # that it was sent
    sent: deque[tuple[int, Any]] = field(default_factory=deque)  # (serial of the task, answer), oldest first
    heard: float = 0.0  # when it last answered, or was sent something while it held nothing

    @property
    def due(self) -> Any:
        """The answer that it will give next, or None."""
        return self.hello or (self.sent[0][1] if self.sent else None)


_Kind = tuple[type, str, bool]


def _kind(task: AnyTask, part: Chunk) -> _Kind:
    """The same for parts that need about as long for a metre: one member drives on where many others crash early."""
    return type(task), task.policy, part.rows.stop - part.rows.start == 1


class RayPool(WorkerPool):
    """Workers as Ray actors of one CPU each. One pool at a time in a process.

    Args:
        workers: how many. On a cluster work begins when the first one is up, and the others join as they come.
        build_map: builds a map, here, once; workers see it in shared memory.
        address: an existing cluster's (`host:port` or `auto`); None for a Ray of our own.
        worker_factory: makes what evaluates; must be importable in the workers.
        patience_s: how long to go on without any worker, or wait for a silent one; default 300 s, but 60 s for a silent
            one on this machine.
        begin_here: whether this process evaluates and collects itself until the first worker is up. Until then, a lack
            of workers does not end the run.

    Raises PoolError at once if nothing answers at `address`; all else that goes wrong is raised by its calls.
    """

    def __init__(
        self, workers: int, build_map: BuildMap, address: str | None = None,
        worker_factory: Callable[[], Worker] = Worker, patience_s: float | None = None, begin_here: bool = False,
    ):  # fmt: skip
        if workers < 1:
            raise ValueError(f"a RayPool needs 1 worker or more, not {workers}")
        self.address = None if address is None else ray_session.check_address(address)
        self._variables = ray_session.prepare(self.address)
        self._asked = workers
        self._build_map = build_map
        self._factory = worker_factory
        self._patience_s = patience_s or LONG_PATIENCE_S
        self._silence_s = patience_s or (PATIENCE_S if address is None else LONG_PATIENCE_S)
        self._here = SerialPool(build_map, worker_factory) if begin_here else None  # until the first worker is up
        self._ray: Any = None  # once it is imported
        self._slots: list[_Slot] = []
        self._dispatch = Dispatch([])
        self._serial = 0
        self._last_failure = ""  # of a worker's start
        self._metre_s: dict[_Kind, float] = {}  # what a metre of such a part took the last time
        self._folder = ""  # of a Ray of our own
        self._tickets: Tickets | None = None  # only workers of this machine can read them
        self._failure: BaseException | None = None
        self._starved = 0  # workers that died for want of memory, without an answer in between
        self._leaving = self._connected = self._named = self._warned = self._memory_noted = False
        self._booted, self._closed = threading.Event(), threading.Event()
        self._alone_since = time.monotonic()
        self._connect_by = self._alone_since + CONNECT_S
        self._thread = threading.Thread(target=self._boot, name="ray", daemon=True)
        self._thread.start()

    def pids(self) -> list[int]:
        """Process ids of the workers that are up, on whichever machine they are."""
        return [slot.pid for slot in self._slots if slot.pid]

    @property
    def _logs(self) -> str:
        """Where the logs are, in words, for an error that is raised now. Logs that an error names are kept."""
        logs = ray_session.logs(self._folder)
        self._named = bool(logs)
        return f" (logs: {logs})" if logs else ""

    def expect(self, maps: Sequence[Name]) -> None:
        if self._connected:
            self._shared.put_maps(maps)

    def _work(self, call: Call, on_progress: Progress | None, meanwhile: Meanwhile | None) -> None:
        started = time.perf_counter()
        self._call, asked = call, call.asked
        self._serial += 1
        try:
            if self._here:
                asked = self._here.work_until(partial(self._worker_is_up, call), call, on_progress, meanwhile)
                meanwhile = None  # it is done
            if asked:
                self._wait_for_ray()
                self._share_out(call, asked, on_progress, meanwhile)
        except Exception as error:
            if self._ray is None or not isinstance(error, self._ray.exceptions.RayError):
                raise
            # Ray itself failed; `_receive` handles deaths of workers.
            raise PoolError(f"Ray failed: {ray_session.reason(error)}{self._logs}") from error
        self._measure(call)
        call.wall_s = time.perf_counter() - started

    def _worker_is_up(self, call: Call) -> bool:
        """Whether a worker is prepared, so that the workers can take over."""
        if not self._warned and time.monotonic() - self._alone_since > self._silence_s:
            self._warned = True
            text = f"no worker is up after {self._silence_s:.0f} s; this process goes on alone until one is"
            call.warnings.append(text)
        if not self._booted.is_set():
            return False
        self._wait_for_ray()  # raises what went wrong
        self._put(call)
        starting = {slot.hello: slot for slot in self._slots if slot.hello}
        for ref in self._ready(list(starting), 0.0):
            self._greet(starting[ref])
        if any(slot.pid and not slot.hello for slot in self._slots):
            self._here = None
        return self._here is None

    def _put(self, call: Call) -> None:
        """Put a call's task into the object store, unless that is done."""
        call.broadcast_bytes = call.broadcast_bytes or self._shared.put(call.task)

    def _share_out(
        self, call: Call, asked: Sequence[Chunk], on_progress: Progress | None, meanwhile: Meanwhile | None
    ) -> None:
        """Have the workers do what is asked for."""
        task = call.task
        metre_s = [self._metre_s.get(_kind(task, part), METRE_S) for part in asked]
        seconds = sum(rate * metres(task, part) for rate, part in zip(metre_s, asked, strict=True))
        self._put(call)
        if self._tickets and seconds < QUEUED_S * len(self.pids()):
            readers = min(len(self.pids()), CORES)  # each costs a call, and more would only share the cores
            self._parcels = dict(enumerate(cut(task, asked, readers, metre_s, WORTH_QUEUING_S)))
            self._packed = pickle.dumps([self._pack(parcel) for parcel in self._parcels.values()], protocol=5)
            self._tickets.put(self._serial, len(self._parcels))
            meanwhile = self._work_off([FROM_QUEUE] * readers, on_progress, meanwhile)
            parcels = list(self._parcels.values())  # those of workers that died or failed
            call.retries = len(parcels)
        else:
            shares = self._asked * (FINER if isinstance(task, CollectTask) else 1)
            parcels = cut(task, asked, shares, metre_s)
        finish(self._work_off(parcels, on_progress, meanwhile))

    def _work_off(
        self, parcels: Sequence[Parcel], on_progress: Progress | None, meanwhile: Meanwhile | None
    ) -> Meanwhile | None:
        """Have parcels done. Returns what is still to be done meanwhile."""
        self._dispatch = dispatch = Dispatch(parcels)
        call, retries = self._call, self._call.retries
        self._alone_since = time.monotonic()
        while not dispatch.finished():
            self._check_own_ray()
            now = time.monotonic()
            for slot in self._slots:
                silent_s = now - slot.heard if slot.pid and slot.due else 0.0
                if silent_s > self._silence_s and not self._ready([slot.due], 0.0):
                    silence = f"did not answer for {silent_s:.0f} s"
                    call.warnings.append(f"a worker {silence} (--patience) and is replaced")
                    self._bury(slot, f"it {silence}")
            idle = [slot.number for slot in self._slots if slot.pid and not slot.due]
            for number, parcel in dispatch.give(idle):
                self._send(self._slots[number], parcel)
            if meanwhile and self.pids() and not meanwhile():
                meanwhile = None
            waiting = {slot.due: slot for slot in self._slots if slot.due}
            for ref in self._ready(list(waiting), 0.0 if meanwhile and self.pids() else 1.0):
                if waiting[ref].hello:
                    self._greet(waiting[ref])
                elif self._receive(waiting[ref]) and on_progress:
                    on_progress(*call.progress())
            call.retries = retries + dispatch.retries
            self._check_patience()
        return meanwhile

    def _check_patience(self) -> None:
        """Raise if there has been no worker for too long."""
        if self.pids():
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > self._patience_s:
            if self.address:
                why = ray_session.capacity()
            else:
                why = f"{self._asked} were started on this machine"
                why += "" if self._last_failure else " and are not up yet, perhaps because it is busy"
            if self._last_failure:
                why += f"; the last that ended: {self._last_failure}{self._logs}"
            raise PoolError(f"there has been no worker for {self._patience_s:g} s (--patience): {why}")

    def _check_own_ray(self) -> None:
        """Raise if a process of our own Ray has ended: calls to Ray may then hang, and after a minute abort."""
        if self._folder and (lost := ray_session.lost_processes()):
            raise PoolError(f"Ray's {lost} on this machine was killed or has crashed{self._logs}")

    def _measure(self, call: Call) -> None:
        """Remember how long a metre took."""
        seconds: defaultdict[_Kind, float] = defaultdict(float)
        whole: defaultdict[_Kind, float] = defaultdict(float)
        for part in call.asked:
            kind = _kind(call.task, part)
            seconds[kind] += call.episode_s[part.columns].sum()
            whole[kind] += metres(call.task, part)
        self._metre_s |= {kind: max(seconds[kind] / whole[kind], 1e-9) for kind in seconds if whole[kind]}

    def _ready(self, refs: list[Any], timeout_s: float) -> list[Any]:
        """All answers that have come; if there are none, wait for the next one, at most `timeout_s`."""
        if not refs:
            time.sleep(timeout_s)
            return []
        ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0.0)  # one look: with many workers it is slow
        if not ready and timeout_s > 0.0:
            ready, _ = self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        return ready

    def _send(self, slot: _Slot, index: int) -> None:
        parcel = self._dispatch.parcels[index]
        if not slot.sent:
            slot.heard = time.monotonic()
        if parcel == FROM_QUEUE:
            assert self._tickets
            self._call.bytes_down += self._call.recipes.nbytes
            answer = slot.actor.take.remote(self._tickets.path, self._serial, self._packed, *self._update(slot))
        else:
            work = self._pack(parcel)
            self._call.bytes_down += sum(len(recipes) for recipes, _, _ in work)
            answer = slot.actor.run.remote(work, *self._update(slot))
        slot.sent.append((self._serial, answer))

    def _pack(self, parcel: Parcel) -> list[Work]:
        return [(recipes.tobytes(), first, stop) for recipes, first, stop in map(self._call.work, parcel)]

    def _update(self, slot: _Slot) -> list[Any]:
        """What a worker still has to be sent of the task."""
        if slot.serial == self._serial:
            return []
        slot.serial = self._serial
        return self._shared.update(slot.maps)

    def _receive(self, slot: _Slot) -> bool:
        """Take in a worker's oldest answer, or its death. Returns whether there is progress."""
        serial, ref = slot.sent[0]
        try:
            answer = self._ray.get(ref)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, BaseException) else error
            if cause is not error and isinstance(cause, self._ray.exceptions.RayError):  # it lacks what it needs
                return self._bury(slot, ray_session.reason(cause), ray_session.is_to_blame(cause))
            if serial == self._serial:
                at = self._dispatch.at(slot.number)
                if self._dispatch.parcels[at] != FROM_QUEUE:  # else its parcels are sent, and one fails again
                    raise self._call.failure(at, self._dispatch.parcels[at], cause) from error
            slot.serial = 0  # it may not have the task
            slot.maps.clear()
            answer = pickle.dumps({})
        except self._ray.exceptions.RayError as error:
            self._note_memory(error)
            return self._bury(slot, ray_session.reason(error), ray_session.is_to_blame(error))
        self._starved = 0
        slot.sent.popleft()
        slot.heard = time.monotonic()
        parcel = self._dispatch.answered(slot.number) if serial == self._serial else None  # else of an interrupted call
        if parcel is None:
            return False
        found, chunks = pickle.loads(answer), self._dispatch.parcels[parcel]
        done = [(self._parcels.pop(k), found[k]) for k in found] if chunks == FROM_QUEUE else [(chunks, found)]
        for chunks, results in done:
            for chunk, result in zip(chunks, results, strict=True):
                self._call.add(slot.number, chunk, *result)
        self._call.bytes_up += len(answer)
        return bool(done)

    def _bury(self, slot: _Slot, reason: str, blamed: bool = True) -> bool:
        """Replace a worker, and have what it held sent again. Returns whether anything is lost."""
        dispatch, call = self._dispatch, self._call
        self._last_failure = reason
        lost = [chunk for parcel in dispatch.died(slot.number, blamed) for chunk in dispatch.parcels[parcel]]
        for part in lost:
            call.lose(part)
        if lost:
            lost_one = call.identify(lost[0].rows.start)
            call.warnings.append(
                f"{lost_one} killed its worker {MAX_KILLS} times and is lost; the last time {reason}{self._logs}"
            )
        if dispatch.deaths > max(MAX_DEATHS, MAX_KILLS * self._asked):
            raise PoolError(
                f"workers die whatever they are given, {dispatch.deaths} in a row; the last time {reason}{self._logs}"
            )
        self._replace(slot)
        return bool(lost)

    def _note_memory(self, error: BaseException) -> None:
        """Warn once, and give up in the end, if workers die because a machine's memory is full."""
        used = ray_session.memory_used(error)
        if not used:
            return
        self._starved += 1
        advice = "close other programs there, or give fewer --workers"
        if self._starved > max(MAX_DEATHS, MAX_KILLS * self._asked):
            raise PoolError(f"memory is full ({used}) where workers run, and Ray ends them, again and again; {advice}")
        if not self._memory_noted:
            self._memory_noted = True
            said = f"memory is full ({used}), so Ray ends workers; what they held is done again, which takes longer"
            self._call.warnings.append(f"{said}; {advice}")

    def close(self) -> None:
        self._leaving = True
        self._booted.wait(CONNECT_S)  # Ray cannot be stopped while it starts
        if self._connected:
            for slot in self._slots:
                self._ray.kill(slot.actor)
            ray_session.leave()
            self._connected = False
        ray_session.restore(self._variables)
        self._slots, self._here = [], None
        self._closed.set()
        self._thread.join(1.0)
        if self._tickets:
            self._tickets.close()
            self._tickets = None
        if self._folder and not self._named:
            ray_session.remove(self._folder)
        self._folder = ""

    def _boot(self) -> None:
        """Bring up Ray and ask it for the workers; then wait, since Ray's processes die with this thread."""
        try:
            import ray  # which takes a second, and so is not done by the caller

            self._ray = ray
            if ray.is_initialized():
                raise PoolError(
                    "Ray is in use in this process already: call ray.shutdown() first, or evaluate in this process "
                    "(workers=0)"
                )
            if self._leaving:
                return
            if self.address is None:
                self._folder = ray_session.own_folder()
                self._tickets = Tickets(f"{self._folder}/tickets", new=True)
                ray_session.start_own(self._asked, self._folder)
            else:
                ray_session.join(self.address)
            self._shared = Shared(ray.put, self._build_map)
            self._connected = True
            self._actor_class = ray.remote(num_cpus=1)(Actor)
            self._slots = [self._start(number) for number in range(self._asked)]
        except BaseException as error:
            self._failure = error
        finally:
            self._alone_since = time.monotonic()
            self._booted.set()
        self._closed.wait()

    def _wait_for_ray(self) -> None:
        if self._closed.is_set():
            raise PoolError("the pool of workers is closed")
        if not self._booted.wait(max(self._connect_by - time.monotonic(), 0.0)):
            raise PoolError(f"Ray did not come up within {CONNECT_S:g} s")
        if isinstance(self._failure, PoolError):
            raise self._failure
        if self._failure:
            what, hint = f"could not join the Ray cluster at {self.address}", ""
            if not self.address:
                what, hint = "Ray could not be started", "; if its folder has no room, set RAY_TMPDIR to one that has"
            raise PoolError(f"{what}: {ray_session.reason(self._failure)}{self._logs}{hint}") from self._failure
        self._check_own_ray()

    def _start(self, number: int) -> _Slot:
        actor: Any = self._actor_class.remote(self._factory)
        return _Slot(number, actor, actor.hello.remote())

    def _replace(self, slot: _Slot) -> None:
        self._ray.kill(slot.actor)  # it may be alive and merely out of reach
        self._slots[slot.number] = self._start(slot.number)

    def _greet(self, slot: _Slot) -> None:
        """Take in a `hello`: a worker is up and is to be prepared, or it is prepared, or it could not start."""
        preparing = slot.serial > 0
        try:
            slot.pid = self._ray.get(slot.hello)
        except self._ray.exceptions.RayError as error:
            self._note_memory(error)
            reason, blamed = ray_session.reason(error), ray_session.is_to_blame(error)
            if preparing:  # it has no parcel yet, and so no member is blamed
                self._bury(slot, reason, blamed)
                return
            if blamed and ray_session.failed_as_it_began(error) and not self.pids():
                raise PoolError(f"no worker can be started: {reason}{self._logs}") from error
            self._last_failure = reason
            self._replace(slot)
        else:
            self._last_failure = ""
            slot.heard = time.monotonic()
            slot.hello = None if preparing else slot.actor.prepare.remote(*self._update(slot))
