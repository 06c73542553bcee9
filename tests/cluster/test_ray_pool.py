"""RayPool with real Ray processes: the same bits from any number of workers, workers that die, and addresses."""

import contextlib
import functools
import http.server
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import psutil  # type: ignore[import-untyped]
import pytest
import ray
from commands import wait_until
from driving import to_bytes
from test_pool import (
    Answering,
    Failing,
    collect_drive_task,
    drive_task,
    make_collect_task,
    make_recipes,
    make_task,
    never_built,
)

from cluster.workers import ray_pool
from cluster.workers.pool import PoolError, SerialPool
from cluster.workers.ray_pool import RayPool
from cluster.workers.ray_session import check_address
from cluster.workers.worker import CollectTask, Task, Worker
from evolution.search.breeding import RECIPE

pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("stand_ins")]

NOBODY = 1_000_000  # stands for a member where there is none: as workers are prepared


class Obeying(Answering):
    """Follows files in a folder: `kill-7` holds how often the member or episode 7 kills its worker, `raise-7` fails."""

    def __init__(self, folder: Path):
        self._folder = folder

    def answer(self, task, maps, recipes, first, stop):
        collecting = isinstance(task, CollectTask)
        self._obey(task.keys[first:stop] if collecting else recipes["seed"] if len(recipes) else np.array([NOBODY]))
        return super().answer(task, maps, recipes, first, stop)

    def _obey(self, seeds: np.ndarray) -> None:
        for path in sorted(self._folder.glob("*-*")):
            what, seed = path.name.split("-")
            if int(seed) not in seeds:
                continue
            if what == "sleep":
                time.sleep(float(path.read_text()))
                continue
            times = int(path.read_text())
            mine = self._folder / str(os.getpid())
            mine.write_text(str(times - 1))
            mine.replace(path)  # at once: another worker may read it just now
            if times > 0 and what == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            if times > 0:
                raise ValueError("that member\nis not to be had")


class Inspecting(Worker):
    """Fails where something is wrong with its process or its inputs."""

    def evaluate(self, task, maps, recipes):
        for array in (task.parents, task.episodes, recipes, *(each.road.field for each in maps)):
            assert array.flags.aligned
        assert not any(each.road.field.flags.writeable for each in maps)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN, "Ctrl-C would reach a worker"
        assert os.environ.get("OMP_NUM_THREADS") == "1", "a worker has more than one thread"
        assert psutil.Process().memory_full_info().uss <= 220 << 20
        return super().evaluate(task, maps, recipes)


class Signing(Answering):
    """Leaves a file named after its process, and takes its time in one of them."""

    def __init__(self, folder: Path, slow: int):
        self._folder, self._slow = folder, slow

    def answer(self, task, maps, recipes, first, stop):
        (self._folder / str(os.getpid())).touch()
        time.sleep(0.1 if os.getpid() == self._slow else 0.0)
        return super().answer(task, maps, recipes, first, stop)


@dataclass(frozen=True)
class Reluctant(Task):
    """Cannot be unpickled the first time in each process."""

    seen: Path

    def __setstate__(self, state: dict[str, Any]) -> None:
        mine = state["seen"] / str(os.getpid())
        if not mine.exists():
            mine.touch()
            raise MemoryError("no room")
        vars(self).update(state)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("orders")


@pytest.fixture(scope="module")
def held() -> Iterator[list[RayPool]]:
    """The pool that is shared by tests, or none. There can only be one in a process."""
    pools: list[RayPool] = []
    yield pools
    for pool in pools:
        pool.close()


@pytest.fixture
def pool(held: list[RayPool], folder: Path) -> RayPool:
    """One pool for many tests (a start takes seconds), both of its workers idle and without orders."""
    for path in folder.iterdir():
        path.unlink()
    if not held:
        held.append(RayPool(2, never_built, worker_factory=functools.partial(Obeying, folder)))
    wait_until(lambda: len(held[0].evaluate(make_task(), make_recipes(512)).busy_s) == 2)
    return held[0]


@pytest.fixture(params=["queued", "sent"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """How parcels get to workers: from the queue, or each by a call of its own, as on a cluster."""
    monkeypatch.setattr(ray_pool, "QUEUED_S", 1e9 if request.param == "queued" else 0.0)
    return request.param


@pytest.fixture
def no_pool(held: list[RayPool]) -> None:
    """For tests that bring their own."""
    while held:
        held.pop().close()


def expected(n: int) -> bytes:
    return SerialPool(never_built, Answering).evaluate(make_task(), make_recipes(n)).results.tobytes()


def test_a_worker_that_had_nothing_to_do_for_longer_than_patience_is_kept(
    pool: RayPool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "_silence_s", 1.0)
    (folder / "sleep-5").write_text("0.5")
    pids = pool.pids()
    time.sleep(1.5)
    assert pool.evaluate(make_task(), make_recipes(512)).warnings == []
    assert pool.pids() == pids


def test_results_progress_and_what_is_sent(pool: RayPool, way: str) -> None:
    progress: list[tuple[int, int]] = []
    outcome = pool.evaluate(make_task(), make_recipes(512), lambda *done: progress.append(done))
    assert outcome.results.tobytes() == expected(512)
    assert progress == sorted(progress)
    assert progress[-1] == (512, 512)
    assert outcome.retries == 0
    assert outcome.bytes_down == 512 * RECIPE.itemsize * (2 if way == "queued" else 1), "to each worker, or once"
    assert outcome.results.nbytes < outcome.bytes_up < outcome.results.nbytes + 10_000
    assert len(progress) <= 2 or way == "sent", "one answer of each worker that did anything"
    assert 8 * 311 * 4 < outcome.broadcast_bytes < 8 * 311 * 4 + 2000
    assert set(outcome.busy_s) <= {0, 1}
    assert len(set(pool.pids())) == len(pool.pids()) == 2


@pytest.mark.usefixtures("way")
def test_what_a_killed_worker_was_at_runs_elsewhere_at_once_and_it_is_replaced(pool: RayPool, folder: Path) -> None:
    before = set(pool.pids())
    (folder / "kill-300").write_text("1")
    outcome = pool.evaluate(make_task(), make_recipes(512))
    assert outcome.results.tobytes() == expected(512)
    assert 1 <= outcome.retries <= 2
    assert outcome.wall_s < 5.0
    wait_until(lambda: pool.evaluate(make_task(), make_recipes(8)) and len(pool.pids()) == 2)
    assert len(before.intersection(pool.pids())) == 1


@pytest.mark.parametrize("what", ["kill", "raise"])
def test_workers_that_cannot_be_prepared_blame_no_member_and_are_given_up(
    pool: RayPool, folder: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.setattr(ray_pool, "MAX_DEATHS", 6)
    order = folder / f"{what}-{NOBODY}"
    for times in (2, 9):
        order.write_text(str(times))
        for pid in pool.pids():
            os.kill(pid, signal.SIGKILL)
        if times == 2:
            assert pool.evaluate(make_task(), make_recipes(512)).results.tobytes() == expected(512)
            assert order.read_text() <= "0", "they were prepared, and failed"
    with pytest.raises(PoolError, match=r"^workers die whatever they are given, 7 in a row; the last time "):
        pool.evaluate(make_task(), make_recipes(512))
    order.unlink()
    assert pool.evaluate(make_task(), make_recipes(100)).results.tobytes() == expected(100), "the pool goes on"


@pytest.mark.usefixtures("way")
def test_a_member_that_always_kills_is_lost_alone(pool: RayPool, folder: Path) -> None:
    (folder / "kill-300").write_text("100")
    progress: list[tuple[int, int]] = []
    outcome = pool.evaluate(make_task(), make_recipes(512), lambda *done: progress.append(done))
    assert np.flatnonzero(outcome.lost).tolist() == [300]
    wanted = SerialPool(never_built, Answering).evaluate(make_task(), make_recipes(512)).results
    wanted[300] = np.zeros((), wanted.dtype)  # it drove nowhere, and did not end
    assert outcome.results.tobytes() == wanted.tobytes()
    assert progress[-1] == (512, 512)
    (warning,) = outcome.warnings
    assert warning.startswith(
        "member 300 (cross of rows 4 and 4, seed 300, key 0x3039) killed its worker 3 times and is lost; the last time "
        "its process was killed, crashed, or ran out of memory (logs: "
    )
    assert 3 <= 100 - int((folder / "kill-300").read_text()) <= 6, "workers that it cost"


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("times", [0, 2])
def test_experience_keeps_its_order_where_workers_die(pool: RayPool, folder: Path, times: int) -> None:
    task, progress = make_collect_task(400), [(0, 0)]
    wanted = SerialPool(never_built, Answering).collect(task)
    (folder / "kill-150").write_text(str(times))
    collected = pool.collect(task, lambda *done: progress.append(done))
    assert to_bytes(collected.experience) == to_bytes(wanted.experience)
    assert collected.results.tobytes() == wanted.results.tobytes()
    assert progress == sorted(progress)
    assert progress[-1] == (400, 400)
    assert times <= collected.retries <= 2 * times
    sent = wanted.results.nbytes + len(to_bytes(wanted.experience))
    assert sent < collected.bytes_up < sent + 20_000 + 1000 * len(progress)


def test_a_worker_that_could_not_take_up_a_queued_task_does_not_go_on_with_the_one_before(
    pool: RayPool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_pool, "QUEUED_S", 1e9)
    other = make_task()
    task = Reluctant(**vars(replace(other, parents=other.parents + 1.0)), seen=tmp_path)
    pool.evaluate(other, make_recipes(512))
    outcome = pool.evaluate(task, make_recipes(512))
    assert {path.name for path in tmp_path.iterdir()} == set(map(str, pool.pids()))
    wanted = SerialPool(never_built, Answering).evaluate(task, make_recipes(512))
    assert outcome.results.tobytes() == wanted.results.tobytes()


@pytest.mark.usefixtures("way")
def test_an_exception_ends_the_run_in_one_line(pool: RayPool, folder: Path) -> None:
    (folder / "raise-100").write_text("9")
    line = r"^a worker failed on parcel \d+ \(members \d+ to \d+\): ValueError: is not to be had\Z"
    with pytest.raises(PoolError, match=line):
        pool.evaluate(make_task(), make_recipes(512))
    (folder / "raise-100").unlink()
    assert pool.evaluate(make_task(), make_recipes(100)).results.tobytes() == expected(100), "the pool goes on"


def test_an_error_of_rays_own_ends_the_run_in_one_line(pool: RayPool, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ray, "wait", Mock(side_effect=ray.exceptions.RaySystemError("the store\nis gone")))
        with pytest.raises(PoolError, match=r"^Ray failed: .*is gone \(logs: .*/logs\)$"):
            pool.evaluate(make_task(), make_recipes(512))
    assert pool.evaluate(make_task(), make_recipes(100)).results.tobytes() == expected(100), "the pool goes on"


def test_something_is_done_again_and_again_while_workers_are_busy(pool: RayPool, folder: Path) -> None:
    """Answers are taken in between; all of it is done when the call returns."""
    (folder / "sleep-0").write_text("0.5")  # in the first chunk
    progress, done_by_then = [(0, 400)], []

    def learn() -> bool:
        time.sleep(0.005)
        done_by_then.append(progress[-1][0])
        return len(done_by_then) < 200

    collected = pool.collect(make_collect_task(400), lambda *done: progress.append(done), learn)
    wanted = SerialPool(never_built, Answering).collect(make_collect_task(400))
    assert to_bytes(collected.experience) == to_bytes(wanted.experience)
    assert len(done_by_then) == 200
    assert 0 < done_by_then[19] < 400, "the other worker's answers, not the sleeping one's"
    assert done_by_then[-1] == 400


def test_only_one_pool_at_a_time_which_survives_an_interruption(pool: RayPool) -> None:
    with pytest.raises(KeyboardInterrupt):
        pool.collect(make_collect_task(400), meanwhile=lambda: signal.raise_signal(signal.SIGINT))
    second = RayPool(1, never_built, worker_factory=Answering)
    with pytest.raises(PoolError, match="in use in this process already"):
        second.evaluate(make_task(), make_recipes(4))
    second.close()
    assert pool.evaluate(make_task(), make_recipes(9)).results.tobytes() == expected(9)


@pytest.mark.usefixtures("no_pool")
@pytest.mark.parametrize("workers", [1, 4])
def test_any_number_of_workers_gives_the_serial_pools_bits(workers: int) -> None:
    """With the real worker on real maps, which `Inspecting` looks at; two of four are killed on the way."""
    (task, maps), (collect_task, _), recipes = drive_task(), collect_drive_task(100), make_recipes(200)
    serial = SerialPool(lambda _, seed: maps[seed])
    wanted, alone = serial.evaluate(task, recipes).results.tobytes(), serial.collect(collect_task)
    with contextlib.closing(RayPool(workers, lambda _, seed: maps[seed], worker_factory=Inspecting)) as pool:
        first = pool.evaluate(task, recipes)
        assert first.results.tobytes() == wanted
        assert first.broadcast_bytes > sum(each.nbytes for each in maps)
        if workers > 1:
            os.kill(pool.pids()[0], signal.SIGKILL)
        again = pool.evaluate(task, recipes)
        assert again.results.tobytes() == wanted
        assert again.broadcast_bytes < task.parents.nbytes + 2000, "maps are sent once"
        killer = threading.Timer(0.001, os.kill, (pool.pids()[-1], signal.SIGKILL))
        killer.start()
        for _ in range(2):
            collected = pool.collect(collect_task)
            assert to_bytes(collected.experience) == to_bytes(alone.experience)
            assert collected.results.tobytes() == alone.results.tobytes()
        killer.join()
        processes = psutil.Process().children(recursive=True)
    assert psutil.wait_procs(processes, timeout=10.0)[1] == [], "some are still there"


LITTER = """
import gc, threading, ray
from cluster.workers import ray_session

ray_session.prepare(None)
folder = ray_session.own_folder()
ray_session.start_own(1, folder)
one, shutdown = ray.put(0), ray.shutdown
cycle = [ray.ObjectRef(one.binary()) for _ in range(100_000)]
cycle.append(cycle)
gc.collect()
stopping, stopped = threading.Event(), threading.Event()

def litter():
    global cycle
    stopping.wait()
    del cycle
    while not stopped.is_set():
        [[] for _ in range(1000)]  # so that garbage is collected, here

def stop(**how):
    stopping.set()
    shutdown(**how)

threading.Thread(target=litter).start()
ray.shutdown = stop
ray_session.leave()
stopped.set()
ray_session.remove(folder)
print("enabled" if gc.isenabled() else "disabled")
"""


def test_garbage_in_another_thread_does_not_end_the_process_while_ray_stops() -> None:
    done = subprocess.run([sys.executable, "-c", LITTER], capture_output=True, text=True, timeout=60)
    assert done.stdout == "enabled\n", done.stderr


@pytest.mark.usefixtures("no_pool")
def test_workers_that_cannot_start_are_given_up() -> None:
    with (
        contextlib.closing(RayPool(2, never_built, worker_factory=Obeying, patience_s=300.0)) as pool,  # type: ignore
        pytest.raises(PoolError, match=r"^no worker can be started: .*TypeError: .*missing 1 required .*'folder'"),
    ):
        pool.evaluate(make_task(), make_recipes(20))


@pytest.mark.usefixtures("no_pool")
def test_this_process_works_until_a_worker_is_up_also_within_one_call(tmp_path: Path) -> None:
    signing, progress = functools.partial(Signing, tmp_path, os.getpid()), list[tuple[int, int]]()
    with contextlib.closing(RayPool(2, never_built, worker_factory=signing, begin_here=True)) as pool:
        assert pool.evaluate(make_task(), make_recipes(8)).results.tobytes() == expected(8)
        assert [int(path.name) for path in tmp_path.iterdir()] == [os.getpid()]
        outcome = pool.evaluate(make_task(), make_recipes(20_000), lambda *done: progress.append(done))
        assert outcome.results.tobytes() == expected(20_000)
        assert {int(path.name) for path in tmp_path.iterdir()} & set(pool.pids())
        assert progress == sorted(progress)
        assert progress[-1] == (20_000, 20_000)
        (tmp_path / str(os.getpid())).unlink()
        assert pool.evaluate(make_task(), make_recipes(512)).results.tobytes() == expected(512)
        assert not (tmp_path / str(os.getpid())).exists(), "no longer here"


@pytest.mark.usefixtures("no_pool")
def test_a_ray_that_does_not_start_ends_a_run_that_has_begun_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        time.sleep(0.2)
        raise OSError("no room")

    monkeypatch.setattr(ray_pool.ray_session, "start_own", fail)
    pool = RayPool(2, never_built, worker_factory=Answering, patience_s=1.0, begin_here=True)
    with (
        contextlib.closing(pool),
        pytest.raises(PoolError, match=r"^Ray could not be started: no room; .*set RAY_TMPDIR to one that has$"),
    ):
        wait_until(lambda: not pool.evaluate(make_task(), make_recipes(8)))


@pytest.mark.usefixtures("no_pool")
def test_a_run_goes_on_alone_as_long_as_ray_starts_and_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_pool, "CONNECT_S", 0.5)  # for close
    monkeypatch.setattr(RayPool, "_boot", lambda pool: pool._closed.wait())
    with contextlib.closing(RayPool(1, never_built, worker_factory=Answering, patience_s=0.3, begin_here=True)) as pool:
        said = []
        for _ in range(4):
            outcome = pool.evaluate(make_task(), make_recipes(8))
            assert outcome.results.tobytes() == expected(8)
            said += outcome.warnings
            time.sleep(0.2)
        assert said == ["no worker is up after 0 s; this process goes on alone until one is"]
    with pytest.raises(PoolError, match=r"^the pool of workers is closed$"):
        pool.evaluate(make_task(), make_recipes(8))


@pytest.mark.usefixtures("no_pool")
def test_an_error_while_ray_is_being_imported_is_shown_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_pool, "CONNECT_S", 0.5)
    monkeypatch.setattr(RayPool, "_boot", lambda pool: pool._closed.wait())
    with (
        contextlib.closing(RayPool(1, never_built, worker_factory=Failing, begin_here=True)) as pool,
        pytest.raises(PoolError, match=r"^a worker failed on parcel \d+ .*: ValueError: not to be had$"),
    ):
        pool.evaluate(make_task(), make_recipes(512))


def test_a_pool_needs_workers() -> None:
    with pytest.raises(ValueError, match="1 worker or more"):
        RayPool(0, never_built)


# --- Addresses of clusters --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "said"),
    [
        *((text, "is not a Ray address; give") for text in ("nowhere", "host:99999", ":6379", "ray://a:10001")),
        ("127.0.0.1:1", r"^no Ray cluster answers at 127.0.0.1:1: Connection refused; is `ray start"),
    ],
)
def test_an_address_where_there_is_no_cluster_is_refused_at_once(address: str, said: str) -> None:
    with pytest.raises(PoolError, match=said):
        RayPool(2, never_built, address)


def test_what_answers_something_else_or_says_nothing_is_no_cluster() -> None:
    other = http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler)
    with other, socket.create_server(("127.0.0.1", 0)) as silent:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        started = time.perf_counter()
        for port in (other.server_port, silent.getsockname()[1]):
            with pytest.raises(PoolError, match="is not a Ray cluster; is that its head's port"):
                check_address(f"127.0.0.1:{port}")
        assert time.perf_counter() - started < 5
        other.shutdown()
