"""What MLflow is to have of a folder, as it was read from the folder's files."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

CHAMPION_TAG = "champion_sha256"  # tag with the digest of a champion's genome; a run registers each genome once


@dataclass(frozen=True)
class Model:
    """A champion as an ONNX file, and what MLflow's model registry says about it."""

    name: str  # of the registered model
    about: str  # description of the registered model, for all of its versions, Markdown
    note: str  # description of this version, Markdown
    tags: Mapping[str, str]  # of the version and, as metadata, of the saved model; CHAMPION_TAG is among them
    onnx: Path
    example: Mapping[str, np.ndarray]  # observations [n, ...] by the names of the graph's inputs


@dataclass(frozen=True)
class Content:
    """All that MLflow is to have of a run or a comparison."""

    name: str
    params: Mapping[str, str]
    tags: Mapping[str, str]
    rows: list[tuple[int, Mapping[str, float], float]] = field(default_factory=list)  # step, metrics, wall_s
    note: str = ""  # beginning of the run's description, Markdown
    result: str = ""  # appended to the description when the run ends; `{run_id}` becomes MLflow's id of the run
    files: list[Path] = field(default_factory=list)  # sent at the end
    model: Model | None = None  # sent at the end
    # Whether the run or comparison is finished. If it is, and MLflow has it as finished, too, with all rows, its status
    # and end in MLflow stay as they are.
    finished: bool = False
    # Seconds from the start to the last row or the end; for a run, without the time between a stop and --resume.
    wall_s: float = 0.0
