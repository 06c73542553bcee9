"""A comparison's runs as processes of the learners' commands.

Each has a session of its own, so that Ctrl-C reaches the comparison alone, which passes it on. Linux sends them SIGTERM
if the comparison is killed; elsewhere they go on.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from cluster.store.folder import RunFolder

LOGS = "logs"  # folder of what the runs print, in the comparison's
# Becomes a command, and is sent SIGTERM (15) when its parent process ends: prctl(PR_SET_PDEATHSIG).
WITH_PARENT = """\
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 15)
if os.getppid() == int(sys.argv[1]):
    os.execvp(sys.argv[2], sys.argv[2:])"""


def flags_of(run: RunFolder, **more: object) -> list[str]:
    """Flags with which the learner's command makes a run, and more of them by name."""
    flags = {**vars(run.settings), "output": run.path.parent, "name": run.name, **more}
    return [f"--{name.replace('_', '-')}={value}" for name, value in flags.items()]


def start(run: RunFolder, flags: Mapping[str, object], environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """Start the process that trains a run, whether it was begun or not; what it prints is in its log.

    Args: `flags` are the command's besides those of the run, and `environment` what its own has besides this one's.
    """
    folders = Path(sys.argv[0]).parent, Path(sys.executable).parent  # this program's, and Python's
    script = shutil.which(run.settings.command, path=os.pathsep.join(map(str, folders))) or run.settings.command
    command = [script, "--resume-if-exists", *flags_of(run, **flags)]
    if sys.platform == "linux":
        command = [sys.executable, "-ISc", WITH_PARENT, str(os.getpid()), *command]
    log_of(run).parent.mkdir(exist_ok=True)
    with log_of(run).open("wb") as log:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
            env={**os.environ, **environment},
        )  # fmt: skip


def log_of(run: RunFolder) -> Path:
    """What the latest process of a run has printed."""
    return run.path.parent / LOGS / f"{run.name}.log"


def said(run: RunFolder) -> list[tuple[str, str]]:
    """The warnings and the errors of a run's latest process: kind and text of each."""
    return re.findall(r"^gridsim-\w+: (warning|error): (.*)$", _read(run), re.MULTILINE)


def last_line(run: RunFolder) -> str:
    """What a run's latest process has printed last, every few seconds its progress."""
    return _read(run).rstrip("\n").rpartition("\n")[2]


def _read(run: RunFolder) -> str:
    log = log_of(run)
    return log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""


def is_sent(run: RunFolder) -> bool:
    """Whether MLflow has all of a finished run, as far as its process knew; if not, its command sends the rest."""
    return not any("not logged to MLflow" in text for _, text in said(run))
