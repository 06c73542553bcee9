"""Everything reaches MLflow once, read back through its own client; nothing that MLflow does stops or litters a run."""

import contextlib
import http.server
import os
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from cluster import tracking
from cluster.tracking import Tracker, TrackingError, check_uri, git_commit

NAMES = ["fitness/best", "distance_m/mean", "car_steps", "wall_s"]
PARAMS = {"scenario": "seamless", "population": "512", "generations": "60"}
TAGS = {"algorithm": "evolution", "scenario": "seamless"}


def row(step):
    return {name: step * 10.0 + place for place, name in enumerate(NAMES)}


def client(uri):
    """MLflow's own."""
    tracking._silence()
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=uri)


def steps(uri, run_id, names=NAMES):
    """The steps that MLflow has of every one of the metrics; a step that was logged twice is there twice."""
    histories = [client(uri).get_metric_history(run_id, name) for name in names]
    found = [sorted(metric.step for metric in history) for history in histories]
    assert all(each == found[0] for each in found), found
    for name, history in zip(names, histories, strict=True):
        assert all(metric.value == row(metric.step)[name] for metric in history if name in NAMES)
    return found[0]


def runs(uri):
    return [run for each in client(uri).search_experiments() for run in client(uri).search_runs([each.experiment_id])]


def tracker(uri, **options):
    given = {"experiment": "driving", "run_name": "a run", "params": PARAMS, "tags": TAGS, "key": "the-key", **options}
    return Tracker(uri, **given)


@pytest.fixture
def uri(empty_database, tmp_path):
    (tmp_path / "store").mkdir()
    shutil.copy(empty_database, tmp_path / "store" / "mlflow.db")
    return check_uri(f"sqlite:///{tmp_path}/store/mlflow.db")


@pytest.fixture
def impatient(monkeypatch):
    """Short pauses."""
    monkeypatch.setattr(tracking, "FLUSH_S", 0.05)
    monkeypatch.setattr(tracking, "RETRY_S", 0.1)
    monkeypatch.setattr(tracking, "CHANCE_S", 0.1)
    monkeypatch.setattr(tracking, "PROBE_S", 0.3)


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
from cluster.tracking import Tracker, check_uri
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


def with_path(**more):
    """An environment in which scripts find the packages, whatever the working directory."""
    root = str(Path(tracking.__file__).resolve().parents[1])
    return {**os.environ, "PYTHONPATH": root, **more}


# ---------------------------------------------------------------------------------------------- silence

QUIET = """
import sys, time
from cluster import tracking
assert not [name for name in ("mlflow", "sqlalchemy", "requests") if name in sys.modules]
started = time.perf_counter()
tracker = tracking.Tracker(tracking.check_uri(sys.argv[1]), "driving", "a run", {}, {})
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


# ---------------------------------------------------------------------------------------------- what goes wrong


def test_an_experiment_that_was_deleted(uri):
    client(uri).delete_experiment(client(uri).get_experiment_by_name("other").experiment_id)
    refused = tracker(uri, experiment="other")
    with pytest.raises(TrackingError, match="'other' has been deleted"):
        refused.wait_ready()
    refused.log_row(0, row(0))
    assert "1 row (step 0), the status FINISHED: experiment 'other' has been deleted" in refused.close("FINISHED")


def test_files_that_cannot_be_stored(uri, tmp_path, impatient):
    logged = tracker(uri)
    (tmp_path / "store" / "mlartifacts").write_text("in the way")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "a.png").touch()
    logged.log_row(0, row(0))
    logged.log_artifacts(tmp_path / "run")
    report = logged.close("FINISHED")
    assert re.fullmatch(rf"not logged to MLflow at {uri}: 1 file: (Not a directory|File exists).*", report)
    assert logged.close("FINISHED") == report
    assert steps(uri, logged.run_id) == [0]
    assert client(uri).get_run(logged.run_id).info.status == "FINISHED"


def test_a_database_that_is_locked_for_a_while(uri, impatient):
    logged = tracker(uri)
    logged.wait_ready()
    with contextlib.closing(sqlite3.connect(uri.removeprefix("sqlite:///"), isolation_level=None)) as database:
        database.execute("BEGIN IMMEDIATE")
        logged.log_row(0, row(0))
        time.sleep(0.5)
        with pytest.raises(TrackingError, match="database is locked"):
            check_uri(uri)
        database.execute("ROLLBACK")
    assert logged.close("FINISHED", timeout_s=30) is None
    assert steps(uri, logged.run_id) == [0]


class Silent:
    """A server that takes connections and never says a word."""

    def __init__(self):
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.uri = f"http://127.0.0.1:{self.socket.getsockname()[1]}"


@pytest.fixture
def silent():
    server = Silent()
    yield server
    server.socket.close()


def test_a_server_that_says_nothing_is_waited_for_no_longer_than_allowed(silent, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "2")
    stuck = tracker(silent.uri)
    for step in range(3, 6):
        stuck.log_row(step, row(step))
    with pytest.raises(TrackingError, match=r"not ready after 0\.5 s"):
        stuck.wait_ready(timeout_s=0.5)
    started = time.perf_counter()
    report = stuck.close("KILLED", timeout_s=1.0)
    assert time.perf_counter() - started < 1.5
    start = f"not logged to MLflow at {silent.uri}: 3 rows (step 3 to 5), the status KILLED: no answer "
    assert report in (start + "within 1 s", start + "in time")
    stuck._thread.join(20)
    assert not stuck._thread.is_alive()
    assert stuck.error == "no answer in time"


@contextlib.contextmanager
def mlflow_server(folder, port):
    """MLflow's own, with a database and artifacts in `folder`; what is yielded kills it."""
    command = [sys.executable, "-m", "mlflow", "server", "--workers", "1", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--backend-store-uri", f"sqlite:///{folder}/served.db", "--artifacts-destination", f"{folder}/served"]
    with open(folder / "server.log", "a") as log:
        quick = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        server = subprocess.Popen(command, cwd=folder, env=quick, stdout=log, stderr=log, start_new_session=True)
    try:
        for _ in range(300):
            with contextlib.suppress(TrackingError):
                check_uri(f"http://127.0.0.1:{port}")
                break
            time.sleep(0.2)
        yield lambda: os.killpg(server.pid, signal.SIGKILL)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
        server.wait(10)


@pytest.mark.e2e
def test_a_server_that_goes_away_and_comes_back(tmp_path, empty_database, capfd):
    shutil.copy(empty_database, tmp_path / "served.db")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "summary.json").write_text("{}")
    with mlflow_server(tmp_path, port) as kill:
        uri = check_uri(f"http://127.0.0.1:{port}/")
        assert uri == f"http://127.0.0.1:{port}"
        logged = tracker(uri)
        for step in range(5):
            logged.log_row(step, row(step))
        run_id = logged.wait_ready(60)
        while logged.missing(range(5)):
            time.sleep(0.1)
        kill()
        time.sleep(2.0)  # the pause between two batches
        for step in range(5, 9):
            logged.log_row(step, row(step))
        logged.log_artifacts(tmp_path / "run")
        while logged.error is None:
            time.sleep(0.1)
        started = time.perf_counter()
        report = logged.close("FINISHED")
        assert time.perf_counter() - started < 5.0
        assert report == (
            f"not logged to MLflow at {uri}: 4 rows (step 5 to 8), 1 file, the status FINISHED: Connection refused"
        )
    with mlflow_server(tmp_path, port):
        resumed = tracker(uri, run_id=run_id)
        for step in range(9):
            resumed.log_row(step, row(step))
        resumed.log_artifacts(tmp_path / "run")
        assert resumed.close("FINISHED", timeout_s=30) is None
        assert resumed.run_id == run_id
        assert steps(uri, run_id) == list(range(9))
        assert client(uri).get_run(run_id).info.status == "FINISHED"
        assert [each.path for each in client(uri).list_artifacts(run_id)] == ["summary.json"]
        assert not os.path.exists(tmp_path / "mlartifacts")
    assert capfd.readouterr() == ("", "")


# ---------------------------------------------------------------------------------------------- addresses


def refused(uri):
    started = time.perf_counter()
    with pytest.raises(TrackingError) as caught:
        check_uri(uri)
    assert time.perf_counter() - started < 5.0
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    return str(caught.value)


def test_addresses_become_absolute(tmp_path, monkeypatch, empty_database):
    (tmp_path / "a folder").mkdir()
    monkeypatch.chdir(tmp_path)
    assert check_uri() == f"sqlite:///{tmp_path}/mlflow.db"
    assert check_uri("sqlite:///a folder/../b.db?timeout=9") == f"sqlite:///{tmp_path}/b.db?timeout=9"
    assert check_uri(f"sqlite:////{tmp_path}/b.db").endswith(f"{tmp_path}/b.db")
    assert check_uri(f"sqlite:///{empty_database}") == f"sqlite:///{empty_database}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///a folder/from the environment.db")
    assert check_uri() == f"sqlite:///{tmp_path}/a folder/from the environment.db"
    assert check_uri("sqlite:///given.db") == f"sqlite:///{tmp_path}/given.db"
    assert os.listdir(tmp_path) == ["a folder"]


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("mlruns", "no runs in folders"),
        ("./mlruns", "no runs in folders"),
        ("file:///tmp/mlruns", "no runs in folders"),
        ("sqlite://", "names no file"),
        ("sqlite:///:memory:", "names no file"),
        ("sqlite:///no/such/folder/mlflow.db", "there is no folder"),
        ("sqlite:///.", "is a folder"),
        ("sqlite:///text.db", "file is not a database"),
        ("ftp://host/x", "not a tracking address"),
        ("http://", "no MLflow server"),
        ("http://no-such-host.invalid:5000", "no MLflow server"),
        ("postgresql://someone:secret@127.0.0.1:1/db", "Connection refused"),
        ("http://someone:secret@127.0.0.1:1", "Connection refused"),
        ("https://127.0.0.1:1", "Connection refused"),
        ("http://127.0.0.1:99999", "no MLflow server"),
    ],
)
def test_addresses_that_cannot_be_used(tmp_path, monkeypatch, uri, reason):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.db").write_text("some text, which is no database at all\n" * 100)
    text = refused(uri)
    assert reason in text
    assert "secret" not in text
    assert os.listdir(tmp_path) == ["text.db"]


def test_a_folder_that_cannot_be_written(tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "ro", "tmpfs", str(folder)]
    as_root = os.geteuid() == 0  # whom permissions do not stop, but a read-only file system does
    if as_root and subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("root without the right to mount")
    if not as_root:
        folder.chmod(0o500)
    try:
        assert "cannot be written" in refused(f"sqlite:///{folder}/mlflow.db")
    finally:
        if as_root:
            subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def web_server():
    """Serves `pages`, path to (status, body), and 404 for everything else."""
    pages: dict[str, tuple[int, bytes]] = {}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            status, body = pages.get(self.path.partition("?")[0], (404, b"<html>not here</html>"))
            self.send_response(status)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}", pages
    server.shutdown()
    server.server_close()


SEARCH = "/api/2.0/mlflow/experiments/search"


def test_what_else_may_answer(web_server, silent, impatient):
    uri, pages = web_server
    assert "something else answers" in refused(uri)
    pages["/health"] = (200, b"<html>a page of somebody's own</html>")
    assert "something else answers" in refused(uri)
    pages["/health"] = (502, b"bad gateway")
    assert "error 502" in refused(uri)
    pages["/health"] = (403, b"Invalid Host header - possible DNS rebinding attack detected")
    assert "refuses this host name" in refused(uri)
    assert "no answer in time" in refused(silent.uri)
    for answers in (
        {"/health": (200, b"OK")},
        {"/health": (401, b"You are not authenticated")},
        {SEARCH: (200, b'{"experiments": []}')},
        {"/health": (200, b"<html></html>"), SEARCH: (403, b"")},
    ):
        pages.clear()
        pages.update(answers)
        assert check_uri(uri + "/") == uri
    pages.clear()
    pages["/prefix/health"] = (200, b"OK")
    assert check_uri(f"{uri}/prefix/") == f"{uri}/prefix"


# ---------------------------------------------------------------------------------------------- the commit


def test_git_commit(tmp_path, monkeypatch):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
        command = ["git", *identity, "-C", str(tmp_path / "repository"), *arguments]
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.strip()

    def told(folder, **environment):
        script = "from cluster.tracking import git_commit; print(git_commit())"
        environment = {**os.environ, "PYTHONPATH": str(folder), **environment}
        done = subprocess.run([sys.executable, "-c", script], cwd="/", env=environment, capture_output=True, text=True)
        assert done.stderr == ""
        return done.stdout.strip()

    for place in ("repository", "repository/.venv/site-packages", "outside"):
        (tmp_path / place / "cluster").mkdir(parents=True)
        (tmp_path / place / "cluster" / "__init__.py").touch()
        shutil.copy(tracking.__file__, tmp_path / place / "cluster")
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
