"""Everything reaches MLflow once, read back through its own client; nothing that MLflow does stops or litters a run."""

import contextlib
import os
import re
import shutil
import sqlite3
import subprocess
import time

import pytest
from commands import finish, start
from tracked import PARAMS, PYTHONPATH, TAGS, begin, client, row, runs, steps, tracker

import cluster.tracking.commit
from cluster.tracking import mlflow_run
from cluster.tracking.address import TrackingError, check_uri


def test_a_run_read_back(uri, tmp_path, monkeypatch):
    monkeypatch.setattr(mlflow_run, "git_commit", lambda: "c0ffee-dirty")
    folder = tmp_path / "run"
    folder.mkdir()
    for number in range(8):
        (folder / f"{number}.bin").write_bytes(os.urandom(1000))
    started = time.perf_counter()
    logged = tracker(uri, 2000)
    assert time.perf_counter() - started < 3.0, "rows are never waited for; one by one they would take ten"
    logged.log_row(1999, row(1999) | {"held_out/success_rate": 0.95, "held_out/nothing": float("nan")})
    logged.log_files(folder.iterdir())
    run_id = logged.wait_ready()
    assert logged.close("FINISHED") is None
    assert logged.close("FAILED") is None

    assert steps(uri, run_id) == list(range(2000))
    run = client(uri).get_run(run_id)
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "a run"
    assert run.data.params == PARAMS
    commit = {"git_commit": "c0ffee-dirty", "mlflow.source.git.commit": "c0ffee"}  # MLflow's own tag links to it
    assert run.data.tags.items() >= {**TAGS, **commit}.items()
    assert {"mlflow.user", "mlflow.source.name", "mlflow.source.type"} <= run.data.tags.keys()
    assert not [name for name in run.data.tags if name.startswith("resumed/")]
    assert client(uri).get_metric_history(run_id, "held_out/success_rate")[0].step == 1999
    assert client(uri).get_experiment(run.info.experiment_id).name == "driving"

    artifacts = tmp_path / "store" / "mlartifacts" / run_id / "artifacts"
    assert run.info.artifact_uri == artifacts.as_uri()
    assert {each.path for each in client(uri).list_artifacts(run_id)} == {f"{number}.bin" for number in range(8)}
    assert (artifacts / "3.bin").read_bytes() == (folder / "3.bin").read_bytes()


def test_a_lost_answer_does_not_double_a_row(uri, impatient, monkeypatch):
    from mlflow.tracking import MlflowClient

    real = MlflowClient.log_batch
    lost: list[int] = []

    def log_batch(self, run_id, metrics=(), **more):
        real(self, run_id, metrics=metrics, **more)
        if metrics and len(lost) < 3:
            lost.append(len(metrics))
            raise ConnectionError("the answer never came")

    monkeypatch.setattr(MlflowClient, "log_batch", log_batch)
    logged = tracker(uri, 5)
    while len(lost) < 3:
        time.sleep(0.05)
    assert logged.close("FINISHED") is None
    assert steps(uri, logged.run_id) == list(range(5))


def test_a_run_without_a_row_is_never_created(tmp_path):
    assert tracker(check_uri(f"sqlite:///{tmp_path}/mlflow.db")).close("KILLED") is None
    assert not os.listdir(tmp_path)


def test_resume_logs_only_what_is_missing(uri, tmp_path, monkeypatch):
    begun = tracker(uri, 9)
    begun.log_row(9, {"car_steps": row(9)["car_steps"]})
    assert begun.close("KILLED") is None
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    resumed = tracker(uri, 15, experiment="other", run_id=begun.run_id)
    resumed.wait_ready()
    assert client(uri).get_run(begun.run_id).info.status == "RUNNING"
    assert resumed.close("FINISHED") is None
    assert resumed.sent["row"] == 6
    assert resumed.run_id == begun.run_id
    assert steps(uri, begun.run_id) == list(range(15))
    assert client(uri).get_run(begun.run_id).info.status == "FINISHED"
    assert len([run for run in runs(uri) if run.info.run_name == "a run"]) == 1
    assert not os.listdir(tmp_path / "elsewhere")


def test_resume_notes_what_is_different(uri):
    run_id = begin(uri, 2)
    for generations in ("90", "120"):
        begin(uri, 2, params={**PARAMS, "generations": generations, "new": "1"})
    data = client(uri).get_run(run_id).data
    assert data.params == {**PARAMS, "new": "1"}
    resumed = {name: tag for name, tag in data.tags.items() if name.startswith("resumed/")}
    assert resumed == {"resumed/generations": "120"}


def test_a_run_that_mlflow_does_not_know_gets_every_row(uri, tmp_path):
    """It was thrown away; and in another store."""
    run_id = begin(uri, 4)
    client(uri).delete_run(run_id)
    for there in (uri, check_uri(f"sqlite:///{tmp_path}/mlflow.db")):
        again = begin(there, 6)
        assert again != run_id
        assert steps(there, again) == list(range(6))


QUIET = """
import sys, time
from cluster.tracking.address import check_uri
from tracked import tracker
assert not [name for name in ("mlflow", "sqlalchemy", "requests") if name in sys.modules]
started = time.perf_counter()
logged = tracker(check_uri(sys.argv[1]), 20, key=str(started))
assert time.perf_counter() - started < 0.3
report = logged.close("FINISHED", 300)
assert (report is None) == (len(sys.argv) > 2), report
"""


def test_two_at_once_create_one_database_and_print_nothing(tmp_path):
    command = ["python", "-W", "default", "-c", QUIET, f"sqlite:///{tmp_path}/mlflow.db", "good"]
    for process in [start(*command, cwd="/", PYTHONPATH=PYTHONPATH) for _ in range(2)]:
        output = "".join(process.communicate(timeout=600))
        # -W default shows what a user never sees; of that nothing may be ours.
        assert process.returncode == 0, output
        assert "cluster" not in output
    uri = check_uri(f"sqlite:///{tmp_path}/mlflow.db")
    assert [steps(uri, run.info.run_id) for run in runs(uri)] == [list(range(20))] * 2
    assert os.listdir(tmp_path) == ["mlflow.db"]


def test_a_database_that_is_no_longer_mlflows_prints_nothing(tmp_path, empty_database):
    foreign, broken = tmp_path / "foreign.db", shutil.copy(empty_database, tmp_path / "broken.db")
    with contextlib.closing(sqlite3.connect(foreign)) as database:
        database.execute("CREATE TABLE alembic_version (version_num VARCHAR(32))")
        database.execute("INSERT INTO alembic_version VALUES ('unheard of')")
        database.commit()
    with contextlib.closing(sqlite3.connect(broken)) as database:
        database.execute("ALTER TABLE metrics RENAME COLUMN is_nan TO is_gone")  # MLflow logs a traceback
    with pytest.raises(TrackingError, match="or of another program; use another --tracking-uri"):
        check_uri(f"sqlite:///{foreign}")
    with contextlib.closing(sqlite3.connect(foreign)) as database:  # and nothing was made in it
        assert database.execute("SELECT name FROM sqlite_master").fetchall() == [("alembic_version",)]
    done = finish("python", "-c", QUIET, f"sqlite:///{broken}", cwd="/", timeout=600, PYTHONPATH=PYTHONPATH)
    assert (done.stdout, done.stderr) == ("", "")


def test_git_commit(tmp_path):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
        command = ["git", *identity, "-C", str(tmp_path / "repository"), *arguments]
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.strip()

    def told(place="repository", **environment):
        script = "from cluster.tracking.commit import git_commit; print(git_commit())"
        done = finish("python", "-c", script, cwd="/", PYTHONPATH=str(tmp_path / place), **environment)
        assert done.stderr == ""
        return done.stdout.strip()

    for place in ("repository", "repository/.venv/site-packages"):
        (tmp_path / place / "cluster" / "tracking").mkdir(parents=True)
        for folder in ("cluster", "cluster/tracking"):
            (tmp_path / place / folder / "__init__.py").touch()
        shutil.copy(cluster.tracking.commit.__file__, tmp_path / place / "cluster" / "tracking")
    assert told() == "unknown"
    git("init")
    git("add", "cluster")
    assert told() == "unknown"
    git("commit", "-m", "first")
    commit = git("rev-parse", "HEAD")
    assert re.fullmatch("[0-9a-f]{40}", commit)
    assert told() == told(GIT_DIR="/nowhere") == commit
    assert told(PATH="/nowhere") == told("repository/.venv/site-packages") == "unknown"
    (tmp_path / "repository/cluster/__init__.py").write_text("changed = True\n")
    assert told() == f"{commit}-dirty"
