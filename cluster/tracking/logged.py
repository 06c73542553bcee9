"""A folder's run in MLflow: found or created, and sent what it lacks of the folder's content. Imports MLflow.

Everything here blocks and may raise whatever MLflow raises; any call can be repeated. What an object holds is only what
MLflow was seen to have. Models are written here and never loaded.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
import time
import uuid
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cluster.redaction import one_line, redacted
from cluster.store.checkpoint import MLFLOW, write_atomic
from cluster.text import count
from cluster.tracking.address import TrackingError, is_database, sqlite_path, unreachable
from cluster.tracking.commit import DIRTY, git_commit
from cluster.tracking.content import Content, Model
from cluster.tracking.database import check_schema, create_database
from cluster.tracking.model import CHAMPION_TAG, write_model
from cluster.tracking.view import VIEW_TAG, view

if TYPE_CHECKING:
    from mlflow.entities import Run

Status = Literal["FINISHED", "KILLED", "FAILED"]

KEY_TAG = "gridsim.key"  # by which a run is found again
NOTE_TAG, OWN_NOTE_TAG = "mlflow.note.content", "mlflow.note.gridsim"
"""MLflow's tag for the description, and ours for the digest of the one written here; the UI lists neither."""
MODEL = "model"  # folder of the champion among a run's artifacts
BEST = "best"  # alias of a registered model's version with the greatest success on held-out roads
MAX_BATCH = 1000  # metrics that MLflow takes in one request


class LoggedRun:
    """The run in MLflow that belongs to a folder; `run_id` and `experiment_id` are MLflow's, "" until it is found.

    `sent` counts the rows, files and models that were sent.
    """

    def __init__(self, folder: Path, uri: str, experiment: str):
        self.run_id = self.experiment_id = ""
        self.sent = Counter(row=0, file=0, model=0)
        self._folder, self._uri, self._experiment = folder, uri, experiment
        # What MLflow was seen to have: the steps of each metric, files with their signatures, the champions whose
        # models are stored and registered, the description, and the status.
        self._steps: defaultdict[str, set[int]] = defaultdict(set)
        self._files: dict[Path, tuple[int, int]] = {}
        self._stored = self._registered = self._note = self._status = ""

    def lacking(self, content: Content, status: Status | None) -> list[str]:
        """What MLflow was not seen to have, in words; `status` is None while the run goes on."""
        steps = sorted({step for _, step in self._missing_rows(content)})
        span = f"{steps[0]} to {steps[-1]}" if len(steps) > 1 else f"{steps[0]}" if steps else ""
        words = [f"{count(len(steps), 'row')} (step {span})"] if steps else []
        if files := self._missing_files(content):
            words.append(count(len(files), "file"))
        if content.model and self._registered != content.model.champion_sha256:
            stored = self._stored == content.model.champion_sha256
            words.append("the registration of the model, whose files are stored" if stored else "the model")
        return words + ([f"the status {status}"] if status not in (None, self._status) else [])

    def send(self, content: Content, status: Status | None) -> str | None:
        """Send what MLflow lacks; what fails does not hold up the rest. Returns: the last failure, in one line."""
        error = None
        try:
            link = {} if self.run_id else self._identify(content)
            self._check_reachable()
            if link:
                self._open(content, link)
            for part in (self._send_rows, self._send_files, self._send_model, self._end):
                try:
                    part(content, status)
                except Exception as failure:
                    error = one_line(failure, self._uri)
                    self._check_reachable()
        except Exception as failure:  # whatever MLflow raises, the run goes on
            error = one_line(failure, self._uri)
        return error

    def _check_reachable(self) -> None:
        """Raise TrackingError within seconds for a dead server, for which MLflow would wait longer."""
        if problem := unreachable(self._uri):
            raise TrackingError(problem)

    def _identify(self, content: Content) -> dict[str, Any]:
        """Write and return mlflow.json, by which a run is found again that was killed, or had no server."""
        link = read_link(self._folder)
        if link.get("uri") != redacted(self._uri):
            link |= {"uri": redacted(self._uri), "experiment": self._experiment or usual_experiment(), "run_id": ""}
        link.setdefault("key", uuid.uuid4().hex)
        link.setdefault("started", time.time() - content.wall_s)
        _write_link(self._folder, link)
        return link

    def _open(self, content: Content, link: dict[str, Any]) -> None:
        """Find the run or create it, and ask what MLflow has of it."""
        from mlflow.tracking import MlflowClient

        uri = self._uri
        path, name = sqlite_path(uri), self._experiment or link["experiment"]
        if path and not path.exists():
            create_database(path)
        check_schema(uri)
        self._client = client = MlflowClient(tracking_uri=uri)
        tags = {"git_commit": git_commit(), **content.tags, KEY_TAG: link["key"]}
        run = self._known(link) if link["run_id"] else None
        experiment = run.info.experiment_id if run else self._find_experiment(name, path)
        if run is None:  # a run that was killed early may not have saved its id
            found = client.search_runs([experiment], f"tags.`{KEY_TAG}` = '{link['key']}'", max_results=1)
            run = found[0] if found else self._create(experiment, content.name, tags, link["started"])
            link["experiment"] = name
        _write_link(self._folder, link | {"run_id": run.info.run_id})
        self._artifacts: str = run.info.artifact_uri
        self._started_ms: int = run.info.start_time
        self._complete(run, content, tags)
        self.run_id, self.experiment_id = run.info.run_id, experiment

    def _known(self, link: dict[str, Any]) -> Run | None:
        """The run that mlflow.json names; None if this store has no such run of ours, or it was deleted."""
        from mlflow.exceptions import MlflowException

        try:
            run = self._client.get_run(link["run_id"])
        except MlflowException as error:
            if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
                raise
            return None
        return run if run.data.tags.get(KEY_TAG) == link["key"] and run.info.lifecycle_stage == "active" else None

    def _create(self, experiment: str, name: str, tags: dict[str, str], started: float) -> Run:
        from mlflow.tracking.context.git_context import GitRunContext
        from mlflow.tracking.context.registry import resolve_tags

        # mlflow.user, mlflow.source.*, and the parent of a comparison's run (MLFLOW_RUN_CONTEXT)
        natural = resolve_tags(ignore=[GitRunContext])  # type: ignore[list-item]
        if tags["git_commit"] != "unknown":
            natural["mlflow.source.git.commit"] = tags["git_commit"].removesuffix(DIRTY)  # the bare commit
        return self._client.create_run(experiment, int(1000.0 * started), {**natural, **tags}, name)

    def _complete(self, run: Run, content: Content, tags: dict[str, str]) -> None:
        """Add the parameters and tags that the run lacks, and ask what else it has."""
        from mlflow.entities import Param, RunTag

        run_id, data = run.info.run_id, run.data
        params = [Param(name, value) for name, value in content.params.items() if name not in data.params]
        new = {name: value for name, value in tags.items() if name not in data.tags}
        if not content.finished:
            # MLflow does not let parameters change; what is different now (another commit) is added as a tag.
            for wanted, have in ((content.params, data.params), (tags, data.tags)):
                new |= {f"resumed/{name}": value for name, value in wanted.items() if have.get(name, value) != value}
            self._client.update_run(run_id, status="RUNNING")
        self._client.log_batch(run_id, params=params, tags=[RunTag(*tag) for tag in new.items()])
        for name in data.metrics:
            self._steps[name] = {metric.step for metric in self._client.get_metric_history(run_id, name)}
        self._note = data.tags.get(NOTE_TAG, "")
        if content.finished and run.info.status == "FINISHED":  # what MLflow has of it stays as it is
            self._status = "FINISHED"
            sizes = {each.path: each.file_size for each in self._client.list_artifacts(run_id)}
            self._files = {path: _signature(path) for path in content.files if sizes.get(path.name) == _size(path)}
            models = [each.path for each in self._client.list_artifacts(run_id, MODEL)]
            if content.model and f"{MODEL}/MLmodel" in models:
                self._stored = content.model.champion_sha256

    def _find_experiment(self, name: str, database: Path | None) -> str:
        """Id of an experiment, created if need be with its artifacts beside the database, and its saved view."""
        from mlflow.exceptions import MlflowException

        client, location = self._client, None  # a server, or a hosted store, knows best where artifacts go
        if is_database(self._uri):
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

    def _missing_rows(self, content: Content) -> dict[tuple[str, int], tuple[float, float]]:
        """Value and wall_s of each (metric, step)."""
        return {
            (name, step): (float(value), wall_s)
            for step, metrics, wall_s in content.rows
            for name, value in metrics.items()
            if step not in self._steps[name]
        }

    def _send_rows(self, content: Content, status: Status | None) -> None:
        """Times follow from the start, so a repeated request is the same one, which MLflow recognises."""
        from mlflow.entities import Metric

        metrics = [
            Metric(name, value, self._started_ms + round(1000.0 * wall_s), step)
            for (name, step), (value, wall_s) in self._missing_rows(content).items()
        ]
        for k in range(0, len(metrics), MAX_BATCH):
            batch = metrics[k : k + MAX_BATCH]
            self._client.log_batch(self.run_id, metrics=batch)
            for metric in batch:
                self._steps[metric.key].add(metric.step)
        self.sent["row"] += len({metric.step for metric in metrics})

    def _missing_files(self, content: Content) -> list[Path]:
        return [path for path in content.files if self._files.get(path) != _signature(path)]

    def _send_files(self, content: Content, status: Status | None) -> None:
        for path in self._missing_files(content):
            signature = _signature(path)
            self._upload(path)
            self._files[path] = signature
            self.sent["file"] += 1

    def _upload(self, path: Path, folder: str | None = None) -> None:
        """Store a file; one by one, as MLflow's own pool of threads would hold up the exit if a server hangs.

        Raises TrackingError, which names the folder, if it is kept in one that is not there or cannot be written.
        """
        from mlflow.utils.file_utils import local_file_uri_to_path
        from mlflow.utils.uri import is_local_uri

        served = self._uri.startswith("http")
        if (served or is_database(self._uri)) and is_local_uri(self._artifacts):
            place = Path(local_file_uri_to_path(self._artifacts)).parents[1]  # without the run's id and `artifacts`
            if not (place.is_dir() or place.parent.is_dir()):  # MLflow would make it, on the wrong machine
                remedy = "start the server with --serve-artifacts and " if served else ""
                raise TrackingError(
                    f"the experiment keeps its files in {place}, which is not on this machine: create it if they "
                    f"belong here, else {remedy}use a new --experiment"
                )
        try:
            self._client.log_artifact(self.run_id, str(path), folder)
        except OSError as error:
            if not error.filename:  # of a server
                raise
            raise TrackingError(f"{error.filename2 or error.filename}: {error.strerror}") from error

    def _send_model(self, content: Content, status: Status | None) -> None:
        """Store the champion's model and register it; a champion gets one version."""
        model = content.model
        if model is None or self._registered == model.champion_sha256:
            return
        if self._stored != model.champion_sha256:
            with tempfile.TemporaryDirectory(prefix="gridsim-") as folder:
                for path in write_model(Path(folder), model):
                    self._upload(path, MODEL)
            self._stored = model.champion_sha256
        with self._registry_named():
            self.sent["model"] += self._register(model)
        self._registered = model.champion_sha256

    def _register(self, model: Model) -> bool:
        """Make the stored model the newest version of its name, unless it is one; the best of all gets the alias.

        Returns: whether there is a new version.
        """
        client, source = self._client, f"{self._artifacts.rstrip('/')}/{MODEL}"
        own = client.search_model_versions(f"name = '{model.name}' and run_id = '{self.run_id}'")
        new = all(each.tags.get(CHAMPION_TAG) != model.champion_sha256 for each in own)
        if new:
            with _may_exist():
                client.create_registered_model(model.name, description=model.about)
            tags = {CHAMPION_TAG: model.champion_sha256, **model.tags}
            client.create_model_version(
                model.name, source, self.run_id, tags, description=model.note, await_creation_for=0
            )
        best = max(
            client.search_model_versions(f"name = '{model.name}'"),
            key=lambda each: (float(each.tags.get("held_out/success_rate", -1.0)), -int(each.version)),
        )
        client.set_registered_model_alias(model.name, BEST, str(best.version))
        return new

    @contextlib.contextmanager
    def _registry_named(self) -> Iterator[None]:
        """Name the registry in errors, if it is not the tracking address."""
        registry = os.environ.get("MLFLOW_REGISTRY_URI") or self._uri
        if registry == self._uri:
            yield
            return
        try:
            if problem := unreachable(registry):
                raise TrackingError(problem)
            check_schema(registry)
            yield
        except Exception as error:  # whatever MLflow raises
            where = f"the registry {redacted(registry)} (MLFLOW_REGISTRY_URI)"
            raise TrackingError(f"{where}: {one_line(error, registry)}") from error

    def _end(self, content: Content, status: Status | None) -> None:
        """Replace the description, unless a user has edited it, and end the run `wall_s` after its start.

        MLflow's UI shows this time as the run's duration, and knows no pauses.
        """
        from mlflow.entities import RunTag

        note = content.note.replace("{run_id}", self.run_id)
        if note != self._note:
            tags = self._client.get_run(self.run_id).data.tags
            old = tags.get(NOTE_TAG, "")
            if old != note and (not old or _digest(old) == tags.get(OWN_NOTE_TAG)):
                both = [RunTag(NOTE_TAG, note), RunTag(OWN_NOTE_TAG, _digest(note))]
                self._client.log_batch(self.run_id, tags=both)
            self._note = note
        if status and status != self._status:
            self._client.set_terminated(self.run_id, status, self._started_ms + round(1000.0 * content.wall_s))
            self._status = status


def usual_experiment() -> str:
    """The experiment of runs that are not given another."""
    return os.environ.get("MLFLOW_EXPERIMENT_NAME") or "gridsim"


def read_link(folder: Path) -> dict[str, Any]:
    """What mlflow.json holds: uri, experiment, key, run_id, started; empty without a whole one."""
    try:
        link = json.loads((folder / MLFLOW).read_bytes())
        texts = {type(link[name]) for name in ("uri", "experiment", "key", "run_id")}
        return link if texts == {str} and isinstance(link["started"], float) else {}
    except (OSError, ValueError, LookupError, TypeError):
        return {}


def _write_link(folder: Path, link: dict[str, Any]) -> None:
    write_atomic(folder / MLFLOW, (json.dumps(link, indent=2) + "\n").encode(), durable=False)


def _size(path: Path) -> int:
    return path.stat().st_size


def _signature(path: Path) -> tuple[int, int]:
    """Size and time of change."""
    return _size(path), path.stat().st_mtime_ns


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@contextlib.contextmanager
def _may_exist() -> Iterator[None]:
    """Ignore the error if what is created exists already: another run may have been first."""
    from mlflow.exceptions import MlflowException

    try:
        yield
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
