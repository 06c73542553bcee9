"""Rows that the tests of tracking log, and what MLflow then has, asked through its own client."""

import os
from pathlib import Path

from cluster import tracking
from cluster.tracker import Tracker

NAMES = ["fitness/best", "distance_m/mean", "car_steps", "wall_s"]
PARAMS = {"scenario": "seamless", "population": "512", "generations": "60"}
TAGS = {"algorithm": "evolution", "scenario": "seamless"}


def row(step):
    return {name: step * 10.0 + place for place, name in enumerate(NAMES)}


def client(uri):
    """MLflow's own."""
    tracking.quiet()
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=uri)


def steps(uri, run_id, names=NAMES):
    """The steps that MLflow has of every one of the metrics; a step that was logged twice is there twice."""
    histories = [client(uri).get_metric_history(run_id, name) for name in names]
    found = [sorted(metric.step for metric in history) for history in histories]
    assert all(each == found[0] for each in found), found
    for name, history in zip(names, histories, strict=True):
        assert all(metric.value == row(metric.step)[name] for metric in history if name in NAMES)
    return found[0]


def runs(uri):
    return [run for each in client(uri).search_experiments() for run in client(uri).search_runs([each.experiment_id])]


def tracker(uri, **options):
    given = {"experiment": "driving", "run_name": "a run", "params": PARAMS, "tags": TAGS, "key": "the-key", **options}
    return Tracker(uri, **given)


def with_path(**more):
    """An environment in which scripts find the packages, whatever the working directory."""
    root = str(Path(tracking.__file__).resolve().parents[1])
    return {**os.environ, "PYTHONPATH": root, **more}
