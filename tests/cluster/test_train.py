"""A run's lifecycle: how it ends, what its caller is told, what it leaves; what signals do."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import ClassVar

import pytest
from commands import call, start, wait_until
from learners import Untracked

from cluster import run as module
from cluster import stopping
from cluster.commands.cli import evolve_main
from cluster.learn.learning import Event
from cluster.run import Place, Session, train
from cluster.settings import EvolveSettings
from cluster.store.folder import new_run, open_run, read_config

SETTINGS = EvolveSettings("curved", policy="mlp:4", population=8, generations=2)


class Told(Untracked):
    ends: ClassVar[list[str]] = []
    outages: ClassVar[list[str | None]] = []

    def __init__(self, folder, uri, experiment, read):
        pass

    @property
    def error(self):
        return self.outages.pop(0) if self.outages else None

    def close(self, status):
        self.ends.append(status)
        return "2 rows are not sent" if status == "FAILED" else None


@pytest.fixture(autouse=True)
def told(monkeypatch):
    monkeypatch.setattr(module, "Tracking", Told)
    Told.ends, Told.outages = [], []
    return Told


def saved_generations(folder):
    saved = open_run(folder).saved
    assert saved is not None
    return saved[1]["generation"]


def end(error):
    def finish(session):
        if error:
            raise error

    return finish


@pytest.mark.parametrize(
    ("error", "raised", "status", "said"),
    [
        (None, None, "FINISHED", []),
        (stopping.Stopped, KeyboardInterrupt, "KILLED", ["stopping; a moment ..."]),
        (MemoryError, MemoryError, "FAILED", ["2 rows are not sent"]),
    ],
)
def test_mlflow_and_the_caller_are_told_how_a_run_ended(told, tmp_path, monkeypatch, error, raised, status, said):
    monkeypatch.setattr(Session, "finish", end(error))
    monkeypatch.setattr(module.kernels, "is_compiled", lambda settings: True)
    run = new_run(tmp_path, "r", SETTINGS)
    events: list[Event] = []
    steps: list[int] = []
    with pytest.raises(raised) if raised else nullcontext():
        train(run, Place(), events.append, lambda done, row: steps.append(done))
    assert (told.ends, steps) == ([status], [1, 2])
    assert [event.text for event in events if not event.total] == said
    assert read_config(run.path / "config.json")[0] == SETTINGS
    assert saved_generations(run.path) == 2


def test_an_outage_of_mlflow_is_told_of_once_and_its_end(told, tmp_path, monkeypatch):
    monkeypatch.setattr(Session, "finish", end(None))
    told.outages = [None, "refused", "refused", None, None]
    warnings: list[tuple[int, str]] = []
    steps: list[int] = []
    settings = dataclasses.replace(SETTINGS, generations=5)
    train(
        new_run(tmp_path, "r", settings), Place(),
        lambda event: warnings.append((len(steps), event.text)) if event.warning else None,
        lambda done, row: steps.append(done),
    )  # fmt: skip
    away = "MLflow at http://host cannot be used: refused; the run continues and sends its rows later"
    assert warnings == [(2, away), (4, "MLflow at http://host is back, and has all rows")]


def test_a_limit_of_wall_time_counts_what_was_before(tmp_path, monkeypatch):
    """At least one step is done by each process, so that a run gets on."""
    monkeypatch.setattr(Session, "finish", end(None))
    run = new_run(tmp_path, "r", dataclasses.replace(SETTINGS, generations=50))
    train(run, Place(wall_limit_s=0.01))
    run = open_run(run.path)
    assert saved_generations(run.path) == 1
    seconds = train(run, Place(wall_limit_s=0.01)).wall_s()
    assert saved_generations(run.path) == 1
    session = train(open_run(run.path), Place(wall_limit_s=seconds + 1.0))
    assert 1 < session.learning.steps < 50 or session.wall_s() < seconds + 1.0


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError("no space"), r"no space\ncontinue with: \S+ --resume r"),
        (FloatingPointError("diverged"), r"diverged\nrepeat it with: \S+ --config r/config.json --learning-rate ..."),
    ],
)
def test_a_run_that_fails_exits_with_1_and_says_how_to_go_on(here, monkeypatch, capsys, error, said):
    monkeypatch.setattr(Session, "finish", end(error))
    small = ["--scenario", "curved", "--policy", "mlp:4", "--population", 8, "--generations", 1]
    code, _, err = call(evolve_main, monkeypatch, capsys, *small, "--output", ".", "--name", "r")
    assert code == 1
    assert re.search(f"^gridsim-evolve: error: {said}\n$", err, re.MULTILINE)
    assert "gridsim-evolve: warning: 2 rows are not sent\n" in err


# --- Signals ---------------------------------------------------------------------------------------------------------

LISTEN = """
import sys, time
from cluster import stopping
stopping.listen()
print("begun", flush=True)
while not stopping.requested():
    time.sleep(0.01)
print("asked", flush=True)
time.sleep(float(sys.argv[1]))
stopping.check()
"""


def listening(seconds):
    """A process that listens, and then takes so many seconds to stop."""
    process = subprocess.Popen([sys.executable, "-c", LISTEN, str(seconds)], stdout=-1, stderr=-1, text=True)
    assert process.stdout
    assert process.stdout.readline() == "begun\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_sets_a_flag_and_stops_where_it_is_looked_at(number):
    with listening(0.0) as process:
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    assert out == "asked\n"
    assert err.splitlines()[-1] == "cluster.stopping.Stopped"


def test_a_second_signal_ends_at_once_but_one_that_is_passed_on_does_not():
    """`make` and `uv run` pass on what the terminal sends to all."""
    with listening(60.0) as process:
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "asked\n"
        process.send_signal(signal.SIGTERM)
        time.sleep(stopping.ONE_SIGNAL_S + 0.1)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130


def test_signals_that_the_shell_ignores_stay_ignored(monkeypatch):
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGHUP)}
    try:
        stopping.listen()
        assert [signal.getsignal(number) for number in before] == [signal.SIG_IGN] * 2
        assert signal.getsignal(signal.SIGTERM) is stopping._stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("prog", ["gridsim-evolve", "gridsim-evaluate", "gridsim-compare"])
def test_a_command_is_quiet_if_it_is_stopped_while_its_libraries_load(prog, tmp_path):
    with start(prog, "--help", cwd=tmp_path) as process:
        loaded = Path(f"/proc/{process.pid}/maps")
        wait_until(lambda: process.poll() is not None or "numpy" in loaded.read_text(), 30, 0.005)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (130, "", "")
