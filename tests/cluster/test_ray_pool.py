"""RayPool with real Ray processes: the same bits from any number of workers, and what happens when workers die."""

import contextlib
import functools
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import psutil  # type: ignore[import-untyped]
import pytest
from commands import importable, wait_until
from driving import to_bytes
from test_pool import (
    MAPS,
    Answering,
    Evaluated,
    collect_drive_task,
    drive_task,
    interrupted,
    make_collect_task,
    make_recipes,
    make_task,
    never_built,
)

from cluster.workers.pool import PoolError, SerialPool
from cluster.workers.ray_pool import RayPool
from cluster.workers.ray_session import check_address
from cluster.workers.worker import CollectTask, Task
from evolution.dqn.experience import Experience
from evolution.search.breeding import RECIPE
from gridsim.maps.map import Map

pytestmark = pytest.mark.e2e

NOBODY = 1_000_000  # who has a member's orders when there is none: as workers are prepared
BANNED = ("torch", "mlflow", "pygame", "matplotlib", "tyro", "rich")


class Obeying(Answering):
    """Does what files in a folder tell it to: `kill-7` holds how often the member with seed 7 kills its worker."""

    def __init__(self, folder: Path):
        self._folder = folder

    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        self._obey(recipes["seed"] if len(recipes) else np.array([NOBODY]))
        return super().evaluate(task, maps, recipes)

    def collect(
        self, task: CollectTask, maps: Sequence[Map], first: int, stop: int
    ) -> tuple[Experience, np.ndarray, float]:
        if stop > first:
            with (self._folder / "collected").open("a") as collected:
                collected.write(f"{first} {stop}\n")
        self._obey(task.keys[first:stop])
        return super().collect(task, maps, first, stop)

    def _obey(self, seeds: np.ndarray) -> None:
        for path in sorted(self._folder.glob("*-*")):
            what, seed = path.name.split("-")
            if int(seed) not in seeds:
                continue
            with (self._folder / "calls").open("a") as calls:
                calls.write(f"{path.name}\n")
            if what == "kill":
                times = int(path.read_text())
                mine = self._folder / str(os.getpid())  # another worker may read it just now
                mine.write_text(str(times - 1))
                mine.replace(path)
                if times > 0:
                    os.kill(os.getpid(), signal.SIGKILL)
            elif what == "raise":
                raise ValueError("that member\nis not to be had")
            elif what == "sleep":
                (self._folder / "sleeper").write_text(f"{os.getpid()} ")
                time.sleep(float(path.read_text()))


class Inspecting(Answering):
    """Tells of its process: modules that should not be there, writable inputs, the time that SIGINT is ignored."""

    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        results, rewound, worlds, seconds = super().evaluate(task, maps, recipes)
        arrays = [task.parents, task.episodes, recipes, *(m.road.field for m in maps)]
        results["distance"] = sum(name in sys.modules for name in BANNED)
        results["paced"] = sum(array.flags.writeable or not array.flags.aligned for array in arrays)
        results["end"] = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        results["steps"] = os.environ.get("OMP_NUM_THREADS") == "1"
        return results, rewound, worlds, seconds


class Unfit(Answering):
    def __init__(self) -> None:
        raise RuntimeError("not in this state")


@pytest.fixture(scope="module", autouse=True)
def _stand_ins_can_be_imported() -> Iterator[None]:
    """By the workers too, which know nothing of pytest's search path."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", importable(__file__))
        yield


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
    """One pool for many tests (a start takes seconds), without orders."""
    for path in folder.iterdir():
        path.unlink()
    if not held:
        held.append(RayPool(2, never_built, worker_factory=functools.partial(Obeying, folder)))
    return held[0]


@pytest.fixture
def no_pool(held: list[RayPool]) -> None:
    """For tests that bring their own."""
    while held:
        held.pop().close()


def expected(n: int) -> bytes:
    return SerialPool(never_built, Answering).evaluate(make_task(), make_recipes(n)).results.tobytes()


def gone(processes: list[psutil.Process], within_s: float = 10.0) -> list[psutil.Process]:
    """Those that are still there after that time."""
    _, alive = psutil.wait_procs(processes, timeout=within_s)
    return alive


def test_results_progress_and_what_is_sent(pool: RayPool) -> None:
    told: list[tuple[int, int]] = []
    recipes = make_recipes(512)
    outcome = pool.evaluate(make_task(), recipes, lambda done, of: told.append((done, of)))
    assert outcome.results.tobytes() == expected(512)
    assert told == sorted(told)
    assert told[-1] == (512, 512)
    assert outcome.retries == 0
    assert outcome.bytes_down == 512 * RECIPE.itemsize
    assert outcome.results.nbytes < outcome.bytes_up < outcome.results.nbytes + 600 * len(told)
    assert 8 * 311 * 4 < outcome.broadcast_bytes < 8 * 311 * 4 + 2000
    assert set(outcome.busy_s) <= {0, 1}
    assert len(set(pool.pids())) == pool.workers() <= 2


def test_a_killed_worker_is_replaced_and_its_chunks_are_sent_again(pool: RayPool, folder: Path) -> None:
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


def test_what_a_dead_worker_was_at_runs_elsewhere_at_once(pool: RayPool, folder: Path) -> None:
    pool.evaluate(make_task(), make_recipes(512))
    (folder / "sleep-300").write_text("600")
    died = []

    def kill() -> None:
        wait_until(lambda: (folder / "sleeper").exists() and (folder / "sleeper").read_text().endswith(" "))
        (folder / "sleep-300").unlink()
        died.append(time.perf_counter())
        os.kill(int((folder / "sleeper").read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    outcome = pool.evaluate(make_task(), make_recipes(512))
    seconds = time.perf_counter() - died[0]
    killer.join()
    assert outcome.results.tobytes() == expected(512)
    print(f"after a worker's death its chunk was done elsewhere in {seconds:.3f} s")
    assert seconds < 5.0


def test_a_member_that_kills_twice_is_sent_a_third_time(pool: RayPool, folder: Path) -> None:
    (folder / "kill-300").write_text("2")
    outcome = pool.evaluate(make_task(), make_recipes(512))
    assert outcome.results.tobytes() == expected(512)
    assert outcome.retries >= 2


def test_who_dies_of_a_first_task_before_it_has_a_member_has_died_of_none(pool: RayPool, folder: Path) -> None:
    pool.evaluate(make_task(), make_recipes(512))
    (folder / f"kill-{NOBODY}").write_text("2")
    for pid in pool.pids():
        os.kill(pid, signal.SIGKILL)
    outcome = pool.evaluate(make_task(), make_recipes(512))
    assert (folder / f"kill-{NOBODY}").read_text() <= "0", "both were prepared, and died of it"
    assert outcome.results.tobytes() == expected(512)
    assert outcome.retries <= 4, "of the two that were killed with two chunks each"


def test_a_member_that_always_kills_is_lost_alone(pool: RayPool, folder: Path) -> None:
    (folder / "kill-300").write_text("100")
    told: list[tuple[int, int]] = []
    outcome = pool.evaluate(make_task(), make_recipes(512), lambda done, of: told.append((done, of)))
    assert np.flatnonzero(outcome.lost).tolist() == [300]
    assert not outcome.results[300].view(np.uint8).any(), "it drove nowhere, and did not end"
    others = np.arange(512) != 300
    wanted = SerialPool(never_built, Answering).evaluate(make_task(), make_recipes(512)).results
    assert outcome.results[others].tobytes() == wanted[others].tobytes()
    assert told[-1] == (512, 512)
    (warning,) = outcome.warnings
    assert warning.startswith(
        "member 300 (cross of rows 4 and 4, seed 300, key 0x3039) killed its worker 3 times and is lost; the last time "
        "its process was killed, crashed, or ran out of memory (logs: "
    )
    assert 3 <= 100 - int((folder / "kill-300").read_text()) <= 12, "workers that it cost"
    (folder / "kill-300").unlink()
    assert pool.evaluate(make_task(), make_recipes(512)).results.tobytes() == expected(512), "the pool goes on"


def test_an_episode_that_always_kills_is_left_out(pool: RayPool, folder: Path) -> None:
    (folder / "kill-150").write_text("100")
    collected = pool.collect(make_collect_task(400))
    assert np.flatnonzero(collected.lost).tolist() == [150]
    wanted = SerialPool(never_built, Answering).collect(make_collect_task(400)).experience
    kept = wanted.rewards != 150
    for mine, theirs in zip(collected.experience, wanted, strict=True):
        assert np.array_equal(mine, theirs[kept])
    assert len(collected.warnings) == 1
    assert collected.warnings[0].startswith("episode 150 (key 0x96, exploration 0) killed its worker 3 times")


def test_an_exception_ends_the_run_in_one_line_and_is_not_tried_again(pool: RayPool, folder: Path) -> None:
    (folder / "raise-100").touch()
    with pytest.raises(
        PoolError, match=r"^a worker failed on chunk \d+ \(members \d+ to \d+\): ValueError: is not to be"
    ):
        pool.evaluate(make_task(), make_recipes(512))
    assert (folder / "calls").read_text().splitlines() == ["raise-100"]
    (folder / "raise-100").unlink()
    outcome = pool.evaluate(make_task(), make_recipes(100))
    assert outcome.results.tobytes() == expected(100)
    assert outcome.retries == 0


def test_sigterm_is_seen_while_ray_waits(pool: RayPool, folder: Path) -> None:
    from cluster.commands.common import Stopped, stoppable  # not with the stand-ins above: a worker must not load it

    pool.evaluate(make_task(), make_recipes(4))  # they are up
    (folder / "sleep-100").write_text("3")
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    with pytest.raises(Stopped), stoppable():
        pool.evaluate(make_task(), make_recipes(512))


@pytest.mark.parametrize("times", [0, 1, 2])
def test_experience_keeps_its_order_and_a_killed_worker_costs_its_chunk_alone(
    pool: RayPool, folder: Path, times: int
) -> None:
    told: list[tuple[int, int]] = []
    task = make_collect_task(400)
    wanted = SerialPool(never_built, Answering).collect(task)
    pool.collect(task)  # both have been up by now, and know how long it takes
    (folder / "collected").unlink()
    (folder / "kill-150").write_text(str(times))
    collected = pool.collect(task, lambda done, of: told.append((done, of)))
    assert to_bytes(collected.experience) == to_bytes(wanted.experience)
    assert collected.results.tobytes() == wanted.results.tobytes()
    assert told == sorted(told)
    assert told[-1] == (400, 400)
    assert len(told) >= 8, "several a worker"
    begun = [tuple(map(int, line.split())) for line in (folder / "collected").read_text().splitlines()]
    again = Counter(begun)
    repeated = sum(again.values()) - len(again)
    lost = [(first, stop) for first, stop in again if first <= 150 < stop]
    assert sum(again[chunk] for chunk in lost) == times + 1
    # The third time in pieces, unless one of the deaths was put down to the chunk before it (see below).
    assert len(lost) in ((1,) if times < 2 else (1, 2))
    # The answer to the chunk before it may have been on its way when the worker died; nothing is sent with a suspect.
    assert repeated <= times + min(times, 1), "what else was sent to the worker had not been begun"
    assert times <= collected.retries <= 2 * times
    sent = 12 * 400 + len(to_bytes(wanted.experience))
    assert sent < collected.bytes_up < sent + 1000 * len(told)


def test_an_exception_while_collecting_names_the_episodes(pool: RayPool, folder: Path) -> None:
    (folder / "raise-100").touch()
    with pytest.raises(PoolError, match=r"^a worker failed on chunk \d+ \(episodes \d+ to \d+\): ValueError: is not"):
        pool.collect(make_collect_task(400))


def test_something_is_done_again_and_again_while_workers_are_busy(pool: RayPool, folder: Path) -> None:
    """Answers are taken in between; all of it is done when the call returns, and what it raises comes out."""
    until = time.perf_counter() + 30
    while pool.workers() < 2 and time.perf_counter() < until:
        pool.evaluate(make_task(), make_recipes(8))
    (folder / "sleep-0").write_text("0.5")  # in the first chunk
    wanted = to_bytes(SerialPool(never_built, Answering).collect(make_collect_task(400)).experience)
    for calls in (20, 200):
        steps: list[float] = []
        done_by_then: list[int] = []
        done = [0]

        def learn() -> bool:
            time.sleep(0.005)
            steps.append(time.perf_counter())  # noqa: B023
            done_by_then.append(done[0])  # noqa: B023
            return len(steps) < calls  # noqa: B023

        def tell(part: int, _: int) -> None:
            done[0] = part  # noqa: B023

        collected = pool.collect(make_collect_task(400), tell, learn)
        assert to_bytes(collected.experience) == wanted
        assert len(steps) == calls
        assert 0 < done_by_then[19] < 400, "the other worker's answers, not the sleeping one's"
        if calls == 200:
            assert done_by_then[-1] == 400
    outcome = pool.evaluate(make_task(), make_recipes(512), meanwhile=lambda: steps.append(0.0))
    assert outcome.results.tobytes() == expected(512)
    assert len(steps) == 201, "who returns None is called once"
    with pytest.raises(KeyboardInterrupt):
        pool.collect(make_collect_task(400), meanwhile=interrupted)
    assert to_bytes(pool.collect(make_collect_task(400)).experience) == wanted, "the pool goes on"


def test_only_one_pool_at_a_time(pool: RayPool) -> None:
    pool.evaluate(make_task(), make_recipes(4))
    second = RayPool(1, never_built, worker_factory=Answering)
    with pytest.raises(PoolError, match="in use in this process already"):
        second.evaluate(make_task(), make_recipes(4))
    second.close()
    assert pool.evaluate(make_task(), make_recipes(9)).results.tobytes() == expected(9)


@pytest.mark.usefixtures("no_pool")
def test_any_number_of_workers_gives_the_serial_pools_bits() -> None:
    """With the real worker on real maps, one of four killed on the way; and what its process holds."""
    task, scenarios = drive_task()
    recipes = make_recipes(200)
    known = dict(zip(MAPS, scenarios, strict=True))
    serial = SerialPool(lambda *name: known[name]).evaluate(task, recipes).results.tobytes()
    collect_task, _ = collect_drive_task(100)
    alone = SerialPool(lambda *name: known[name]).collect(collect_task)
    for workers in (1, 2, 4):
        pool = RayPool(workers, lambda *name: known[name])
        try:
            first = pool.evaluate(task, recipes)
            assert first.results.tobytes() == serial
            assert first.broadcast_bytes > sum(array.nbytes for s in scenarios for array in s.arrays().values())
            if workers == 4:
                os.kill(pool.pids()[0], signal.SIGKILL)
            again = pool.evaluate(task, recipes)
            assert again.results.tobytes() == serial
            assert again.broadcast_bytes < task.parents.nbytes + 2000, "maps are sent once"
            pids = pool.pids()
            killer = threading.Timer(0.001, lambda: os.kill(pids[-1], signal.SIGKILL))  # noqa: B023
            killer.start()
            for _ in range(2):
                collected = pool.collect(collect_task)
                assert to_bytes(collected.experience) == to_bytes(alone.experience)
                assert collected.results.tobytes() == alone.results.tobytes()
            killer.join()
            for pid in pool.pids():
                assert psutil.Process(pid).memory_full_info().uss <= 220 << 20
        finally:
            processes = psutil.Process().children(recursive=True)
            pool.close()
        assert gone(processes) == []


@pytest.mark.usefixtures("no_pool")
def test_what_a_worker_is_given_and_what_it_has_loaded() -> None:
    task, scenarios = drive_task()
    known = dict(zip(MAPS, scenarios, strict=True))
    with contextlib.closing(RayPool(1, lambda *name: known[name], worker_factory=Inspecting)) as pool:
        results = pool.evaluate(task, make_recipes(50)).results
    assert (results["distance"] == 0).all(), f"a worker carries one of {BANNED}"
    assert (results["paced"] == 0).all(), "an input is writable or not aligned"
    assert (results["end"] == 1).all(), "Ctrl-C would reach a worker"
    assert (results["steps"] == 1).all(), "a worker has more than one thread"


@pytest.mark.usefixtures("no_pool")
def test_workers_that_cannot_start_are_given_up() -> None:
    pool = RayPool(2, never_built, worker_factory=Unfit, patience_s=300.0)
    with (
        contextlib.closing(pool),
        pytest.raises(PoolError, match=r"^no worker can be started: .*RuntimeError: not in this state"),
    ):
        pool.evaluate(make_task(), make_recipes(20))


@pytest.mark.usefixtures("no_pool")
def test_a_cluster_is_joined_with_what_it_has_and_left_as_it_was(
    cluster: Callable[..., tuple[str, subprocess.Popen]], monkeypatch: pytest.MonkeyPatch
) -> None:
    address, _ = cluster(2, PYTHONPATH=importable(__file__))
    for name in (address, "auto"):
        monkeypatch.setenv("RAY_ADDRESS", address)
        with contextlib.closing(RayPool(4, never_built, name, worker_factory=Answering)) as pool:
            assert pool.address == address
            outcome = pool.evaluate(make_task(), make_recipes(512))
            assert outcome.results.tobytes() == expected(512)
            while pool.workers() < 2:
                assert pool.evaluate(make_task(), make_recipes(512)).results.tobytes() == expected(512)
            processes = [psutil.Process(pid) for pid in pool.pids()]
            assert len(processes) == 2, "there are two CPUs"
        assert gone(processes) == []
        check_address(address)


@pytest.mark.usefixtures("no_pool")
def test_a_cluster_is_told_how_a_run_is_doing(
    cluster: Callable[..., tuple[str, subprocess.Popen]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What Prometheus reads from its node, under the run's name. What tells it there comes with ray[default]."""
    pytest.importorskip("prometheus_client")
    quick = {"RAY_metrics_report_interval_ms": "500"}
    for name, value in quick.items():
        monkeypatch.setenv(name, value)
    address, _ = cluster(2, PYTHONPATH=importable(__file__), **quick)
    with contextlib.closing(RayPool(1, never_built, address, worker_factory=Stepping, run="a run")) as pool:
        pool.evaluate(make_task(), make_recipes(512))
        os.kill(pool.pids()[0], signal.SIGKILL)
        pool.evaluate(make_task(), make_recipes(512))
        import ray

        (node,) = ray.nodes()
        page = f"http://{node['NodeManagerAddress']}:{node['MetricsExportPort']}/metrics"

        def told() -> dict[str, float]:
            time.sleep(0.2)
            pool.evaluate(make_task(), make_recipes(0))
            with contextlib.suppress(OSError), urllib.request.urlopen(page, timeout=10) as answer:
                lines = [line for line in answer.read().decode().splitlines() if 'run="a run"' in line]
                return {line.split("{")[0]: float(line.rsplit(" ", 1)[1]) for line in lines}
            return {}

        names = {"ray_gridsim_car_steps_total", "ray_gridsim_retries_total", "ray_gridsim_queue", "ray_gridsim_workers"}
        until = time.monotonic() + 60
        while not names <= set(found := told()) and time.monotonic() < until:
            pass
    assert names <= set(found), found
    assert found["ray_gridsim_car_steps_total"] == 2 * 512 * 2 * 3
    assert found["ray_gridsim_retries_total"] >= 1
    assert "ray_gridsim_lost_chunks_total" not in found


class Stepping(Answering):
    """Three steps an episode."""

    def evaluate(self, task: Task, maps: Sequence[Map], recipes: np.ndarray) -> Evaluated:
        results, rewound, worlds, seconds = super().evaluate(task, maps, recipes)
        results["steps"] = 3
        return results, rewound, worlds, seconds


def test_a_cluster_that_wants_a_token(
    cluster: Callable[..., tuple[str, subprocess.Popen]], monkeypatch: pytest.MonkeyPatch
) -> None:
    address, _ = cluster(2, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN="0123456789abcdef" * 4)
    with pytest.raises(
        PoolError, match=rf"^the Ray cluster at {address} wants its token: set RAY_AUTH_MODE=token, and"
    ):
        check_address(address)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")  # somebody's; Ray will tell
    assert check_address(address) == address


@pytest.mark.parametrize("workers", [0, -1])
def test_a_pool_needs_workers(workers: int) -> None:
    with pytest.raises(ValueError, match="1 worker or more"):
        RayPool(workers, never_built)
