"""A folder's run in MLflow: it is found or created, and is sent what it lacks of the folder's content. Imports MLflow.

Calls block as long as MLflow does, and can be repeated. `LoggedRun.send` returns what MLflow raises as a text. A
`LoggedRun` remembers only what MLflow was seen to have. Models are written here and never loaded.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import time
import uuid
from collections import Counter, defaultdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cluster.redaction import one_line, redacted
from cluster.store.checkpoint import MLFLOW, write_json
from cluster.text import count
from cluster.tracking.address import VIEW, TrackingError, is_database, sqlite_path, unreachable
from cluster.tracking.commit import git_commit
from cluster.tracking.content import CHAMPION_TAG, Content, Model
from cluster.tracking.database import check_schema, create_database

if TYPE_CHECKING:
    from mlflow.entities import Run

Status = Literal["FINISHED", "KILLED", "FAILED"]

KEY_TAG = "gridsim.key"  # tag with the key (in mlflow.json) by which a folder's run is found again
NOTE_TAG = "mlflow.note.content"  # MLflow's tag for the description
VIEW_TAG = f"mlflow.sharedViewState.{VIEW}"  # MLflow's tag of an experiment for a saved view
# What the view's run table shows of each run, and the columns' widths in pixels.
COLUMNS = {
    "attributes.`Run Name`": 270, "metrics.`held_out/success_rate`": 165, "metrics.`validation/success_rate`": 175,
    "metrics.`held_out/speed_mps`": 150, "metrics.`car_steps`": 90,
}  # fmt: skip
MODEL = "model"  # folder of the champion among a run's artifacts
BEST = "best"  # alias of a registered model's version with the greatest success on held-out roads
MAX_BATCH = 1000  # metrics that MLflow takes in one request
LINK = {"uri": str, "experiment": str, "key": str, "run_id": str, "started": float}  # what mlflow.json holds


class LoggedRun:
    """The run in MLflow that belongs to a folder; `run_id` and `experiment_id` are "" until it is found or created.

    `sent` counts the rows, files and models that were sent.
    """

    def __init__(self, folder: Path, uri: str, experiment: str):
        self.run_id = self.experiment_id = ""
        self.sent = Counter(row=0, file=0, model=0)
        self._folder, self._uri, self._experiment = folder, uri, experiment
        # What MLflow was seen to have: the steps of each metric, artifacts, the champion's version, and the status.
        self._steps: defaultdict[str, set[int]] = defaultdict(set)
        self._artifacts: set[str] = set()
        self._registered, self._status = False, ""

    def lacking(self, content: Content, status: Status | None) -> list[str]:
        """What MLflow was not seen to have, in words; only rows while the run goes on (`status` is None)."""
        rows = len({step for _, step in self._missing_rows(content)})
        words = [count(rows, "row")] if rows else []
        if status is None:
            return words
        if files := sum(path.name not in self._artifacts for path in content.files):
            words.append(count(files, "file"))
        words += ["the model"] if content.model and not self._registered else []
        return words + ([f"the status {status}"] if status != self._status else [])

    def send(self, content: Content, status: Status | None) -> str | None:
        """Send what MLflow lacks: rows; with a status also files, model and the run's end.

        If one of these fails, the next is tried, unless the server no longer answers.

        Returns: the last failure in one line, or None.
        """
        error = None
        try:
            link = {} if self.run_id else self._identify(content)
            if problem := unreachable(self._uri):  # asked first, because MLflow itself would wait for longer
                return problem
            if link:
                self._open(content, link)
        except Exception as failure:  # whatever MLflow raises, the run goes on
            return one_line(failure, self._uri)
        at_the_end = (self._send_files, self._send_model, self._end) if status else ()
        for part in (self._send_rows, *at_the_end):
            try:
                part(content, status)
            except Exception as failure:
                if problem := unreachable(self._uri):
                    return problem
                error = one_line(failure, self._uri)
        return error

    def _identify(self, content: Content) -> dict[str, Any]:
        """Write mlflow.json and return its content; its key finds the run again after a kill or a missing server."""
        link = read_link(self._folder)
        if link.get("uri") != redacted(self._uri):
            experiment = self._experiment or os.environ.get("MLFLOW_EXPERIMENT_NAME") or "gridsim"
            link |= {"uri": redacted(self._uri), "experiment": experiment, "run_id": ""}
        link.setdefault("key", uuid.uuid4().hex)
        link.setdefault("started", time.time() - content.wall_s)
        _write_link(self._folder, link)
        return link

    def _open(self, content: Content, link: dict[str, Any]) -> None:
        """Find the run by its key or create it, add parameters and tags that it lacks, and ask MLflow what else it has.

        The run is looked for in the experiment of `link`, where it was begun, and in the one that is asked for. If
        neither has it, it is created in the latter, or in the former if none is asked for. An unfinished run gets the
        status RUNNING.
        """
        from mlflow.entities import Param, RunTag
        from mlflow.tracking import MlflowClient

        path, name, key = sqlite_path(self._uri), self._experiment or link["experiment"], link["key"]
        if path and not path.exists():
            create_database(path)
        check_schema(self._uri)
        self._client = client = MlflowClient(tracking_uri=self._uri)
        experiments = map(client.get_experiment_by_name, {name, link["experiment"]})
        ids = [each.experiment_id for each in experiments if each and each.lifecycle_stage == "active"]
        found = client.search_runs(ids, f"tags.`{KEY_TAG}` = '{key}'", max_results=1) if ids else []
        if not found:
            found, link["experiment"] = [self._create(content.name, name, link)], name
        info, data = found[0].info, found[0].data
        _write_link(self._folder, link | {"run_id": info.run_id})

        tags = {"git_commit": git_commit(), **content.tags}
        new = {name: value for name, value in {NOTE_TAG: content.note, **tags}.items() if name not in data.tags}
        if not content.finished:
            # MLflow does not let parameters change: what a resumed run changes (such as the commit) becomes a new tag.
            for wanted, have in ((content.params, data.params), (tags, data.tags)):
                new |= {f"resumed/{name}": value for name, value in wanted.items() if have.get(name, value) != value}
            client.update_run(info.run_id, status="RUNNING")
        params = [Param(name, value) for name, value in content.params.items() if name not in data.params]
        client.log_batch(info.run_id, params=params, tags=[RunTag(*tag) for tag in new.items()])
        for name in data.metrics:
            self._steps[name] = {metric.step for metric in client.get_metric_history(info.run_id, name)}
        if content.finished and info.status == "FINISHED" and not self._missing_rows(content):  # rows and end are there
            self._status = "FINISHED"
            stored = [*client.list_artifacts(info.run_id), *client.list_artifacts(info.run_id, MODEL)]
            sizes = {path.name: path.stat().st_size for path in content.files}
            self._artifacts = {each.path for each in stored if sizes.get(each.path, each.file_size) == each.file_size}
        self._location: str = info.artifact_uri
        self._started_ms: int = info.start_time
        self.run_id, self.experiment_id = info.run_id, info.experiment_id

    def _create(self, name: str, experiment_name: str, link: dict[str, Any]) -> Run:
        """Create a run, and its experiment if there is none. An experiment without the saved view gets it.

        In a database, a new experiment keeps its runs' files in `mlartifacts`, beside a SQLite file or else in the
        working directory.
        """
        from mlflow.exceptions import MlflowException
        from mlflow.tracking.context.git_context import GitRunContext
        from mlflow.tracking.context.registry import resolve_tags

        client, location = self._client, None  # a server, or a hosted store, knows best where artifacts go
        if is_database(self._uri):
            location = ((sqlite_path(self._uri) or Path("x").absolute()).parent / "mlartifacts").as_uri()
        if client.get_experiment_by_name(experiment_name) is None:
            with contextlib.suppress(MlflowException):  # another run may be first
                client.create_experiment(experiment_name, location)
        experiment = client.get_experiment_by_name(experiment_name)
        if experiment is None or experiment.lifecycle_stage != "active":
            problem = "has been deleted; restore it" if experiment else "cannot be created; create it"
            raise TrackingError(f"experiment {experiment_name!r} {problem} or choose another name")
        if VIEW_TAG not in experiment.tags:  # one that is there may be the user's own, changed in the UI
            with contextlib.suppress(MlflowException):  # a server may allow nothing but runs
                client.set_experiment_tag(experiment.experiment_id, VIEW_TAG, _view())
        # MLflow's own tags: mlflow.user, mlflow.source.*, and the parent of a comparison's run (MLFLOW_RUN_CONTEXT).
        natural = resolve_tags(ignore=[GitRunContext])  # type: ignore[list-item]
        tags = {**natural, KEY_TAG: link["key"]}
        return client.create_run(experiment.experiment_id, int(1000.0 * link["started"]), tags, name)

    def _missing_rows(self, content: Content) -> dict[tuple[str, int], tuple[float, float]]:
        """Value and wall_s of each (metric, step) that MLflow was not seen to have."""
        return {
            (name, step): (float(value), wall_s)
            for step, metrics, wall_s in content.rows
            for name, value in metrics.items()
            if step not in self._steps[name]
        }

    def _send_rows(self, content: Content, status: Status | None) -> None:
        """Send missing rows. A row's time is the run's start + wall_s: MLflow recognises a row that is sent again."""
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

    def _send_files(self, content: Content, status: Status | None) -> None:
        for path in content.files:
            if path.name not in self._artifacts:
                self._upload(path)
                self.sent["file"] += 1

    def _upload(self, path: Path, folder: str | None = None) -> None:
        """Store one file as an artifact. For several, MLflow uses threads, which delay the exit if a server hangs.

        Raises TrackingError, which names the folder, if artifacts are kept in one that is missing or cannot be written.
        """
        from mlflow.utils.file_utils import local_file_uri_to_path
        from mlflow.utils.uri import is_local_uri

        served = self._uri.startswith("http")
        if (served or is_database(self._uri)) and is_local_uri(self._location):
            place = Path(local_file_uri_to_path(self._location)).parents[1]  # the experiment's folder
            if not (place.is_dir() or place.parent.is_dir()):  # MLflow would make both, on the wrong machine
                remedy = "start the server with --serve-artifacts and " if served else ""
                raise TrackingError(
                    f"the experiment keeps its files in {place}, which is not on this machine: create it if they "
                    f"belong here, else {remedy}use a new --experiment"
                )
        try:
            self._client.log_artifact(self.run_id, str(path), folder)
        except OSError as error:
            if not error.filename:  # a server's error, not one of a file here
                raise
            raise TrackingError(f"{error.filename2 or error.filename}: {error.strerror}") from error
        self._artifacts.add(f"{folder}/{path.name}" if folder else path.name)

    def _send_model(self, content: Content, status: Status | None) -> None:
        """Store the champion's model and register it; a champion gets one version."""
        model = content.model
        if model is None or self._registered:
            return
        if f"{MODEL}/MLmodel" not in self._artifacts:
            with tempfile.TemporaryDirectory(prefix="gridsim-") as folder:
                _write_model(Path(folder, MODEL), model)
                for path in sorted(Path(folder, MODEL).iterdir(), key=lambda path: (path.name == "MLmodel", path)):
                    self._upload(path, MODEL)
        registry = os.environ.get("MLFLOW_REGISTRY_URI") or self._uri
        try:
            if problem := unreachable(registry):
                raise TrackingError(problem)
            check_schema(registry)
            self._register(model)
        except Exception as error:  # whatever MLflow raises
            if registry == self._uri:
                raise
            where = f"the registry {redacted(registry)} (MLFLOW_REGISTRY_URI)"
            raise TrackingError(f"{where}: {one_line(error, registry)}") from error
        self._registered = True

    def _register(self, model: Model) -> None:
        """Register the stored model as a new version, unless this run has registered this champion already.

        The best version gets the alias BEST.
        """
        from mlflow.exceptions import MlflowException

        client, source = self._client, f"{self._location.rstrip('/')}/{MODEL}"
        own = client.search_model_versions(f"name = '{model.name}' and run_id = '{self.run_id}'")
        if all(each.tags.get(CHAMPION_TAG) != model.tags[CHAMPION_TAG] for each in own):
            with contextlib.suppress(MlflowException):  # raised if the name exists already
                client.create_registered_model(model.name, description=model.about)
            tags = dict(model.tags)
            client.create_model_version(model.name, source, self.run_id, tags, None, model.note, await_creation_for=0)
            self.sent["model"] += 1
        best = max(
            client.search_model_versions(f"name = '{model.name}'"),
            key=lambda each: (float(each.tags.get("held_out/success_rate", -1.0)), -int(each.version)),
        )
        client.set_registered_model_alias(model.name, BEST, str(best.version))

    def _end(self, content: Content, status: Status | None) -> None:
        """Add the result to the description, which a user may have edited, and end the run `wall_s` after its start.

        Does nothing if MLflow was seen to have this status. MLflow's UI shows the time from start to end as the
        duration, so a training run's `wall_s` leaves out pauses.
        """
        if status == self._status:
            return
        note, result = self._client.get_run(self.run_id).data.tags.get(NOTE_TAG, ""), content.result
        result = result.replace("{run_id}", self.run_id)
        if result not in note:
            self._client.set_tag(self.run_id, NOTE_TAG, f"{note}\n\n{result}")
        self._client.set_terminated(self.run_id, status, self._started_ms + round(1000.0 * content.wall_s))
        self._status = status or ""


def _write_model(folder: Path, model: Model) -> None:
    """Write a champion as files of MLflow's flavour `onnx` into a new folder."""
    import onnx
    from mlflow.models import ModelSignature
    from mlflow.onnx import save_model
    from mlflow.types.schema import Schema, TensorSpec

    inputs = Schema([TensorSpec(array.dtype, (-1, *array.shape[1:]), name) for name, array in model.example.items()])
    network = onnx.load(model.onnx)
    outputs = Schema([
        TensorSpec(
            onnx.helper.tensor_dtype_to_np_dtype(each.type.tensor_type.elem_type),
            (-1, *(axis.dim_value for axis in each.type.tensor_type.shape.dim[1:])),
            each.name,
        )
        for each in network.graph.output
    ])  # fmt: skip
    save_model(
        network,
        str(folder),
        signature=ModelSignature(inputs, outputs),
        input_example=dict(model.example),
        metadata=dict(model.tags),
        pip_requirements=[f"{name}=={version(name)}" for name in ("mlflow", "onnx", "onnxruntime")],
        onnx_execution_providers=["CPUExecutionProvider"],
        save_as_external_data=False,
    )


def _view() -> str:
    """The saved view as MLflow's UI writes it: the run table's columns, and curves over car-steps."""
    axis = {"xAxisKey": "metric", "selectedXAxisMetricKey": "car_steps", "lineSmoothness": 0}
    state = {"selectedColumns": list(COLUMNS), "columnOrder": list(COLUMNS), "columnWidths": COLUMNS}
    state["globalLineChartConfig"] = axis
    return json.dumps({"name": "GridSim", "createdAt": int(1000.0 * time.time()), "state": json.dumps(state)})


def read_link(folder: Path) -> dict[str, Any]:
    """What mlflow.json holds; an empty dictionary if it is missing or incomplete."""
    try:
        link = json.loads((folder / MLFLOW).read_bytes())
        return {name: kind(link[name]) for name, kind in LINK.items()}
    except (OSError, ValueError, LookupError, TypeError):
        return {}


def _write_link(folder: Path, link: dict[str, Any]) -> None:
    write_json(folder / MLFLOW, link)
