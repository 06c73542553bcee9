"""A Ray of our own on this machine: what it touches, what its workers import, and what a run does without it."""

import contextlib
import functools
import os
import re
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil  # type: ignore[import-untyped]
import pytest
import tracked
from commands import BIN, command_line, descendants, finish, rows, running, same_run, wait_until
from test_pool import Answering, drive_task, make_recipes, never_built

from cluster.workers import ray_pool
from cluster.workers.open import open_pool
from cluster.workers.pool import Outcome, PoolError
from cluster.workers.ray_pool import RayPool
from cluster.workers.ray_session import OWN_ENVIRONMENT
from cluster.workers.worker import Worker

SMALL = ["--scenario", "curved", "--traffic", "2", "--population", "48", "--generations", "20", "--seed", "5"]
REFERENCE = ("gridsim-evolve", *SMALL)
ON_LOOPBACK = {"127.0.0.1", "::1", "::ffff:127.0.0.1"}


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for Ray, with a path that is short enough for its sockets."""
    with tempfile.TemporaryDirectory(prefix="t-", dir="/tmp") as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)
        yield Path(folder)


class Inspecting(Worker):
    """Fails where something is wrong with its process or its inputs."""

    def evaluate(self, task, maps, recipes):
        for array in (task.parents, task.episodes, recipes, *(each.road.field for each in maps)):
            assert array.flags.aligned
        assert not any(each.road.field.flags.writeable for each in maps), "they are copies"
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN, "Ctrl-C would reach a worker"
        assert os.environ.get("OMP_NUM_THREADS") == "1", "a worker has more than one thread"
        assert os.nice(0) == 0, "busy programs would starve it"
        assert psutil.Process().memory_full_info().uss <= 220 << 20
        return super().evaluate(task, maps, recipes)


@pytest.mark.e2e
@pytest.mark.usefixtures("stand_ins")
def test_it_is_private_on_loopback_has_workers_as_they_should_be_and_leaves_nothing_behind(short: Path) -> None:
    before, ((task, maps), recipes) = dict(os.environ), (drive_task(), make_recipes(200))
    with contextlib.closing(RayPool(2, lambda _, seed: maps[seed], worker_factory=Inspecting)) as pool:
        pool.open()
        driven = pool.run(Outcome(task, recipes))
        assert driven.results.tobytes() == Worker().evaluate(task, maps, recipes)[0].tobytes()
        (own,) = short.iterdir()
        assert own.stat().st_mode & 0o777 == 0o700
        processes = psutil.Process().children(recursive=True)
        ours = [psutil.Process(), *processes]
        listening = [each for process in ours for each in process.net_connections("tcp") if each.status == "LISTEN"]
        assert listening
        assert {each.laddr.ip for each in listening} <= ON_LOOPBACK
        assert os.environ == before, "other programs would use the token"
        commands = " ".join(command_line(process.pid) for process in ours)
        assert OWN_ENVIRONMENT["RAY_AUTH_TOKEN"] not in commands
    assert psutil.wait_procs(processes, timeout=10.0)[1] == [], "some are still there"
    assert list(short.iterdir()) == []


@pytest.mark.e2e
@pytest.mark.usefixtures("stand_ins")
def test_workers_that_cannot_start_end_the_run_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_pool, "MAX_DEATHS", 3)
    factory = functools.partial(Answering, "too much")  # type: ignore[call-arg]
    with (
        contextlib.closing(RayPool(1, never_built, worker_factory=factory)) as pool,
        pytest.raises(
            PoolError, match=r"^workers keep dying \(4 in a row\); the last time .*TypeError: .* arguments?$"
        ),
    ):
        pool.open()


STUBBORN = """
import time
from cluster.workers import child

child.GRACE_S = 1
child.Child(["sh", "-c", "trap '' TERM; while :; do sleep 1; done"])
print(flush=True)
time.sleep(600)
"""


def test_what_does_not_end_by_itself_is_killed_if_the_coordinator_is(tmp_path: Path) -> None:
    """Ray's head does not, if it waits for its own processes that have ended."""
    (tmp_path / "own.py").write_text(STUBBORN)
    with running("python", "own.py", cwd=tmp_path) as process:
        process.stdout.readline()
        wait_until(lambda: len(psutil.Process(process.pid).children(recursive=True)) == 3)
        ours = psutil.Process(process.pid).children(recursive=True)
        process.kill()
    assert psutil.wait_procs(ours, timeout=10.0)[1] == [], "some are still there"


SCRIPT = """
import time
from test_pool import Answering, make_recipes, make_task, never_built
from cluster.workers.pool import Outcome
from cluster.workers.ray_pool import RayPool

pool = RayPool(1, never_built, worker_factory=Answering)
pool.open()
print(pool.run(Outcome(make_task(), make_recipes(8))).done, flush=True)
time.sleep(600)
"""


@pytest.mark.e2e
@pytest.mark.usefixtures("stand_ins")
def test_workers_import_what_the_coordinator_imported_and_end_with_it_when_it_is_killed(
    short: Path, tmp_path: Path
) -> None:
    (tmp_path / "script").mkdir()
    (tmp_path / "script/evaluate.py").write_text(SCRIPT)
    for name in ("cluster", "evolution", "gridsim"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a file of the user')")
    folder = tmp_path / ("long" * 25)  # as Slurm makes one for each job, too long for Ray's sockets
    folder.mkdir()
    with running("python", "script/evaluate.py", cwd=tmp_path, TMPDIR=str(folder)) as process:
        assert process.stdout.readline() == "16\n"
        ours = psutil.Process(process.pid).children(recursive=True)
        assert len(ours) > 4
        process.kill()
    assert psutil.wait_procs(ours, timeout=30.0)[1] == [], "some are still there"


@pytest.mark.parametrize(("folder", "why"), [("long" * 25, "cannot exceed 107 bytes"), ("none", "No such file")])
def test_a_folder_that_ray_cannot_use_is_named_with_the_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, why: str
) -> None:
    if folder != "none":
        (tmp_path / folder).mkdir()
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path / folder))
    with pytest.raises(PoolError, match=rf"^Ray cannot be started: .*{why}.*; set RAY_TMPDIR to a folder with room"):
        open_pool(1, None, 0.0, never_built)
    assert list(tmp_path.glob("*/gs-*")) == []


@pytest.mark.e2e
def test_a_ray_that_was_imported_too_early_for_a_token_is_refused(tmp_path: Path) -> None:
    text = "import ray; from cluster.workers.open import open_pool; open_pool(1, None, 0.0, None)"
    done = finish("python", "-c", text, cwd=tmp_path, code=1)
    assert done.stderr.splitlines()[-1].endswith(
        "Ray was imported before it could be given a token: open the pool before that, or evaluate in this process "
        "(workers=0)"
    )


# --- Whole commands ---------------------------------------------------------------------------------------------------


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_a_run_that_has_lost_its_ray_ends_in_one_line_and_can_be_resumed(reference: Path, tmp_path: Path) -> None:
    run, command = tmp_path / "runs/r", ["gridsim-evolve", *SMALL, "--name", "r", "--resume-if-exists", "--workers"]
    for lost in ("raylet", "gcs_server"):
        done = len(rows(run))
        with running(*command, "1", cwd=tmp_path) as process:
            wait_until(lambda done=done: len(rows(run)) > done or process.poll() is not None)
            process.send_signal(signal.SIGSTOP)  # or it may be done before its Ray is killed
            (victim,) = [pid for pid in descendants(process.pid) if f"/{lost}" in command_line(pid).partition(" ")[0]]
            psutil.Process(victim).kill()
            process.send_signal(signal.SIGCONT)
            _, err = process.communicate(timeout=60)
        assert process.returncode == 1
        said, hint = err.splitlines()
        line = r"gridsim-evolve: error: a process of Ray's on this machine was killed or has crashed \(logs: (.*)\)"
        found = re.fullmatch(line, said)
        assert found, said
        assert Path(found[1]).is_dir(), "they are kept"
        assert hint == f"continue with: {BIN}/gridsim-evolve --resume runs/r"
        (logged,) = (each.info for each in tracked.runs(f"sqlite:///{tmp_path}/mlflow.db") if each.info.run_name == "r")
        assert logged.status == "FAILED"
    finish(*command, "0", cwd=tmp_path)
    assert same_run(run, reference)


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_memory_that_is_full_ends_a_run_in_one_line(tmp_path: Path) -> None:
    """Ray ends every worker at once, as where another program has filled the memory."""
    full = {"RAY_memory_usage_threshold": "0.001", "RAY_memory_monitor_refresh_ms": "100"}
    done = finish("gridsim-evolve", *SMALL, "--workers", "1", "--name", "r", cwd=tmp_path, code=1, **full)
    (error,) = [line for line in done.stderr.splitlines() if "error: " in line]
    assert error.endswith("memory is full where it ran; close other programs there, or give fewer --workers")
