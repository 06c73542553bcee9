"""A run as MLflow has it: found or created, its rows, files, description and model. The one module that imports MLflow.

Everything here blocks and may raise whatever MLflow raises; any call can be repeated, as `tracker.Tracker` does.

Models are written here and never read. They are `torch.export`'s graph with its weights, MLflow's format `pt2`, never a
pickled module, and load where MLFLOW_ALLOW_PICKLE_DESERIALIZATION is `false`. Where it is not, a user's own
`mlflow.pytorch.load_model` runs whatever a model's maker has put into it, in either format.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import tempfile
import time
import uuid
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from cluster.redaction import one_line, redacted
from cluster.tracking.address import TrackingError, is_database, schema_problem, sqlite_path, sqlite_uri
from cluster.tracking.commit import DIRTY, git_commit
from cluster.tracking.view import VIEW_TAG, run_table, view

if TYPE_CHECKING:
    import numpy as np
    import torch
    from mlflow.entities import FileInfo, Run
    from mlflow.tracking import MlflowClient

Status = Literal["FINISHED", "KILLED", "FAILED"]

KEY_TAG = "gridsim.key"
"""The tag by which a run is found again."""
NOTE_TAG, OWN_NOTE_TAG = "mlflow.note.content", "mlflow.note.gridsim"
"""MLflow's tag for the description, and ours for the digest of the one written here; the UI lists neither."""
CHAMPION_TAG = "champion_sha256"
"""The tag of a registered version that identifies its champion."""
RUN_ID = "{run_id}"
"""Stands in a description for MLflow's id of the run, which is not yet known when it is written."""
BEST = "best"
"""Alias of a registered model's version with the greatest success on held-out roads."""
MODEL = "model"
"""Folder of the champion as a torch model, in a run's folder and among its artifacts."""
ROOM = 3_000_000  # bytes in the temporary folder for a new database (1 MB), or for a model besides its weights
MAX_BATCH = 1000  # metrics that MLflow takes in one request

# Set unless the user has set them. MLflow's own retries would go on for minutes; ours replace them.
_ENVIRONMENT = {
    "MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false",
    "MLFLOW_CONFIGURE_LOGGING": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
}
_LOGGERS = ("mlflow", "alembic", "sqlalchemy", "urllib3", "torch", "matplotlib")


def quiet() -> None:
    """Keep MLflow and others from writing to the terminal: errors reach the caller. What the user has set stays.

    To be called before there are threads, as `ray_session.prepare`.
    """
    from gridsim.jit import CACHE_FOLDER  # here, because it loads Numba, which takes half a second

    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    # Else PyTorch sets it, later.
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(CACHE_FOLDER / "torchinductor"))
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())
            logger.propagate = False


class Row(NamedTuple):
    """Metrics of one step, `wall_s` after the run's start without pauses, or if None at `logged_ms` since the epoch.

    Times are fixed, so that a repeated request is the same.
    """

    step: int
    metrics: Mapping[str, float]
    wall_s: float | None
    logged_ms: int


@dataclass(frozen=True)
class Identity:
    """Which run is meant, and what a new one begins with."""

    uri: str  # what `address.check_uri` returned
    experiment: str
    name: str
    params: Mapping[str, str]
    tags: Mapping[str, str]
    note: str = ""  # its description, Markdown
    key: str = field(default_factory=lambda: uuid.uuid4().hex)  # made before MLflow is imported; the run's KEY_TAG
    run_id: str = ""  # MLflow's id of the run, if it is known
    finished: bool = False  # whether it has ended, so that what MLflow has of it stays as it is: status, times, files
    started: float | None = None  # s since the epoch at which a new one began; None: now


@dataclass(frozen=True)
class Model:
    """The champion as a torch model, and the registered version that it becomes."""

    name: str  # of the registered model
    champion_sha256: str  # digest of the champion's genome; a run registers one champion once
    about: str  # what all versions of the registered model have in common, Markdown
    note: str  # what this version is, Markdown
    tags: Mapping[str, str]  # the version's; the saved model has them as its metadata
    # Makes the module and an input for it, float32 [n, inputs] with n of 2 or more, so that what is written takes any
    # n. It is called in the tracker's thread, as torch takes seconds to import.
    build: Callable[[], tuple[torch.nn.Module, np.ndarray]]


class LoggedRun:
    """A run in MLflow, found by its id or key, or created; `run_id` and `experiment_id` are MLflow's."""

    def __init__(self, identity: Identity):
        quiet()
        from mlflow.tracking import MlflowClient

        self._identity = identity
        path = sqlite_path(identity.uri)
        if path and not path.exists():
            _create_database(path)
        _check_schema(identity.uri)
        self._client = MlflowClient(tracking_uri=identity.uri)
        self._logged: defaultdict[str, set[int]] = defaultdict(set)  # the steps that MLflow has of each metric
        run = self._known()
        self.experiment_id: str = run.info.experiment_id if run else _experiment_id(self._client, identity, path)
        run = run or self._with_key() or self._create()
        self.run_id: str = run.info.run_id
        self._artifacts: str = run.info.artifact_uri
        self._started: int = run.info.start_time
        self._has_ended = identity.finished and run.info.status == "FINISHED"
        self._complete(run)

    def _known(self) -> Run | None:
        """The run with the id that the run's folder has; None if this store has no such run, or it was deleted."""
        from mlflow.exceptions import MlflowException

        if not self._identity.run_id:
            return None
        try:
            run = self._client.get_run(self._identity.run_id)
        except MlflowException as error:
            if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
                raise
            return None
        ours = run.data.tags.get(KEY_TAG) == self._identity.key and run.info.lifecycle_stage == "active"
        return run if ours else None

    def _with_key(self) -> Run | None:
        """The run of the experiment that has the key: a run that was killed may not have saved its id."""
        found = self._client.search_runs(
            [self.experiment_id], f"tags.`{KEY_TAG}` = '{self._identity.key}'", max_results=1
        )
        return found[0] if found else None

    def _create(self) -> Run:
        from mlflow.tracking.context.git_context import GitRunContext
        from mlflow.tracking.context.registry import resolve_tags

        identity, commit = self._identity, git_commit()
        started = int(1000.0 * (time.time() if identity.started is None else identity.started))
        natural = resolve_tags(ignore=[GitRunContext])  # type: ignore[list-item]  # mlflow.user, mlflow.source.*
        if commit != "unknown":
            natural["mlflow.source.git.commit"] = commit.removesuffix(DIRTY)  # the bare commit
        tags = {**natural, **self._tags(), **_note_tags(identity.note)}
        return self._client.create_run(self.experiment_id, started, tags, identity.name)

    def _complete(self, run: Run) -> None:
        """Add the parameters and tags that the run lacks, and ask which steps it has."""
        from mlflow.entities import Param, RunTag

        run_id, data, identity = run.info.run_id, run.data, self._identity
        params = [Param(name, value) for name, value in identity.params.items() if name not in data.params]
        tags = {name: value for name, value in self._tags().items() if name not in data.tags}
        if not identity.finished:
            self._client.update_run(run_id, status="RUNNING")
            # MLflow does not let parameters change; what is different now (another commit) is added as a tag.
            for wanted, have in ((identity.params, data.params), (self._tags(), data.tags)):
                tags |= {f"resumed/{name}": new for name, new in wanted.items() if have.get(name, new) != new}
        for name in data.metrics:
            self._logged[name] = {metric.step for metric in self._client.get_metric_history(run_id, name)}
        self._client.log_batch(run_id, params=params, tags=[RunTag(*tag) for tag in tags.items()])

    def _tags(self) -> dict[str, str]:
        return {"git_commit": git_commit(), **self._identity.tags, KEY_TAG: self._identity.key}

    def log(self, rows: Sequence[Row]) -> int:
        """Log what MLflow lacks of these rows. Returns: how many of them it lacked."""
        from mlflow.entities import Metric

        missing = {}
        for row in rows:
            logged_ms = row.logged_ms if row.wall_s is None else self._started + round(1000.0 * row.wall_s)
            for name, value in row.metrics.items():
                if row.step not in self._logged[name]:
                    missing[name, row.step] = Metric(name, float(value), logged_ms, row.step)
        metrics = list(missing.values())
        for k in range(0, len(metrics), MAX_BATCH):
            batch = metrics[k : k + MAX_BATCH]
            self._client.log_batch(self.run_id, metrics=batch)
            for metric in batch:
                self._logged[metric.key].add(metric.step)
        return len({step for _, step in missing})

    def upload(self, path: Path, folder: str | None = None) -> bool:
        """Store a file among the artifacts. Returns: False for a finished run's file that MLflow has in the same size.

        Files are sent one by one: MLflow's own pool of threads would hold up the exit if a server hangs.
        Raises: TrackingError, which names the folder, if they are kept in one that is not there or cannot be written.
        """
        self._check_artifacts()
        if self._identity.finished:
            listed: list[FileInfo] = self._client.list_artifacts(self.run_id, folder)
            if (path.name, path.stat().st_size) in [(Path(each.path).name, each.file_size) for each in listed]:
                return False
        try:
            self._client.log_artifact(self.run_id, str(path), folder)
        except OSError as error:
            if not error.filename:  # of a server
                raise
            raise TrackingError(f"{error.filename2 or error.filename}: {error.strerror}") from error
        return True

    def _check_artifacts(self) -> None:
        """Raise TrackingError if files go to a folder of another machine, which MLflow would make on this one."""
        from mlflow.utils.file_utils import local_file_uri_to_path
        from mlflow.utils.uri import is_local_uri

        served = self._identity.uri.startswith("http")
        if not (served or is_database(self._identity.uri)) or not is_local_uri(self._artifacts):
            return
        location = Path(local_file_uri_to_path(self._artifacts)).parents[1]  # without the run's id and `artifacts`
        if not (location.is_dir() or location.parent.is_dir()):
            remedy = "start the server with --serve-artifacts and " if served else ""
            raise TrackingError(
                f"the experiment keeps its files in {location}, which is not on this machine: create it if they belong "
                f"here, else {remedy}use a new --experiment"
            )

    def store_model(self, folder: Path, model: Model) -> None:
        """Write a model into a run's folder, and store it."""
        write_model(folder / MODEL, model)
        for path in sorted((folder / MODEL).rglob("*")):
            if path.is_file():
                self.upload(path, path.parent.relative_to(folder).as_posix())

    def register(self, model: Model) -> bool:
        """Make a stored model the newest version of its name. The best of all versions gets the alias.

        Returns: whether there is a new version; a champion gets only one.
        Raises: TrackingError with the registry's address if it is not the run's.
        """
        registry = os.environ.get("MLFLOW_REGISTRY_URI") or self._identity.uri
        if registry == self._identity.uri:
            return self._register(model)
        try:
            _check_schema(registry)
            return self._register(model)
        except Exception as error:  # whatever MLflow raises
            raise TrackingError(
                f"the registry {redacted(registry)} (MLFLOW_REGISTRY_URI): {one_line(error, registry)}"
            ) from error

    def _register(self, model: Model) -> bool:
        client = self._client
        found = client.search_model_versions(f"name = '{model.name}' and run_id = '{self.run_id}'")
        new = all(each.tags.get(CHAMPION_TAG) != model.champion_sha256 for each in found)
        if new:
            with _may_exist():
                client.create_registered_model(model.name, description=model.about)
            client.create_model_version(
                model.name,
                f"{self._artifacts.rstrip('/')}/{MODEL}",
                self.run_id,
                tags={CHAMPION_TAG: model.champion_sha256, **model.tags},
                description=model.note,
                await_creation_for=0,
            )
        best = max(
            client.search_model_versions(f"name = '{model.name}'"),
            key=lambda each: (float(each.tags.get("held_out/success_rate", -1.0)), -int(each.version)),
        )
        client.set_registered_model_alias(model.name, BEST, str(best.version))
        return new

    def end(self, status: Status, wall_s: float | None = None, note: str = "") -> None:
        """End the run, now or so many seconds after its start, and replace its description unless a user edited it.

        MLflow's UI shows the time from start to end as the run's duration, and the start cannot be changed: an earlier
        end leaves out the pauses of a run that was stopped and resumed. A run that has ended keeps its end.
        """
        from mlflow.entities import RunTag

        if note:
            text = note.replace(RUN_ID, self.run_id)
            tags = self._client.get_run(self.run_id).data.tags
            old = tags.get(NOTE_TAG, "")
            if old != text and (not old or _note_tags(old)[OWN_NOTE_TAG] == tags.get(OWN_NOTE_TAG)):
                self._client.log_batch(self.run_id, tags=[RunTag(*tag) for tag in _note_tags(text).items()])
        if not (self._has_ended and status == "FINISHED"):
            ended = None if wall_s is None else self._started + round(1000.0 * wall_s)
            self._client.set_terminated(self.run_id, status, ended)


def _note_tags(text: str) -> dict[str, str]:
    """A description, and its digest, by which one that a user has edited is recognised."""
    return {NOTE_TAG: text, OWN_NOTE_TAG: hashlib.sha256(text.encode()).hexdigest()} if text else {}


def preload() -> None:
    """Import what `write_model` needs, which takes three seconds, so that a run's end need not wait for it."""
    with contextlib.suppress(Exception):  # `write_model` raises it again
        import mlflow.pytorch  # noqa: F401
        import torch._dynamo  # noqa: F401  # as torch.export does when it is called


def write_model(folder: Path, model: Model) -> None:
    """Write a torch model as MLflow's: graph and weights (`pt2`), signature and input example.

    A folder that has the same champion is left as it is; any other is replaced as a whole.
    """
    written = folder / "MLmodel"
    if written.is_file() and model.champion_sha256 in written.read_text(encoding="utf-8"):
        return
    import mlflow.pytorch
    import torch
    from mlflow.models import infer_signature

    module, example = model.build()
    built = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(built, ignore_errors=True)
    # In the temporary folder first, with enough room: PyTorch aborts the process if a disk becomes full as it writes.
    with _scratch(ROOM + 3 * sum(each.nbytes for each in module.parameters())) as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch and MLflow cause them themselves
        mlflow.pytorch.save_model(
            module,
            f"{scratch}/model",
            input_example=example,
            signature=infer_signature(example, module(torch.from_numpy(example)).numpy()),
            serialization_format="pt2",
            # If not given, MLflow starts a process and loads the model there to find out.
            pip_requirements=[f"mlflow=={mlflow.__version__}", f"torch=={torch.__version__.partition('+')[0]}"],
            metadata={**model.tags, CHAMPION_TAG: model.champion_sha256},
        )
        shutil.copytree(f"{scratch}/model", built)
    shutil.rmtree(folder, ignore_errors=True)
    built.rename(folder)


@contextlib.contextmanager
def _scratch(room: int) -> Iterator[str]:
    """A folder in the temporary folder, with so many bytes of room. Raises TrackingError if there is less."""
    with contextlib.ExitStack() as stack:
        try:
            scratch = stack.enter_context(tempfile.TemporaryDirectory())
            tried = Path(scratch, "room")
            tried.write_bytes(bytes(room))
            tried.unlink()
        except OSError as error:
            where = f"the temporary folder, {tempfile.gettempdir()}, has no {room / 1e6:.0f} MB left"
            raise TrackingError(f"{where}: {error.strerror or error}; make room, or set TMPDIR") from error
        yield scratch


def _check_schema(uri: str) -> None:
    """Raise TrackingError for a database of another version of MLflow, which would migrate it without asking."""
    from mlflow.store.db import utils

    if is_database(uri):
        engine = utils.create_sqlalchemy_engine(uri)
        try:
            problem = schema_problem(utils._get_schema_version(engine), uri)
        finally:
            engine.dispose()
        if problem:
            raise TrackingError(problem)


def _create_database(path: Path) -> None:
    """Make a new, complete MLflow database appear at `path`, unless another process is first.

    MLflow builds it by 60 migrations in a second. If it is killed in the middle, or two runs start together, what is
    left is a database that it can never open again. So it is built elsewhere, by one process at a time.
    """
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    whole, locked = (path.with_name(f".{path.name}.{end}") for end in (f"{os.getpid()}.tmp", "lock"))
    with open(locked, "wb") as lock, contextlib.ExitStack() as last:
        last.callback(locked.unlink, missing_ok=True)
        last.callback(whole.unlink, missing_ok=True)
        # NFS may not lock. Then several processes build a database, and the first one's stays.
        with contextlib.suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        if path.exists():
            return
        with _scratch(ROOM) as folder:
            built = Path(folder, "mlflow.db")
            # An address as MLflow's own default location: it breaks at some folders' names.
            SqlAlchemyStore(sqlite_uri(built), (path.parent / "mlartifacts").as_uri()).engine.dispose()
            shutil.copyfile(built, whole)
        try:
            os.link(whole, path)
        except OSError:
            if not path.exists():  # on a file system without hard links
                os.rename(whole, path)


@contextlib.contextmanager
def _may_exist() -> Iterator[None]:
    """Ignore the error if what is created exists already: another run may have been first."""
    from mlflow.exceptions import MlflowException

    try:
        yield
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise


def _experiment_id(client: MlflowClient, identity: Identity, database: Path | None) -> str:
    """The experiment of that name, created if need be with its artifacts beside the database, and its saved view."""
    from mlflow.exceptions import MlflowException

    name, location = identity.experiment, None  # a server, or a hosted store, knows best where artifacts go
    if is_database(identity.uri):
        location = ((database.parent if database else Path.cwd()) / "mlartifacts").as_uri()
    if client.get_experiment_by_name(name) is None:
        with _may_exist():
            client.create_experiment(name, artifact_location=location)
    experiment = client.get_experiment_by_name(name)
    if experiment is None or experiment.lifecycle_stage != "active":
        raise TrackingError(f"experiment {name!r} has been deleted; restore it or choose another name")
    if VIEW_TAG not in experiment.tags:  # it may have been changed in the UI
        with contextlib.suppress(MlflowException):  # a server may allow nothing but runs
            client.set_experiment_tag(experiment.experiment_id, VIEW_TAG, view())
    return experiment.experiment_id


def run_tables(uri: str, server: str) -> dict[str, str]:
    """`run_table` of each experiment that has runs in a store, by name."""
    quiet()
    from mlflow.tracking import MlflowClient

    path = sqlite_path(uri)
    if path and not path.exists():
        return {}
    _check_schema(uri)
    client = MlflowClient(tracking_uri=uri)
    found = [each for each in client.search_experiments() if client.search_runs([each.experiment_id], max_results=1)]
    return {each.name: run_table(server, each.experiment_id) for each in found}
