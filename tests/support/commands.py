"""What tests of whole commands share: the installed scripts, run as a user runs them, and their workers."""

import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from importlib.metadata import requires
from pathlib import Path
from subprocess import PIPE

import psutil  # type: ignore[import-untyped]
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

BIN = Path(sys.executable).parent
CHAMPION = Path(__file__).parents[2] / "benchmarks/champion.npz"
PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
# Of a user who has not activated .venv, so that commands print their whole path.
PATH = os.pathsep.join(name for name in os.get_exec_path() if Path(name).resolve() != BIN.resolve())


def requirements(extra=""):
    """What the project and one of its extras ask for."""
    asked = map(Requirement, requires(PROJECT["project"]["name"]) or ())
    return [item for item in asked if item.marker is None or item.marker.evaluate({"extra": extra})]


def needed(names):
    """These distributions, and all that pip installs with them."""
    found, waiting = set(), list(names)
    while waiting:
        if (name := canonicalize_name(waiting.pop())) not in found:
            found.add(name)
            items = map(Requirement, requires(name) or ())
            waiting += [item.name for item in items if item.marker is None or item.marker.evaluate({"extra": ""})]
    return found


def start(program, *flags, cwd, **env):
    command, env = [str(BIN / program), *flags], {**os.environ, "PATH": PATH, **env}
    return subprocess.Popen(command, cwd=cwd, env=env, stdout=PIPE, stderr=PIPE, text=True, start_new_session=True)


@contextlib.contextmanager
def running(*arguments, cwd, **env):
    """A command, started; nothing of it is left in the end."""
    with start(*arguments, cwd=cwd, **env) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def finish(*arguments, cwd, timeout=240, code=0, **env):
    """A command, run to its end, which has to be with that exit code."""
    with running(*arguments, cwd=cwd, **env) as process:
        out, err = process.communicate(timeout=timeout)
    assert process.returncode == code, f"{process.args} ended with {process.returncode}:\n{out}\n{err}"
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def call(main, monkeypatch, capsys, *arguments):
    """A command's function (`evolve_main`) in this process: (exit code, what it prints, its errors)."""
    monkeypatch.setattr(sys, "argv", [main.args[0], *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, *capsys.readouterr()


def refused(main, monkeypatch, capsys, *arguments):
    """The one line or two that a command says where it refuses to begin."""
    code, out, err = call(main, monkeypatch, capsys, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith(f"{main.args[0]}: error: ")
    lines = err.splitlines()
    assert len(lines) <= 2
    return lines


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def rows(folder):
    """Of a run's history.csv; none before it is there."""
    if not (folder / "history.csv").exists():
        return []
    with (folder / "history.csv").open() as file:
        return list(csv.DictReader(file))


def all_in_mlflow(run, names=("fitness/best", "distance_m/mean", "car_steps", "wall_s"), unit="generations"):
    """Whether MLflow, in the database beside the run's folder's folder, has all of it once, and that it is finished."""
    from mlflow.tracking import MlflowClient

    ended = summary(run)
    client = MlflowClient(tracking_uri=f"sqlite:///{run.parent.parent}/mlflow.db")
    for name in names:
        steps = [metric.step for metric in client.get_metric_history(ended["mlflow_run_id"], name)]
        assert sorted(steps) == list(range(ended[unit])), f"{name}: lost or doubled"
    return client.get_run(ended["mlflow_run_id"]).info.status == "FINISHED"


def same_run(run, reference):
    """Whether two runs of evolution came to the same by the same way, and MLflow has all of the first once."""
    mine, theirs = summary(run), summary(reference)
    assert mine["champion_sha256"] == theirs["champion_sha256"]
    assert mine["car_steps"] == theirs["car_steps"]
    assert (run / "elites.npz").read_bytes() == (reference / "elites.npz").read_bytes()
    assert len(rows(run)) == theirs["generations"]
    for row, other in zip(rows(run), rows(reference), strict=True):
        for name in ("fitness/best", "fitness/mean", "distance_m/mean", "car_steps", "leader/success_rate"):
            assert row[name] == other[name]
    return all_in_mlflow(run)


def descendants(pid):
    with contextlib.suppress(psutil.NoSuchProcess):
        return [child.pid for child in psutil.Process(pid).children(recursive=True)]
    return []


def command_line(pid):
    """Of a process; empty where it is gone."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return " ".join(psutil.Process(pid).cmdline())
    return ""


def ray_workers(pid):
    return [child for child in descendants(pid) if command_line(child).startswith("ray::Actor")]


def wait_until(condition, timeout=120.0, pause=0.02):
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(pause)
    raise AssertionError("it did not happen in time")


def answers(address: str) -> bool:
    """Whether a Ray cluster is there, if only to say that it wants its token."""
    from cluster.workers.address import check_address
    from cluster.workers.pool import PoolError

    try:
        return bool(check_address(address))
    except PoolError as error:
        return "wants its token" in str(error)


def end(node: subprocess.Popen) -> None:
    """Kill a host: all of its processes, at once."""
    for pid in descendants(node.pid):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    node.kill()
    node.wait()
