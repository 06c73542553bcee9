"""The saved view of an experiment in MLflow's UI, and the address of its run table. Does not import MLflow."""

import json
import time

from cluster.redaction import redacted

VIEW, VIEW_TAG = "gridsim", "mlflow.sharedViewState.gridsim"
"""The saved view of an experiment in MLflow's UI, and the experiment's tag that holds it."""
_COLUMNS = {"held_out/success_rate": 165, "validation/success_rate": 175, "held_out/speed_mps": 150, "car_steps": 90}
"""What the view's run table shows of each run, and the columns' widths in pixels."""


def run_table(server: str, experiment_id: str) -> str:
    """Address of an experiment's run table in an MLflow server's UI, as MLflow 3.17 opens another page by default."""
    page = f"#/experiments/{experiment_id}/runs?workflowType=machine_learning&viewStateShareKey={VIEW}"
    return f"{redacted(server)}/{page}"


def view() -> str:
    """The saved view as MLflow's UI writes it: the run table's columns, and curves over car-steps."""
    columns = {"attributes.`Run Name`": 270, **{f"metrics.`{name}`": width for name, width in _COLUMNS.items()}}
    axis = {"xAxisKey": "metric", "selectedXAxisMetricKey": "car_steps", "lineSmoothness": 0}
    state = {"selectedColumns": list(columns), "columnOrder": list(columns), "columnWidths": columns}
    state["globalLineChartConfig"] = axis
    return json.dumps({"name": "GridSim", "createdAt": int(1000.0 * time.time()), "state": json.dumps(state)})
