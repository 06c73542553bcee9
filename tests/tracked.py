"""Rows that the tests of tracking log, what MLflow then has, asked through its own client, and its own server."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from cluster import tracking
from cluster.tracker import Tracker
from cluster.tracking_address import TrackingError, check_uri

NAMES = ["fitness/best", "distance_m/mean", "car_steps", "wall_s"]
PARAMS = {"scenario": "seamless", "population": "512", "generations": "60"}
TAGS = {"algorithm": "evolution", "scenario": "seamless"}


def row(step):
    return {name: step * 10.0 + place for place, name in enumerate(NAMES)}


def client(uri):
    """MLflow's own."""
    tracking.quiet()
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


def tracker(uri, **options):
    given = {"experiment": "driving", "run_name": "a run", "params": PARAMS, "tags": TAGS, "key": "the-key", **options}
    return Tracker(uri, **given)


def with_path(**more):
    """An environment in which scripts find the packages, whatever the working directory."""
    root = str(Path(tracking.__file__).resolve().parents[1])
    return {**os.environ, "PYTHONPATH": root, **more}


# ---------------------------------------------------------------------------------------------- a server


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@contextlib.contextmanager
def mlflow_server(folder, port):
    """MLflow's own, with a database and artifacts in `folder`; what is yielded kills it."""
    command = [sys.executable, "-m", "mlflow", "server", "--workers", "1", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--backend-store-uri", f"sqlite:///{folder}/served.db", "--artifacts-destination", f"{folder}/served"]
    with open(folder / "server.log", "a") as log:
        quick = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        server = subprocess.Popen(command, cwd=folder, env=quick, stdout=log, stderr=log, start_new_session=True)
    try:
        for _ in range(300):
            with contextlib.suppress(TrackingError):
                check_uri(f"http://127.0.0.1:{port}")
                break
            time.sleep(0.2)
        yield lambda: os.killpg(server.pid, signal.SIGKILL)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
        server.wait(10)


# ---------------------------------------------------------------------------------------------- a fresh process

DRIVE = """
import sys
import mlflow.pytorch, torch
from cluster.champion import load_champion
tracking, model, path, traffic = sys.argv[1:]
mlflow.set_tracking_uri(tracking)
network, champion = mlflow.pytorch.load_model(model), load_champion(path)

def drive(act):
    env = champion.make_env(traffic=int(traffic))
    observation, _ = env.reset(seed=2_000_001)
    actions, over = [], False
    while not over:
        actions.append(act(observation))
        observation, _, terminated, truncated, info = env.step(actions[-1])
        over = terminated or truncated
    return actions, info

mine, theirs = drive(champion.act), drive(lambda seen: int(network(torch.from_numpy(seen[None])).argmax()))
assert mine == theirs, (mine[1], theirs[1])
print(len(mine[0]), mine[1]["end"], mine[1]["distance_m"])
"""


def drive(tracking, model, champion, traffic):
    """Drive a model and a champion.npz in a fresh process that takes no pickle: steps, how it ended, metres."""
    command = [sys.executable, "-c", DRIVE, tracking, model, str(champion), str(traffic)]
    safe = with_path(MLFLOW_ALLOW_PICKLE_DESERIALIZATION="false")
    done = subprocess.run(command, env=safe, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    count, end, distance = done.stdout.split()
    return int(count), end, float(distance)
