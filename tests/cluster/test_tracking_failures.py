"""What goes wrong between a run and MLflow, and stores as people have them: hosted, in odd folders, behind a proxy."""

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
import urllib.request

import pytest
import requests
from commands import finish, wait_until
from tracked import client, free_port, runs, send, steps, tracking, write_run

from cluster.tracking.address import TrackingError, check_uri, reach_loopback_directly, sqlite_uri
from cluster.tracking.database import run_tables
from cluster.tracking.description import read_run
from cluster.tracking.logged import LoggedRun
from cluster.tracking.tracking import Tracking, sync

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


def test_addresses_become_absolute(here, monkeypatch, empty_database):
    (here / "a folder").mkdir()
    assert check_uri() == f"sqlite:///{here}/mlflow.db"
    assert check_uri("sqlite:///a folder/../b.db?timeout=9") == f"sqlite:///{here}/b.db?timeout=9"
    assert check_uri(f"sqlite:////{here}/b.db").endswith(f"{here}/b.db")
    assert check_uri(f"sqlite:///{empty_database}") == f"sqlite:///{empty_database}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///a folder/from the environment.db")
    assert check_uri() == f"sqlite:///{here}/a folder/from the environment.db"
    assert check_uri("sqlite:///given.db") == f"sqlite:///{here}/given.db"
    unix = "postgresql://u:p@/db?host=/var/run/postgresql"  # a socket, not looked for on a port
    assert check_uri(unix) == unix
    assert os.listdir(here) == ["a folder"]


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("mlruns", "no runs in folders"), ("file:///tmp/mlruns", "no runs in folders"), ("sqlite://", "names no file"),
        ("sqlite:///:memory:", "names no file"), ("sqlite:///no/such/folder/mlflow.db", "there is no folder"),
        ("sqlite:///.", "names no file"), ("sqlite:///text.db", "file is not a database"),
        ("sqlite://u:cret@/x.db", "names no file"), ("sqlite:////no/folder/x.db?key=cret", "there is no folder"),
        ("ftp://u:cret@h", "not a tracking address"), ("u:cret@127.0.0.1/db", "not a tracking address"),
        ("http://no-such-host.invalid:5000", "no MLflow server"), ("http://127.0.0.1:99999", "no MLflow server"),
        ("http://u:se/cr@et@127.0.0.1:1", "Connection refused"), ("http://127.0.0.1:1/?token=cret", " refused"),
        ("postgresql://u:se/cr@et@127.0.0.1:1/db", " refused"), ("mysql://u:cret@127.0.0.1:1/d?token=cret", " refused"),
        ("postgresql://u:p?cret@127.0.0.1:5999/db", "in a password, write ? as %3F, @ as %40 and / as %2F"),
    ],
)  # fmt: skip
def test_addresses_that_cannot_be_used_are_shown_without_their_secrets(here, uri, reason):
    (here / "text.db").write_text("some text, which is no database at all\n" * 100)
    text = refused(uri)
    assert reason in text
    assert not re.search("cret|se/", text)
    assert os.listdir(here) == ["text.db"]
    assert sync(write_run(here / "a", 1), uri, "", read_run)[1] == f"could not upload to MLflow: {text}"


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


# --- Stores ----------------------------------------------------------------------------------------------------------


def test_a_run_in_a_folder_with_an_odd_name(tmp_path, monkeypatch):
    folder, elsewhere = tmp_path / "what now? #1 100%41;a&b'\" ü [c]", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    monkeypatch.chdir(folder)
    _, run_id = send(write_run(folder / "runs/a", 2, success_rate=0.5), "")
    assert sorted(os.listdir(folder)) == ["mlartifacts", "mlflow.db", "runs"]
    monkeypatch.chdir(elsewhere)
    assert send(folder / "runs/a", "") == ("", run_id)
    assert os.listdir(elsewhere) == []
    assert (folder / "mlartifacts" / run_id / "artifacts/model/MLmodel").is_file()
    assert list(run_tables(sqlite_uri(folder / "mlflow.db"), "http://127.0.0.1:5000")) == ["driving"]


@pytest.mark.parametrize("revision", ["unheard of", "0584bdc529eb"])  # the latter of MLflow 2.19
def test_a_database_of_another_mlflow_is_refused_before_it_is_migrated(tmp_path, revision):
    path = tmp_path / "mlflow.db"
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE alembic_version (version_num VARCHAR(32))")
        database.execute("INSERT INTO alembic_version VALUES (?)", (revision,))
        database.commit()
    before, uri = path.read_bytes(), f"sqlite:///{path}"
    said = (
        f"{uri} was made by another version of MLflow, or by another program; use another --tracking-uri, or copy it "
        f"and run mlflow db upgrade {uri}, after which an older MLflow cannot open it"
    )
    with pytest.raises(TrackingError, match=f"^{re.escape(said)}$"):
        check_uri(uri)
    done = finish("python", "-m", "cluster.commands.ui", str(free_port()), cwd=tmp_path, code=1)
    assert done.stderr == f"make ui: {said}\n"
    refused = tracking(write_run(tmp_path / "a", 1), uri)  # as tracking says of a database server
    assert (refused.wait_id(30), refused.error) == ("", said)
    refused.close("KILLED")
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ["a", "mlflow.db"]


def test_hosted_stores_and_those_of_plug_ins_are_left_to_mlflow(tmp_path, monkeypatch):
    plugin = tmp_path / "filetest-1.0.dist-info"
    plugin.mkdir()
    (plugin / "METADATA").write_text("Metadata-Version: 2.1\nName: filetest\nVersion: 1.0\n")
    (plugin / "entry_points.txt").write_text("[mlflow.tracking_store]\nfiletest = filetest:tracking\n")
    with pytest.raises(TrackingError, match=r"^filetest://x: not a tracking address"):
        check_uri("filetest://x")
    monkeypatch.syspath_prepend(tmp_path)
    for uri in ("databricks", "databricks://profile", "filetest://x"):
        assert check_uri(uri) == check_uri(begun_with=uri) == uri
        assert Tracking(tmp_path, uri, "", read_run).where("mlflow") == uri


@pytest.mark.parametrize(
    ("before", "after"), [("", "127.0.0.1,localhost,::1,[::1]"), ("a", "a,127.0.0.1,localhost,::1,[::1]"), ("*", "*")]
)
def test_this_machine_is_never_asked_through_a_proxy(monkeypatch, before, after):
    monkeypatch.setenv("http_proxy", "http://p:1")
    monkeypatch.setenv("no_proxy", before)
    reach_loopback_directly()
    reach_loopback_directly()
    assert os.environ["no_proxy"] == after
    for host in ("127.0.0.1", "localhost", "[::1]"):
        assert requests.utils.should_bypass_proxies(f"http://{host}:5000", None)
        assert urllib.request.proxy_bypass(f"{host}:5000")
