"""A pool of Ray actors, on a Ray of its own or on an existing cluster. The only file that imports Ray.

What differs from Ray's own habits, and why:

* A Ray of our own goes without dashboard server, autoscaler monitor and log monitor, none of which a run uses: they
  cost a second at the start, another one at the end, and 1.5 core-seconds of the workers' time (`_lean_head`).
* Ray is started by a thread, so that the caller can load kernels meanwhile. The thread lives until `close`: the kernel
  kills Ray's processes when their parent *thread* dies, and so they die with us whatever kills us.
* Actors are replaced by this pool and not by Ray's `max_restarts`: what was sent has to be sent again either way, and a
  chunk that kills whoever takes it has to end the run with a clear line.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import pickle
import shutil
import signal
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from cluster import shipping
from cluster.pool import (
    FINER,
    METRE_S,
    BuildMap,
    Chunk,
    Collected,
    Meanwhile,
    Outcome,
    PoolError,
    Progress,
    all_episodes,
    answer,
    cut,
    describe,
    everything,
    finish,
    last_line,
    metres,
    new_collected,
    new_outcome,
)
from cluster.ray_address import (
    AUTH_ENVIRONMENT,
    ENVIRONMENT,
    OWN_ENVIRONMENT,
    STORE_BYTES,
    TOKEN,
    environment,
    has_token,
    no_interrupt,
    probe,
    store_bytes,
)
from cluster.worker import CollectTask, Task, Worker
from evolution.packing import pack_recipes
from evolution.rollout import Limits
from gridsim.scenarios import Scenario

CONNECT_S = 60.0
QUEUE = 2  # chunks that a worker holds: one that it works on, one so that it need not wait for us
MAX_KILLS = 3  # workers that one chunk may cost
MAX_FAILED_STARTS = 3  # in a row
MAP_BYTES = 512 << 20  # of maps kept there: those of training and validation, or they are sent every generation

_Name = tuple[str, int]  # of a map: scenario and seed

#: What a worker needs to take up a task: references to it and to the maps that it lacks, and maps to be forgotten.
_News = tuple[Any, dict[_Name, Any], list[_Name]]


class _Actor:
    """Runs in a worker's process: holds the present task and its maps, answers chunks."""

    def __init__(self, factory: Callable[[], Worker]):
        # Ctrl-C goes to every process of the terminal; whether the workers stop is the coordinator's business.
        with contextlib.suppress(ValueError):
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._worker = factory()
        self._serial = 0
        self._task: Task | CollectTask | None = None
        self._maps: dict[_Name, Scenario] = {}

    def hello(self) -> int:
        return os.getpid()

    def run(self, serial: int, payload: bytes, first: int, stop: int, news: _News | None) -> bytes:
        """What `cluster.pool.answer` says; `news` is for a worker that does not have the task yet."""
        if news:
            self._take_up(serial, *news)
        if self._task is None or serial != self._serial:
            raise RuntimeError(f"a chunk of task {serial} came to a worker that has task {self._serial}")
        maps = [self._maps[name] for name in self._task.maps]
        return answer(self._worker, self._task, maps, payload, first, stop)

    def _take_up(self, serial: int, task_ref: Any, map_refs: dict[_Name, Any], gone: list[_Name]) -> None:
        import ray

        self._task = None
        for name, ref in map_refs.items():
            if name not in self._maps:
                self._maps[name] = Scenario.from_arrays(ray.get(ref))
        # A map in use stays in the object store: those that the coordinator has let go are let go here.
        for name in gone:
            self._maps.pop(name, None)
        self._task = ray.get(task_ref)
        self._serial = serial


@dataclass
class _Slot:
    """One worker's place; who dies in it is replaced."""

    number: int
    actor: Any
    hello: Any  # the answer that says it is up; None once it is
    pid: int = 0
    serial: int = 0  # of the last task that it was told of
    maps: set[_Name] = field(default_factory=set)  # that it was told of
    sent: deque[tuple[int, Any]] = field(default_factory=deque)  # (chunk, answer), oldest first


class RayPool:
    """Workers as Ray actors of one CPU each. One pool at a time in a process.

    Args:
        workers: how many. On a cluster the first one that is up starts, the others join as they come.
        build_map: builds a map, here, once; workers see it in shared memory.
        address: an existing cluster's (`host:port` or `auto`); None for a Ray of our own.
        worker_factory: makes what evaluates; must be importable in the workers.
        start_timeout_s: how long there may be no worker at all; default 60 s, on a cluster 300 s (it may be growing).

    Raises PoolError at once where nothing answers at `address`; all else that goes wrong is raised by its calls.
    """

    def __init__(
        self,
        workers: int,
        build_map: BuildMap,
        address: str | None = None,
        worker_factory: Callable[[], Worker] = Worker,
        start_timeout_s: float | None = None,
    ):
        if workers < 1:
            raise ValueError(f"a RayPool needs 1 worker or more, not {workers}")
        for name, value in ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        self.address = None if address is None else check_address(address)
        self._asked = workers
        self._build_map = build_map
        self._factory = worker_factory
        self._start_timeout_s = start_timeout_s or (60.0 if address is None else 300.0)
        self._slots: list[_Slot] = []
        self._maps: OrderedDict[_Name, tuple[Any, int]] = OrderedDict()  # references and bytes
        self._map_bytes = MAP_BYTES
        self._serial = 0
        self._failed_starts = 0
        self._metre_s: dict[tuple[type, Limits], float] = {}  # what a metre of such tasks took the last time
        self._session: str | None = None  # folder of our own Ray's logs
        self._failure: BaseException | None = None
        self._connected = self._troubled = False
        self._booted, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._boot, name="ray", daemon=True)
        self._thread.start()

    def workers(self) -> int:
        return len(self.pids())

    def pids(self) -> list[int]:
        """Process ids of the workers that are up, on whichever machine they are."""
        return [slot.pid for slot in self._slots if slot.pid]

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
        self._work(task, asked, 1, lambda chunk: pack_recipes(recipes[chunk.rows]), outcome, on_progress, meanwhile)
        return outcome

    def collect(
        self, task: CollectTask, on_progress: Progress | None = None, meanwhile: Meanwhile | None = None
    ) -> Collected:
        collected = new_collected(task)
        self._work(task, all_episodes(task), FINER, lambda _: b"", collected, on_progress, meanwhile)
        return collected

    def _work(
        self,
        task: Task | CollectTask,
        asked: Sequence[Chunk],
        finer: int,
        payload: Callable[[Chunk], bytes],
        brought: Outcome | Collected,
        on_progress: Progress | None,
        meanwhile: Meanwhile | None,
    ) -> None:
        """Have what is asked for done, in chunks `finer` times as small as they need be, and fill `brought`."""
        import ray

        started = time.perf_counter()
        self._wait_for_ray()
        kind = type(task), task.limits
        parts = cut(task, asked, finer * self._asked, self._metre_s.get(kind, METRE_S))
        todo = deque(range(len(parts)))
        kills: Counter[int] = Counter()
        suspects: set[int] = set()
        self._serial += 1
        for slot in self._slots:
            slot.sent.clear()  # left over where the last call was interrupted
        task_ref = self._broadcast(task, brought)
        nobody_since = time.monotonic()

        while not brought.whole():
            for slot in self._free(todo, suspects):
                chunk = todo.popleft()
                columns, raw = parts[chunk].columns, payload(parts[chunk])
                what = None if slot.serial == self._serial else self._news(slot, task, task_ref)
                answered = slot.actor.run.remote(self._serial, raw, columns.start, columns.stop, what)
                slot.sent.append((chunk, answered))
                slot.serial = self._serial
                brought.bytes_down += len(raw)
            if meanwhile and self.pids() and not meanwhile():
                meanwhile = None
            waiting = {slot.hello or slot.sent[0][1]: slot for slot in self._slots if slot.hello or slot.sent}
            # Take all that is there: with many workers a look costs more than an answer. If there is nothing, and
            # nothing else to do, wait for the next.
            ready, _ = ray.wait(list(waiting), num_returns=len(waiting), timeout=0.0)
            if not ready and not (meanwhile and self.pids()):
                ready, _ = ray.wait(list(waiting), num_returns=1, timeout=1.0)
            for ref in ready:
                slot = waiting[ref]
                if slot.hello:
                    self._greet(slot)
                    continue
                chunk = slot.sent[0][0]
                part = parts[chunk]
                try:
                    raw = ray.get(ref)
                except ray.exceptions.RayTaskError as error:
                    cause = error.cause if isinstance(error.cause, BaseException) else error
                    raise PoolError(f"a worker failed on {describe(task, chunk, part)}: {last_line(cause)}") from error
                except ray.exceptions.RayError as error:
                    kills[chunk] += 1
                    if kills[chunk] >= MAX_KILLS:
                        raise PoolError(
                            f"{describe(task, chunk, part)} killed its worker {MAX_KILLS} times; the last time "
                            + _reason(error)
                            + self._logs()
                        ) from error
                    suspects.update(index for index, _ in slot.sent)
                    todo.extendleft(index for index, _ in reversed(slot.sent))
                    brought.retries += len(slot.sent)
                    self._replace(slot)
                    continue
                slot.sent.popleft()
                brought.take(slot.number, part, raw)
                if on_progress:
                    on_progress(*brought.progress())
            if self.pids():
                nobody_since = time.monotonic()
            elif time.monotonic() - nobody_since > self._start_timeout_s:
                raise PoolError(f"no worker came up within {self._start_timeout_s:g} s: {_capacity()}")
        finish(meanwhile)
        driven = sum(metres(task, block) for block in asked)
        if driven > 0.0:
            self._metre_s[kind] = max(sum(brought.busy_s.values()) / driven, 1e-9)
        brought.wall_s = time.perf_counter() - started

    def close(self) -> None:
        if self._closed.is_set():
            return
        with no_interrupt():  # a second Ctrl-C must not leave half of it behind
            self._booted.wait(CONNECT_S)  # what is only just starting cannot be stopped
            if self._connected:
                import ray

                for slot in self._slots:
                    ray.kill(slot.actor)
                ray.shutdown(wait_for_processes=True)
                _forget_token()
                if self._session and not self._troubled:
                    shutil.rmtree(self._session, ignore_errors=True)  # Ray itself never clears up its logs
            self._slots = []
            self._closed.set()
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
            if self.address is None:
                store = store_bytes()
                self._map_bytes = store * MAP_BYTES // STORE_BYTES
                self._session = _start_own(self._asked, store)
            else:
                _join(self.address)
            self._connected = True
            self._actor_class = ray.remote(num_cpus=1)(_Actor)
            for number in range(self._asked):
                self._slots.append(_Slot(number, *self._new_actor()))
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
            raise PoolError(f"{where}: {_reason(self._failure)}") from self._failure

    def _new_actor(self) -> tuple[Any, Any]:
        actor: Any = self._actor_class.remote(self._factory)
        return actor, actor.hello.remote()

    def _replace(self, slot: _Slot) -> None:
        import ray

        self._troubled = True
        ray.kill(slot.actor)  # it may be alive and merely out of reach
        actor, hello = self._new_actor()
        self._slots[slot.number] = _Slot(slot.number, actor, hello)

    def _greet(self, slot: _Slot) -> None:
        """A worker is up, or could not start."""
        import ray

        try:
            slot.pid = ray.get(slot.hello)
        except ray.exceptions.RayError as error:
            self._failed_starts += 1
            if self._failed_starts >= MAX_FAILED_STARTS:
                raise PoolError(f"no worker can be started: {_reason(error)}{self._logs()}") from error
            self._replace(slot)
        else:
            slot.hello = None
            self._failed_starts = 0

    def _logs(self) -> str:
        return f" (logs: {self._session}/logs)" if self._session else ""

    def _free(self, todo: deque[int], suspects: set[int]) -> Iterator[_Slot]:
        """Whom to give the next chunk, as long as there is one.

        The last ones only go to who has nothing to do. So do suspects, which were lost with a worker, and nothing is
        queued behind them: the next time it is clear which one it was.
        """
        up = [slot for slot in self._slots if slot.pid]
        for slot in up:
            if todo and not slot.sent:
                yield slot
        for slot in up:
            if len(todo) > len(up) and 0 < len(slot.sent) < QUEUE and suspects.isdisjoint([todo[0], slot.sent[0][0]]):
                yield slot

    def _broadcast(self, task: Task | CollectTask, brought: Outcome | Collected) -> Any:
        """Put the task, and those of its maps that are not there yet, into the object store; returns its reference."""
        import ray

        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(task, protocol=5, buffer_callback=buffers.append)
        brought.broadcast_bytes = len(head) + sum(buffer.raw().nbytes for buffer in buffers)
        for name in task.maps:
            if name not in self._maps:
                arrays = self._build_map(*name).arrays()
                size = sum(array.nbytes for array in arrays.values())
                self._maps[name] = ray.put(arrays), size
                brought.broadcast_bytes += size
            self._maps.move_to_end(name)
        used = sum(size for _, size in self._maps.values())
        while used > self._map_bytes and len(self._maps) > len(set(task.maps)):
            used -= self._maps.popitem(last=False)[1][1]
        return ray.put(task)

    def _news(self, slot: _Slot, task: Task | CollectTask, task_ref: Any) -> _News:
        """What a worker needs to take up a task; from then on it has that."""
        gone = [name for name in slot.maps if name not in self._maps]
        refs = {name: self._maps[name][0] for name in task.maps if name not in slot.maps}
        slot.maps.difference_update(gone)
        slot.maps.update(refs)
        return task_ref, refs, gone


def check_address(address: str) -> str:
    """The `host:port` of the Ray cluster meant by `address` (`host:port`, or `auto`: RAY_ADDRESS, else this machine's).

    Raises PoolError, one line, within 3 s where no Ray answers or it would not let us in. (Ray itself would try for
    20 s to minutes, and print a warning for each second.)
    """
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS") or "auto"
    if address == "auto":
        logging.getLogger("ray").setLevel(logging.CRITICAL)
        services = importlib.import_module("ray._private.services")
        try:
            address = services.canonicalize_bootstrap_address("auto")
        except ConnectionError:
            raise PoolError(
                "no Ray cluster runs on this machine; start one with `ray start --head`, or give its host:port"
            ) from None
    probe(address)
    return address


def _start_own(workers: int, store_bytes: int) -> str:
    """Start Ray on this machine with one CPU for each worker; returns the folder of its logs."""
    import ray

    if not any(name in os.environ for name in AUTH_ENVIRONMENT):
        # Ray listens on all interfaces and lets in who has its token. One of our own need not outlive the run in
        # ~/.ray, where it would change what `ray start` does from then on.
        os.environ["RAY_AUTH_TOKEN"] = TOKEN
    with environment(OWN_ENVIRONMENT), _lean_head():
        context: Any = ray.init(
            address="local",  # whatever RAY_ADDRESS says
            num_cpus=workers,
            num_gpus=0,
            object_store_memory=store_bytes,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.CRITICAL,
        )
    return context.address_info["session_dir"]


def _join(address: str) -> None:
    """Connect to a cluster that was found to let us in."""
    import ray

    if has_token(address.rpartition(":")[0]):
        with contextlib.suppress(ImportError, AttributeError):  # what Ray does where it is asked to find the cluster
            setup = importlib.import_module("ray._private.authentication.authentication_token_setup")
            setup.maybe_enable_token_auth_if_token_available(warn_if_disabled=False)
    with environment(shipping.ENVIRONMENT):
        env = shipping.runtime_env()
        ray.init(address=address, runtime_env=env, log_to_driver=False, logging_level=logging.CRITICAL)


@contextlib.contextmanager
def _lean_head() -> Iterator[None]:
    """Start Ray's head without the helpers that only its dashboard, autoscaler and terminal output need.

    Ray has no setting for that, so this replaces private names while `ray.init` runs. Where a version lacks them, Ray
    starts with all its helpers, as it would by itself.
    """
    try:
        node = importlib.import_module("ray._private.node").Node
        parameter: Any = importlib.import_module("ray._private.parameter")
        start_api_server, ray_params = node.start_api_server, parameter.RayParams
        ray_params(no_monitor=True, include_log_monitor=False)
    except (ImportError, AttributeError, TypeError):
        yield
        return

    def no_api_server(self: Any, **_: Any) -> None:
        self._webui_url = ""

    node.start_api_server = no_api_server
    parameter.RayParams = partial(ray_params, no_monitor=True, include_log_monitor=False)
    try:
        yield
    finally:
        node.start_api_server, parameter.RayParams = start_api_server, ray_params


def _forget_token() -> None:
    """Leave Ray and the environment as they were: with our token, a cluster that is joined next could not call us."""
    if os.environ.get("RAY_AUTH_TOKEN") == TOKEN:
        del os.environ["RAY_AUTH_TOKEN"]
        os.environ.pop("RAY_AUTH_MODE", None)  # Ray's own doing
        with contextlib.suppress(ImportError, AttributeError):
            raylet = importlib.import_module("ray._raylet")
            raylet.Config.initialize("")
            raylet.AuthenticationTokenLoader.instance().reset_cache()


def _capacity() -> str:
    """What the cluster has to offer, in words."""
    import ray

    free, total = ray.available_resources().get("CPU", 0), ray.cluster_resources().get("CPU", 0)
    return f"Ray has {total:g} CPUs, {free:g} of them free, and a worker needs 1"


def _reason(error: BaseException) -> str:
    """What matters in Ray's long messages, in one short line."""
    text = (str(error).strip() or type(error).__name__).splitlines()[-1].strip()
    if "Worker exit detail: " in text:
        text = text.split("Worker exit detail: ")[1].split(". Some common causes")[0]
        if "connection error" in text:
            text = "its process was killed, crashed, or ran out of memory"
    return text[:300]
