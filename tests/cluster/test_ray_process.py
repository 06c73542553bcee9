"""A process that holds a RayPool, and the addresses it is given: it ends as it should, whatever happens to it."""

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
import psutil  # type: ignore[import-untyped]
import pytest
from commands import importable
from test_pool import Answering, Evaluated, never_built
from test_ray_pool import gone

from cluster.workers.pool import PoolError
from cluster.workers.ray_pool import RayPool
from cluster.workers.ray_session import check_address
from cluster.workers.worker import Task
from gridsim.maps.map import Map

pytestmark = pytest.mark.e2e

SCRIPT = """
    import ctypes
    import sys
    from cluster.commands.common import main
    from cluster.runs.train import undisturbed
    from cluster.workers.ray_pool import RayPool
    from test_pool import make_recipes, make_task, never_built
    from test_ray_process import Slow

    def hold():
        # What C++ does as a process ends aborts it, as destructors may whose objects Ray's threads still use.
        libc = ctypes.CDLL(None)
        libc.__cxa_atexit(ctypes.cast(libc.abort, ctypes.c_void_p), None, None)
        pool = RayPool(2, never_built, worker_factory=Slow)
        try:
            if sys.argv[1] == "busy":
                pool.evaluate(make_task(), make_recipes(8))
            sys.stdout.write("ready\\n")
            sys.stdout.flush()
            pool.evaluate(make_task(), make_recipes(int(sys.argv[2])))
        except KeyboardInterrupt:
            return 130
        finally:
            with undisturbed():
                pool.close()
        return 0

    if __name__ == "__main__":
        main("test", hold)
"""


class Slow(Answering):
    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        time.sleep(0.001 * len(recipes))
        return super().evaluate(task, maps, recipes)


@pytest.fixture
def script(tmp_path: Path, root: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a process of its own that holds a pool; returns when it says so."""
    path = tmp_path / "holds_a_pool.py"
    path.write_text(textwrap.dedent(SCRIPT))
    started: list[subprocess.Popen[str]] = []

    def start(when: str, members: int) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, path, when, str(members)],
            env=os.environ | {"PYTHONPATH": f"{root}{os.pathsep}{importable(__file__)}"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(("when", "after_s"), [("busy", 0.5), ("starting", 0.1)])
def test_ctrl_c_leaves_nothing_behind(script: Callable[..., subprocess.Popen[str]], when: str, after_s: float) -> None:
    """As the terminal does it: to every process of the foreground, and once more by an impatient user."""
    process = script(when, 100_000)
    time.sleep(after_s)
    children = psutil.Process(process.pid).children(recursive=True)
    for child in children:
        child.send_signal(signal.SIGINT)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(0.2)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (130, "", "")
    assert gone(children) == []


def test_a_killed_coordinator_takes_its_workers_along(script: Callable[..., subprocess.Popen[str]]) -> None:
    process = script("busy", 100_000)
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    # Two idle helpers of Ray's look for it for another minute; they do nothing and hold no port that is needed.
    assert {child.name() for child in gone(children, 6)} <= {"ray::DashboardAgent", "ray::RuntimeEnvAgent"}


def test_a_run_says_nothing_even_where_a_worker_dies(script: Callable[..., subprocess.Popen[str]]) -> None:
    process = script("busy", 2_000)
    workers = [p for p in psutil.Process(process.pid).children(recursive=True) if p.name().startswith("ray::Actor")]
    assert len(workers) in (1, 2)
    workers[0].kill()
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "")


@pytest.mark.parametrize("address", ["nowhere", "host:0", "host:99999", ":6379", "ray://127.0.0.1:10001", "a/b:1"])
def test_what_is_no_address(address: str) -> None:
    with pytest.raises(PoolError, match="is no address of a Ray cluster; give host:port"):
        RayPool(2, never_built, address)


def test_an_address_where_nothing_answers() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    started = time.perf_counter()
    with pytest.raises(PoolError, match=rf"^no Ray cluster answers at {address}: Connection refused; is `ray start"):
        RayPool(2, never_built, address)
    assert time.perf_counter() - started < 2


def test_an_address_where_something_else_answers() -> None:
    class Quiet(http.server.BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(PoolError, match="is no Ray cluster; is that its head's port"):
            check_address(f"127.0.0.1:{server.server_port}")
        server.shutdown()


def test_an_address_that_accepts_and_says_nothing() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        started = time.perf_counter()
        with pytest.raises(PoolError, match="is no Ray cluster"):
            check_address(f"127.0.0.1:{server.getsockname()[1]}")
        assert time.perf_counter() - started < 5
