"""MLflow's stores as people have them: hosted, of another MLflow, locked, in odd folders, with files elsewhere."""

import contextlib
import os
import shlex
import sqlite3
import threading
import time
import urllib.request
from pathlib import Path

import pytest
from commands import all_in_mlflow, finish, start, summary
from tracked import begin, client, free_port, mlflow_server, runs, steps, tracker

from cluster.commands.common import WorkFlags
from cluster.tracking import mlflow_run
from cluster.tracking.address import TrackingError, check_uri, reach_loopback_directly, sqlite_path, sqlite_uri
from cluster.tracking.mlflow_run import run_tables

TINY = ("--scenario", "curved", "--traffic", "0", "--population", "16", "--generations", "2", "--workers", "0")


@pytest.mark.parametrize(
    "name", ["what now?", "a#b", "100%", "a%41b", "a;b&c", "it's", '"quoted"', "[old]", "a b", "ü", "a?b=c", "a?b=c/d"]
)
def test_the_address_of_a_database_in_an_odd_folder(tmp_path, monkeypatch, name):
    (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / name)
    uri, path = check_uri(), tmp_path / name / "mlflow.db"
    assert sqlite_path(uri) == path
    assert check_uri(uri) == uri
    if "=" not in name:  # which would be read as a parameter
        assert check_uri(f"sqlite:///{path}") == uri
    assert sqlite_uri(path, "timeout=9") == check_uri("sqlite:///mlflow.db?timeout=9")
    from sqlalchemy.engine import make_url

    assert make_url(uri).database == str(path)


@pytest.mark.e2e
def test_a_run_in_a_folder_with_an_odd_name(tmp_path):
    folder, elsewhere = tmp_path / "what now? #1 100%41;a&b'\" ü [c]", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    done = finish("gridsim-evolve", *TINY, "--name", "a", cwd=folder)
    assert done.stderr == ""
    assert sorted(os.listdir(folder)) == ["mlartifacts", "mlflow.db", "runs"]
    assert sorted(os.listdir(tmp_path)) == ["elsewhere", folder.name]
    again = finish("gridsim-evolve", "--resume", str(folder / "runs/a"), "--generations", "3", cwd=elsewhere)
    assert again.stderr == ""
    assert os.listdir(elsewhere) == []
    uri = check_uri(sqlite_uri(folder / "mlflow.db"))
    run_id = summary(folder / "runs/a")["mlflow_run_id"]
    assert [run.info.run_id for run in runs(uri)] == [run_id]
    assert sorted(each.step for each in client(uri).get_metric_history(run_id, "car_steps"))[:3] == [0, 1, 2]
    assert (folder / "mlartifacts" / run_id / "artifacts/model/MLmodel").is_file()
    assert list(run_tables(uri, "http://127.0.0.1:5000")) == ["gridsim"]
    (command,) = [line for line in done.stdout.splitlines() if line.startswith("compare: make ui, or ")]
    words = shlex.split(command.removesuffix("; then open"))
    assert words[words.index("--backend-store-uri") + 1] == uri


def test_an_experiment_is_taken_from_mlflows_own_variable(monkeypatch):
    assert WorkFlags().experiment == "gridsim"
    monkeypatch.setenv("MLFLOW_EXPERIMENT_NAME", "theirs")
    assert WorkFlags().experiment == "theirs"


def older(path):
    """A database of MLflow's at the revision before the newest that made a table."""
    mlflow_run.quiet()
    from alembic import command
    from mlflow.store.db import utils
    from mlflow.store.tracking.dbmodels.initial_models import Base

    engine = utils.create_sqlalchemy_engine(f"sqlite:///{path}")
    Base.metadata.create_all(engine)
    config = utils._get_alembic_config(f"sqlite:///{path}")
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, "0584bdc529eb")  # of MLflow 2.19
    engine.dispose()
    return path.read_bytes()


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore")  # of SQLAlchemy's, about MLflow
def test_a_database_of_an_older_mlflow_is_refused_before_it_is_migrated(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mlflow.db"
    before, uri = older(path), f"sqlite:///{path}"
    said = (
        f"{uri} was made by an older MLflow, which cannot open it once it is upgraded; copy it, then run "
        f"mlflow db upgrade {uri}, or use another --tracking-uri"
    )
    for program, *flags in (["gridsim-evolve", *TINY], ["gridsim-compare", "--quick", "--workers", "0"]):
        done = finish(program, *flags, cwd=tmp_path, code=2)
        assert done.stderr == f"{program}: error: {said}\n"
    done = finish("python", "-m", "cluster.commands.ui", str(free_port()), cwd=tmp_path, code=1)
    assert done.stderr == f"make ui: {said}\n"
    refused = tracker(uri, 1)  # as the tracker says of a database server
    with pytest.raises(TrackingError, match="was made by an older MLflow"):
        refused.wait_ready()
    refused.close("KILLED")
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["mlflow.db"]
    finish("mlflow", "db", "upgrade", uri, cwd=tmp_path)  # as it says
    assert check_uri() == uri


def test_a_run_is_looked_for_by_its_id_then_in_its_experiment_alone(uri, monkeypatch):
    from mlflow.tracking import MlflowClient

    run_id = begin(uri, 2)
    asked = []
    real = MlflowClient.search_runs

    def search_runs(self, experiment_ids, *arguments, **options):
        asked.append(experiment_ids)
        return real(self, experiment_ids, *arguments, **options)

    monkeypatch.setattr(MlflowClient, "search_runs", search_runs)
    monkeypatch.setattr(MlflowClient, "search_experiments", lambda *_, **__: pytest.fail("scans all experiments"))
    assert begin(uri, 4, experiment="other", run_id=run_id) == run_id
    assert asked == []
    assert begin(uri, 5) == run_id  # killed before its id was saved
    assert len(asked) == len(asked[0]) == 1
    assert begin(uri, 5, run_id="0" * 32) == run_id  # an id of another store
    assert begin(uri, 1, run_id=run_id, key="of another run") != run_id
    assert steps(uri, run_id) == list(range(5))


@pytest.mark.e2e
def test_a_database_that_is_locked_for_ten_seconds_as_a_run_starts(uri):
    with contextlib.closing(sqlite3.connect(uri.removeprefix("sqlite:///"), isolation_level=None)) as database:
        database.execute("BEGIN EXCLUSIVE")
        started = time.perf_counter()
        assert check_uri(uri) == uri
        assert time.perf_counter() - started < 1.0
        logged = tracker(uri, 3)
        time.sleep(8.0)
        database.execute("ROLLBACK")
    assert logged.close("FINISHED") is None
    assert steps(uri, logged.run_id) == [0, 1, 2]


PLUGIN = """
def tracking(store_uri, artifact_uri):
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    folder = store_uri.removeprefix("filetest://")
    return SqlAlchemyStore(f"sqlite:///{folder}/hosted.db", f"{folder}/files")

def registry(store_uri, **_):
    from mlflow.store.model_registry.sqlalchemy_store import SqlAlchemyStore

    return SqlAlchemyStore(f"sqlite:///{store_uri.removeprefix('filetest://')}/hosted.db")
"""


@pytest.mark.e2e
def test_a_run_in_the_store_of_a_plug_in(tmp_path):
    plugin, hosted, cwd = (tmp_path / name for name in ("plugin", "hosted", "cwd"))
    for folder in (plugin / "filetest-1.0.dist-info", hosted, cwd):
        folder.mkdir(parents=True)
    (plugin / "filetest.py").write_text(PLUGIN)
    (plugin / "filetest-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: filetest\nVersion: 1.0\n")
    (plugin / "filetest-1.0.dist-info/entry_points.txt").write_text(
        "[mlflow.tracking_store]\nfiletest = filetest:tracking\n"
        "[mlflow.model_registry_store]\nfiletest = filetest:registry\n"
    )
    flags = (*TINY, "--name", "a", "--tracking-uri", f"filetest://{hosted}")
    refused = finish("gridsim-evolve", *flags, cwd=cwd, code=2)
    assert f"filetest://{hosted}: not a tracking address" in refused.stderr
    done = finish("gridsim-evolve", *flags, cwd=cwd, PYTHONPATH=str(plugin))
    assert done.stderr == ""
    assert f"compare: filetest://{hosted}\n" in done.stdout
    assert os.listdir(cwd) == ["runs"]
    run_id = summary(cwd / "runs/a")["mlflow_run_id"]
    run = client(f"sqlite:///{hosted}/hosted.db").get_run(run_id)
    assert run.info.status == "FINISHED"
    assert run.info.artifact_uri.startswith(f"{hosted}/files/")
    assert Path(run.info.artifact_uri, "model/MLmodel").is_file()
    again = finish("gridsim-evolve", "--resume", "runs/a", cwd=cwd, PYTHONPATH=str(plugin))
    assert "nothing to do" in again.stdout


@pytest.mark.parametrize("uri", ["databricks", "databricks://profile"])
def test_hosted_stores_are_left_to_mlflow(uri):
    assert check_uri(uri) == check_uri(begun_with=uri) == uri
    assert tracker(uri).where("mlflow") == uri


@pytest.mark.e2e
def test_files_of_a_server_that_does_not_serve_them(tmp_path, impatient):
    root, port = tmp_path / "srv" / "files", free_port()
    picture = tmp_path / "a.png"
    picture.write_bytes(b"png")
    with mlflow_server(tmp_path, port, "--no-serve-artifacts", "--default-artifact-root", str(root)):
        uri = check_uri(f"http://127.0.0.1:{port}")
        logged = tracker(uri, 2)
        logged.log_files([picture])
        assert logged.close("FINISHED") == (
            f"not logged to MLflow at {uri}: 1 file: the experiment keeps its files in {root}/1, which is not on this "
            "machine: create it if they belong here, else start the server with --serve-artifacts and use a new "
            "--experiment"
        )
        assert not root.exists()
        assert not root.parent.exists()
        assert steps(uri, logged.run_id) == [0, 1]
        root.mkdir(parents=True)  # the server is on this machine, or shares the folder
        again = tracker(uri, 2)
        again.log_files([picture])
        assert again.close("FINISHED") is None
        assert (root / "1" / again.run_id / "artifacts/a.png").read_bytes() == b"png"


@pytest.mark.e2e
def test_several_first_runs_at_once_in_an_empty_folder(tmp_path):
    names = [str(number) for number in range(4)]
    started = [start("gridsim-evolve", *TINY, "--seed", name, "--name", name, cwd=tmp_path) for name in names]
    for process in started:
        out, err = process.communicate(timeout=600)
        assert (process.returncode, err) == (0, ""), out
    for name in names:
        assert all_in_mlflow(tmp_path / "runs" / name)
        assert client(f"sqlite:///{tmp_path}/mlflow.db").search_model_versions(
            f"run_id = '{summary(tmp_path / 'runs' / name)['mlflow_run_id']}'"
        )
    assert sorted(os.listdir(tmp_path)) == ["mlartifacts", "mlflow.db", "runs"]


@pytest.mark.filterwarnings("ignore")  # of SQLAlchemy's, about MLflow
def test_only_one_process_builds_a_database(tmp_path, monkeypatch):
    from mlflow.store.db import utils

    built = []
    real = utils._upgrade_db

    def upgrade(engine):
        built.append(engine)
        real(engine)

    monkeypatch.setattr(utils, "_upgrade_db", upgrade)
    threads = [threading.Thread(target=mlflow_run._create_database, args=(tmp_path / "mlflow.db",)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(built) == 1
    assert os.listdir(tmp_path) == ["mlflow.db"]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ({"http_proxy": "http://p:1"}, "127.0.0.1,localhost,::1,[::1]"),
        ({"ALL_PROXY": "http://p:1", "NO_PROXY": "a.b, localhost"}, "a.b,localhost,127.0.0.1,::1,[::1]"),
        ({"https_proxy": "http://p:1", "no_proxy": "*"}, "*"),
        ({"no_proxy": "a.b"}, "a.b"),
        ({}, None),
    ],
)
def test_this_machine_is_never_asked_through_a_proxy(monkeypatch, before, after):
    import requests

    for name in [name for name in os.environ if name.lower().endswith("_proxy")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("no_proxy", "")  # so that it is as it was in the end
    monkeypatch.delenv("no_proxy")
    for name, value in before.items():
        monkeypatch.setenv(name, value)
    reach_loopback_directly()
    reach_loopback_directly()
    assert os.environ.get("no_proxy") == after
    if len(os.environ.get("no_proxy", "")) > 20:
        for host in ("127.0.0.1", "localhost", "[::1]"):
            assert requests.utils.should_bypass_proxies(f"http://{host}:5000", None)
            assert urllib.request.proxy_bypass(f"{host}:5000")
