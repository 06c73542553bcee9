"""gridsim-dqn as a user runs it: the same network whatever the workers do, exact resume, and a run's contracts."""

import json
import os
import re
import shutil
import signal
import time

import numpy as np
import pytest
from commands import BIN, all_in_mlflow, finish, ray_workers, rows, running, summary, wait_until
from tracked import client

from cluster.store.checkpoint import load

SMALL = [
    *("--scenario", "curved", "--traffic", "2", "--policy", "mlp:12", "--seed", "5"),
    *("--car-steps", "330000", "--evaluate-every", "40000", "--replay", "50000"),
]
REFERENCE = ("gridsim-dqn", *SMALL)
NOT_OF_THE_CLOCK = ("distance_m/best", "distance_m/mean", "loss", "q/mean", "q/change", "updates", "car_steps")

pytestmark = pytest.mark.e2e


@pytest.mark.usefixtures("database", "audited")
def test_a_killed_worker_ctrl_c_and_a_killed_process_change_nothing(reference, tmp_path):
    run = tmp_path / "runs/k"
    with running("gridsim-dqn", "--workers", "2", "--name", "k", *SMALL, cwd=tmp_path) as process:
        wait_until(lambda: rows(run) and ray_workers(process.pid))
        os.kill(ray_workers(process.pid)[0], signal.SIGKILL)
        wait_until(lambda: len(rows(run)) >= 2)
        time.sleep(0.3)  # in the midst of an evaluation's updates
        os.kill(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=120)
        assert process.returncode == 130
        assert f"continue with: {BIN}/gridsim-dqn --resume runs/k" in err
        assert "replay_actions" in load(run / "checkpoint.npz")[0]
    saved = len(rows(run))
    with running("gridsim-dqn", "--resume", "runs/k", "--workers", "1", cwd=tmp_path) as process:
        wait_until(lambda: len(rows(run)) > saved)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    assert not (run / "summary.json").exists()
    finish("gridsim-dqn", "--resume", str(run), "--workers", "0", cwd=tmp_path)
    assert summary(run)["champion_sha256"] == summary(reference)["champion_sha256"]
    assert (run / "elites.npz").read_bytes() == (reference / "elites.npz").read_bytes()
    mine, theirs = load(run / "checkpoint.npz")[0], load(reference / "checkpoint.npz")[0]
    assert {name for name in theirs if not np.array_equal(mine[name], theirs[name])} <= {"history"}  # it has the clock
    for row, other in zip(rows(run), rows(reference), strict=True):
        assert {name: row[name] for name in NOT_OF_THE_CLOCK} == {name: other[name] for name in NOT_OF_THE_CLOCK}


def test_run_keeps_the_contracts(reference):
    found = summary(reference)
    assert found["evaluations"] == len(rows(reference)) >= 5
    assert found["updates"] == int(float(rows(reference)[-1]["updates"])) > 300
    assert found["car_steps"] >= 330_000
    names = ("distance_m/best", "speed_mps/mean", "car_steps", "wall_s", "car_steps_per_s", "loss")
    assert all_in_mlflow(reference, names, "evaluations")
    logged = client(f"sqlite:///{reference.parent.parent}/mlflow.db").get_run(found["mlflow_run_id"]).data
    assert logged.tags["algorithm"] == "dqn"
    assert not [name for name in logged.metrics if name.startswith("fitness")]
    assert logged.params["discount"]
    done = finish("gridsim-evaluate", str(reference), "--json", cwd=reference.parent)
    assert json.loads(done.stdout) == found["held_out"]


@pytest.mark.usefixtures("database")
def test_an_ended_run_keeps_no_replay_and_can_be_extended(reference, tmp_path):
    home = reference.parent.parent
    kept = [path for part in ("runs", "mlartifacts") for path in (home / part).rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in kept) < 10e6
    assert not [name for name in load(reference / "checkpoint.npz")[0] if name.startswith("replay_")]
    run = tmp_path / "runs/ref"
    shutil.copytree(reference, run)
    done = finish("gridsim-dqn", "--resume", "runs/ref", "--workers", "0", "--car-steps", "500000", cwd=tmp_path)
    assert done.stderr == ""
    assert summary(run)["car_steps"] >= 500_000
    assert summary(run)["updates"] > summary(reference)["updates"]


@pytest.mark.usefixtures("database")
def test_a_run_that_diverges_says_so(tmp_path):
    done = finish("gridsim-dqn", "--workers", "0", *SMALL, "--learning-rate", "1e38", cwd=tmp_path, code=1)
    assert re.fullmatch(r"gridsim-dqn: error: the Q network diverged at update \d+: [^\n]*\n", done.stderr)
    assert not list(tmp_path.glob("runs/*"))
