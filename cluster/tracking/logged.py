"""A run as MLflow has it: found or created, and what it lacks of a folder's content. Imports MLflow.

Everything here blocks and may raise whatever MLflow raises; any call can be repeated. Models are written here and never
loaded.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cluster.redaction import one_line, redacted
from cluster.tracking.address import TrackingError, is_database, sqlite_path, unreachable
from cluster.tracking.commit import DIRTY, git_commit
from cluster.tracking.content import Content, Model
from cluster.tracking.database import check_schema, create_database
from cluster.tracking.model import CHAMPION_TAG, MODEL, write_model
from cluster.tracking.view import VIEW_TAG, view

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

Status = Literal["FINISHED", "KILLED", "FAILED"]

KEY_TAG = "gridsim.key"
"""The tag by which a run is found again."""
NOTE_TAG, OWN_NOTE_TAG = "mlflow.note.content", "mlflow.note.gridsim"
"""MLflow's tag for the description, and ours for the digest of the one written here; the UI lists neither."""
BEST = "best"
"""Alias of a registered model's version with the greatest success on held-out roads."""
MAX_BATCH = 1000  # metrics that MLflow takes in one request


@dataclass
class Seen:
    """What MLflow was seen to have of a run."""

    steps: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set))  # of each metric
    files: dict[Path, tuple[int, int]] = field(default_factory=dict)  # size and time of change
    model: str = ""  # digest of the champion whose model's files are stored
    version: str = ""  # digest of the champion that is registered
    note: str | None = None
    status: str = ""

    def missing_rows(self, content: Content) -> dict[tuple[str, int], tuple[float, float]]:
        """Value and wall_s of each (metric, step) that MLflow lacks."""
        return {
            (name, step): (float(value), wall_s)
            for step, metrics, wall_s in content.rows
            for name, value in metrics.items()
            if step not in self.steps[name]
        }

    def missing_files(self, content: Content) -> list[Path]:
        """The files that MLflow lacks, or has as they were before."""
        return [path for path in content.files if self.files.get(path) != _signature(path)]


def _signature(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, found.st_mtime_ns


class LoggedRun:
    """A run in MLflow, found by its id or key, or created; `run_id` and `experiment_id` are MLflow's."""

    def __init__(self, uri: str, experiment: str, key: str, run_id: str, started: float, content: Content):
        """Find or create it. `run_id` is its id in an earlier process, or ""; `started` is in s since the epoch."""
        from mlflow.tracking import MlflowClient

        self.seen = Seen()
        self._uri = uri
        path = sqlite_path(uri)
        if path and not path.exists():
            create_database(path)
        check_schema(uri)
        self._client = MlflowClient(tracking_uri=uri)
        run = self._known(run_id, key) if run_id else None
        self.experiment_id = run.info.experiment_id if run else _experiment_id(self._client, uri, experiment, path)
        # A run that was killed early may not have saved its id.
        with_key = f"tags.`{KEY_TAG}` = '{key}'"
        run = run or next(iter(self._client.search_runs([self.experiment_id], with_key, max_results=1)), None)
        tags = {"git_commit": git_commit(), **content.tags, KEY_TAG: key}
        run = run or self._create(content, tags, started)
        self.run_id: str = run.info.run_id
        self._artifacts: str = run.info.artifact_uri
        self._started_ms: int = run.info.start_time
        self._ended = content.finished and run.info.status == "FINISHED"
        self._complete(run, content, tags)

    def _known(self, run_id: str, key: str) -> Run | None:
        """The run with this id; None if this store has no such run of ours, or it was deleted."""
        from mlflow.exceptions import MlflowException

        try:
            run = self._client.get_run(run_id)
        except MlflowException as error:
            if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
                raise
            return None
        return run if run.data.tags.get(KEY_TAG) == key and run.info.lifecycle_stage == "active" else None

    def _create(self, content: Content, tags: dict[str, str], started: float) -> Run:
        from mlflow.tracking.context.git_context import GitRunContext
        from mlflow.tracking.context.registry import resolve_tags

        # mlflow.user, mlflow.source.*, and the parent of a comparison's run (MLFLOW_RUN_CONTEXT)
        natural = resolve_tags(ignore=[GitRunContext])  # type: ignore[list-item]
        if tags["git_commit"] != "unknown":
            natural["mlflow.source.git.commit"] = tags["git_commit"].removesuffix(DIRTY)  # the bare commit
        return self._client.create_run(self.experiment_id, int(1000.0 * started), {**natural, **tags}, content.name)

    def _complete(self, run: Run, content: Content, tags: dict[str, str]) -> None:
        """Add the parameters and tags that the run lacks, and ask what else it has."""
        from mlflow.entities import Param, RunTag

        data, seen = run.data, self.seen
        params = [Param(name, value) for name, value in content.params.items() if name not in data.params]
        new = {name: value for name, value in tags.items() if name not in data.tags}
        if not content.finished:
            # MLflow does not let parameters change; what is different now (another commit) is added as a tag.
            for wanted, have in ((content.params, data.params), (tags, data.tags)):
                new |= {f"resumed/{name}": value for name, value in wanted.items() if have.get(name, value) != value}
            if run.info.status != "RUNNING":
                self._client.update_run(self.run_id, status="RUNNING")
        if params or new:
            self._client.log_batch(self.run_id, params=params, tags=[RunTag(*tag) for tag in new.items()])
        for name in data.metrics:
            seen.steps[name] = {metric.step for metric in self._client.get_metric_history(self.run_id, name)}
        seen.note = data.tags.get(NOTE_TAG)
        if self._ended:
            seen.status = "FINISHED"
            sizes = {each.path: each.file_size for each in self._client.list_artifacts(self.run_id)}
            seen.files = {
                each: _signature(each) for each in content.files if sizes.get(each.name) == _signature(each)[0]
            }

    def send_rows(self, content: Content) -> int:
        """Log what MLflow lacks. A repeated request is the same, which MLflow recognises. Returns: how many rows."""
        from mlflow.entities import Metric

        metrics = [
            Metric(name, value, self._started_ms + round(1000.0 * wall_s), step)
            for (name, step), (value, wall_s) in self.seen.missing_rows(content).items()
        ]
        for k in range(0, len(metrics), MAX_BATCH):
            batch = metrics[k : k + MAX_BATCH]
            self._client.log_batch(self.run_id, metrics=batch)
            for metric in batch:
                self.seen.steps[metric.key].add(metric.step)
        return len({metric.step for metric in metrics})

    def send_file(self, path: Path) -> None:
        """Store a file among the artifacts."""
        signature = _signature(path)
        self._upload(path)
        self.seen.files[path] = signature

    def _upload(self, path: Path, folder: str | None = None) -> None:
        """Store a file; one by one, as MLflow's own pool of threads would hold up the exit if a server hangs.

        Raises: TrackingError, which names the folder, if files are kept in one that is not there or cannot be written.
        """
        self._check_artifacts()
        try:
            self._client.log_artifact(self.run_id, str(path), folder)
        except OSError as error:
            if not error.filename:  # of a server
                raise
            raise TrackingError(f"{error.filename2 or error.filename}: {error.strerror}") from error

    def _check_artifacts(self) -> None:
        """Raise TrackingError if files go to a folder of another machine, which MLflow would make on this one."""
        from mlflow.utils.file_utils import local_file_uri_to_path
        from mlflow.utils.uri import is_local_uri

        served = self._uri.startswith("http")
        if not (served or is_database(self._uri)) or not is_local_uri(self._artifacts):
            return
        location = Path(local_file_uri_to_path(self._artifacts)).parents[1]  # without the run's id and `artifacts`
        if not (location.is_dir() or location.parent.is_dir()):
            remedy = "start the server with --serve-artifacts and " if served else ""
            raise TrackingError(
                f"the experiment keeps its files in {location}, which is not on this machine: create it if they belong "
                f"here, else {remedy}use a new --experiment"
            )

    def send_model(self, model: Model) -> bool:
        """Store a champion's model and make it the newest version of its name; the best of all gets the alias.

        Returns: whether there is a new version; a champion gets only one.
        Raises: TrackingError with the registry's address if it is not the run's.
        """
        if self._ended and self._is_registered(model):
            self.seen.model = model.champion_sha256
        if self.seen.model != model.champion_sha256:
            with tempfile.TemporaryDirectory(prefix="gridsim-") as folder:
                write_model(Path(folder), model)
                for path in sorted(Path(folder).iterdir()):
                    self._upload(path, MODEL)
            self.seen.model = model.champion_sha256
        with _registry_named(self._uri):
            new = self._register(model)
        self.seen.version = model.champion_sha256
        return new

    def _is_registered(self, model: Model) -> bool:
        query = f"name = '{model.name}' and run_id = '{self.run_id}'"
        with _registry_named(self._uri):
            found = self._client.search_model_versions(query)
        return any(each.tags.get(CHAMPION_TAG) == model.champion_sha256 for each in found)

    def _register(self, model: Model) -> bool:
        client, new = self._client, not self._is_registered(model)
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

    def send_note(self, note: str) -> None:
        """Replace the description, unless a user has edited it."""
        from mlflow.entities import RunTag

        note = note.replace("{run_id}", self.run_id)
        if note == self.seen.note:
            return
        tags = self._client.get_run(self.run_id).data.tags
        old = tags.get(NOTE_TAG, "")
        if old != note and (not old or _digest(old) == tags.get(OWN_NOTE_TAG)):
            both = [RunTag(NOTE_TAG, note), RunTag(OWN_NOTE_TAG, _digest(note))]
            self._client.log_batch(self.run_id, tags=both)
        self.seen.note = note

    def end(self, status: Status, wall_s: float) -> None:
        """End the run `wall_s` after its start: MLflow's UI shows this time as the duration, and knows no pauses."""
        if self.seen.status != status:
            self._client.set_terminated(self.run_id, status, self._started_ms + round(1000.0 * wall_s))
            self.seen.status = status


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@contextlib.contextmanager
def _registry_named(uri: str) -> Iterator[None]:
    """Name the registry in errors, if it is not the tracking address."""
    registry = os.environ.get("MLFLOW_REGISTRY_URI") or uri
    try:
        if registry != uri:
            if problem := unreachable(registry):
                raise TrackingError(problem)
            check_schema(registry)
        yield
    except Exception as error:  # whatever MLflow raises
        if registry == uri:
            raise
        where = f"the registry {redacted(registry)} (MLFLOW_REGISTRY_URI)"
        raise TrackingError(f"{where}: {one_line(error, registry)}") from error


@contextlib.contextmanager
def _may_exist() -> Iterator[None]:
    """Ignore the error if what is created exists already: another run may have been first."""
    from mlflow.exceptions import MlflowException

    try:
        yield
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise


def _experiment_id(client: MlflowClient, uri: str, name: str, database: Path | None) -> str:
    """The experiment of that name, created if need be with its artifacts beside the database, and its saved view."""
    from mlflow.exceptions import MlflowException

    location = None  # a server, or a hosted store, knows best where artifacts go
    if is_database(uri):
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
