"""A comparison's runs as processes of the learners' commands.

Ctrl-C reaches the comparison alone, which passes it on. If the comparison is killed, its runs save and end, too.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from cluster.store.folder import RunFolder
from cluster.workers.child import Child

LOGS = "logs"  # folder in the comparison's folder, for files with what the runs print


def flags_of(run: RunFolder, **more: object) -> list[str]:
    """Flags with which the learner's command makes this run; `more` are further flags, by their fields' names."""
    flags = {**vars(run.settings), "output": run.path.parent, "name": run.name, **more}
    return [f"--{name.replace('_', '-')}={value}" for name, value in flags.items()]


def start(run: RunFolder, flags: Mapping[str, object], environment: Mapping[str, str]) -> Child:
    """Start the process that trains a run, continues it if it was begun, or if it is finished sends what MLflow lacks.

    What it prints replaces the run's log.

    Args: `flags`, the command's flags besides the run's settings; `environment`, variables besides this process's.
    """
    folders = Path(sys.argv[0]).parent, Path(sys.executable).parent  # this program's, and Python's
    script = shutil.which(run.settings.command, path=os.pathsep.join(map(str, folders))) or run.settings.command
    log_of(run).parent.mkdir(exist_ok=True)
    command = [script, "--resume-if-exists", *flags_of(run, **flags)]
    return Child(command, {**os.environ, **environment}, log_of(run))


def log_of(run: RunFolder) -> Path:
    """The file with what the latest process of a run has printed."""
    return run.path.parent / LOGS / f"{run.name}.log"


def said(run: RunFolder) -> list[tuple[str, str]]:
    """The warnings and the errors of a run's latest process: kind and text of each."""
    return re.findall(r"^gridsim-\w+: (warning|error): (.*)$", _read(run), re.MULTILINE)


def last_line(run: RunFolder) -> str:
    """The last line that a run's latest process has printed; every few seconds it prints its progress."""
    return _read(run).rstrip("\n").rpartition("\n")[2]


def _read(run: RunFolder) -> str:
    log = log_of(run)
    return log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""


def is_sent(run: RunFolder) -> bool:
    """Whether MLflow has all of a finished run (or none is used): its log does not warn that something was not sent.

    If the log does, starting the run again sends the rest.
    """
    return not any("not logged to MLflow" in text for _, text in said(run))
