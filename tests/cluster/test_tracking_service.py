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
from tracked import PYTHONPATH, client, free_port, mlflow_server

from cluster.runs.run import open_run
from cluster.runs.train import send_missing

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

    def begun(name):
        rows_of = "SELECT count(*) FROM metrics JOIN runs USING (run_uuid) WHERE name LIKE ?"
        return query(cwd / "served.db", rows_of, f"{name}%")[0][0]

    with contextlib.ExitStack() as stack:
        with mlflow_server(cwd, port):
            for name in ("during", "after"):
                asked = (*SMALL, "--workers", "0", "--name", name, "--tracking-uri", uri)
                runs[name] = stack.enter_context(running(COMMAND, *asked, cwd=cwd))
            wait_until(lambda: begun("during") and begun("after"), 300)
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
    run = client(served.uri).get_run(found["mlflow_run_id"])
    assert run.info.status == "FINISHED"
    run_id = run.info.run_id
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
    metrics = run.data.metrics
    assert metrics["held_out/distance_m"] == found["held_out"]["distance_m"]
    assert f"**{found['held_out']['success_rate']:.1%}**" in run.data.tags["mlflow.note.content"]
    assert f'"runs:/{run_id}/model"' in run.data.tags["mlflow.note.content"]

    stored = served.cwd / "served" / run.info.experiment_id / run_id / "artifacts"
    files = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    assert {"drive.html", "curves.png", "trajectory.png", "model/MLmodel"} <= {path.as_posix() for path in files}
    for path in files:
        assert (stored / path).read_bytes() == (folder / path).read_bytes()
    versions = client(served.uri).search_model_versions(f"run_id = '{run_id}'")
    assert [each.tags["champion_sha256"] for each in versions] == [found["champion_sha256"]]
    assert versions[0].name == "gridsim-curved-evolution"
    return run


def away(served):
    """What a run says while its server is away, if it gets to it."""
    return rf"{COMMAND}: warning: MLflow at {served.uri} cannot be used: [^\n]* and sends its rows later\n"


def test_a_run_outlives_an_outage_and_loses_nothing(served):
    _out, err = served.said["during"]
    assert served.runs["during"].returncode == 0
    assert re.fullmatch(rf"({away(served)}[^\n]* is back, and has all rows\n)?", err)
    run = check_complete(served, "during")
    assert len({summary(served.cwd / "runs" / name)["champion_sha256"] for name in ("during", "after")}) == 1
    assert run.info.run_name == "during"
    assert run.data.tags["group"] == "curved evolution mlp:64+motion+steering 2 cars, until 2.0, population 48"


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
    assert re.search(
        r"is finished: \d+ generations; sent to MLflow: \d+ rows?, \d+ files, 1 model\. To go on", done.stdout
    )
    run = check_complete(served, "after")
    assert run.info.end_time <= 1000.0 * ended + 2.0  # not when it was sent
    assert run.info.end_time - run.info.start_time == pytest.approx(1000.0 * summary(folder)["wall_s"], abs=2.0)

    tables = ("runs", "metrics", "tags", "model_versions")
    before = [query(served.database, f"SELECT * FROM {table}") for table in tables]
    assert send_missing(open_run(folder), "", "gridsim") == ("", None)
    assert before == [query(served.database, f"SELECT * FROM {table}") for table in tables]


FRESH = """
import sys
import mlflow.pytorch
from cluster.runs.champion import load_champion
from tracked import drive_both
mlflow.set_tracking_uri(sys.argv[1])
model = mlflow.pytorch.load_model("models:/gridsim-curved-evolution/1")
print(*drive_both(load_champion(sys.argv[2]), model, 2))
"""


def test_the_registered_champion_drives_as_the_file_does(served):
    """In a fresh process, which takes no pickle, from the registry alone."""
    champion, safe = served.cwd / "runs/during/champion.npz", {"MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false"}
    done = finish("python", "-c", FRESH, served.uri, str(champion), cwd="/", PYTHONPATH=PYTHONPATH, timeout=600, **safe)
    count, end, distance = done.stdout.split()
    assert int(count) > 10
    assert end in ("collision", "idle", "success", "time")
    assert float(distance) > 0.0


@pytest.mark.parametrize("change", [{"held_out": 3}, {"wall_s": None}])
def test_an_edited_run_is_finished_all_the_same_and_nothing_of_it_is_sent(served, tmp_path, change):
    shutil.copytree(served.cwd / "runs/during", tmp_path / "edited")
    path = tmp_path / "edited/summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    before = query(served.database, "SELECT * FROM metrics")
    sent, lost = send_missing(open_run(tmp_path / "edited"), "", "gridsim")
    assert sent == ""
    assert lost is not None
    assert lost.startswith("what MLflow lacks is not sent: ")
    assert "\n" not in lost
    assert query(served.database, "SELECT * FROM metrics") == before


def test_a_server_that_is_away_is_no_reason_to_fail(served):
    uri = f"http://127.0.0.1:{free_port()}"
    done = finish(COMMAND, "--resume", "runs/during", "--tracking-uri", uri, cwd=served.cwd)
    finished = f"is finished: {GENERATIONS} generations; nothing to do."
    assert f"{finished} To go on beyond its end, resume it with a greater --generations." in done.stdout
    assert re.fullmatch(
        rf"{COMMAND}: warning: what MLflow lacks is not sent: no MLflow server at {uri}: [^\n]*\n", done.stderr
    )
