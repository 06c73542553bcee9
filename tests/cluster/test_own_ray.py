"""A Ray of our own on this machine: what it touches, what its workers import, and what a run does without it."""

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]
import pytest
import ray  # before a Ray of our own is started, as in a notebook that uses Ray itself
import tracked
from commands import (
    BIN,
    command_line,
    descendants,
    finish,
    ray_workers,
    refused,
    rows,
    running,
    same_run,
    wait_until,
)
from test_pool import Answering, make_recipes, make_task, never_built

from cluster.commands.cli import evolve_main
from cluster.commands.compare import compare_main
from cluster.workers import ray_session
from cluster.workers.pool import PoolError
from cluster.workers.ray_pool import RayPool

TINY = ["--scenario", "curved", "--population", "16", "--generations", "2"]
SMALL = ["--scenario", "curved", "--traffic", "2", "--population", "48", "--generations", "40", "--seed", "5"]
REFERENCE = ("gridsim-evolve", *SMALL)
ON_LOOPBACK = {"127.0.0.1", "::1", "::ffff:127.0.0.1"}


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder with a path that is short enough for Ray's sockets."""
    with tempfile.TemporaryDirectory(prefix="t-", dir="/tmp") as folder:
        yield Path(folder)


@pytest.mark.e2e
@pytest.mark.usefixtures("stand_ins")
def test_it_is_private_on_loopback_and_removes_nothing_of_others(short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = short / "ray/session_of_another_user"
    others.mkdir(parents=True)
    os.mkfifo(others / "tickets")
    (others / "logs").mkdir()
    monkeypatch.setenv("RAY_TMPDIR", str(short))
    with contextlib.closing(RayPool(1, never_built, worker_factory=Answering)) as pool:
        pool.evaluate(make_task(), make_recipes(8))
        (own,) = set(short.iterdir()) - {short / "ray"}
        assert own.stat().st_mode & 0o777 == 0o700
        ours = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [each for process in ours for each in process.net_connections("tcp") if each.status == "LISTEN"]
        assert listening
        assert {each.laddr.ip for each in listening} <= ON_LOOPBACK
        assert [psutil.Process(pid).nice() for pid in pool.pids()] == [os.nice(0)], "busy programs would starve it"
    assert [path.name for path in short.iterdir()] == ["ray"]
    assert sorted(path.name for path in others.iterdir()) == ["logs", "tickets"]


IN_THE_WAY = """
import contextlib
from test_pool import Answering, make_recipes, make_task, never_built
from cluster.workers.ray_pool import RayPool

with contextlib.closing(RayPool(1, never_built, worker_factory=Answering)) as pool:
    print(pool.evaluate(make_task(), make_recipes(8)).done)
"""


@pytest.mark.e2e
@pytest.mark.usefixtures("stand_ins")
def test_workers_import_what_the_coordinator_imported(tmp_path: Path) -> None:
    (tmp_path / "script").mkdir()
    (tmp_path / "script/evaluate.py").write_text(IN_THE_WAY)
    for name in ("cluster", "evolution", "gridsim"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a file of the user')")
    assert finish("python", "script/evaluate.py", cwd=tmp_path).stdout == "16\n"


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_a_long_temporary_folder_is_no_matter(tmp_path: Path) -> None:
    """As Slurm makes one for each job. Unix sockets need paths of 107 bytes at most."""
    folder = tmp_path / ("long" * 25)
    folder.mkdir()
    finish("gridsim-evolve", *TINY, "--workers", "1", "--name", "r", cwd=tmp_path, TMPDIR=str(folder))
    assert list(folder.glob("gs-*")) == []


@pytest.mark.parametrize(("folder", "why"), [("long" * 25, "is too long for its sockets"), ("none", "No such file")])
def test_a_folder_that_ray_cannot_use_is_named_with_the_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, why: str
) -> None:
    if folder != "none":
        (tmp_path / folder).mkdir()
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path / folder))
    with pytest.raises(PoolError, match=rf"^Ray cannot be started: .*{folder}.*{why}.*; set RAY_TMPDIR to a folder "):
        ray_session.own_folder()
    assert list(tmp_path.glob("*/gs-*")) == []


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
@pytest.mark.parametrize("lost", ["raylet", "gcs_server"])
def test_a_run_that_has_lost_its_ray_ends_in_one_line_and_can_be_resumed(
    lost: str, reference: Path, tmp_path: Path
) -> None:
    run = tmp_path / "runs/r"
    with running("gridsim-evolve", *SMALL, "--workers", "1", "--name", "r", cwd=tmp_path) as process:
        wait_until(lambda: (rows(run) and ray_workers(process.pid)) or process.poll() is not None)
        wait_until(lambda: len(rows(run)) > 2 or process.poll() is not None)
        (victim,) = [pid for pid in descendants(process.pid) if f"/{lost}" in command_line(pid).partition(" ")[0]]
        psutil.Process(victim).kill()
        _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    said, hint = err.splitlines()
    assert said.startswith(f"gridsim-evolve: error: Ray's {lost} on this machine was killed or has crashed (logs: ")
    assert hint == f"continue with: {BIN}/gridsim-evolve --resume runs/r"
    (logged,) = (each.info for each in tracked.runs(f"sqlite:///{tmp_path}/mlflow.db") if each.info.run_name == "r")
    assert logged.status == "FAILED"
    finish("gridsim-evolve", "--workers", "0", "--resume", "runs/r", cwd=tmp_path)
    assert same_run(run, reference)


@pytest.mark.e2e
@pytest.mark.skipif(os.getuid() != 0, reason="makes a network of its own")
@pytest.mark.usefixtures("database")
def test_a_network_that_goes_away_is_no_matter(tmp_path: Path) -> None:
    network = ["set lo up", "add eth7 type veth peer name eth8", "set eth7 up", "set eth8 up"]
    script = "; ".join([*(f"ip link {words}" for words in network), "ip addr add 10.9.8.7/24 dev eth7"])
    script += '; ip route add default dev eth7; exec "$0" "$@"'
    command = [
        f"{BIN}/gridsim-evolve",
        *SMALL[:-4],
        "--car-steps",
        "1e9",
        "--until",
        "1",
        "--workers",
        "1",
        "--name",
        "r",
    ]
    with running("/usr/bin/unshare", "-n", "/bin/sh", "-e", "-c", script, *command, cwd=tmp_path) as process:
        wait_until(lambda: ray_workers(process.pid) and rows(tmp_path / "runs/r"))
        subprocess.run(["nsenter", "-t", str(process.pid), "-n", "ip", "link", "del", "eth7"], check=True)
        time.sleep(10)
        done = len(rows(tmp_path / "runs/r"))
        wait_until(lambda: len(rows(tmp_path / "runs/r")) > done, 30)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_memory_that_is_full_costs_no_member_and_is_said_once(reference: Path, tmp_path: Path) -> None:
    """Ray ends every worker at once, as where another program has filled the memory."""
    full = {"RAY_memory_usage_threshold": "0.001", "RAY_memory_monitor_refresh_ms": "100"}
    done = finish("gridsim-evolve", *SMALL, "--workers", "1", "--name", "r", cwd=tmp_path, **full)
    (said,) = [line for line in done.stderr.splitlines() if "memory is full" in line]
    assert "so Ray ends workers" in said
    assert "give fewer --workers" in said
    assert same_run(tmp_path / "runs/r", reference)


def test_a_ray_that_is_in_use_in_this_process_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "is_initialized", lambda: True)
    with (
        contextlib.closing(RayPool(1, never_built, worker_factory=Answering)) as pool,
        pytest.raises(PoolError, match=r"call ray\.shutdown\(\) first, or evaluate in this process \(workers=0\)$"),
    ):
        pool.evaluate(make_task(), make_recipes(8))


# --- RAY_ADDRESS, as Ray's guide sets it ------------------------------------------------------------------------------


@pytest.mark.parametrize("main", [evolve_main, compare_main])
@pytest.mark.parametrize("address", ["ray://u:secret@127.0.0.1:10001", "127.0.0.1:1"])
def test_an_address_from_the_environment_is_refused_with_the_variables_name(
    main: Any, address: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RAY_ADDRESS", address)
    (line,) = refused(main, monkeypatch, capsys, "--workers", "1")
    assert line.endswith(" (RAY_ADDRESS says so; unset it, or give --address local)")
    assert address.rpartition("@")[2] in line
    assert "secret" not in line


def test_the_address_of_rays_jobs_is_left_out_and_local_means_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "http://u:secret@127.0.0.1:8265")
    with pytest.warns(UserWarning, match=r"^RAY_ADDRESS=http://127.0.0.1:8265 is where Ray takes jobs, so this run"):
        assert ray_session.cluster_address("") is None
    assert ray_session.cluster_address("local") is None
    monkeypatch.setenv("RAY_ADDRESS", "local")
    assert ray_session.cluster_address("") is None
    assert ray_session.cluster_address("auto") is None
