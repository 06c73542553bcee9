"""Everything reaches MLflow once, read back through its own client; nothing that MLflow does stops or litters a run."""

import contextlib
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time

import pytest
from tracked import NAMES, PARAMS, TAGS, client, row, runs, steps, tracker, with_path

import cluster.tracking.commit
from cluster.tracking.address import check_uri
from cluster.tracking.commit import git_commit

# ---------------------------------------------------------------------------------------------- what is logged


def test_a_run_read_back(uri, tmp_path):
    folder = tmp_path / "runs" / "a run"
    (folder / "pictures").mkdir(parents=True)
    for number in range(8):
        (folder / f"{number}.bin").write_bytes(os.urandom(1000))
    (folder / "pictures" / "map.png").write_bytes(b"png")
    (folder / ".checkpoint.npz.1.tmp").write_bytes(b"left behind")

    logged = tracker(uri)
    for step in range(30):
        logged.log_row(step, row(step))
    logged.log_summary({"held_out/success_rate": 0.95, "held_out/nothing": float("nan")})
    logged.log_artifacts(folder)
    run_id = logged.wait_ready()
    assert logged.close("FINISHED") is None
    assert logged.close("FAILED") is None

    assert steps(uri, run_id) == list(range(30))
    run = client(uri).get_run(run_id)
    assert run.info.status == "FINISHED"
    assert run.info.end_time >= run.info.start_time
    assert run.info.run_name == "a run"
    assert run.data.params == PARAMS
    assert run.data.tags.items() >= {**TAGS, "git_commit": git_commit()}.items()
    assert {"mlflow.user", "mlflow.source.name", "mlflow.source.type"} <= run.data.tags.keys()
    assert not [name for name in run.data.tags if name.startswith("resumed/")]
    assert run.data.metrics["held_out/success_rate"] == 0.95
    assert client(uri).get_metric_history(run_id, "held_out/success_rate")[0].step == 29
    assert client(uri).get_experiment(run.info.experiment_id).name == "driving"

    artifacts = tmp_path / "store" / "mlartifacts" / run_id / "artifacts"
    assert run.info.artifact_uri == artifacts.as_uri()
    listed = {each.path for each in client(uri).list_artifacts(run_id)}
    assert listed == {"pictures", *(f"{number}.bin" for number in range(8))}
    assert client(uri).list_artifacts(run_id, "pictures")[0].path == "pictures/map.png"
    assert (artifacts / "3.bin").read_bytes() == (folder / "3.bin").read_bytes()


@pytest.mark.parametrize("status", ["KILLED", "FAILED"])
def test_how_it_ended(uri, status):
    ended = tracker(uri)
    ended.log_row(0, row(0))
    assert ended.close(status) is None
    assert client(uri).get_run(ended.run_id).info.status == status


def test_the_duration_is_what_the_run_has_taken_without_its_pauses(uri):
    began = time.time() - 500.0
    for status, wall_s in (("KILLED", 54.0), ("FINISHED", 61.5)):
        logged = tracker(uri, started=began)
        logged.log_row(0, row(0))
        logged.wall_s = wall_s
        assert logged.close(status) is None
        info = client(uri).get_run(logged.run_id).info
        assert info.start_time == int(1000.0 * began)
        assert info.end_time - info.start_time == 1000.0 * wall_s


def test_rows_are_never_waited_for(uri):
    started = time.perf_counter()
    logged = tracker(uri)
    for step in range(2000):
        logged.log_row(step, row(step))
    assert time.perf_counter() - started < 1.0
    assert logged.close("FINISHED", timeout_s=60) is None
    assert steps(uri, logged.run_id) == list(range(2000))


def test_a_step_twice_in_one_run_is_logged_once(uri, impatient):
    logged = tracker(uri)
    for step in (0, 1, 1):
        logged.log_row(step, row(step))
    logged.wait_ready()
    time.sleep(0.5)
    logged.log_row(1, row(1))
    logged.log_row(1, {"later": 3.0})
    assert logged.close("FINISHED") is None
    assert steps(uri, logged.run_id) == [0, 1]
    assert client(uri).get_run(logged.run_id).data.metrics["later"] == 3.0


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
    logged = tracker(uri)
    for step in range(5):
        logged.log_row(step, row(step))
        time.sleep(0.1)
    time.sleep(1.0)
    assert logged.close("FINISHED") is None
    assert len(lost) == 3
    assert steps(uri, logged.run_id) == list(range(5))


@pytest.mark.parametrize("name", ["", "a\nb", "/a", "../a", "a/../b", "a//b", "fitness?", "ä" * 251])
def test_names_are_checked_when_they_are_given(uri, name):
    logged = tracker(uri, start=False)
    with pytest.raises(ValueError, match="no name that MLflow allows"):
        logged.log_row(0, {name: 1.0})
    with pytest.raises(ValueError, match="no name that MLflow allows"):
        tracker(uri, params={name: "1"}, start=False)
    assert logged.close("KILLED") is None


def test_wrong_use(uri):
    logged = tracker(uri, start=False)
    with pytest.raises(ValueError, match="could not convert"):
        logged.log_row(0, {"a": "one"})
    with pytest.raises(ValueError, match="key"):
        tracker(uri, key="it's", start=False)
    assert logged.close("KILLED") is None
    with pytest.raises(RuntimeError, match="closed"):
        logged.log_row(0, row(0))
    with pytest.raises(RuntimeError, match="closed"):
        logged.log_artifacts(".")


def test_never_begun_is_never_created(tmp_path):
    path = tmp_path / "mlflow.db"
    assert tracker(check_uri(f"sqlite:///{path}"), start=False).close("KILLED") is None
    assert not path.exists()


# ---------------------------------------------------------------------------------------------- resume


def begin(uri, count, **options):
    """A run of `count` rows that ended without its last words; returns its id."""
    begun = tracker(uri, **options)
    for step in range(count):
        begun.log_row(step, row(step))
    assert begun.close("KILLED") is None
    return begun.run_id


@pytest.mark.parametrize("by", ["run_id", "key"])
def test_resume_logs_only_what_is_missing(uri, tmp_path, monkeypatch, by):
    run_id = begin(uri, 10)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    resumed = tracker(uri, **({"run_id": run_id, "key": None} if by == "run_id" else {}))
    assert resumed.missing(range(15)) == [10, 11, 12, 13, 14]
    assert client(uri).get_run(run_id).info.status == "RUNNING"
    for step in range(15):
        resumed.log_row(step, row(step))
    (tmp_path / "file").write_text("text")
    assert resumed.close("FINISHED") is None
    assert resumed.run_id == run_id
    assert steps(uri, run_id) == list(range(15))
    assert client(uri).get_run(run_id).info.status == "FINISHED"
    assert len([run for run in runs(uri) if run.info.run_name == "a run"]) == 1
    assert not os.listdir(tmp_path / "elsewhere")


def test_resume_fills_in_a_metric_that_a_row_lacks(uri):
    begun = tracker(uri)
    begun.log_row(0, row(0))
    begun.log_row(1, {"car_steps": row(1)["car_steps"]})
    assert begun.close("KILLED") is None
    resumed = tracker(uri, run_id=begun.run_id)
    for step in range(2):
        resumed.log_row(step, row(step))
    assert resumed.close("FINISHED") is None
    assert steps(uri, begun.run_id) == [0, 1]


def test_resume_notes_what_is_different(uri):
    run_id = begin(uri, 2)
    for generations in ("90", "120"):
        resumed = tracker(uri, run_id=run_id, params={**PARAMS, "generations": generations, "new": "1"})
        assert resumed.close("FINISHED") is None
    data = client(uri).get_run(run_id).data
    assert data.params == {**PARAMS, "new": "1"}
    assert {name: tag for name, tag in data.tags.items() if name.startswith("resumed/")} == {
        "resumed/generations": "120"
    }


def test_resume_at_another_address_logs_everything_there(uri, tmp_path):
    run_id = begin(uri, 4)
    other = tmp_path / "other"
    other.mkdir()
    moved = tracker(check_uri(f"sqlite:///{other}/mlflow.db"), run_id=run_id)
    for step in range(6):
        moved.log_row(step, row(step))
    assert moved.close("FINISHED", timeout_s=60) is None
    assert moved.run_id != run_id
    assert steps(moved.uri, moved.run_id) == list(range(6))


def test_resume_of_a_run_that_was_thrown_away(uri):
    run_id = begin(uri, 4)
    client(uri).delete_run(run_id)
    again = begin(uri, 5, run_id=run_id)
    assert again != run_id
    assert steps(uri, again) == list(range(5))


RUN = """
import sys, time
from cluster.tracking.tracker import Tracker
from cluster.tracking.address import check_uri
tracker = Tracker(check_uri("sqlite:///mlflow.db"), "driving", "a run", {}, {}, key="the-key")
names = %r
for step in range(100000):
    tracker.log_row(step, {name: step * 10.0 + place for place, name in enumerate(names)})
    time.sleep(0.02)
    if step %% 10 == 9:
        print(tracker.run_id, flush=True)
"""


@pytest.mark.e2e
@pytest.mark.parametrize("kills", [[0.3, 1.5, 2.0, 2.4, None, None]])
def test_killed_at_any_moment_and_resumed(tmp_path, monkeypatch, kills):
    """None is a kill among the rows. Before that, MLflow is being imported or its database created."""
    for seconds in kills:
        with subprocess.Popen(
            [sys.executable, "-c", RUN % NAMES], cwd=tmp_path, stdout=subprocess.PIPE, env=with_path(), text=True
        ) as run:
            assert run.stdout
            if seconds is None:
                assert any(line != "None\n" for line in run.stdout)
                time.sleep(2.5)  # another batch or two
            else:
                time.sleep(seconds)
            run.send_signal(signal.SIGKILL)
    monkeypatch.chdir(tmp_path)
    uri = check_uri(None)
    assert uri == f"sqlite:///{tmp_path}/mlflow.db"
    resumed = tracker(uri)
    missing = resumed.missing(range(1000), timeout_s=60)
    assert 0 < len(missing) < 1000
    for step in range(1000):
        resumed.log_row(step, row(step))
    assert resumed.close("FINISHED", timeout_s=60) is None
    assert steps(uri, resumed.run_id) == list(range(1000))
    assert len(runs(uri)) == 1


# ---------------------------------------------------------------------------------------------- silence

QUIET = """
import sys, time
from cluster.tracking.tracker import Tracker
from cluster.tracking.address import check_uri
assert not [name for name in ("mlflow", "sqlalchemy", "requests") if name in sys.modules]
started = time.perf_counter()
tracker = Tracker(check_uri(sys.argv[1]), "driving", "a run", {}, {})
for step in range(20):
    tracker.log_row(step, {"a": 1.0})
assert time.perf_counter() - started < 0.3
if len(sys.argv) > 2:
    open(sys.argv[2], "w").write(str(tracker.wait_ready()))
report = tracker.close("FINISHED", timeout_s=60)
assert (report is None) == (len(sys.argv) > 2), report
"""


def test_two_at_once_create_one_database_and_print_nothing(tmp_path):
    command = [sys.executable, "-W", "default", "-c", QUIET, f"sqlite:///{tmp_path}/mlflow.db"]
    both = [
        subprocess.Popen(
            [*command, f"{tmp_path}/{name}"],
            env=with_path(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name in "ab"
    ]
    for process in both:
        output = process.communicate(timeout=60)[0]
        # -W default shows what a user never sees; of that nothing may be ours.
        assert process.returncode == 0, output
        assert "cluster" not in output
    uri = check_uri(f"sqlite:///{tmp_path}/mlflow.db")
    assert {run.info.run_id for run in runs(uri)} == {(tmp_path / name).read_text() for name in "ab"}
    assert all(len(client(uri).get_metric_history(run.info.run_id, "a")) == 20 for run in runs(uri))
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "mlflow.db"]


def test_prints_nothing(tmp_path, empty_database):
    good, foreign, broken = (tmp_path / name for name in ("good.db", "foreign.db", "broken.db"))
    with contextlib.closing(sqlite3.connect(foreign)) as database:
        database.execute("CREATE TABLE alembic_version (version_num VARCHAR(32))")
        database.execute("INSERT INTO alembic_version VALUES ('unheard of')")
        database.commit()
    shutil.copy(empty_database, good)
    shutil.copy(empty_database, broken)
    with contextlib.closing(sqlite3.connect(broken)) as database:
        database.execute("ALTER TABLE metrics RENAME COLUMN is_nan TO is_gone")  # MLflow logs a traceback
    for arguments in ([f"sqlite:///{good}", f"{tmp_path}/id"], [f"sqlite:///{foreign}"], [f"sqlite:///{broken}"]):
        done = subprocess.run(
            [sys.executable, "-c", QUIET, *arguments], env=with_path(), capture_output=True, text=True, timeout=60
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# ---------------------------------------------------------------------------------------------- the commit


def test_git_commit(tmp_path, monkeypatch):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
        command = ["git", *identity, "-C", str(tmp_path / "repository"), *arguments]
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.strip()

    def told(folder, **environment):
        script = "from cluster.tracking.commit import git_commit; print(git_commit())"
        environment = {**os.environ, "PYTHONPATH": str(folder), **environment}
        done = subprocess.run([sys.executable, "-c", script], cwd="/", env=environment, capture_output=True, text=True)
        assert done.stderr == ""
        return done.stdout.strip()

    for place in ("repository", "repository/.venv/site-packages", "outside"):
        (tmp_path / place / "cluster" / "tracking").mkdir(parents=True)
        for folder in ("cluster", "cluster/tracking"):
            (tmp_path / place / folder / "__init__.py").touch()
        shutil.copy(cluster.tracking.commit.__file__, tmp_path / place / "cluster" / "tracking")
    assert told(tmp_path / "outside") == "unknown"
    git("init")
    assert told(tmp_path / "repository") == "unknown"
    git("add", "cluster")
    assert told(tmp_path / "repository") == "unknown"
    git("commit", "-m", "first")
    commit = git("rev-parse", "HEAD")
    assert re.fullmatch("[0-9a-f]{40}", commit)
    assert told(tmp_path / "repository") == commit
    assert told(tmp_path / "repository", GIT_DIR="/nowhere") == commit
    assert told(tmp_path / "repository", PATH="/nowhere") == "unknown"
    assert told(tmp_path / "repository/.venv/site-packages") == "unknown"
