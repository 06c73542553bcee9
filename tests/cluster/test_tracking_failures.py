"""What goes wrong between a run and MLflow: stores, servers and addresses that fail, stall or are no such thing."""

import contextlib
import http.server
import os
import re
import signal
import socket
import sqlite3
import subprocess
import threading
import time

import pytest
from commands import wait_until
from tracked import client, free_port, runs, send, steps, tracking, write_run

from cluster.tracking.address import TrackingError, check_uri
from cluster.tracking.description import read_run
from cluster.tracking.logged import LoggedRun
from cluster.tracking.tracking import sync

pytestmark = pytest.mark.usefixtures("in_this_process")


def test_an_experiment_that_was_deleted(uri, tmp_path, impatient):
    client(uri).delete_experiment(client(uri).get_experiment_by_name("other").experiment_id)
    failed = tracking(write_run(tmp_path / "a", 1), uri, experiment="other")
    assert failed.wait_id(30) == ""
    assert failed.error == "experiment 'other' has been deleted; restore it or choose another name"
    assert failed.close("FINISHED") == f"not logged to MLflow at {uri}: 1 row, the status FINISHED: {failed.error}"
    assert send(tmp_path / "a", uri, "another")[0] == "1 row"


def test_files_that_cannot_be_stored_hold_up_nothing_else(uri, tmp_path, impatient, monkeypatch):
    folder = write_run(tmp_path / "a", 1, success_rate=0.5)
    (tmp_path / "store" / "mlartifacts").write_text("in the way")
    sent, report = sync(folder, uri, "driving", read_run)
    assert sent == "2 rows"
    reason = "/.*/mlartifacts.*: (Not a directory|File exists)"
    assert re.fullmatch(rf"not logged to MLflow at {uri}: 6 files, the model: {reason}", str(report))
    (run,) = runs(uri)
    assert steps(uri, run.info.run_id) == [0]
    assert run.info.status == "FINISHED"
    (tmp_path / "store" / "mlartifacts").unlink()
    with monkeypatch.context() as patch:
        patch.setattr("tempfile.tempdir", str(tmp_path / "no room for temporary files"))
        report = f"not logged to MLflow at {uri}: the model: No such file or directory"
        assert sync(folder, uri, "driving", read_run) == ("6 files", report)
    assert send(folder, uri)[0] == "1 model"


def test_a_locked_database_is_waited_for(uri, tmp_path, impatient):
    folder = write_run(tmp_path / "a", 1)
    run = tracking(folder, f"{uri}?timeout=0.1")
    run.wait_id(30)
    with contextlib.closing(sqlite3.connect(uri.removeprefix("sqlite:///"), isolation_level=None)) as database:
        database.execute("BEGIN EXCLUSIVE")
        write_run(folder, 3)
        assert check_uri(uri) == uri
        closed: list[str | None] = []
        closing = threading.Thread(target=lambda: closed.append(run.close("FINISHED")))
        closing.start()
        time.sleep(2.0)
        assert closing.is_alive()
        database.execute("ROLLBACK")
    closing.join(30)
    assert closed == [None]
    assert steps(uri, run.run_id) == [0, 1, 2]


@pytest.fixture
def silent():
    """The address of a server that takes connections and never says a word."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize("kind", ["silent", "dead"])
def test_a_server_that_does_not_answer_costs_seconds(tmp_path, silent, kind):
    uri = silent if kind == "silent" else f"http://127.0.0.1:{free_port()}"
    run = tracking(write_run(tmp_path / "a", 3, success_rate=0.5), uri)
    started = time.perf_counter()
    assert run.wait_id(30) == ""
    report = run.close("FINISHED")
    assert time.perf_counter() - started < 12.0  # MLflow's import among them
    reason = "no answer in time" if kind == "silent" else "Connection refused"
    assert report == f"not logged to MLflow at {uri}: 4 rows, 6 files, the model, the status FINISHED: {reason}"
    refused = str(sync(tmp_path / "a", uri, "", read_run)[1])
    assert refused.startswith("could not upload to MLflow: no MLflow server at ")


def test_a_sync_that_hangs_is_not_waited_for(uri, tmp_path, monkeypatch):
    monkeypatch.setattr("cluster.tracking.tracking.STOP_S", 1.0)
    monkeypatch.setattr(LoggedRun, "send", lambda *_: time.sleep(60))
    run = tracking(write_run(tmp_path / "a", 1), uri)
    wait_until(lambda: run._lacking == ["1 row"])
    started = time.perf_counter()
    assert run.close("KILLED") == f"not logged to MLflow at {uri}: 1 row: no answer within 1 s"
    assert time.perf_counter() - started < 3.0


def test_a_process_that_is_killed_is_reported_and_sent_for_later(uri, tmp_path, monkeypatch):
    monkeypatch.setattr("cluster.tracking.tracking.Popen", subprocess.Popen)
    run = tracking(write_run(tmp_path / "a", 1), uri)
    run_id = run.wait_id(60)
    assert run._process
    os.kill(run._process.pid, signal.SIGTERM)  # of a whole job, which ends after it
    write_run(tmp_path / "a", 2)
    wait_until(lambda: run.sent.get("row") == 2)
    os.kill(run._process.pid, signal.SIGKILL)
    wait_until(lambda: run.error)
    said = f"not logged to MLflow at {uri}: what is new: the process that sends has ended with exit code -9"
    assert run.close("FINISHED") == said
    assert send(write_run(tmp_path / "a", 3), uri) == ("1 row", run_id)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("summary.json", '{"wall_s": null}'), ("summary.json", "{"), ("history.csv", "generation,wall_s\n0,x\n"),
        ("config.json", "[]"), ("champion.npz", "no archive"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_named_and_nothing_is_sent(uri, tmp_path, name, text):
    folder = write_run(tmp_path / "a", 2, success_rate=0.5)
    (folder / name).write_text(text)
    sent, report = sync(folder, uri, "driving", read_run)
    assert sent == ""
    assert re.fullmatch(rf"not logged to MLflow at {uri}: what is new in its folder: {folder / name}.*", str(report))
    assert runs(uri) == []


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
        ("mlruns", "no runs in folders"), ("file:///tmp/mlruns", "no runs in folders"), ("sqlite://", "names no file"),
        ("sqlite:///:memory:", "names no file"), ("sqlite:///no/such/folder/mlflow.db", "there is no folder"),
        ("sqlite:///.", "names no file"), ("sqlite:///text.db", "file is not a database"),
        ("ftp://host/x", "not a tracking address"), ("http://no-such-host.invalid:5000", "no MLflow server"),
        ("postgresql://someone:secret@127.0.0.1:1/db", "Connection refused"),
        ("http://someone:secret@127.0.0.1:1", "Connection refused"), ("http://127.0.0.1:99999", "no MLflow server"),
    ],
)  # fmt: skip
def test_addresses_that_cannot_be_used(tmp_path, monkeypatch, uri, reason):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.db").write_text("some text, which is no database at all\n" * 100)
    text = refused(uri)
    assert reason in text
    assert "secret" not in text
    assert os.listdir(tmp_path) == ["text.db"]


def test_what_else_may_answer(silent, impatient):
    """A server of `pages`, path to (status, body), and of 404 for everything else."""
    pages: dict[str, tuple[int, bytes]] = {}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            status, body = pages.get(self.path.partition("?")[0], (404, b"<html>not here</html>"))
            self.send_response(status)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    page = "/api/2.0/mlflow/experiments/search"
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        uri = f"http://127.0.0.1:{server.server_port}"
        assert "error 404" in refused(uri)
        for status, body, problem in (
            (200, b"<html>a page of somebody's own</html>", "something else answers"),
            (502, b"bad gateway", "error 502"),
            (403, b"Invalid Host header - possible DNS rebinding attack detected", "refuses this host name"),
        ):
            pages = {page: (status, body)}
            assert problem in refused(uri)
        for path, status, body in (("", 401, b"You are not authenticated"), ("", 403, b""), ("/prefix", 200, b"{}")):
            pages = {f"{path}{page}": (status, body)}
            assert check_uri(f"{uri}{path}/") == f"{uri}{path}"
        server.shutdown()
    assert "no answer in time" in refused(silent)
