"""Sends a folder to MLflow: what the folder has and MLflow lacks, again and again, until MLflow has all of it.

The folder is the queue. So MLflow may be away for as long as it likes, and never stops or slows a run: a thread syncs
every few seconds and a last time at the end, and what could not be sent then is sent by a later `sync` of the folder.
"""

from __future__ import annotations

import contextlib
import shlex
import threading
import time
from collections.abc import Callable
from pathlib import Path

from cluster import stopping
from cluster.redaction import one_line, redacted
from cluster.text import count
from cluster.tracking.address import UI, TrackingError, check_uri, is_database, sqlite_path
from cluster.tracking.content import Content
from cluster.tracking.database import silence_mlflow
from cluster.tracking.logged import LoggedRun, Status, read_link
from cluster.tracking.view import run_table

SYNC_S = 2.0  # rows that come within this time go out as one request: 5 ms of CPU for a row alone, 0.8 ms among many
READ_SHARE = 0.02  # of a core that reading the folder takes at most: a long history is read less often
RETRY_S = 5.0  # after a sync that failed
LAST_RETRY_S = 1.0  # between the last syncs
CLOSE_S, STOP_S = 60.0, 15.0  # s that closing takes at most, for a finished run and for one that was stopped

Read = Callable[[Path], Content | None]
"""Reads what MLflow is to have of a folder; None if that is nothing yet."""


class Tracking:
    """Keeps MLflow up to date with a folder, in a thread, from `start` to `close`.

    `error` says why the last sync failed, in one line; None when MLflow has all.
    """

    def __init__(self, folder: Path, uri: str, experiment: str, read: Read):
        self.uri = uri
        self.error: str | None = None
        self._folder, self._read = folder, read
        self._run = LoggedRun(folder, uri, experiment)
        self.sent = self._run.sent  # how many rows, files and models were sent that MLflow did not have
        self._status: Status | None = None  # set by `close`
        self._read_s = 0.0  # processor time that reading the folder took
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)

    @property
    def run_id(self) -> str:
        """MLflow's id of the run; "" until it is known."""
        return self._run.run_id

    def start(self) -> None:
        """Start the thread."""
        silence_mlflow()
        self._thread.start()

    def wait_id(self, timeout_s: float) -> str:
        """MLflow's id of the run; "" if there is none by then, or as soon as a sync has failed."""
        end = time.monotonic() + timeout_s
        while not self.run_id and time.monotonic() < end and (self.error is None or self._is_locked()):
            stopping.check()
            time.sleep(0.05)
        return self.run_id

    def close(self, status: Status) -> str | None:
        """Sync a last time and end MLflow's run. Returns: None, or one line about what MLflow lacks.

        To be called when the folder is complete. Raises nothing and returns within CLOSE_S or STOP_S, whatever MLflow
        does; an unreachable server is tried once more.
        """
        try:
            content = self._read(self._folder)
        except Exception as failure:  # whatever it is, the run has ended
            return f"could not upload to MLflow at {redacted(self.uri)}: {one_line(failure)}"
        if content is None or self._thread.ident is None:
            return None
        self._status = status
        self._wake.set()
        timeout_s = CLOSE_S if status == "FINISHED" else STOP_S
        self._thread.join(timeout_s)
        lacking, reason = self._run.lacking(content, status), self.error or f"no answer within {timeout_s:g} s"
        return f"not logged to MLflow at {redacted(self.uri)}: {', '.join(lacking)}: {reason}" if lacking else None

    def where(self, mlflow: str) -> str:
        """How to see the run beside others in MLflow's UI, in words for the terminal; `mlflow` is how to call it."""
        served, shown = self.uri.startswith("http"), redacted(self.uri)
        if not (served or is_database(self.uri)):
            return shown
        experiment = self._run.experiment_id
        table = run_table(self.uri if served else UI, experiment) if experiment else ""
        if served:
            return table or shown
        make = "make ui, or " if sqlite_path(self.uri) == Path.cwd() / "mlflow.db" else ""  # the store that it shows
        command = f"{make}MLFLOW_DISABLE_TELEMETRY=true {mlflow} ui --backend-store-uri {shlex.quote(shown)}"
        without = "" if shown == self.uri else " (add its user and password, which are not shown)"
        return f"{command}{without}" + (f"; then open\n{table}" if table else "")

    def _work(self) -> None:
        """Sync until the run is closed, then once or twice; a locked database is tried until time is up."""
        with contextlib.suppress(Exception):  # a sync raises it again
            import mlflow.tracking

            if is_database(self.uri):
                import mlflow.store.tracking.sqlalchemy_store  # noqa: F401
        while self._status is None:
            synced = self._sync()
            self._wake.wait(max(SYNC_S, self._read_s / READ_SHARE) if synced else RETRY_S)
        if not self._sync():
            time.sleep(LAST_RETRY_S)
            while not self._sync() and self._is_locked():
                time.sleep(LAST_RETRY_S)

    def _sync(self) -> bool:
        """Send what MLflow lacks. Returns: whether it has all of it."""
        status = self._status  # before the folder is read, so that a run ends with its last row
        began = time.thread_time()
        try:
            content = self._read(self._folder)
            new = content and (not self.run_id or self._run.lacking(content, status))
            self._read_s = time.thread_time() - began
            self.error = self._run.send(content, status) if content and new else None
        except Exception as failure:  # of a damaged folder; the run goes on
            self.error = one_line(failure)
        return self.error is None

    def _is_locked(self) -> bool:
        """Whether the last sync failed only because others write to the database, which ends."""
        return "database is locked" in (self.error or "")


def sync(folder: Path, uri: str, experiment: str, read: Read, status: Status = "FINISHED") -> tuple[str, str | None]:
    """Send what MLflow lacks of a folder that nobody is at work on, to the folder's own address if `uri` is "".

    Returns: what was sent, in words, and None or one line about what could not be.
    """
    try:
        tracking = Tracking(folder, check_uri(uri, saved_uri(folder)), experiment, read)
    except TrackingError as error:
        return "", f"could not upload to MLflow: {error}"
    tracking.start()
    lacking = tracking.close(status)
    return ", ".join(count(number, noun) for noun, number in tracking.sent.items() if number), lacking


def saved_run_id(folder: Path) -> str:
    """MLflow's id of a folder's run; "" if there is none yet."""
    return str(read_link(folder).get("run_id", ""))


def saved_uri(folder: Path) -> str:
    """The address that a folder was last sent to, without its password; "" if there is none."""
    return str(read_link(folder).get("uri", ""))
