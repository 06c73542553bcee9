"""Sends a folder to MLflow: what the folder has and MLflow lacks, again and again, until MLflow has all of it.

The folder is the queue: nothing is kept in memory but what MLflow was seen to have. So MLflow may be away for as long
as it likes, and never stops or slows a run: a thread syncs every few seconds and a last time at the end, and what could
not be sent then is sent by a later `sync` of the same folder. `mlflow.json` in it says which run of MLflow's it is.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cluster import stopping
from cluster.redaction import one_line, redacted
from cluster.text import count
from cluster.tracking.address import UI, TrackingError, check_uri, is_database, sqlite_path, unreachable
from cluster.tracking.content import Content
from cluster.tracking.database import silence_mlflow
from cluster.tracking.logged import LoggedRun, Seen, Status
from cluster.tracking.view import run_table

LINK = "mlflow.json"
EXPERIMENT = "gridsim"  # used if none is given
SYNC_S = 2.0  # rows that come within this time go out as one request: 5 ms of CPU for a row alone, 0.8 ms among many
RETRY_S = 5.0  # after a sync that failed
LAST_RETRY_S = 1.0  # between the last syncs
CLOSE_S, STOP_S = 60.0, 15.0  # s that closing takes at most, for a finished run and for one that was stopped

Read = Callable[[Path], Content | None]
"""Reads what MLflow is to have of a folder; None if that is nothing yet."""


class Tracking:
    """Keeps MLflow up to date with a folder, in a thread, from `start` to `close`.

    Attributes:
        error: why the last sync failed, in one line; None when MLflow has all.
        run_id: MLflow's id of the run; "" until it is known.
        sent: how many rows, files and models were sent that MLflow did not have.
    """

    def __init__(self, folder: Path, uri: str, experiment: str, read: Read):
        self.folder, self.uri = folder, uri
        self.error: str | None = None
        self.run_id = ""
        self.sent = Counter(row=0, file=0, model=0)
        self._experiment, self._read = experiment, read
        self._run: LoggedRun | None = None
        self._status: Status | None = None  # set by `close`
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)

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

        Raises nothing and returns within CLOSE_S or STOP_S, whatever MLflow does; an unreachable server is tried once
        more. To be called when the folder is complete.
        """
        where = redacted(self.uri)
        try:
            content = self._read(self.folder)
        except Exception as failure:  # whatever it is, the run has ended
            return f"could not upload to MLflow at {where}: {one_line(failure)}"
        if content is None or self._thread.ident is None:
            return None
        self._status = status
        self._wake.set()
        timeout_s = CLOSE_S if status == "FINISHED" else STOP_S
        self._thread.join(timeout_s)
        lacking = self._lacking(content, status)
        reason = self.error or f"no answer within {timeout_s:g} s"
        return f"not logged to MLflow at {where}: {', '.join(lacking)}: {reason}" if lacking else None

    def where(self, mlflow: str) -> str:
        """How to see the run beside others in MLflow's UI, in words for the terminal; `mlflow` is how to call it."""
        served, shown = self.uri.startswith("http"), redacted(self.uri)
        if not (served or is_database(self.uri)):
            return shown
        table = run_table(self.uri if served else UI, self._run.experiment_id) if self._run else ""
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
            self._wake.wait(SYNC_S if synced else RETRY_S)
        if not self._sync():
            time.sleep(LAST_RETRY_S)
            while not self._sync() and self._is_locked():
                time.sleep(LAST_RETRY_S)

    def _is_locked(self) -> bool:
        """Whether the last sync failed only because others write to the database, which ends."""
        return "database is locked" in (self.error or "")

    def _sync(self) -> bool:
        """Send what MLflow lacks; a failure does not hold up the rest. Returns: whether MLflow has all of it."""
        errors: list[str] = []
        status = self._status  # before the folder is read, so that a run ends with its last row
        try:
            content = self._read(self.folder)
            if content and self._lacking(content, status):
                self._check_reachable()
                run = self._run = self._run or self._open(content)
                for send in (self._send_rows, self._send_files, self._send_model, self._end):
                    try:
                        send(run, content, status)
                    except Exception as failure:
                        errors.append(one_line(failure, self.uri))
                        self._check_reachable()
        except Exception as failure:  # whatever it is, the run goes on
            errors.append(one_line(failure, self.uri))
        self.error = errors[-1] if errors else None
        return not errors

    def _lacking(self, content: Content, status: Status | None) -> list[str]:
        """What MLflow was not seen to have, in words."""
        seen = self._run.seen if self._run else Seen()
        steps = sorted({step for _, step in seen.missing_rows(content)})
        span = f"{steps[0]} to {steps[-1]}" if len(steps) > 1 else f"{steps[0]}" if steps else ""
        lacking = [f"{count(len(steps), 'row')} (step {span})"] if steps else []
        if files := len(seen.missing_files(content)):
            lacking.append(count(files, "file"))
        if content.model and seen.version != content.model.champion_sha256:
            stored = seen.model == content.model.champion_sha256
            lacking.append("the registration of the model, whose files are stored" if stored else "the model")
        if status not in (None, seen.status):
            lacking.append(f"the status {status}")
        return lacking

    def _check_reachable(self) -> None:
        """Raise TrackingError at once for a dead server, for which MLflow would wait longer."""
        if problem := unreachable(self.uri):
            raise TrackingError(problem)

    def _open(self, content: Content) -> LoggedRun:
        """MLflow's run, found or created; mlflow.json is written first, so that a killed run finds it again."""
        link = _read_link(self.folder)
        if link.get("uri") != redacted(self.uri):
            link |= {"uri": redacted(self.uri), "experiment": self._experiment or EXPERIMENT, "run_id": ""}
        link.setdefault("key", uuid.uuid4().hex)
        link.setdefault("started", time.time() - content.wall_s)
        _write_link(self.folder, link)
        experiment = self._experiment or link["experiment"]
        run = LoggedRun(self.uri, experiment, link["key"], link["run_id"], link["started"], content)
        self.run_id = run.run_id
        _write_link(self.folder, link | {"run_id": run.run_id, "experiment": experiment})
        return run

    def _send_rows(self, run: LoggedRun, content: Content, status: Status | None) -> None:
        self.sent["row"] += run.send_rows(content)

    def _send_files(self, run: LoggedRun, content: Content, status: Status | None) -> None:
        for path in run.seen.missing_files(content):
            run.send_file(path)
            self.sent["file"] += 1

    def _send_model(self, run: LoggedRun, content: Content, status: Status | None) -> None:
        if content.model and run.seen.version != content.model.champion_sha256:
            self.sent["model"] += run.send_model(content.model)

    def _end(self, run: LoggedRun, content: Content, status: Status | None) -> None:
        run.send_note(content.note)
        if status:
            run.end(status, content.wall_s)


def _read_link(folder: Path) -> dict[str, Any]:
    """What mlflow.json holds: uri, experiment, key, run_id, started; empty without a whole one."""
    try:
        link = json.loads((folder / LINK).read_bytes())
        whole = {name: type(link[name]) for name in ("uri", "experiment", "key", "run_id")}
    except (OSError, ValueError, LookupError, TypeError):
        return {}
    return link if set(whole.values()) == {str} and isinstance(link.get("started"), float) else {}


def _write_link(folder: Path, link: dict[str, Any]) -> None:
    written = folder / f".{LINK}.tmp"
    written.write_text(json.dumps(link, indent=2) + "\n", encoding="utf-8")
    os.replace(written, folder / LINK)


def saved_uri(folder: Path) -> str:
    """The address that a folder was last sent to, without its password; "" if there is none."""
    return str(_read_link(folder).get("uri", ""))


def sync(folder: Path, uri: str, experiment: str, read: Read, status: Status = "FINISHED") -> tuple[str, str | None]:
    """Send what MLflow lacks of a folder that nobody is at work on, to the folder's own address if `uri` is "".

    Returns: what was sent, in words, and None or one line about what could not be.
    """
    try:
        uri = check_uri(uri, saved_uri(folder))
    except TrackingError as error:
        return "", f"could not upload to MLflow: {error}"
    tracking = Tracking(folder, uri, experiment, read)
    tracking.start()
    lacking = tracking.close(status)
    return ", ".join(count(number, noun) for noun, number in tracking.sent.items() if number), lacking
