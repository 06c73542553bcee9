"""A comparison's runs as processes of the learners' commands, several at once.

Each has a session of its own, so that Ctrl-C reaches the comparison alone, which passes it on. Linux sends them SIGTERM
if the comparison is killed; elsewhere they go on.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from cluster import stopping
from cluster.compare.plan import PlannedRun
from cluster.store.checkpoint import HISTORY

LOGS = "logs"  # folder of what the runs print, in the comparison's
LOOK_S = 0.1  # between two looks at the processes
LAST_BYTES = 4096  # of history.csv, which hold its last row
# Becomes a command, and is sent SIGTERM (15) when its parent process ends: prctl(PR_SET_PDEATHSIG).
WITH_PARENT = """\
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 15)
if os.getppid() == int(sys.argv[1]):
    os.execvp(sys.argv[2], sys.argv[2:])"""


class RunProcess:
    """A process that trains one run; what it prints is in its log."""

    def __init__(self, run: PlannedRun, flags: Sequence[str], environment: Mapping[str, str]):
        self.run, self.began, self.log = run, time.perf_counter(), log_of(run)
        self.log.parent.mkdir(exist_ok=True)
        command = [str(_script(run.settings.command)), *run.flags(), "--resume-if-exists", *flags]
        if sys.platform == "linux":
            command = [sys.executable, "-ISc", WITH_PARENT, str(os.getpid()), *command]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
                env={**os.environ, **environment},
            )  # fmt: skip

    def said(self, kind: str) -> list[str]:
        """Its messages of one kind, error or warning."""
        return _said(self.log, kind)

    def newest_row(self) -> dict[str, float]:
        """The last row of its run's history.csv, by column; empty before there is one."""
        try:
            with (self.run.path / HISTORY).open("rb") as file:
                columns = file.readline().decode().strip().split(",")
                file.seek(max(file.tell(), os.fstat(file.fileno()).st_size - LAST_BYTES))
                whole = file.read().decode().split("\n")[:-1]
        except OSError:
            return {}
        return dict(zip(columns, map(float, whole[-1].split(",")), strict=True)) if whole else {}


class Processes:
    """Makes runs, as many at once as `jobs` says. A run that fails does not stop the others.

    Args: `flags` are those of all of them, besides their own, and `environment` what theirs has besides this one's.
    """

    def __init__(self, runs: Iterable[PlannedRun], jobs: int, flags: Sequence[str]):
        self.waiting, self.running, self.environment = deque(runs), list[RunProcess](), dict[str, str]()
        self.jobs, self._flags = jobs, flags

    def wait(self) -> list[RunProcess]:
        """Start what may start; after a moment, the processes that have ended since. Raises: Stopped, OSError."""
        while self.waiting and len(self.running) < self.jobs:
            self.running.append(RunProcess(self.waiting.popleft(), self._flags, self.environment))
        time.sleep(LOOK_S)
        stopping.check()
        ended = [each for each in self.running if each.process.poll() is not None]
        self.running = [each for each in self.running if each not in ended]
        return ended

    def stop(self) -> None:
        """Ask all of them to save and to end, and wait until they have."""
        for each in self.running:
            each.process.terminate()
        for each in self.running:
            each.process.wait()


def log_of(run: PlannedRun) -> Path:
    """What the latest process of a run has printed."""
    return run.path.parent / LOGS / f"{run.name}.log"


def is_sent(run: PlannedRun) -> bool:
    """Whether MLflow has all of a finished run, as far as its process knew; if not, its command sends the rest."""
    log = log_of(run)
    return not log.is_file() or not any("not logged to MLflow" in text for text in _said(log, "warning"))


def _said(log: Path, kind: str) -> list[str]:
    return re.findall(rf"^gridsim-\w+: {kind}: (.*)$", log.read_text(encoding="utf-8", errors="replace"), re.MULTILINE)


def _script(command: str) -> Path | str:
    """The console script of a command: the one beside this program, or beside Python."""
    folders = Path(sys.argv[0]).parent, Path(sys.executable).parent
    return next((path for folder in folders if (path := folder / command).is_file()), command)
