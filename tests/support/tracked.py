"""Folders of runs as they are written, what MLflow then has, asked through its own client, and its own server."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from dataclasses import asdict
from pathlib import Path

import numpy as np
from commands import wait_until

import cluster
from cluster.settings import EvolveSettings
from cluster.store.champion import Champion
from cluster.tracking.address import unreachable
from cluster.tracking.database import configure_mlflow
from cluster.tracking.description import read_run
from cluster.tracking.sync import serve
from cluster.tracking.tracking import Tracking, sync
from evolution.networks.export import to_onnx
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig

NAMES = ["fitness/best", "distance_m/mean", "car_steps", "wall_s"]
HELD_OUT = {
    "episodes": 64, "success_rate": 0.5, "distance_m": 1000.0, "speed_mps": 7.5, "collision_rate": 0.5,
    "km_per_collision": 2.0,
}  # fmt: skip
MODEL = "gridsim-curved-evolution"
# With it scripts find the packages and this file, whatever the working directory.
PYTHONPATH = os.pathsep.join([str(Path(cluster.__file__).resolve().parents[1]), str(Path(__file__).parent)])

# A process that tracks a run: arguments are the address, the folder, and one more if all of it has to arrive.
QUIET = """
import sys, time
from pathlib import Path
from cluster.tracking.address import check_uri
from tracked import tracking, write_run
assert not [name for name in ("mlflow", "sqlalchemy", "requests") if name in sys.modules]
folder, uri, started = write_run(Path(sys.argv[2]), 20, 0.5), check_uri(sys.argv[1]), time.perf_counter()
run = tracking(folder, uri)
assert time.perf_counter() - started < 1.0, "it waits for MLflow's import"
report = run.close("FINISHED")
assert (report is None) == (len(sys.argv) > 3), report
"""


class InThisProcess:
    """The process of `tracking.py` as threads of this one, whose MLflow a test can disturb."""

    def __init__(self, command, **options):
        configure_mlflow()
        (orders, stdin), (stdout, answers) = os.pipe(), os.pipe()
        self.stdin, self.stdout = os.fdopen(stdin, "w"), os.fdopen(stdout)
        self._orders, self._answers = os.fdopen(orders), os.fdopen(answers, "w", buffering=1)
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        with contextlib.suppress(SystemExit, ValueError):  # by a test; the answers are closed
            serve(self._orders, self._answers, self._orders.close)
        self.kill()

    def kill(self):
        self._answers.close()

    def wait(self):
        return 0


def row(step):
    return {name: step * 10.0 + place for place, name in enumerate(NAMES)}


def write_run(folder, count=3, success_rate=None, **flags):
    """A run's folder after so many generations; with a success rate it is finished, and has a champion of that seed."""
    settings = EvolveSettings("curved", **flags)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"command": "gridsim-evolve", "settings": asdict(settings)}))
    lines = [",".join(map(repr, [step, *row(step).values(), 375.0])) for step in range(count)]
    (folder / "history.csv").write_text("\n".join([",".join(["generation", *NAMES, "target_m"]), *lines, ""]))
    (folder / "summary.json").unlink(missing_ok=True)
    if success_rate is not None:
        spec = PolicySpec.parse(settings.policy)
        genome = np.random.default_rng(settings.seed).standard_normal(spec.size).astype(np.float32)
        Champion(genome, settings.policy, "curved", SimConfig()).save(folder / "champion.npz")
        (folder / "champion.onnx").write_bytes(to_onnx(spec, genome, SimConfig()))
        (folder / "curves.png").write_bytes(b"png")
        summary = {
            "generations": count, "car_steps": 1_000_000, "wall_s": 10.0 * count, "solved": True,
            "validation_success_rate": 0.75, "held_out": HELD_OUT | {"success_rate": success_rate},
        }  # fmt: skip
        (folder / "summary.json").write_text(json.dumps(summary))
    return folder


GIVEN: dict = {}


def read_given(folder):
    return GIVEN[folder]


def tracking(folder, uri, experiment="driving", given=None):
    """A run's tracking, started; of what is `given`, if it is, in place of the folder's files."""
    GIVEN[folder] = given
    started = Tracking(folder, uri, experiment, read_given if given else read_run)
    started.start()
    started.listen()
    return started


def send(folder, uri, experiment="driving"):
    """Send a folder, of which nothing may be left; returns what was sent, and MLflow's id of the run."""
    sent, lacking = sync(folder, uri, experiment, read_run)
    assert lacking is None
    return sent, json.loads((folder / "mlflow.json").read_text())["run_id"]


def client(uri):
    configure_mlflow()
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


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@contextlib.contextmanager
def mlflow_server(folder, port, *flags):
    """MLflow's own, with a database and artifacts in `folder`, until it is killed at the end."""
    command = [sys.executable, "-m", "mlflow", "server", "--workers", "1", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--backend-store-uri", f"sqlite:///{folder}/served.db", "--artifacts-destination", f"{folder}/served"]
    with open(folder / "server.log", "a") as log:
        quick = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        command += flags
        server = subprocess.Popen(command, cwd=folder, env=quick, stdout=log, stderr=log, start_new_session=True)
    try:
        wait_until(lambda: not unreachable(f"http://127.0.0.1:{port}"), pause=0.2)
        yield
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait(10)
