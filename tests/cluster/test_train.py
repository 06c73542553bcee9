"""A run's lifecycle: how it ends in MLflow, and what its caller is shown."""

import dataclasses
import re
from contextlib import nullcontext
from unittest.mock import Mock, PropertyMock

import pytest
from commands import call, rows
from tracked import client, free_port, steps

from cluster import run as train
from cluster.commands.cli import evolve_main
from cluster.settings import EvolveSettings
from cluster.store.folder import new_run, open_run, read_config

SETTINGS = EvolveSettings("curved", policy="mlp:4", population=8, generations=2)


class Notes(train.Reporter):
    def __init__(self):
        self.seen, self.told, self.resume = [], [], "again"

    def warn(self, text):
        self.told.append((len(self.seen), text))

    def row(self, steps, row):
        self.seen.append(steps)

    def stopping(self):
        self.seen.append("stopping")


INTERRUPTED_RAY = SystemError()
INTERRUPTED_RAY.__cause__ = KeyboardInterrupt()


def end(error):
    def finish(session, workers):
        if error:
            raise error

    return finish


@pytest.mark.parametrize(
    ("error", "raised", "status", "shown"),
    [
        (None, None, "FINISHED", []),
        (KeyboardInterrupt, KeyboardInterrupt, "KILLED", ["stopping"]),
        (INTERRUPTED_RAY, KeyboardInterrupt, "KILLED", ["stopping"]),
        (MemoryError, MemoryError, "FAILED", []),
    ],
)
def test_mlflow_is_told_how_a_run_ended(uri, tmp_path, monkeypatch, error, raised, status, shown):
    monkeypatch.setattr(train.Session, "finish", end(error))
    run, notes = new_run(tmp_path, "r", SETTINGS), Notes()
    with pytest.raises(raised) if raised else nullcontext():
        train.train(run, train.Workers(0, None, 0.0), uri, "driving", notes)
    assert notes.seen == [1, 2, *shown]
    assert read_config(run.path / "config.json")[0] == SETTINGS
    (found,) = client(uri).search_runs([client(uri).get_experiment_by_name("driving").experiment_id])
    assert found.info.status == status
    took_s = (found.info.end_time - found.info.start_time) / 1000.0
    assert took_s == pytest.approx(float(rows(run.path)[-1]["wall_s"]), abs=0.01)
    assert steps(uri, found.info.run_id, ["leader/success_rate"]) == [0, 1]
    assert open_run(run.path).tracking_key == found.data.tags["gridsim.key"]


def test_mlflow_gets_the_files_of_the_run_and_none_of_the_users(tmp_path):
    run = new_run(tmp_path, "r", SETTINGS)
    sent: list[str] = []
    run.path.mkdir()
    for name in ("config.json", "summary.json", "curves.png", "passwords.txt", "notes.md"):
        (run.path / name).touch()
    tracker = Mock(log_files=lambda paths: sent.extend(path.name for path in paths))
    end = {"held_out": {}, "wall_s": 3.0, "validation_success_rate": 0.5, "mlflow_run_id": "x"}
    train.log_end(tracker, run, 0, end, "a note")
    assert sent == ["config.json", "curves.png", "summary.json"]


def test_the_last_candidates_validation_is_a_step_after_the_last(uri, tmp_path):
    run, names = new_run(tmp_path, "r", SETTINGS), ["validation/success_rate"]
    run.path.mkdir()
    tracker = train.make_tracker(run, uri, "driving")
    train.log_rows(tracker, [{names[0]: 0.25, "wall_s": 1.0}])
    end = {"held_out": {"success_rate": 0.75}, "wall_s": 3.0, "validation_success_rate": 0.5}
    train.log_end(tracker, run, 0, end, "a note")
    assert tracker.close("FINISHED") is None
    history = client(uri).get_metric_history(tracker.run_id, names[0])
    assert [(each.step, each.value) for each in history] == [(0, 0.25), (1, 0.5)]
    assert steps(uri, tracker.run_id, ["held_out/success_rate"]) == [0]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError("no space"), r"no space\ncontinue with: \S+ --resume r"),
        (FloatingPointError("diverged"), r"diverged\nrepeat it with: \S+ --config r/config.json --learning-rate ..."),
    ],
)
def test_a_run_that_fails_exits_with_1_and_says_how_to_go_on(uri, tmp_path, monkeypatch, capsys, error, said):
    monkeypatch.setattr(train.Session, "finish", end(error))
    monkeypatch.chdir(tmp_path)
    small = ["--scenario", "curved", "--policy", "mlp:4", "--population", 8, "--generations", 1, "--workers", 0]
    flags = [*small, "--output", ".", "--name", "r", "--tracking-uri", uri]
    code, _, err = call(evolve_main, monkeypatch, capsys, *flags)
    assert code == 1
    assert re.search(f"^gridsim-evolve: error: {said}\n$", err, re.MULTILINE)


@pytest.mark.usefixtures("impatient")
def test_a_run_is_resumed_while_its_server_is_away(tmp_path, monkeypatch, capsys):
    away = f"http://127.0.0.1:{free_port()}"
    monkeypatch.setattr(train.Session, "finish", end(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train.train(new_run(tmp_path, "r", SETTINGS), train.Workers(0, None, 0.0), away, "driving", Notes())
    flags = ["--resume", tmp_path / "r", "--generations", 3, "--workers", 0]
    code, _, err = call(evolve_main, monkeypatch, capsys, *flags)
    assert code == 130
    said = f"warning: not logged to MLflow at {away}: 3 rows (step 0 to 2), the status KILLED: Connection refused"
    *begun, warning = [line for line in err.splitlines() if "warning" in line]
    assert warning == f"gridsim-evolve: {said}"
    assert len(begun) <= 1, "told of already while it went on"
    saved = open_run(tmp_path / "r").saved
    assert saved is not None
    assert saved[1]["steps"] == 3


def test_an_outage_of_mlflow_is_told_of_once_and_its_end(tmp_path, monkeypatch):
    tracker = Mock(uri="http://me:secret@host", run_id=None, close=lambda status: None)
    type(tracker).error = PropertyMock(side_effect=[None, "refused", "refused", None, None, None])
    monkeypatch.setattr(train.Session, "finish", end(None))
    monkeypatch.setattr(train, "make_tracker", lambda *_, **__: tracker)
    settings, notes = dataclasses.replace(SETTINGS, generations=5), Notes()
    train.train(new_run(tmp_path, "r", settings), train.Workers(0, None, 0.0), "", "driving", notes)
    away = "MLflow at http://host cannot be used: refused; the run continues and sends its rows later"
    assert notes.told == [(2, away), (4, "MLflow at http://host is back, and has all rows")]
