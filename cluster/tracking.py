"""MLflow, kept off the generation loop's back: the one module that imports it.

MLflow takes two seconds to import and to open its store, and milliseconds a row, so all of it happens in one background
thread that is fed through a queue. What cannot be logged is kept, tried again, and in the end reported; it never stops
a run. Every row is logged once: a resumed run asks MLflow what it has, and a request whose answer was lost is
repeated with the same timestamps, which MLflow recognises.
"""

import contextlib
import functools
import logging
import os
import posixpath
import re
import socket
import sqlite3
import ssl
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from mlflow.entities import Metric, Run
    from mlflow.tracking import MlflowClient

Status = Literal["FINISHED", "KILLED", "FAILED"]

DEFAULT_URI = "sqlite:///mlflow.db"
KEY_TAG = "gridsim.key"
"""The tag that a run is found again by, if it was killed before anybody knew its id."""

PROBE_S = 3.0
FLUSH_S = 2.0  # rows that come within this time go out as one request: 5 ms of CPU for a row alone, 0.8 ms among many
RETRY_S = 5.0
CHANCE_S = 1.0  # between the two attempts that a closed tracker still makes
CLOSE_S = 10.0
MAX_BATCH, MAX_PARAM, MAX_TAG = 1000, 6000, 8000  # MLflow's own limits: metrics a request, characters of a value

# Only where the user has not decided otherwise. MLflow's own retries would go on for minutes; ours replace them.
_ENVIRONMENT = {
    "MLFLOW_CONFIGURE_LOGGING": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
}
_LOGGERS = ("mlflow", "alembic", "sqlalchemy", "urllib3")
_SERVERS = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}


class TrackingError(Exception):
    """MLflow cannot be used as asked; its text is one line for the user."""


@dataclass(frozen=True)
class _Row:
    step: int
    metrics: dict[str, float]
    timestamp: int  # ms; fixed when the row is handed over, so that a repeated request is the same one


def check_uri(uri: str | None = None) -> str:
    """The tracking address made absolute, after a look whether it can be used: 4 s at most, and without MLflow.

    None stands for MLFLOW_TRACKING_URI and, where that is not set, for `sqlite:///mlflow.db` in the working directory.
    Raises TrackingError for a server that does not answer, a database that cannot be written, a folder (MLflow 3
    stores nothing in folders) and anything unknown.
    """
    uri = uri or os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_URI
    scheme = uri.partition("://")[0].partition("+")[0].lower() if "://" in uri else ""
    if scheme == "sqlite":
        return _check_sqlite(uri)
    if scheme in ("http", "https"):
        return _check_http(uri)
    if scheme in _SERVERS:
        return _check_server(uri, _SERVERS[scheme])
    if scheme in ("", "file"):
        raise TrackingError(f"{uri}: MLflow 3 keeps no runs in folders; use sqlite:///mlflow.db or http://host:port")
    raise TrackingError(f"{_shown(uri)}: not a tracking address; use sqlite:///mlflow.db or http://host:port")


@functools.cache
def git_commit() -> str:
    """The commit that this code was checked out from; `unknown` outside git (an installed copy, no git, no commit)."""
    here = Path(__file__).resolve()
    # A hook's GIT_DIR would lead to another repository.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=5.0, check=True)
        return done.stdout.strip()

    try:
        # Installed into a .venv inside somebody else's repository, this file is there but is not tracked.
        git("ls-files", "--error-unmatch", here.name)
        return git("rev-parse", "HEAD") or "unknown"
    except (OSError, subprocess.SubprocessError):
        return "unknown"


class Tracker:
    """One MLflow run, found or created, and filled by a background thread.

    `uri` is what `check_uri` returned (None: it is asked). `key` is the run's own unique name, made by the caller
    before MLflow is even imported and kept in its checkpoint: with it a run is found again that was killed before its
    `run_id` had been saved. A `run_id` or `key` that this store does not know means a new run, which gets every row.

    On resume hand over the whole history: what MLflow has is skipped. What a resumed run says differently (a larger
    number of generations, another commit) is added as tag `resumed/<name>`, as MLflow lets no parameter change.
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
    ):
        if key is not None and not re.fullmatch(r"[\w.:/-]{1,250}", key):
            raise ValueError(f"{key!r} cannot be a run's key")
        for name in [*params, *tags]:
            _check_name(name)
        self.uri = uri or check_uri(None)
        self._experiment = experiment
        self._run_name = run_name
        self._params = {name: str(value)[:MAX_PARAM] for name, value in params.items()}
        self._tags = {name: str(value)[:MAX_TAG] for name, value in tags.items()}
        self._known_id = run_id
        self._key = key or uuid.uuid4().hex

        self._changed = threading.Condition()  # guards what follows; the thread alone takes away from the deques
        self._rows: deque[_Row] = deque()
        self._files: deque[tuple[Path, str | None]] = deque()
        self._last_step = 0
        self._status: Status | None = None  # set by close()
        self._terminated = False
        self._error: str | None = None
        self._run_id: str | None = None
        self._report: str | None = None

        self._client: MlflowClient | None = None  # the thread's own, as is the next
        self._logged: dict[str, set[int]] = {}  # metric -> steps that MLflow has
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        if start:
            self.start()

    def start(self) -> None:
        """Begin in the background, if that has not happened; with `start=False` the first row or question does it."""
        with self._changed:
            if self._thread.ident is None:
                for name, value in _ENVIRONMENT.items():
                    os.environ.setdefault(name, value)
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
                raise TrackingError(f"{_shown(self.uri)}: {self._error or f'MLflow not ready after {timeout_s:g} s'}")
            return self._run_id

    def missing(self, steps: Iterable[int], timeout_s: float = 30.0) -> list[int]:
        """Those of `steps` that MLflow has nothing of (rows still queued count as missing). Waits like `wait_ready`."""
        self.wait_ready(timeout_s)
        with self._changed:
            logged = set().union(*self._logged.values())
        return [step for step in steps if step not in logged]

    def log_row(self, step: int, row: Mapping[str, float]) -> None:
        """Queue one row of metrics; returns at once. A (metric, step) that has been logged before is skipped.

        Raises ValueError or TypeError for a name or value that MLflow cannot hold, RuntimeError after `close`.
        """
        for name in row:
            _check_name(name)
        metrics = {name: float(value) for name, value in row.items()}
        with self._changed:
            self._check_open()
            self._rows.append(_Row(int(step), metrics, time.time_ns() // 1_000_000))
            self._last_step = max(self._last_step, int(step))
            self._changed.notify_all()
        self.start()

    def log_summary(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Queue the run's final figures, at `step` or else at the highest step so far."""
        self.log_row(self._last_step if step is None else step, metrics)

    def log_artifacts(self, folder: str | os.PathLike[str]) -> None:
        """Queue every file under `folder` but hidden ones; they have to stay as they are until `close` returns."""
        folder = Path(folder).resolve()
        found = []
        for path in sorted(folder.rglob("*")):
            inside = path.relative_to(folder)
            if path.is_file() and not any(part.startswith(".") for part in inside.parts):
                found.append((path, None if inside.parent == Path(".") else inside.parent.as_posix()))
        self._queue(found)

    def log_files(self, paths: Iterable[str | os.PathLike[str]]) -> None:
        """Queue files, each under its own name; what `log_artifacts` says of them holds here too."""
        self._queue([(Path(path).resolve(), None) for path in paths])

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
            self._changed.notify_all()
        if self._thread.ident is None and not self._rows and not self._files:
            return None  # never begun: there is nothing to end
        self.start()
        self._thread.join(timeout_s)
        with self._changed:
            steps = [row.step for row in self._rows]
            lost = [f"{_count(steps, 'row')} (step {_span(steps)})"] if steps else []
            lost += [_count(self._files, "file")] if self._files else []
            lost += [] if self._terminated else [f"the status {status}"]
            if lost:
                reason = self._error or f"no answer within {timeout_s:g} s"
                self._report = f"not logged to MLflow at {_shown(self.uri)}: {', '.join(lost)}: {reason}"
            return self._report

    # ------------------------------------------------------------------------------------------ in the thread

    def _work(self) -> None:
        """Log what comes, until closed. Nothing leaves a queue before MLflow has it, so any step can be repeated."""
        chances = 2  # once closed
        while chances:
            status = self._status
            chances -= status is not None
            done = self._attempt(self._set_up) and self._attempt(self._log_rows) & self._attempt(self._upload)
            if status and self._client and (done or not chances):
                done &= self._attempt(self._terminate)
            with self._changed:
                if done:
                    self._error = None
                    if status:
                        return
                    self._changed.wait_for(lambda: self._status, FLUSH_S)
                    self._changed.wait_for(lambda: self._status or self._rows or self._files)
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
                self._error = _one_line(error)
                self._changed.notify_all()
            return False
        return True

    def _set_up(self) -> None:
        """Import MLflow, open the store, find or create the run."""
        if self._client is not None:
            return
        _silence()
        from mlflow.entities import Param, RunTag
        from mlflow.tracking import MlflowClient
        from mlflow.tracking.context.git_context import GitRunContext
        from mlflow.tracking.context.registry import resolve_tags

        path = _sqlite_path(self.uri)
        if path and not path.exists():
            _create_database(path)
        client = MlflowClient(tracking_uri=self.uri)
        experiment_id = _experiment_id(client, self._experiment, path)

        commit = git_commit()
        natural = resolve_tags(ignore=[GitRunContext])  # type: ignore[list-item]  # mlflow.user, mlflow.source.*
        if commit != "unknown":
            natural["mlflow.source.git.commit"] = commit
        tags = {"git_commit": commit, **self._tags, KEY_TAG: self._key}

        run = self._find_run(client, experiment_id)
        logged: dict[str, set[int]] = {}
        if run is None:
            run = client.create_run(experiment_id, tags={**natural, **tags}, run_name=self._run_name)
        else:
            client.update_run(run.info.run_id, status="RUNNING")
            for name in run.data.metrics:
                logged[name] = {metric.step for metric in client.get_metric_history(run.info.run_id, name)}
        resumed: dict[str, str] = {}
        for wanted, have in ((self._params, run.data.params), (tags, run.data.tags)):
            resumed |= {f"resumed/{name}": new for name, new in wanted.items() if have.get(name, new) != new}
        params = [Param(name, value) for name, value in self._params.items() if name not in run.data.params]
        new_tags = {name: value for name, value in tags.items() if name not in run.data.tags} | resumed
        client.log_batch(run.info.run_id, params=params, tags=[RunTag(*tag) for tag in new_tags.items()])
        with self._changed:
            self._client, self._logged, self._run_id = client, logged, run.info.run_id
            self._changed.notify_all()

    def _find_run(self, client: "MlflowClient", experiment_id: str) -> "Run | None":
        """The run by its id, or else by its key; None if this store has neither, or only in its bin."""
        from mlflow.exceptions import MlflowException

        if self._known_id:
            try:
                run = client.get_run(self._known_id)
            except MlflowException as error:
                if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
                    raise
            else:
                if run.info.lifecycle_stage == "active":
                    return run
        found = client.search_runs([experiment_id], f"tags.`{KEY_TAG}` = '{self._key}'", max_results=1)
        return client.get_run(found[0].info.run_id) if found else None

    def _log_rows(self) -> None:
        """Send the queued rows, many a request."""
        while rows := self._next_rows():
            metrics = list(self._metrics(rows))
            self._ready_client().log_batch(str(self._run_id), metrics=metrics)
            with self._changed:
                for metric in metrics:
                    self._logged.setdefault(metric.key, set()).add(metric.step)
                for _ in rows:
                    self._rows.popleft()

    def _next_rows(self) -> list[_Row]:
        """The oldest rows that fit into one request (one request logs all of its metrics, or none)."""
        rows: list[_Row] = []
        size = 0
        with self._changed:
            for row in self._rows:
                size += len(row.metrics)
                if rows and size > MAX_BATCH:
                    break
                rows.append(row)
        return rows

    def _metrics(self, rows: list[_Row]) -> "Iterator[Metric]":
        """What MLflow does not have of `rows`."""
        from mlflow.entities import Metric

        seen: set[tuple[str, int]] = set()
        for row in rows:
            for name, value in row.metrics.items():
                if row.step not in self._logged.get(name, ()) and (name, row.step) not in seen:
                    seen.add((name, row.step))
                    yield Metric(name, value, row.timestamp, row.step)

    def _upload(self) -> None:
        """Send the queued files, one by one: MLflow's own pool of threads would hold up the exit if a server hangs."""
        while self._files:
            path, folder = self._files[0]
            self._ready_client().log_artifact(str(self._run_id), str(path), folder)
            with self._changed:
                self._files.popleft()

    def _terminate(self) -> None:
        """End the run as `close` was told."""
        self._ready_client().set_terminated(str(self._run_id), self._status)
        with self._changed:
            self._terminated = True

    def _ready_client(self) -> "MlflowClient":
        assert self._client is not None  # _work sees to it
        return self._client

    def _check_open(self) -> None:
        if self._status is not None:
            raise RuntimeError("this tracker has been closed")


# ------------------------------------------------------------------------------------------------ addresses


def _check_sqlite(uri: str) -> str:
    """The address with an absolute path, after the database, or the folder for it, was found to be writable."""
    path = _sqlite_path(uri)
    if path is None:
        raise TrackingError(f"{uri}: names no file; use sqlite:///mlflow.db")
    if not path.parent.is_dir():
        raise TrackingError(f"{uri}: there is no folder {path.parent}; create it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise TrackingError(f"{uri}: the folder {path.parent} cannot be written")
    if path.is_dir():
        raise TrackingError(f"{uri}: {path} is a folder; name a file")
    if path.exists() and path.stat().st_size:
        try:
            with contextlib.closing(_connect(path, "rw")) as database:
                database.execute("BEGIN IMMEDIATE")
                database.execute("PRAGMA schema_version").fetchone()
                database.execute("ROLLBACK")
        except sqlite3.Error as error:
            raise TrackingError(f"{uri}: not a database that can be written: {error}") from error
    query = uri.partition("?")[2]
    return f"sqlite:///{path}" + (f"?{query}" if query else "")


def _sqlite_path(uri: str) -> Path | None:
    """The database file of a SQLite address, absolute; None for another kind of address or a database in memory."""
    match = re.fullmatch(r"sqlite(?:\+\w+)?:///([^?]+)(?:\?.*)?", uri)
    return None if match is None or match[1] == ":memory:" else Path(os.path.abspath(match[1]))


def _check_http(uri: str) -> str:
    """The address of a server, without a slash at its end, after an MLflow server answered there."""
    uri = uri.rstrip("/")
    problem: list[str | None] = []
    # In a thread, as nothing else bounds the time that looking up a name takes.
    thread = threading.Thread(target=lambda: problem.append(_probe_http(uri)), daemon=True)
    thread.start()
    thread.join(PROBE_S + 1.0)
    reason = problem[0] if problem else f"no answer within {PROBE_S:g} s"
    if reason:
        raise TrackingError(f"no MLflow server at {_shown(uri)}: {reason}; start one, or use {DEFAULT_URI}")
    return uri


def _probe_http(uri: str) -> str | None:
    """What speaks against an MLflow server at `uri`, or None. Sends no credentials, and so checks no certificate."""
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    for page in ("/health", "/api/2.0/mlflow/experiments/search?max_results=1"):  # a gateway may know but the second
        url = re.sub(r"//[^/@]*@", "//", uri) + page
        try:
            with urllib.request.urlopen(url, timeout=PROBE_S, context=unchecked) as answer:
                if answer.read(64).lstrip().startswith((b"OK", b"{")):
                    return None
        except urllib.error.HTTPError as error:
            if error.code in (400, 401, 403, 405, 429):
                return None if b"Invalid Host header" not in error.read(200) else "it refuses this host name"
            if error.code >= 500:
                return f"it answers with error {error.code}"
        except Exception as error:  # refused, unknown host, timed out, no HTTP, no address at all
            return _one_line(error)
    return "something else answers there"


def _check_server(uri: str, port: int) -> str:
    """The address of a database server, after something answered there."""
    try:
        parts = urllib.parse.urlsplit(uri)
        socket.create_connection((parts.hostname or "localhost", parts.port or port), PROBE_S).close()
    except (OSError, ValueError) as error:
        raise TrackingError(f"no database server at {_shown(uri)}: {_one_line(error)}") from error
    return uri


# ------------------------------------------------------------------------------------------------ the store


def _silence() -> None:
    """Nothing of MLflow's reaches the terminal: its errors reach the caller. A handler that is there stays."""
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())
            logger.propagate = False


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    address = f"file:{urllib.parse.quote(str(path))}?mode={mode}"
    return sqlite3.connect(address, timeout=PROBE_S, isolation_level=None, uri=True)


def _create_database(path: Path) -> None:
    """Make a new MLflow database appear at `path` whole, if nobody else is first.

    MLflow builds it by 60 migrations in a second. Killed in the middle of them it leaves a database that it can never
    open again, and two runs that start together do the same to each other. So it is built elsewhere.
    """
    from mlflow.tracking import MlflowClient

    whole = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with tempfile.TemporaryDirectory() as folder:
            built = Path(folder, "mlflow.db")
            MlflowClient(tracking_uri=f"sqlite:///{built}").search_experiments(max_results=1)
            whole.unlink(missing_ok=True)
            with (
                contextlib.closing(_connect(built, "ro")) as source,
                contextlib.closing(_connect(whole, "rwc")) as copy,
            ):
                source.backup(copy)
        try:
            os.link(whole, path)
        except FileExistsError:
            pass
        except OSError:  # a file system without hard links
            if not path.exists():
                os.rename(whole, path)
    finally:
        whole.unlink(missing_ok=True)


def _experiment_id(client: "MlflowClient", name: str, database: Path | None) -> str:
    """The experiment of that name, created if need be with its artifacts beside the database."""
    from mlflow.exceptions import MlflowException

    http = client.tracking_uri.startswith("http")  # the server knows best where artifacts go
    location = None if http else ((database.parent if database else Path.cwd()) / "mlartifacts").as_uri()
    experiment = client.get_experiment_by_name(name)
    if experiment is None:
        try:
            return client.create_experiment(name, artifact_location=location)
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":  # another run was first
                raise
            experiment = client.get_experiment_by_name(name)
    if experiment is None or experiment.lifecycle_stage != "active":
        raise TrackingError(f"experiment {name!r} has been deleted; restore it or choose another name")
    return experiment.experiment_id


# ------------------------------------------------------------------------------------------------ words


def _check_name(name: str) -> None:
    """Hold a name against MLflow's rules now, as MLflow would refuse the whole request later."""
    clean = re.fullmatch(r"[/\w.\- :]{1,250}", name) and posixpath.normpath(name) == name
    if not clean or name == "." or name.startswith(("..", "/")):
        raise ValueError(f"{name!r} is no name that MLflow allows")


def _count(things: Sized, noun: str) -> str:
    return f"{len(things)} {noun}{'' if len(things) == 1 else 's'}"


def _span(steps: list[int]) -> str:
    return str(steps[0]) if len(steps) == 1 else f"{min(steps)} to {max(steps)}"


def _shown(uri: str) -> str:
    """An address without its password."""
    return re.sub(r"//[^/@\s]*@", "//", uri)


def _one_line(error: BaseException) -> str:
    """The error in one line without a password; of a failed connection only what went wrong."""
    text = str(error) or type(error).__name__
    reasons = re.findall(r"\[Errno -?\d+\] ([^'\")\]]+)", text)
    if reasons:
        return reasons[-1].strip()
    if "timed out" in text.lower():
        return "no answer in time"
    return _shown(text.splitlines()[0])[:200]
