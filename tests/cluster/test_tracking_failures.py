"""What goes wrong between a run and MLflow: stores, servers and addresses that fail, stall or are no such thing."""

import contextlib
import http.server
import os
import re
import socket
import sqlite3
import threading
import time

import pytest
from commands import wait_until
from tracked import client, row, steps, tracker

from cluster.tracking.address import TrackingError, check_uri


def test_an_experiment_that_was_deleted(uri):
    client(uri).delete_experiment(client(uri).get_experiment_by_name("other").experiment_id)
    failed = tracker(uri, 1, experiment="other")
    with pytest.raises(TrackingError, match="'other' has been deleted"):
        failed.wait_ready()
    assert "1 row (step 0), the status FINISHED: experiment 'other' has been deleted" in failed.close("FINISHED")


def test_files_that_cannot_be_stored(uri, tmp_path, impatient):
    logged = tracker(uri, 1)
    (tmp_path / "store" / "mlartifacts").write_text("in the way")
    logged.log_files([tmp_path / "store" / "mlflow.db"])
    report = logged.close("FINISHED")
    assert re.fullmatch(
        rf"not logged to MLflow at {uri}: 1 file: /.*/mlartifacts.*: (Not a directory|File exists)", report
    )
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
        assert check_uri(uri) == uri
        database.execute("ROLLBACK")
    assert logged.close("FINISHED") is None
    assert steps(uri, logged.run_id) == [0]


@pytest.fixture
def silent():
    """The address of a server that takes connections and never says a word."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}"


def test_a_server_that_says_nothing_is_waited_for_no_longer_than_allowed(silent, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "2")
    stuck = tracker(silent, 3)
    with pytest.raises(TrackingError, match=r"not ready after 0\.5 s"):
        stuck.wait_ready(timeout_s=0.5)
    started = time.perf_counter()
    report = stuck.close("KILLED", timeout_s=1.0)
    assert time.perf_counter() - started < 1.5
    start = f"not logged to MLflow at {silent}: 3 rows (step 0 to 2), the status KILLED: no answer "
    assert report in (start + "within 1 s", start + "in time")
    wait_until(lambda: stuck.error == "no answer in time")


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
        ("file:///tmp/mlruns", "no runs in folders"),
        ("sqlite://", "names no file"),
        ("sqlite:///:memory:", "names no file"),
        ("sqlite:///no/such/folder/mlflow.db", "there is no folder"),
        ("sqlite:///.", "is a folder"),
        ("sqlite:///text.db", "file is not a database"),
        ("ftp://host/x", "not a tracking address"),
        ("http://no-such-host.invalid:5000", "no MLflow server"),
        ("postgresql://someone:secret@127.0.0.1:1/db", "Connection refused"),
        ("http://someone:secret@127.0.0.1:1", "Connection refused"),
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


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # permissions do not stop root
    assert "cannot be written" in refused(f"sqlite:///{tmp_path}/mlflow.db")


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
        for status, body, problem in (
            (404, b"<html>not here</html>", "something else answers"),
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
