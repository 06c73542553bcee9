"""What a run survives, with real processes: stopped workers, hosts that come and go.

Each ends with the same champion as the undisturbed run. `benchmarks/faults.py` injects all kinds of faults at random.
"""

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import BIN, answers, end, finish, ray_workers, rows, running, same_run, wait_until

pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("stand_ins")]

LONG_S = 300.0  # what takes seconds where nothing else runs
PATIENCE_S = 45  # a host and its worker take 10 to 30 to come up
SMALL = ["--scenario", "curved", "--traffic", "2", "--population", "48", "--generations", "10", "--seed", "5"]
REFERENCE = ("gridsim-evolve", *SMALL)


@pytest.mark.usefixtures("database")
def test_hosts_come_and_go_and_in_the_end_patience_does(
    reference: Path, cluster: Callable[..., tuple[str, subprocess.Popen]], tmp_path: Path
) -> None:
    """It waits for the first host, takes in the second, goes on without the first, and is resumed without any."""
    address, _ = cluster(0)
    run = tmp_path / "runs/h"
    arguments = ("--workers", "2", "--address", "auto", "--patience", str(PATIENCE_S), "--name", "h", *SMALL)
    with running("gridsim-evolve", *arguments, cwd=tmp_path, RAY_ADDRESS=address) as process:
        _, first = cluster(1, address)
        wait_until(lambda: rows(run) or process.poll() is not None, LONG_S)
        process.send_signal(signal.SIGSTOP)  # or it may be done before the second host is up
        _, second = cluster(1, address)
        wait_until(lambda: ray_workers(second.pid) or process.poll() is not None, LONG_S)
        done = len(rows(run))
        end(first)
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: len(rows(run)) > done + 1 or process.poll() is not None, LONG_S)
        end(second)
        killed = time.monotonic()
        _, err = process.communicate(timeout=LONG_S)
        assert time.monotonic() - killed > PATIENCE_S - 1, err
    assert process.returncode == 1
    assert answers(address), "the run left, the cluster stays"
    # The dead host's worker may first be reported as silent.
    said = [line for line in err.splitlines() if "a worker is replaced: " not in line]
    no_worker = f"gridsim-evolve: error: there has been no worker for {PATIENCE_S} s (--patience): Ray has"
    assert said[0].startswith(no_worker)
    assert said[1:] == [f"continue with: {BIN}/gridsim-evolve --resume runs/h"]
    finish("gridsim-evolve", "--workers", "0", "--resume", "runs/h", cwd=tmp_path)
    assert same_run(run, reference)


AUDIT = """
import os, sys, threading
known = set(os.environ)

def hook(event, arguments):
    if event == "os.unsetenv":
        known.discard(os.fsdecode(arguments[0]))
    elif event == "os.putenv" and (name := os.fsdecode(arguments[0])) not in known:
        known.add(name)
        # MLflow's thread does nothing but read from a pipe.
        threads = {thread.name for thread in threading.enumerate()} - {"MainThread", "mlflow"}
        if threads and "gridsim-" in " ".join(sys.argv):
            print("LATE", name, file=sys.stderr)

sys.addaudithook(hook)
"""


@pytest.mark.parametrize(
    "command",
    [
        "gridsim-evolve --scenario curved --generations 2",
        "gridsim-dqn --scenario curved --car-steps 2000",
        "gridsim-compare --scenarios curved --learners evolution --seeds 2 --budget 20k --name c --jobs 2",
    ],
)
def test_no_variable_is_added_while_threads_may_read_the_environment(tmp_path: Path, command: str) -> None:
    """A new variable may move the environment while another thread is in `getenv`, which crashes the process."""
    (tmp_path / "sitecustomize.py").write_text(AUDIT)
    done = finish(*command.split(), "--workers", "2", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert [line for line in done.stderr.splitlines() if "LATE" in line] == []
