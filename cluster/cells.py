"""A comparison's runs, each by its own command in a process of its own, which ends with this one."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from cluster.experiment import Cell, CellError, ExperimentError, read_json
from cluster.run import CHECKPOINT, CONFIG, HISTORY, SUMMARY, read_history

MAX_GENERATIONS = 100_000  # where a budget is what ends a run
# Its standard input ends when this process does, however it does: then nobody may go on writing to the run's folder.
_CHILD = """
import os, signal, threading
def end():
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGKILL)
threading.Thread(target=end, daemon=True).start()
signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell started in the background ignores it
from cluster.cli import evolve_main
evolve_main()
"""


@dataclass
class Commands:
    """Executes cells by `gridsim-evolve`: an `experiment.Execute`.

    Attributes:
        workers, address, tracking_uri, experiment: as the command has them.
        parent_id: MLflow's run that the cells belong to, or "".
        note: told what the command says while it runs.
    """

    workers: int
    address: str
    tracking_uri: str
    experiment: str
    parent_id: str = ""
    note: Callable[[str], None] = lambda text: None

    def __call__(self, cell: Cell) -> dict[str, Any]:
        if cell.learner == "dqn":
            raise CellError("this GridSim has no gridsim-dqn")
        wall_s = cell.plan.budget.wall_s
        if wall_s and (left := wall_s - _wall(cell)) > 0.0:
            self._run(cell, cell.plan.generations or MAX_GENERATIONS, left)
        if wall_s and not cell.finished():  # out of time: its last generation is the one in which a champion is sought
            self._run(cell, _generations(cell) + 1)
        elif not cell.finished():
            self._run(cell, cell.plan.generations or MAX_GENERATIONS)
        try:
            return read_json(cell.folder / SUMMARY)
        except ExperimentError as error:
            raise CellError(str(error)) from error

    def _run(self, cell: Cell, generations: int, stop_after_s: float = 0.0) -> None:
        """Run the command to its end, or stop it by Ctrl-C when its time is over. Raises CellError."""
        common = ["--workers", str(self.workers), "--generations", str(generations)]
        common += ["--tracking-uri", self.tracking_uri, "--experiment", self.experiment]
        common += ["--address", self.address] if self.address else []
        environment = dict(os.environ)
        if self.parent_id:  # MLflow takes tags from here
            environment["MLFLOW_RUN_CONTEXT"] = json.dumps({"mlflow.parentRunId": self.parent_id})
        process = subprocess.Popen(
            [sys.executable, "-c", _CHILD, *_flags(cell), *common],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
            start_new_session=True,
        )  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        said: list[str] = []
        listener = threading.Thread(target=lambda stream: said.extend(stream), args=(process.stderr,), daemon=True)
        listener.start()
        timer = threading.Timer(stop_after_s, process.send_signal, (signal.SIGINT,))
        if stop_after_s:
            timer.start()
        try:
            for line in process.stdout:
                self.note(line.partition("  ETA")[0].strip())
            code = process.wait()
        except BaseException:
            process.send_signal(signal.SIGINT)
            for _ in process.stdout:  # until it has saved
                pass
            process.wait()
            raise
        finally:
            timed_out = stop_after_s > 0.0 and not timer.is_alive()
            timer.cancel()
            process.stdin.close()
            listener.join()
            process.stdout.close()
            process.stderr.close()
        if code and not (timed_out and code in (130, -signal.SIGINT)):
            raise CellError(_reason(said) or f"it ended with {code}")


def _flags(cell: Cell) -> Sequence[str]:
    """Of a new run, or of one that goes on."""
    if (cell.folder / CHECKPOINT).is_file():
        return ["--resume", str(cell.folder)]
    if cell.folder.exists():  # it was killed before its first generation
        with contextlib.suppress(OSError):
            (cell.folder / CONFIG).unlink(missing_ok=True)
            cell.folder.rmdir()
    plan = cell.plan
    flags = {
        "scenario": cell.scenario,
        "seed": cell.seed,
        "traffic": cell.traffic,
        "observation": plan.observation,
        "search": cell.learner,
        "car-steps": plan.budget.car_steps,
        "output": cell.folder.parent,
        "name": cell.name,
    } | ({"population": plan.population} if plan.population else {})
    return [word for name, value in flags.items() for word in (f"--{name}", str(value))]


def _generations(cell: Cell) -> int:
    """That are done."""
    try:
        return len(read_history(cell.folder / HISTORY))
    except FileNotFoundError:
        return 0
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise CellError(f"{cell.folder / HISTORY} is damaged: {type(error).__name__}") from error


def _wall(cell: Cell) -> float:
    """Seconds that were used so far."""
    return read_history(cell.folder / HISTORY)[-1]["wall_s"] if _generations(cell) else 0.0


def _reason(said: Sequence[str]) -> str:
    """What a command that failed gave as the reason."""
    for line in said:
        if ": error: " in line:
            return line.partition(": error: ")[2].strip()
    return said[-1].strip() if said else ""
