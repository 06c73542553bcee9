"""Whole runs on an MLflow server that is killed under them: none is lost, slowed or doubled, and all of it gets there.

Two runs of one seed. `during` goes on while the server is away, and has it back before its end; `after` ends without
it, and is sent later.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import sqlite3
from types import SimpleNamespace

import pytest
from commands import finish, rows, running, summary, wait_until
from tracked import client, free_port, mlflow_server

from cluster.run import send_missing
from cluster.store.folder import open_run

pytestmark = pytest.mark.e2e

GENERATIONS = 12
SMALL = ["--scenario", "curved", "--traffic", "2", "--population", "48", "--generations", str(GENERATIONS),
         "--seed", "5", "--until", "2"]  # fmt: skip
COMMAND = "gridsim-evolve"


def query(database, text, *arguments):
    with contextlib.closing(sqlite3.connect(database)) as connection:
        return connection.execute(text, arguments).fetchall()


@pytest.fixture(scope="module")
def served(tmp_path_factory, empty_database):
    cwd = tmp_path_factory.mktemp("served")
    shutil.copy(empty_database, cwd / "served.db")
    port = free_port()
    uri = f"http://127.0.0.1:{port}"
    runs, said = {}, {}
    begun = "SELECT count(DISTINCT name) FROM metrics JOIN runs USING (run_uuid)"
    with contextlib.ExitStack() as stack:
        with mlflow_server(cwd, port):
            for name in ("during", "after"):
                asked = (*SMALL, "--workers", "0", "--name", name, "--tracking-uri", uri)
                runs[name] = stack.enter_context(running(COMMAND, *asked, cwd=cwd))
            wait_until(lambda: query(cwd / "served.db", begun) == [(2,)], 300)
        seen = len(rows(cwd / "runs/during"))  # and the server is dead
        wait_until(lambda: len(rows(cwd / "runs/during")) >= min(seen + 3, GENERATIONS), 300)
        os.kill(runs["during"].pid, signal.SIGSTOP)
        said["after"] = runs["after"].communicate(timeout=600)
        with mlflow_server(cwd, port):
            os.kill(runs["during"].pid, signal.SIGCONT)
            said["during"] = runs["during"].communicate(timeout=600)
            yield SimpleNamespace(cwd=cwd, uri=uri, database=cwd / "served.db", said=said, runs=runs)


def check_complete(served, name):
    """Everything of a run is in MLflow, once."""
    folder = served.cwd / "runs" / name
    found = summary(folder)
    run_id = found["mlflow_run_id"]
    run = client(served.uri).get_run(run_id)
    assert run.info.status == "FINISHED"
    assert query(served.database, "SELECT count(*) FROM runs WHERE name LIKE ?", f"{name}%") == [(1,)]
    doubled = "SELECT key, step FROM metrics WHERE run_uuid = ? GROUP BY key, step HAVING count(*) > 1"
    assert query(served.database, doubled, run_id) == []

    history = rows(folder)
    assert len(history) == GENERATIONS
    for column in set(history[0]) - {"generation", "target_m"}:
        wanted = {int(row["generation"]): float(row[column]) for row in history}
        if column == "validation/success_rate":
            wanted[GENERATIONS] = found["validation_success_rate"]  # with the last candidate, tried after the last step
        logged = client(served.uri).get_metric_history(run_id, column)
        assert {metric.step: metric.value for metric in logged} == pytest.approx(wanted)
        times = {metric.step: metric.timestamp - run.info.start_time for metric in logged if metric.step < GENERATIONS}
        assert times == pytest.approx({k: 1000.0 * float(row["wall_s"]) for k, row in enumerate(history)}, abs=2.0)
    assert run.data.metrics["held_out/distance_m"] == found["held_out"]["distance_m"]
    assert f"**{found['held_out']['success_rate']:.1%}**" in run.data.tags["mlflow.note.content"]
    assert f'"runs:/{run_id}/model"' in run.data.tags["mlflow.note.content"]

    stored = served.cwd / "served" / run.info.experiment_id / run_id / "artifacts"
    files = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    assert {"drive.html", "curves.png", "trajectory.png", "model/MLmodel"} <= {path.as_posix() for path in files}
    for path in files:
        assert (stored / path).read_bytes() == (folder / path).read_bytes()
    versions = client(served.uri).search_model_versions(f"run_id = '{run_id}'")
    assert [each.tags["champion_sha256"] for each in versions] == [found["champion_sha256"]]
    return run


def away(served):
    """What a run says while its server is away, if it gets to it."""
    return rf"{COMMAND}: warning: MLflow at {served.uri} cannot be used: [^\n]* and sends its rows later\n"


def test_a_run_outlives_an_outage_and_loses_nothing(served):
    _out, err = served.said["during"]
    assert served.runs["during"].returncode == 0
    assert re.fullmatch(rf"({away(served)}[^\n]* is back, and has all rows\n)?", err)
    check_complete(served, "during")
    assert len({summary(served.cwd / "runs" / name)["champion_sha256"] for name in ("during", "after")}) == 1


def test_a_run_that_ended_without_its_server_is_sent_later_and_once(served):
    _out, err = served.said["after"]
    assert served.runs["after"].returncode == 0
    assert re.fullmatch(
        rf"({away(served)})?"
        rf"{COMMAND}: warning: not logged to MLflow at {served.uri}: \d+ rows? \(step [\d to]*{GENERATIONS}\), "
        rf"\d+ files, the model, the status FINISHED: [^\n]*; send it later with: \S*{COMMAND} --resume runs/after\n",
        err,
    )
    folder = served.cwd / "runs/after"
    ended = (folder / "summary.json").stat().st_mtime
    done = finish(COMMAND, "--resume", "runs/after", cwd=served.cwd)
    assert done.stderr == ""
    sent = r"is finished: \d+ generations; sent to MLflow: \d+ rows?, \d+ files, 1 model\. To go on"
    assert re.search(sent, done.stdout)
    run = check_complete(served, "after")
    assert run.info.end_time <= 1000.0 * ended + 2.0  # not when it was sent
    assert run.info.end_time - run.info.start_time == pytest.approx(1000.0 * summary(folder)["wall_s"], abs=2.0)

    tables = ("runs", "metrics", "tags", "model_versions")
    before = [query(served.database, f"SELECT * FROM {table}") for table in tables]
    assert send_missing(open_run(folder), "", "gridsim") == ("", None)
    assert before == [query(served.database, f"SELECT * FROM {table}") for table in tables]


def test_an_edited_run_is_finished_all_the_same_and_nothing_of_it_is_sent(served, tmp_path):
    folder = shutil.copytree(served.cwd / "runs/during", tmp_path / "edited")
    (folder / "summary.json").write_text(json.dumps(summary(folder) | {"wall_s": None}))
    before = query(served.database, "SELECT * FROM metrics")
    sent, lost = send_missing(open_run(folder), "", "gridsim")
    assert sent == ""
    assert re.fullmatch("what MLflow lacks is not sent: .*", str(lost))
    assert query(served.database, "SELECT * FROM metrics") == before


def test_a_server_that_is_away_is_no_reason_to_fail(served):
    uri = f"http://127.0.0.1:{free_port()}"
    done = finish(COMMAND, "--resume", "runs/during", "--tracking-uri", uri, cwd=served.cwd)
    finished = f"is finished: {GENERATIONS} generations; nothing to do."
    assert f"{finished} To go on beyond its end, resume it with a greater --generations." in done.stdout
    not_sent = rf"{COMMAND}: warning: what MLflow lacks is not sent: no MLflow server at {uri}: [^\n]*\n"
    assert re.fullmatch(not_sent, done.stderr)
