"""No secret of a tracking address is printed, written or sent, and none is lost to a run that is resumed."""

import json
import re
import shlex

import pytest
from commands import finish
from hypothesis import given
from hypothesis import strategies as st
from tracked import PYTHONPATH, client, free_port, mlflow_server, tracking, write_run

from cluster.redaction import one_line, redacted
from cluster.tracking.address import check_uri, with_password
from cluster.tracking.description import read_run
from cluster.tracking.tracking import Tracking, saved_uri

pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.mark.parametrize(
    ("uri", "shown"),
    [
        ("http://u:se%40cret@h:5000", "http://h:5000"),
        ("https://u:se@cret@h/prefix", "https://h/prefix"),
        ("http://secret@h", "http://h"),
        ("postgresql://u:se/cr@et@h:1/db", "postgresql://h:1/db"),
        ("mysql+pymysql://u:sec/ret@h/db?charset=utf8mb4", "mysql+pymysql://h/db?charset=utf8mb4"),
        ("postgresql://u:secret@[::1]:5432/db", "postgresql://[::1]:5432/db"),
        ("postgresql://u:sec?ret@h/db", "postgresql://..."),
        ("postgresql://h/db?PASSWORD=se@cret", "postgresql://..."),
        ("postgresql://h/db?user=u&password=secret&timeout=9", "postgresql://h/db?user=u&timeout=9"),
        ("postgresql://h/db?p%61ssword=secret", "postgresql://h/db"),
        ("postgresql://h/db?sslkey=/secret&sslpassword=secret&sslmode=require", "postgresql://h/db?sslmode=require"),
        ("mssql+pyodbc://u:secret@h/db?driver=ODBC+Driver+18", "mssql+pyodbc://h/db?driver=ODBC+Driver+18"),
        ("mssql+pyodbc:///?odbc_connect=DRIVER=x;UID=u;PWD=secret", "mssql+pyodbc:///"),
        ("https://h/?sas=secret&code=secret#token=secret", "https://h/"),
        ("http://h#token=secret", "http://h"),
        ("postgresql://h/db?options=-c%20password%3Dsecret", "postgresql://h/db"),
        ("u:secret@h/db", "h/db"),
        ("//u:secret@h/db", "//h/db"),
        ("sqlite:////a/with@sign/mlflow.db?timeout=9", "sqlite:////a/with@sign/mlflow.db?timeout=9"),
        ("databricks://profile", "databricks://profile"),
        ("some/folder", "some/folder"),
    ],
)  # fmt: skip
def test_what_is_shown_of_an_address(uri, shown):
    assert redacted(uri) == shown
    assert redacted(shown) == shown
    said = one_line(ValueError(f"(psycopg2.OperationalError) {uri}: no such host\nmore of {uri}"))
    assert not re.search("secret|se%40cret|cret|ret@|sec/", said)


SPECIAL = st.lists(st.sampled_from([*list("@/?#:&=;%+, '\"[]"), "hunter"]), min_size=1).map("".join)


@given(SPECIAL, st.sampled_from(["postgresql", "mysql+pymysql", "http"]), st.booleans())
def test_no_part_of_a_password_is_shown_whatever_characters_it_has(password, scheme, query):
    uri = f"{scheme}://user:{password}@host:1/db{'?timeout=9' if query else ''}"
    assert "hunter" not in redacted(uri)
    assert "hunter" not in one_line(ValueError(f"API request to {uri}/api/2.0 failed"), uri)
    value = password.replace("&", "")
    assert "hunter" not in redacted(f"{scheme}://host:1/db?password={value}{'&timeout=9' if query else ''}")


def test_what_a_run_prints_at_its_end_is_quoted_and_has_no_password(tmp_path):
    def where(uri):
        return Tracking(tmp_path, uri, "", read_run).where("mlflow")

    assert where("postgresql://u:secret@db/ml flow") == (
        "MLFLOW_DISABLE_TELEMETRY=true mlflow ui --backend-store-uri 'postgresql://db/ml flow'"
        " (add its user and password, which are not shown)"
    )
    assert shlex.split(where("sqlite:////a b/it's/mlflow.db"))[-1] == "sqlite:////a b/it's/mlflow.db"
    for text in ("request to http://u:p secret@h/api failed", "{'password': 'secret'}", "connect(password = secret)"):
        assert "secret" not in one_line(ValueError(text))


def test_the_folder_holds_no_secret_and_a_resumed_run_finds_it_again(tmp_path, monkeypatch):
    whole = "postgresql://u:se/cr@et@127.0.0.1:1/db?sslkey=/my/secret&sslmode=require"
    said = tracking(write_run(tmp_path / "a", 1), whole).close("KILLED")
    saved = saved_uri(tmp_path / "a")
    assert saved == redacted(whole) == "postgresql://127.0.0.1:1/db?sslmode=require"
    assert str(said).startswith(f"not logged to MLflow at {saved}: 1 row, the status KILLED: ")
    assert not re.search("cret|se/", str(said) + (tmp_path / "a/mlflow.json").read_text())
    assert check_uri(begun_with=saved) == saved
    monkeypatch.setenv("MLFLOW_TRACKING_URI", whole)
    assert check_uri(begun_with=saved) == whole
    assert with_password("postgresql://u@127.0.0.1:1/db?sslmode=require") == whole
    own = "http://me:mine@h:5000"
    for usual in ("http://h:5000", "http://you:yours@h:5000"):
        monkeypatch.setenv("MLFLOW_TRACKING_URI", usual)
        assert (with_password(own), with_password("http://h:5000/")) == (own, usual)


RUN = """
from pathlib import Path
from cluster.tracking.address import check_uri
from tracked import read_run, send, tracking, write_run
run = tracking(write_run(Path("a"), 2), check_uri())
print(run.wait_id(60))
write_run(Path("a"), 3, success_rate=0.5)
print(run.close("FINISHED"), run.where("mlflow"), run.error)
(Path("a") / "trajectory.png").write_bytes(b"png")
print(send(Path("a"), ""))
"""


@pytest.mark.e2e
def test_a_secret_is_in_nothing_that_is_printed_written_or_sent(tmp_path):
    secret, port = "hunter2", free_port()
    address = f"http://someone:p%40{secret}@127.0.0.1:{port}"
    with mlflow_server(tmp_path, port):
        done = finish("python", "-c", RUN, cwd=tmp_path, MLFLOW_TRACKING_URI=address, PYTHONPATH=PYTHONPATH)
        run_id = json.loads((tmp_path / "a/mlflow.json").read_text())["run_id"]
        assert client(f"http://127.0.0.1:{port}").get_run(run_id).info.status == "FINISHED"
    assert f"None http://127.0.0.1:{port}/#/experiments/" in done.stdout
    assert "('1 file', " in done.stdout
    assert secret not in done.stdout + done.stderr
    written = [path for path in tmp_path.rglob("*") if path.is_file()]  # the server's database and artifacts, too
    assert len([path for path in written if "served/" in str(path)]) > 10
    assert [path for path in written if secret.encode() in path.read_bytes()] == []
