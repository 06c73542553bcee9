"""Rows that the tests of tracking log, what MLflow then has, asked through its own client, and its own server."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

from commands import wait_until

from cluster.tracking import mlflow_run
from cluster.tracking.address import server_problem
from cluster.tracking.mlflow_run import Identity
from cluster.tracking.tracker import Tracker

NAMES = ["fitness/best", "distance_m/mean", "car_steps", "wall_s"]
PARAMS = {"scenario": "seamless", "population": "512", "generations": "60"}
TAGS = {"algorithm": "evolution", "scenario": "seamless"}
# With it scripts find the packages and this file, whatever the working directory.
PYTHONPATH = os.pathsep.join([str(Path(mlflow_run.__file__).resolve().parents[2]), str(Path(__file__).parent)])


def row(step):
    return {name: step * 10.0 + place for place, name in enumerate(NAMES)}


def client(uri):
    mlflow_run.quiet()
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


def tracker(uri, count=0, **options):
    """A tracker that was given so many rows."""
    given = {"experiment": "driving", "name": "a run", "params": PARAMS, "tags": TAGS, "key": "the-key", **options}
    made = Tracker(Identity(uri, **given))
    for step in range(count):
        made.log_row(step, row(step))
    return made


def begin(uri, count, **options):
    """A run of `count` rows that was stopped; returns its id."""
    begun = tracker(uri, count, **options)
    assert begun.close("KILLED", 60) is None
    return begun.run_id


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@contextlib.contextmanager
def mlflow_server(folder, port, *flags):
    """MLflow's own, with a database and artifacts in `folder`, until it is killed at the end."""
    command = [sys.executable, "-m", "mlflow", "server", "--workers", "1", "--host", "127.0.0.1", "--port", str(port)]
    command += [
        "--backend-store-uri",
        f"sqlite:///{folder}/served.db",
        "--artifacts-destination",
        f"{folder}/served",
        *flags,
    ]
    command += flags
    with open(folder / "server.log", "a") as log:
        quick = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        server = subprocess.Popen(command, cwd=folder, env=quick, stdout=log, stderr=log, start_new_session=True)
    try:
        wait_until(lambda: not server_problem(f"http://127.0.0.1:{port}"), pause=0.2)
        yield
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait(10)
