"""What MLflow lacks of a finished run, sent when MLflow is there again: rows, files, the model, how the run ended.

A run does not wait for a tracking server that is away, and ends without it. Everything that MLflow would have got is in
the run's folder: the checkpoint holds the history. What MLflow has already is not touched, so that this may be done at
any time and any number of times, and also with another server, which then gets all of it.
"""

from __future__ import annotations

import time

from cluster.comparison.results import ExperimentError, part, read_json
from cluster.runs.champion import load_champion
from cluster.runs.checkpoint import CheckpointError
from cluster.runs.run import CHAMPION, NOT_LOGGED, SUMMARY, RunFolder, make_tracker, write_summary
from cluster.tracking import description
from cluster.tracking.address import TrackingError, check_uri

WAIT_S = 60.0  # for MLflow to be there, and then for it to have everything
NOTHING = "nothing to do"


def send(run: RunFolder, uri: str, experiment: str) -> tuple[str, str | None]:
    """Send what MLflow lacks of a finished run, as far as that can be: whatever happens, the run is no less finished.

    Args: the run, opened (`run.open_run`); the tracking address, or "" for the one that the run has; the experiment.
    Returns: what was sent, in a few words, and a line about what could not be, or None.
    """
    try:
        return _send(run, uri, experiment)
    except (CheckpointError, ExperimentError, TrackingError) as error:
        return NOTHING, f"what MLflow lacks is not sent: {error}"
    except (OSError, LookupError, TypeError, ValueError, StopIteration) as error:  # edited
        reason = f"{run.path} has not the files of a finished run ({type(error).__name__})"
        return NOTHING, f"what MLflow lacks is not sent: {reason}"


def _send(run: RunFolder, uri: str, experiment: str) -> tuple[str, str | None]:
    assert run.saved is not None
    arrays, meta = run.saved
    uri = check_uri(uri or meta["tracking"]["uri"] or None)
    path = run.path / SUMMARY
    summary = read_json(path)
    held_out = part(summary, "held_out", path)
    model = description.torch_model(load_champion(run.path / CHAMPION), run.settings, held_out)
    note = description.describe(run, summary)
    history = [dict(zip(meta["columns"], row, strict=True)) for row in arrays["history"].tolist()]
    ended, wall = path.stat().st_mtime, summary["wall_s"]
    tracker = make_tracker(run, uri, experiment, late=True, started=ended - wall)
    tracker.wall_s = wall
    age, last = time.time() - ended, history[-1]["wall_s"]
    for step, row in enumerate(history):
        metrics = {name: value for name, value in row.items() if name not in NOT_LOGGED}
        tracker.log_row(step, metrics, age + last - row["wall_s"])
    tracker.log_summary(description.held_out_metrics(held_out), ago_s=age)
    try:
        run_id = tracker.wait_ready(WAIT_S)
    except TrackingError:
        tracker.close("FINISHED", 0.0)
        raise
    if not summary.get("mlflow_run_id"):
        write_summary(run.path, {**summary, "mlflow_run_id": run_id})
    tracker.describe(note)
    tracker.log_model(run.path, model)
    tracker.log_artifacts(run.path)
    lost = tracker.close("FINISHED", WAIT_S)
    sent = tracker.sent
    counts = ((sent.rows, "row"), (sent.files, "file"), (sent.models, "model"))
    words = [f"{n} {noun}{'' if n == 1 else 's'}" for n, noun in counts if n]
    return f"sent to MLflow: {', '.join(words)}" if words else NOTHING, lost
