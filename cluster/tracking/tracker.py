"""A run's way to MLflow, kept off the generation loop's back.

MLflow takes two seconds to import and to open its store, and milliseconds a row, so all of it happens in one background
thread that is fed through a queue. What cannot be logged is kept, tried again, and in the end reported; it never stops
a run. Every row is logged once: a resumed run asks MLflow what it has, and a request whose answer was lost is
repeated with the same timestamps, which MLflow recognises. Nothing is kept for MLflow alone: the checkpoint holds the
history and the run's folder the files, so that what is missing can be sent later (`run.log_missing`).
"""

from __future__ import annotations

import os
import posixpath
import re
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cluster.tracking.address import UI, TrackingError, check_uri, one_line, shown
from cluster.tracking.mlflow_run import (
    CHAMPION_TAG,
    MODEL,
    Identity,
    LoggedRun,
    Row,
    Status,
    Version,
    run_table,
    save_model,
    saved_champion,
)

if TYPE_CHECKING:
    import numpy as np
    import torch

FLUSH_S = 2.0  # rows that come within this time go out as one request: 5 ms of CPU for a row alone, 0.8 ms among many
RETRY_S = 5.0
CHANCE_S = 1.0  # between the two attempts that a closed tracker still makes
CLOSE_S = 10.0
MAX_BATCH, MAX_PARAM, MAX_TAG = 1000, 6000, 8000  # MLflow's own limits: metrics a request, characters of a value


@dataclass(frozen=True)
class Model:
    """The champion as a torch model, and under which name it is registered.

    Attributes:
        version: what is registered.
        build: makes the module and an input for it, float32 [n, inputs]; called in the thread, as torch takes seconds.
        metadata: what the model tells of itself, beside the champion's digest.
    """

    version: Version
    build: Callable[[], tuple[torch.nn.Module, np.ndarray]]
    metadata: Mapping[str, str]


@dataclass
class Sent:
    """What reached MLflow that was not there before."""

    rows: int = 0
    files: int = 0
    models: int = 0

    def __str__(self) -> str:
        counts = ((self.rows, "row"), (self.files, "file"), (self.models, "model"))
        return ", ".join(_count(number, noun) for number, noun in counts if number)


class Tracker:
    """One MLflow run, found or created, and filled by a background thread.

    `uri` is what `check_uri` returned (None: it is asked). `key` is the run's own unique name, made by the caller
    before MLflow is even imported and kept in its checkpoint: with it a run is found again that was killed before its
    `run_id` had been saved. A `run_id` or `key` that this store does not know means a new run, which gets every row.

    On resume hand over the whole history: what MLflow has is skipped. What a resumed run says differently (a larger
    number of generations, another commit) is added as tag `resumed/<name>`, as MLflow lets no parameter change. With
    `late` nothing but what is missing is logged (`mlflow_run.Identity`). A new run `started` so many seconds after the
    epoch, or now.

    Attributes:
        wall_s: seconds that the run has taken, pauses left out, by which it ends in MLflow; None: it ends when closed.
    """

    def __init__(
        self,
        uri: str | None,
        experiment: str,
        run_name: str,
        params: Mapping[str, str],
        tags: Mapping[str, str],
        run_id: str | None = None,
        key: str | None = None,
        start: bool = True,
        note: str = "",
        late: bool = False,
        started: float | None = None,
    ):
        if key is not None and not re.fullmatch(r"[\w.:/-]{1,250}", key):
            raise ValueError(f"{key!r} cannot be a run's key")
        for name in [*params, *tags]:
            _check_name(name)
        self.uri = uri or check_uri(None)
        self._identity = Identity(
            self.uri,
            experiment,
            run_name,
            {name: str(value)[:MAX_PARAM] for name, value in params.items()},
            {name: str(value)[:MAX_TAG] for name, value in tags.items()},
            note[:MAX_TAG],
            key or uuid.uuid4().hex,
            run_id,
            late,
            int(1000.0 * (time.time() if started is None else started)),
        )
        self._changed = threading.Condition()  # guards what follows; the thread alone takes away from the deques
        self._rows: deque[Row] = deque()
        self._files: deque[tuple[Path, str | None]] = deque()
        self._note: str | None = None
        self._model: tuple[Path, Model] | None = None  # until it is registered, or cannot be made
        self._model_saved = False
        self._model_error = ""
        self._last_step = 0
        self._status: Status | None = None  # set by close()
        self._terminated = False
        self._error: str | None = None
        self._run_id: str | None = None
        self._report: str | None = None
        self.sent = Sent()
        self.wall_s: float | None = None

        self._run: LoggedRun | None = None  # the thread's own
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        if start:
            self.start()

    def start(self) -> None:
        """Begin in the background, if that has not happened; with `start=False` the first row or question does it."""
        with self._changed:
            if self._thread.ident is None:
                self._thread.start()

    @property
    def run_id(self) -> str | None:
        """MLflow's id of the run, or None as long as there is none."""
        return self._run_id

    @property
    def error(self) -> str | None:
        """Why the last attempt failed, in one line; None once one has succeeded."""
        return self._error

    def wait_ready(self, timeout_s: float = 30.0) -> str:
        """The run's id, once there is one. Raises TrackingError when an attempt fails, or after `timeout_s`."""
        self.start()
        with self._changed:
            self._changed.wait_for(lambda: self._run_id or self._error or not self._thread.is_alive(), timeout_s)
            if self._run_id is None:
                raise TrackingError(f"{shown(self.uri)}: {self._error or f'MLflow not ready after {timeout_s:g} s'}")
            return self._run_id

    def where(self) -> str:
        """How to see the run beside others in MLflow's UI, in words for the terminal."""
        served = self.uri.startswith("http")
        table = run_table(self.uri if served else UI, self._run.experiment_id) if self._run else ""
        if served:
            return table or shown(self.uri)
        return f"make ui, or mlflow ui --backend-store-uri {self.uri}" + (f"; then open\n{table}" if table else "")

    def missing(self, steps: Iterable[int], timeout_s: float = 30.0) -> list[int]:
        """Those of `steps` that MLflow has nothing of (rows still queued count as missing). Waits like `wait_ready`."""
        self.wait_ready(timeout_s)
        with self._changed:
            assert self._run is not None
            logged = set().union(*self._run.logged.values())
        return [step for step in steps if step not in logged]

    def log_row(self, step: int, row: Mapping[str, float], ago_s: float = 0.0) -> None:
        """Queue one row of metrics, of so many seconds ago; returns at once. What has been logged before is skipped.

        Raises ValueError or TypeError for a name or value that MLflow cannot hold, RuntimeError after `close`.
        """
        for name in row:
            _check_name(name)
        metrics = {name: float(value) for name, value in row.items()}
        with self._changed:
            self._check_open()
            self._rows.append(Row(int(step), metrics, time.time_ns() // 1_000_000 - int(1000.0 * ago_s)))
            self._last_step = max(self._last_step, int(step))
            self._changed.notify_all()
        self.start()

    def log_summary(self, metrics: Mapping[str, float], step: int | None = None, ago_s: float = 0.0) -> None:
        """Queue the run's final figures, at `step` or else at the highest step so far."""
        self.log_row(self._last_step if step is None else step, metrics, ago_s)

    def log_artifacts(self, folder: str | os.PathLike[str]) -> None:
        """Queue every file under `folder` but hidden ones; they have to stay as they are until `close` returns.

        A model in it (`mlflow_run.MODEL`) is left to `log_model`.
        """
        folder = Path(folder).resolve()
        found = []
        for path in sorted(folder.rglob("*")):
            inside = path.relative_to(folder)
            hidden = any(part.startswith(".") for part in inside.parts)
            if path.is_file() and not hidden and inside.parts[0] != MODEL:
                found.append((path, None if inside.parent == Path(".") else inside.parent.as_posix()))
        self._queue(found)

    def log_files(self, paths: Iterable[str | os.PathLike[str]]) -> None:
        """Queue files, each under its own name; what `log_artifacts` says of them holds here too."""
        self._queue([(Path(path).resolve(), None) for path in paths])

    def log_model(self, folder: str | os.PathLike[str], model: Model) -> None:
        """Begin to write the champion as a torch model into a run's folder, to store it, and to register it.

        What is there of the same champion is not written again, and what is registered is not registered again.
        """
        with self._changed:
            self._check_open()
            self._model, self._model_saved = (Path(folder).resolve() / MODEL, model), False
            self._changed.notify_all()
        self.start()

    def describe(self, note: str) -> None:
        """Queue the run's description, Markdown; one that somebody has written in MLflow's UI is left alone."""
        with self._changed:
            self._check_open()
            self._note = note[:MAX_TAG]
            self._changed.notify_all()
        self.start()

    def _queue(self, files: Iterable[tuple[Path, str | None]]) -> None:
        with self._changed:
            self._check_open()
            self._files.extend(files)
            self._changed.notify_all()
        self.start()

    def close(self, status: Status, timeout_s: float = CLOSE_S) -> str | None:
        """Log what is queued, end the run as `status`, and return None, or one line about what could not be logged.

        Raises nothing and returns within `timeout_s`, whatever MLflow does; a server that is away gets one more chance.
        """
        with self._changed:
            if self._status is not None:
                return self._report
            self._status = status
            if status != "FINISHED":
                self._model = None  # there is a better one to come
            self._changed.notify_all()
        if self._thread.ident is None and not self._rows and not self._files:
            return None  # never begun: there is nothing to end
        self.start()
        self._thread.join(timeout_s)
        with self._changed:
            steps = [row.step for row in self._rows]
            lost = [f"{_count(len(steps), 'row')} (step {_span(steps)})"] if steps else []
            lost += [_count(len(self._files), "file")] if self._files else []
            lost += ["the model"] if self._model or self._model_error else []
            lost += [] if self._terminated else [f"the status {status}"]
            if lost:
                reason = self._error or self._model_error or f"no answer within {timeout_s:g} s"
                self._report = f"not logged to MLflow at {shown(self.uri)}: {', '.join(lost)}: {reason}"
            return self._report

    # ------------------------------------------------------------------------------------------ in the thread

    def _work(self) -> None:
        """Log what comes, until closed. Nothing leaves a queue before MLflow has it, so any step can be repeated."""
        chances = 2  # once closed
        while chances:
            status = self._status
            chances -= status is not None
            done = self._attempt(self._open) and (
                self._attempt(self._log_rows)
                & self._attempt(self._describe)
                & (self._attempt(self._store_model) & self._attempt(self._upload) and self._attempt(self._register))
            )
            if status and self._run and (done or not chances):
                done &= self._attempt(self._terminate)
            with self._changed:
                if done:
                    self._error = None
                    if status:
                        return
                    self._changed.wait_for(lambda: self._status, FLUSH_S)
                    self._changed.wait_for(
                        lambda: self._status or self._rows or self._files or self._model or self._note is not None
                    )
                elif not status:
                    self._changed.wait_for(lambda: self._status, RETRY_S)
                elif chances:
                    self._changed.wait(CHANCE_S)

    def _attempt(self, step: Callable[[], None]) -> bool:
        """Whether `step` succeeded. If not, `error` says why: whatever it was, the run that is tracked goes on."""
        try:
            step()
        except Exception as error:
            with self._changed:
                self._error = one_line(error)
                self._changed.notify_all()
            return False
        return True

    def _open(self) -> None:
        """Find or create the run."""
        if self._run is None:
            run = LoggedRun(self._identity)
            with self._changed:
                self._run, self._run_id = run, run.run_id
                self._changed.notify_all()

    def _log_rows(self) -> None:
        """Send the queued rows, many a request."""
        run = self._opened()
        while rows := self._next_rows():
            self.sent.rows += run.log(rows)
            with self._changed:
                for _ in rows:
                    self._rows.popleft()

    def _next_rows(self) -> list[Row]:
        """The oldest rows that fit into one request (one request logs all of its metrics, or none)."""
        rows: list[Row] = []
        size = 0
        with self._changed:
            for row in self._rows:
                size += len(row.metrics)
                if rows and size > MAX_BATCH:
                    break
                rows.append(row)
        return rows

    def _describe(self) -> None:
        note = self._note
        if note is not None:
            self._opened().describe(note)
            with self._changed:
                self._note = None if self._note == note else self._note

    def _store_model(self) -> None:
        """Write the model to the run's folder, and queue its files. Not tried twice: what is wrong is wrong here."""
        if self._model is None or self._model_saved:
            return
        folder, model = self._model
        champion = model.version.champion_sha256
        try:
            if saved_champion(folder) != champion:
                save_model(folder, *model.build(), {**model.metadata, CHAMPION_TAG: champion})
        except Exception as error:
            with self._changed:
                self._model, self._model_error = None, one_line(error)
            return
        with self._changed:
            self._model_saved = True
            self._files.extend(
                (path, f"{MODEL}/{path.relative_to(folder).parent.as_posix()}".removesuffix("/."))
                for path in sorted(folder.rglob("*"))
                if path.is_file()
            )

    def _upload(self) -> None:
        """Send the queued files."""
        while self._files:
            self.sent.files += self._opened().upload(*self._files[0])
            with self._changed:
                self._files.popleft()

    def _register(self) -> None:
        """Register the model, whose files MLflow has."""
        if self._model and self._model_saved:
            self.sent.models += self._opened().register(self._model[1].version)
            with self._changed:
                self._model = None

    def _terminate(self) -> None:
        """End the run as `close` was told."""
        assert self._status is not None
        self._opened().end(self._status, self.wall_s)
        with self._changed:
            self._terminated = True

    def _opened(self) -> LoggedRun:
        assert self._run is not None  # _work sees to it
        return self._run

    def _check_open(self) -> None:
        if self._status is not None:
            raise RuntimeError("this tracker has been closed")


# ------------------------------------------------------------------------------------------------ words


def _check_name(name: str) -> None:
    """Hold a name against MLflow's rules now, as MLflow would refuse the whole request later."""
    clean = re.fullmatch(r"[/\w.\- :]{1,250}", name) and posixpath.normpath(name) == name
    if not clean or name == "." or name.startswith(("..", "/")):
        raise ValueError(f"{name!r} is no name that MLflow allows")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _span(steps: list[int]) -> str:
    return str(steps[0]) if len(steps) == 1 else f"{min(steps)} to {max(steps)}"
