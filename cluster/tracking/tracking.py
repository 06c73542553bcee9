"""Keeps MLflow up to date with a folder: what the folder has and MLflow lacks is sent until MLflow has all of it.

The folder is the queue. So MLflow may be away for any time, and never stops a run that has begun or slows its learning:
a separate process (`sync.py`) sends every few seconds and a last time at the end, and what could not be sent then is
sent by a later `sync` of the folder. The 3 s that MLflow's import takes do not delay the run.
"""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from typing import Any

from cluster import stopping
from cluster.redaction import redacted
from cluster.text import count
from cluster.tracking.address import UI, TrackingError, check_uri, is_database, is_locked, run_table, sqlite_path
from cluster.tracking.content import Content
from cluster.tracking.logged import Status, read_link

CLOSE_S, STOP_S = 60.0, 15.0  # s that closing takes at most: for a finished run, and for one that stopped or failed

Read = Callable[[Path], Content | None]
"""Reads what MLflow is to have of a folder, None if that is nothing yet; a function of a module."""


class Tracking:
    """A process that keeps MLflow up to date with a folder, from `start` to `close`.

    `listen` is called after `start`, or else by `close`. `run_id` is MLflow's id of the run, "" until it is known;
    `sent` counts the rows, files and models that were sent; `error` says in one line why the last sync failed, and is
    None if it did not.
    """

    def __init__(self, folder: Path, uri: str, experiment: str, read: Read):
        self.uri = uri
        self.run_id = ""
        self.sent: dict[str, int] = {}
        self.error: str | None = None
        self._folder, self._read = folder, read
        self._order = {
            "folder": str(folder), "uri": uri, "experiment": experiment, "argv": sys.argv,
            "read": f"{read.__module__}:{read.__qualname__}",
        }  # fmt: skip
        self._experiment_id, self._lacking = "", ["all"]
        self._process: Popen[str] | None = None

    def start(self) -> None:
        """Start the process, but no thread yet (`listen`). A terminal's signals do not reach the process."""
        command = [sys.executable, "-P", "-m", "cluster.tracking.sync"]
        self._process = Popen(command, text=True, start_new_session=True, stdin=PIPE, stdout=PIPE, stderr=DEVNULL)
        self._tell(self._order)
        self._listener = threading.Thread(target=self._listen, args=(self._process,), daemon=True)

    def listen(self) -> None:
        """Start the thread that reads the process's answers."""
        if self._process:
            self._listener.start()

    def wait_id(self, timeout_s: float) -> str:
        """Wait for MLflow's id of the run; "" if there is none in time, or once a sync fails. Raises Stopped.

        A sync that failed because the database was locked does not count.
        """
        end = time.monotonic() + timeout_s
        while self._process and not self.run_id and time.monotonic() < end:
            if self.error is not None and not is_locked(self.error):
                break
            stopping.check()
            time.sleep(0.05)
        return self.run_id

    def close(self, status: Status) -> str | None:
        """Sync a last time and end MLflow's run with this status. Returns: None, or one line about what MLflow lacks.

        Without a sync, this returns None if the process was not started or the folder has nothing for MLflow yet.
        To be called when the folder is complete. Raises nothing and returns within CLOSE_S or STOP_S, whatever MLflow
        does; an unreachable server is tried once more.
        """
        if self._process is None:
            return None
        if self._listener.ident is None:
            self.listen()
        timeout_s = CLOSE_S if status == "FINISHED" else STOP_S
        nothing = False
        with contextlib.suppress(Exception):  # the folder is damaged, which the process reports
            nothing = self._read(self._folder) is None
        if not nothing:
            self._tell(status)
            self._listener.join(timeout_s)
        lacking, reason = ", ".join(self._lacking), self.error or f"no answer within {timeout_s:g} s"
        self._process.kill()  # if there is nothing to send, it may still be importing MLflow
        self._listener.join()
        return None if nothing or not lacking else f"not logged to MLflow at {redacted(self.uri)}: {lacking}: {reason}"

    def where(self, mlflow: str) -> str:
        """How to see the run beside others in MLflow's UI, in words for the terminal.

        Args: `mlflow` is the command `mlflow` as the user would type it.
        """
        served, shown = self.uri.startswith("http"), redacted(self.uri)
        if not (served or is_database(self.uri)):
            return shown
        table = run_table(self.uri if served else UI, self._experiment_id) if self._experiment_id else ""
        if served:
            return table or shown
        make = "make ui, or " if sqlite_path(self.uri) == Path.cwd() / "mlflow.db" else ""  # what `make ui` shows
        command = f"{make}MLFLOW_DISABLE_TELEMETRY=true {mlflow} ui --backend-store-uri {shlex.quote(shown)}"
        without = "" if shown == self.uri else " (add its user and password, which are not shown)"
        return f"{command}{without}" + (f"; then open\n{table}" if table else "")

    def _tell(self, message: Any) -> None:
        assert self._process
        assert self._process.stdin
        with contextlib.suppress(OSError, ValueError):  # the process has ended, which `_listen` notices
            print(json.dumps(message), file=self._process.stdin, flush=True)

    def _listen(self, process: Popen[str]) -> None:
        """Read the process's answers until it ends."""
        assert process.stdin
        assert process.stdout
        with process.stdout as answers:
            for line in answers:
                known = json.loads(line)
                self.sent, self.error, self._lacking = known["sent"], known["error"], known["lacking"]
                self._experiment_id, self.run_id = known["experiment_id"], known["run_id"]
        with contextlib.suppress(OSError):  # the process ended before it read the status
            process.stdin.close()
        if code := process.wait():
            self._lacking = self._lacking or ["what is new"]
            self.error = self.error or f"the process that sends has ended with exit code {code}"


def sync(folder: Path, uri: str, experiment: str, read: Read, status: Status = "FINISHED") -> tuple[str, str | None]:
    """Send what MLflow lacks of a folder that no run is using.

    Args: `uri` is where to; "" is the address that the folder was last sent to, or else that of `check_uri`.
    Returns: what was sent, in words, and None or one line about what could not be sent.
    """
    try:
        tracking = Tracking(folder, check_uri(uri, saved_uri(folder)), experiment, read)
    except TrackingError as error:
        return "", f"could not upload to MLflow: {error}"
    tracking.start()  # `close` listens
    lacking = tracking.close(status)
    return ", ".join(count(number, noun) for noun, number in tracking.sent.items() if number), lacking


def saved_run_id(folder: Path) -> str:
    """MLflow's id of a folder's run; "" if there is none yet."""
    return str(read_link(folder).get("run_id", ""))


def saved_uri(folder: Path) -> str:
    """The address that a folder was last sent to, without its password; "" if there is none."""
    return str(read_link(folder).get("uri", ""))
