"""Ray's workers: those that die, are silent, cannot start or fail; clusters that are wrong, closed or full."""

import contextlib
import functools
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]
import pytest
from commands import finish, wait_until
from searching import to_bytes
from test_pool import Answering, make_collect_task, make_recipes, make_task, never_built

from cluster.workers.address import cluster_address
from cluster.workers.open import open_pool
from cluster.workers.pool import Call, Collected, Outcome, PoolError
from cluster.workers.ray_pool import RayPool
from cluster.workers.threads import ThreadPool
from cluster.workers.worker import CollectTask

pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("stand_ins")]
KILLED = "its process was killed, crashed, or ran out of memory"


class Obeying(Answering):
    """Follows files in a folder: `kill-7` holds how often member or episode 7 kills its worker (or stops it)."""

    def __init__(self, folder: Path):
        self._folder = folder

    def answer(self, task, maps, recipes, columns):
        rows = task.keys[columns] if isinstance(task, CollectTask) else recipes["seed"]
        for path in sorted(self._folder.glob("*-*")):
            what, row = path.name.split("-")
            times = int(path.read_text())
            if int(row) in rows and times > 0:
                mine = self._folder / str(os.getpid())
                mine.write_text(str(times - 1))
                mine.replace(path)  # at once: another worker may read it just now
                os.kill(os.getpid(), signal.SIGKILL if what == "kill" else signal.SIGSTOP)
        return super().answer(task, maps, recipes, columns)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("orders")


@pytest.fixture(scope="module")
def only_pool(folder: Path, stand_ins: None) -> Iterator[RayPool]:
    """One for all tests, as there can only be one in a process, and a start takes seconds."""
    with contextlib.closing(RayPool(2, never_built, worker_factory=functools.partial(Obeying, folder))) as pool:
        pool.open()
        yield pool


@pytest.fixture
def pool(only_pool: RayPool, folder: Path) -> RayPool:
    """A pool whose workers are both up and without orders."""
    for path in folder.iterdir():
        path.unlink()
    wait_until(lambda: goes_on(only_pool) and len(only_pool.pids()) == 2)
    return only_pool


def goes_on(pool: RayPool) -> bool:
    """Whether a pool can be used again, with the results of threads."""
    outcome = Outcome(make_task(), make_recipes(512))
    with contextlib.closing(ThreadPool(never_built, 1, Answering)) as threads:
        wanted = threads.run(Outcome(make_task(), make_recipes(512)))
    return pool.run(outcome).results.tobytes() == wanted.results.tobytes()


@pytest.mark.parametrize(("what", "kind"), [("kill", Outcome), ("stop", Collected)])
def test_what_a_lost_worker_held_is_done_by_another(
    pool: RayPool, folder: Path, monkeypatch: pytest.MonkeyPatch, what: str, kind: type[Call]
) -> None:
    """One that is killed, or that is stopped, as by a host that is cut off, of which Ray says nothing."""
    monkeypatch.setattr(pool, "_silence_s", 2.0)
    asked = (make_task(), make_recipes(512)) if kind is Outcome else (make_collect_task(400),)
    before = set(pool.pids())
    (folder / f"{what}-30").write_text("1")
    call = pool.run(kind(*asked))
    with contextlib.closing(ThreadPool(never_built, 1, Answering)) as threads:
        wanted = threads.run(kind(*asked))
    assert call.results.tobytes() == wanted.results.tobytes()
    if isinstance(call, Collected) and isinstance(wanted, Collected):
        assert to_bytes(call.experience) == to_bytes(wanted.experience)
    (said,) = call.warnings
    reason = KILLED if what == "kill" else r"it did not answer for \d+ s \(--patience\)"
    assert re.fullmatch(f"a worker is replaced: {reason}", said)
    wait_until(lambda: goes_on(pool) and len(pool.pids()) == 2)
    (pid,) = before - set(pool.pids())
    wait_until(lambda: not psutil.pid_exists(pid), 30)
    pids = pool.pids()
    time.sleep(2.5)
    assert pool.run(Outcome(make_task(), make_recipes(512))).warnings == [], "it only had nothing to do"
    assert pool.pids() == pids


def test_three_deaths_over_one_piece_end_the_run_in_one_line(pool: RayPool, folder: Path) -> None:
    (folder / "kill-300").write_text("9")
    line = (
        r"3 workers died over members (\d+) to (\d+) \(first: member \1 \(cross of rows \d and \d, seed \1, key "
        rf"0x3039\)\); the last time {KILLED}"
    )
    with pytest.raises(PoolError) as caught:
        pool.run(Outcome(make_task(), make_recipes(512)))
    found = re.fullmatch(line, str(caught.value))
    assert found, caught.value
    assert int(found[1]) <= 300 <= int(found[2])
    assert (folder / "kill-300").read_text() == "6"
    (folder / "kill-300").unlink()
    assert goes_on(pool)


def test_a_ray_that_is_in_use_is_used_and_left_alone(pool: RayPool) -> None:
    with pytest.raises(PoolError, match=r"leave the address out to use it, or .*\(workers=0\)$"):
        open_pool(1, "127.0.0.1:6379", 0.0, never_built)
    with (
        contextlib.closing(RayPool(1, never_built, patience_s=1.0, worker_factory=Answering)) as other,
        pytest.raises(PoolError, match="Ray has 2 CPUs, 0 of them free"),
    ):
        other.open()
    assert goes_on(pool)


# --- Clusters, which are joined by processes of their own: Ray reads a token once -------------------------------------

JOIN = """
import sys
from test_pool import make_recipes, make_task, never_built, Answering
from cluster.workers.pool import Outcome, PoolError
from cluster.workers.ray_pool import RayPool

pool = RayPool(int(sys.argv[1]), never_built, sys.argv[2], float(sys.argv[3]), Answering)
try:
    pool.open()
    print(pool.workers, pool.run(Outcome(make_task(), make_recipes(8))).done)
except PoolError as error:
    print(error)
pool.close()
"""


def joined(tmp_path: Path, workers: int, address: str, patience_s: float = 100.0, **environment: Any) -> list[str]:
    """What a pool says of an address."""
    done = finish("python", "-c", JOIN, str(workers), address, str(patience_s), cwd=tmp_path, **environment)
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_a_cluster_is_joined_with_its_token_and_all_of_its_free_cpus(cluster: Callable, tmp_path: Path) -> None:
    token: dict[str, Any] = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "ab" * 32}
    at = cluster(3, **token)
    assert joined(tmp_path, 0, at, **token) == ["3 16"]
    assert joined(tmp_path, 2, at, **token) == ["2 16"], "the run before has left"
    assert joined(tmp_path, 2, at) == [
        f"could not join the Ray cluster at {at}: it wants its token: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to "
        "its head's `ray get-auth-token`"
    ]


def test_a_cluster_without_free_cpus_is_waited_for_and_named(cluster: Callable, tmp_path: Path) -> None:
    at = cluster(0)
    wanted = "there has been no worker for 6 s (--patience): Ray has 0 CPUs, 0 of them free, and a worker needs 1"
    assert [joined(tmp_path, workers, at, 6.0) for workers in (0, 2)] == [[wanted], [wanted]]


def test_what_says_nothing_is_no_cluster(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        started, at = time.perf_counter(), f"127.0.0.1:{silent.getsockname()[1]}"
        assert joined(tmp_path, 2, at) == [
            f"could not join the Ray cluster at {at}: what answers there is not a Ray cluster; is that its head's port?"
        ]
        assert time.perf_counter() - started < 30


@pytest.mark.parametrize(
    ("given", "said"),
    [
        *(
            (text, "is not a Ray address; give")
            for text in ("nowhere", "host:99999", ":6379", "ray://u:secret@a:10001")
        ),
        ("127.0.0.1:1", "no Ray cluster answers at 127.0.0.1:1: Connection refused; is `ray start"),
    ],
)
def test_an_address_where_there_is_no_cluster_is_refused_at_once(
    given: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PoolError, match=said) as caught:
        cluster_address(given)
    assert "secret" not in str(caught.value)
    monkeypatch.setenv("RAY_ADDRESS", given)
    for automatic in ("", "auto"):
        with pytest.raises(PoolError, match=rf"{said}.* \(RAY_ADDRESS says so; unset it, or give --address local\)$"):
            cluster_address(automatic)


def test_the_address_of_rays_jobs_is_left_out_and_local_means_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    assert cluster_address("auto") == "auto"
    monkeypatch.setenv("RAY_ADDRESS", "http://u:secret@127.0.0.1:8265")
    with pytest.warns(UserWarning, match=r"^RAY_ADDRESS=http://127.0.0.1:8265 is where Ray takes jobs, so this run"):
        assert cluster_address("") is None
    assert cluster_address("local") is None
    monkeypatch.setenv("RAY_ADDRESS", "local")
    assert [cluster_address(given) for given in ("", "auto")] == [None, None]
