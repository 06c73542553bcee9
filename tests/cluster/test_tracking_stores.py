"""MLflow's stores as people have them: hosted, of another MLflow, in odd folders, behind a proxy."""

import contextlib
import os
import re
import sqlite3
import urllib.request

import pytest
import requests
from commands import finish
from tracked import free_port, send, tracking, write_run

from cluster.tracking.address import TrackingError, check_uri, reach_loopback_directly, sqlite_uri
from cluster.tracking.database import run_tables
from cluster.tracking.description import read_run
from cluster.tracking.tracking import Tracking

pytestmark = pytest.mark.usefixtures("in_this_process")


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
    ("before", "after"),
    [("", "127.0.0.1,localhost,::1,[::1]"), ("a", "a,127.0.0.1,localhost,::1,[::1]"), ("*", "*")],
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
