"""RayPool with real Ray processes: the same bits from any number of workers, and what happens when workers die."""

import functools
import http.server
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import psutil
import pytest

from cluster.pool import PoolError, SerialPool, chunks
from cluster.ray_pool import RayPool, check_address
from cluster.worker import Task
from gridsim.scenarios import Scenario
from test_pool import MAPS, Answering, drive_task, make_recipes, make_task, never_built

pytestmark = pytest.mark.e2e

BANNED = ("torch", "mlflow", "pygame", "matplotlib", "tyro", "rich")


class Obeying(Answering):
    """Does what files in a folder tell it to: `kill-7` holds how often the member with seed 7 kills its worker."""

    def __init__(self, folder: Path):
        self._folder = folder

    def evaluate(self, task: Task, maps: Sequence[Scenario], recipes: np.ndarray) -> tuple[np.ndarray, float]:
        for path in sorted(self._folder.glob("*-*")):
            what, seed = path.name.split("-")
            if int(seed) not in recipes["seed"]:
                continue
            with (self._folder / "calls").open("a") as calls:
                calls.write(f"{path.name}\n")
            if what == "kill":
                times = int(path.read_text())
                path.write_text(str(times - 1))
                if times > 0:
                    os.kill(os.getpid(), signal.SIGKILL)
            elif what == "raise":
                raise ValueError("that member\nis not to be had")
            elif what == "sleep":
                time.sleep(float(path.read_text()))
        return super().evaluate(task, maps, recipes)


class Inspecting(Answering):
    """Tells of its process: modules that should not be there, writable inputs, the time that SIGINT is ignored."""

    def evaluate(self, task: Task, maps: Sequence[Scenario], recipes: np.ndarray) -> tuple[np.ndarray, float]:
        results, seconds = super().evaluate(task, maps, recipes)
        arrays = [task.parents, task.episodes, recipes, *(m.road.field for m in maps)]
        results["distance"] = sum(name in sys.modules for name in BANNED)
        results["paced"] = sum(array.flags.writeable or not array.flags.aligned for array in arrays)
        results["end"] = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        results["steps"] = os.environ.get("OMP_NUM_THREADS") == "1"
        return results, seconds


class Unfit(Answering):
    def __init__(self) -> None:
        raise RuntimeError("no worker\nin this state")


@pytest.fixture(scope="module", autouse=True)
def _stand_ins_can_be_imported() -> Iterator[None]:
    """By the workers too, which know nothing of pytest's search path."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("orders")


@pytest.fixture(scope="module")
def _pool(folder: Path) -> Iterator[RayPool]:
    pool = RayPool(2, never_built, worker_factory=functools.partial(Obeying, folder))
    yield pool
    pool.close()


@pytest.fixture
def pool(_pool: RayPool, folder: Path) -> RayPool:
    """One pool for many tests (a start takes seconds), without orders."""
    for path in folder.iterdir():
        path.unlink()
    return _pool


def expected(n: int) -> bytes:
    return SerialPool(never_built, Answering).evaluate(make_task(), make_recipes(n)).results.tobytes()


def gone(processes: list[psutil.Process], within_s: float = 10.0) -> list[psutil.Process]:
    """Those that are still there after that time."""
    _, alive = psutil.wait_procs(processes, timeout=within_s)
    return alive


def test_results_progress_and_what_is_sent(pool: RayPool):
    told: list[tuple[int, int]] = []
    recipes = make_recipes(512)
    outcome = pool.evaluate(make_task(), recipes, lambda done, of: told.append((done, of)))
    assert outcome.results.tobytes() == expected(512)
    assert told == sorted(told)
    assert told[-1] == (512, 512)
    assert outcome.retries == 0
    assert outcome.bytes_down == recipes.nbytes
    assert outcome.bytes_up == outcome.results.nbytes + 8 * len(chunks(512, 2))
    assert 8 * 311 * 4 < outcome.broadcast_bytes < 8 * 311 * 4 + 2000
    assert set(outcome.busy_s) <= {0, 1}
    assert len(set(pool.pids())) == pool.workers() <= 2


def test_a_killed_worker_is_replaced_and_its_chunks_are_sent_again(pool: RayPool, folder: Path):
    (folder / "sleep-0").write_text("0.7")  # an elite's: in the first chunk
    pool.evaluate(make_task(), make_recipes(4))  # both have been up by now
    before = pool.pids()
    recipes = make_recipes(512)
    killed_at: list[float] = []

    def kill() -> None:
        os.kill(before[0], signal.SIGKILL)
        killed_at.append(time.perf_counter())

    timer = threading.Timer(0.3, kill)
    timer.start()
    outcome = pool.evaluate(make_task(), recipes)
    while pool.workers() < 2 or set(pool.pids()) == set(before):
        pool.evaluate(make_task(), make_recipes(8))
        assert time.perf_counter() < killed_at[0] + 20
    print(f"replaced after {time.perf_counter() - killed_at[0]:.2f} s")
    assert outcome.results.tobytes() == expected(512)
    assert outcome.retries >= 1
    assert before[0] not in pool.pids()


def test_a_member_that_kills_twice_is_sent_a_third_time(pool: RayPool, folder: Path):
    (folder / "kill-300").write_text("2")
    outcome = pool.evaluate(make_task(), make_recipes(512))
    assert outcome.results.tobytes() == expected(512)
    assert outcome.retries >= 2


def test_a_chunk_that_kills_three_workers_ends_the_run(pool: RayPool, folder: Path):
    (folder / "kill-300").write_text("100")
    with pytest.raises(PoolError, match=r"^chunk \d+ \(members \d+ to \d+\) killed its worker 3 times; .*died") as caught:
        pool.evaluate(make_task(), make_recipes(512))
    assert "\n" not in str(caught.value)
    assert (folder / "kill-300").read_text() == "97"
    (folder / "kill-300").unlink()
    assert pool.evaluate(make_task(), make_recipes(512)).results.tobytes() == expected(512), "the pool goes on"


def test_an_exception_ends_the_run_in_one_line_and_is_not_tried_again(pool: RayPool, folder: Path):
    (folder / "raise-100").touch()
    with pytest.raises(PoolError, match=r"^a worker failed on chunk \d+ \(members \d+ to \d+\): ValueError: is not to be"):
        pool.evaluate(make_task(), make_recipes(512))
    assert (folder / "calls").read_text().splitlines() == ["raise-100"]
    (folder / "raise-100").unlink()
    outcome = pool.evaluate(make_task(), make_recipes(100))
    assert outcome.results.tobytes() == expected(100)
    assert outcome.retries == 0


def test_only_one_pool_at_a_time(pool: RayPool):
    pool.evaluate(make_task(), make_recipes(4))
    second = RayPool(1, never_built, worker_factory=Answering)
    with pytest.raises(PoolError, match="in use in this process already"):
        second.evaluate(make_task(), make_recipes(4))
    second.close()
    assert pool.evaluate(make_task(), make_recipes(9)).results.tobytes() == expected(9)
