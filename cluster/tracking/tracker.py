"""Sends a run to MLflow from a thread of its own, so that MLflow never stops or slows the run.

MLflow takes two seconds to import and to open its store, and milliseconds for a row. The thread syncs every two
seconds, and a last time when the run ends. A sync sends what MLflow lacks, and nothing twice: it asks MLflow
once what it has, and repeats an unanswered request with the same timestamps, which MLflow recognises. What cannot be
sent is kept, tried again, and in the end reported in one line. All of it is also in the run's folder, from which it can
be sent later (`train.send_missing`).
"""

from __future__ import annotations

import shlex
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from cluster.redaction import one_line, redacted
from cluster.text import count
from cluster.tracking.address import UI, TrackingError, is_database, sqlite_path
from cluster.tracking.mlflow_run import Identity, LoggedRun, Model, Row, Status, preload
from cluster.tracking.view import run_table

FLUSH_S = 2.0  # rows that come within this time go out as one request: 5 ms of CPU for a row alone, 0.8 ms among many
RETRY_S = 5.0
CHANCE_S = 1.0  # between the two last attempts when it is closed
CLOSE_S, STOP_S = 60.0, 15.0  # that closing takes at most, for a finished run and for one that was stopped


class Tracker:
    """One MLflow run, found or created, and filled by a background thread, which starts with the first row.

    A resumed run hands over its whole history, and what MLflow has is skipped. A store without this run gets a new one.
    """

    def __init__(self, identity: Identity):
        self.uri = identity.uri
        self.run_id: str | None = None  # MLflow's id of the run, once there is one
        self.error: str | None = None  # why the last sync failed, in one line
        self.sent = Counter(row=0, file=0, model=0)  # what reached MLflow that was not there before
        self.note = ""  # Markdown that replaces the run's description as it ends, unless a user has written another
        self._identity = identity
        self._run: LoggedRun | None = None
        # What MLflow lacks: the run adds to it, and the thread removes what it has sent.
        self._rows: list[Row] = []
        self._files: list[Path] = []
        self._model: tuple[Path, Model] | None = None
        self._stored = False  # whether MLflow has the model's files
        self._wall_s: float | None = None
        self._status: Status | None = None  # set by close()
        self._ended = False

        self._tried, self._wake, self._closed = (threading.Event() for _ in range(3))
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        self._preload = threading.Thread(target=preload, name="preload", daemon=True)

    def wait_ready(self, timeout_s: float = 30.0) -> str:
        """The run's id, once there is one. Raises TrackingError when an attempt fails, or after `timeout_s`."""
        self._start()
        self._tried.wait(timeout_s)
        if self.run_id is None:
            raise TrackingError(f"{redacted(self.uri)}: {self.error or f'MLflow not ready after {timeout_s:g} s'}")
        return self.run_id

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

    def log_row(self, step: int, row: Mapping[str, float], wall_s: float | None = None) -> None:
        """Send metrics of a step, at `wall_s` after the run's start, or now. The last of these ends MLflow's run."""
        self._rows.append(Row(step, row, wall_s, time.time_ns() // 1_000_000))
        self._wall_s = wall_s
        self._start()

    def log_files(self, paths: Iterable[Path]) -> None:
        """Send files, each under its own name; they must stay as they are until `close` returns."""
        self._files += paths
        self._start()

    def log_model(self, folder: Path, model: Model) -> None:
        """Write the champion as a torch model into a run's folder, send it and register it, unless that is done."""
        self._model = folder, model
        self._wake.set()  # it takes seconds, in which the run has other work
        self._start()

    def close(self, status: Status, timeout_s: float | None = None) -> str | None:
        """Send what is left, end the run as `status`, and return None, or one line about what could not be sent.

        Raises nothing and returns within `timeout_s`, whatever MLflow does; an unreachable server is tried once more.
        """
        if self._thread.ident is None:
            return None
        self._status = status
        if status != "FINISHED":
            self._model = None  # a resumed run finds a better one
        self._closed.set()
        self._wake.set()
        timeout_s = timeout_s or (CLOSE_S if status == "FINISHED" else STOP_S)
        self._thread.join(timeout_s)
        steps = sorted({row.step for row in self._rows})
        span = f"{steps[0]} to {steps[-1]}" if len(steps) > 1 else f"{steps[0]}" if steps else ""
        lost = [f"{count(len(steps), 'row')} (step {span})"] if steps else []
        lost += [count(len(self._files), "file")] if self._files else []
        if self._model:
            lost.append("the registration of the model, whose files are stored" if self._stored else "the model")
        lost += [] if self._ended else [f"the status {self._status}"]
        if not lost:
            return None
        reason = self.error or f"no answer within {timeout_s:g} s"
        return f"not logged to MLflow at {redacted(self.uri)}: {', '.join(lost)}: {reason}"

    def _start(self) -> None:
        if self._thread.ident is None:
            self._thread.start()

    def _work(self) -> None:
        """Sync every FLUSH_S seconds, without a request if nothing is new, and once or twice when closed.

        A database that is locked as it is closed is tried again until `close` gives up.
        """
        while not self._closed.is_set():
            synced = self._sync()
            if synced and self._preload.ident is None:
                self._preload.start()
            self._wake.wait(FLUSH_S if synced else RETRY_S)
            self._wake.clear()
        if not self._sync():
            time.sleep(CHANCE_S)
            while not self._sync() and self._is_locked():
                time.sleep(CHANCE_S)

    def _sync(self) -> bool:
        """Send what MLflow lacks; a failure does not hold up the rest. Returns whether MLflow has all of it."""
        error: str | None = None
        for send in (self._send_rows, self._send_files, self._send_model, self._end):
            try:
                send()
            except Exception as failure:  # whatever it is, the tracked run goes on
                self.error = error = one_line(failure, self.uri)
                if self._run is None:
                    break
            finally:
                if self._run or not self._is_locked():
                    self._tried.set()
        self.error = error
        return error is None

    def _is_locked(self) -> bool:
        """Whether the last sync failed only because others write to the database, which ends."""
        return "database is locked" in (self.error or "")

    @property
    def _opened(self) -> LoggedRun:
        """MLflow's run, found or created when it is first needed."""
        if self._run is None:
            self._run = LoggedRun(self._identity)
            self.run_id = self._run.run_id
        return self._run

    def _send_rows(self) -> None:
        rows = self._rows[:]
        self.sent["row"] += self._opened.log(rows)
        del self._rows[: len(rows)]

    def _send_files(self) -> None:
        while self._files:
            self.sent["file"] += self._opened.upload(self._files[0])
            del self._files[0]

    def _send_model(self) -> None:
        if self._model:
            folder, model = self._model
            if not self._stored:
                self._opened.store_model(folder, model)
                self._stored = True
            self.sent["model"] += self._opened.register(model)
            self._model = None

    def _end(self) -> None:
        if self._status is not None:
            self._opened.end(self._status, self._wall_s, self.note)
            self._ended = True
