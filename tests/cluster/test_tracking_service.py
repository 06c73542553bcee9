"""Runs on an MLflow server that goes away before, while and after they train: all of each gets there, once."""

import contextlib
import shutil
import sqlite3

import pytest
from commands import wait_until
from tracked import HELD_OUT, MODEL, NAMES, client, free_port, mlflow_server, row, send, steps, tracking, write_run

from cluster.tracking.description import read_run
from cluster.tracking.tracking import sync

pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("in_this_process")]

TABLES = ("runs", "metrics", "tags", "params", "model_versions", "registered_model_aliases")


@pytest.fixture
def served(tmp_path, empty_database):
    """A server's address, and what starts it."""
    shutil.copy(empty_database, tmp_path / "served.db")
    port = free_port()
    return f"http://127.0.0.1:{port}", lambda *flags: mlflow_server(tmp_path, port, *flags)


def query(database, text, *arguments):
    with contextlib.closing(sqlite3.connect(database)) as connection:
        return connection.execute(text, arguments).fetchall()


def check_complete(uri, folder, count, run_id):
    """Everything of a finished run of so many steps is in MLflow, once."""
    run, root = client(uri).get_run(run_id), folder.parent
    assert run.info.status == "FINISHED"
    assert query(root / "served.db", "SELECT count(*) FROM runs WHERE name = ?", folder.name) == [(1,)]
    doubled = "SELECT key, step FROM metrics WHERE run_uuid = ? GROUP BY key, step HAVING count(*) > 1"
    assert query(root / "served.db", doubled, run_id) == []
    assert steps(uri, run_id) == list(range(count))
    history, begun = client(uri).get_metric_history(run_id, NAMES[0]), run.info.start_time
    times = {each.step: each.timestamp - begun for each in history}
    assert times == {step: 1000 * row(step)["wall_s"] for step in range(count)}
    assert run.data.metrics["held_out/distance_m"] == HELD_OUT["distance_m"]
    assert "**50.0%**" in run.data.tags["mlflow.note.content"]
    assert f'"runs:/{run_id}/model"' in run.data.tags["mlflow.note.content"]
    stored = root / "served" / run.info.experiment_id / run_id / "artifacts"
    content = read_run(folder)
    assert content
    for path in content.files:
        assert (stored / path.name).read_bytes() == path.read_bytes()
    assert (stored / "model/model.onnx").read_bytes() == (folder / "champion.onnx").read_bytes()
    assert [each.run_id for each in client(uri).search_model_versions(f"name = '{MODEL}'")] == [run_id]


def test_a_server_that_is_away_before_while_and_after_a_run(served, tmp_path, impatient):
    uri, server = served
    folder = write_run(tmp_path / "a", 2)
    run = tracking(folder, uri)
    wait_until(lambda: run.error == "Connection refused")  # before
    with server():
        wait_until(lambda: run.sent.get("row") == 2 and run.error is None)
    write_run(folder, 5)
    wait_until(lambda: run.error == "Connection refused")  # while it trains
    with server():
        wait_until(lambda: run.sent.get("row") == 5 and run.error is None)
    write_run(folder, 7, success_rate=0.5)
    lacking = "3 rows, 6 files, the model, the status FINISHED"
    assert run.close("FINISHED") == f"not logged to MLflow at {uri}: {lacking}: Connection refused"  # as it ends
    with server():
        assert send(folder, "", "") == ("3 rows, 6 files, 1 model", run.run_id)  # and later
        check_complete(uri, folder, 7, run.run_id)
        before = [query(tmp_path / "served.db", f"SELECT * FROM {table}") for table in TABLES]
        assert send(folder, uri) == ("", run.run_id)
        assert before == [query(tmp_path / "served.db", f"SELECT * FROM {table}") for table in TABLES]


def test_files_of_a_server_that_does_not_serve_them(served, tmp_path, impatient):
    uri, server = served
    folder, root = write_run(tmp_path / "a", 2, success_rate=0.5), tmp_path / "srv/files"
    with server("--no-serve-artifacts", "--default-artifact-root", str(root)):
        sent, lacking = sync(folder, uri, "driving", read_run)
        assert sent == "3 rows"
        place = next(path for path in (root / "2", root / "1") if str(path) in str(lacking))
        assert lacking == (
            f"not logged to MLflow at {uri}: 6 files, the model: the experiment keeps its files in {place}, which is "
            "not on this machine: create it if they belong here, else start the server with --serve-artifacts and use "
            "a new --experiment"
        )
        assert not root.parent.exists()
        root.mkdir(parents=True)  # the server is on this machine, or shares the folder
        _, run_id = send(folder, uri)
        assert (place / run_id / "artifacts/curves.png").read_bytes() == b"png"
