"""Finished training runs as a comparison reads them: what they were, how well they drove, and their errors.

A run's folder is taken as somebody may have edited it: what does not fit is refused with one line.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from cluster.runs import checkpoint
from cluster.runs.champion import evaluate, load_champion
from cluster.runs.checkpoint import CHAMPION, CheckpointError
from cluster.runs.run import CONFIG, SUMMARY, RunError, read_config
from evolution.episodes.curriculum import HELD_OUT_EPISODES
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import label

if TYPE_CHECKING:
    from gridsim.reference.errors import Series

Learner = Literal["evolution", "two-parents", "dqn", "random"]
LEARNERS: tuple[Learner, ...] = get_args(Learner)
ERRORS_KEPT = "errors.json"
FORMAT = 1  # of that file
ALIKE = 0.25  # share of a summary's distance that a champion must drive again when its errors are measured
_MAX_JSON = 16 << 20  # bytes

ERROR_FIGURES = {
    "velocity_error_mps": "velocity_mean_mps",
    "velocity_error_percent": "velocity_mean_percent",
    "velocity_error_max_mps": "velocity_max_mps",
    "steering_error_deg": "steering_mean_deg",
    "steering_error_max_deg": "steering_max_deg",
    "compared_m": "metres",
}
"""A champion's errors against the reference, mean and largest, and over how many metres; by their names in
`gridsim.reference.errors.Errors`."""
RUN_FIGURES = (
    "success_rate", "distance_m", "speed_mps", "collision_rate", "car_steps", "wall_s", "training_s", "best_car_steps",
    "best_wall_s",
)  # fmt: skip
"""A run's figures: held-out drives, what it cost from start to end, how long it trained (without measuring and filming
the champion), and what training had cost when the final champion was bred."""


class ExperimentError(GridSimError):
    """A comparison that cannot be made, read or resumed; the message is one line for the user."""


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file. Raises ExperimentError."""
    try:
        if path.stat().st_size > _MAX_JSON:
            raise ExperimentError(f"{path}: too large")
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise ExperimentError(f"{path} is damaged: not JSON ({type(error).__name__})") from error
    if not isinstance(content, dict):
        raise ExperimentError(f"{path} is damaged: not a JSON object")
    return content


@dataclass(frozen=True)
class Run:
    """A finished training run, of a comparison or any other.

    Attributes:
        folder: its folder.
        learner, scenario, seed, traffic, observation: what it was.
        champion_sha256: digest of its champion's genome.
        figures: RUN_FIGURES, and ERROR_FIGURES once they are measured; not a number where they could not be.
    """

    folder: Path
    learner: str
    scenario: str
    seed: int
    traffic: int
    observation: str
    champion_sha256: str
    figures: Mapping[str, float]


def read_run(folder: Path) -> Run:
    """A finished run from its folder. Raises ExperimentError with one line for anything else."""
    if not folder.is_dir():
        raise ExperimentError(f"{folder}: no such folder" if not folder.exists() else f"{folder} is no folder")
    if not (folder / CONFIG).is_file():
        raise ExperimentError(f"{folder} is no run's folder: it has no {CONFIG}")
    if not (folder / SUMMARY).is_file():
        raise ExperimentError(f"{folder} is not finished: it has no {SUMMARY}; finish it with --resume {folder}")
    path = folder / SUMMARY
    summary = read_json(path)
    try:
        settings, _ = read_config(folder / CONFIG)
        champion = load_champion(folder / CHAMPION)
    except (CheckpointError, RunError) as error:
        raise ExperimentError(str(error)) from error
    if (settings.scenario, settings.seed) != (summary.get("scenario"), summary.get("seed")):
        raise ExperimentError(f"{folder}: {CONFIG} and {SUMMARY} do not belong together; one of them was edited")
    if champion.sha256 != summary.get("champion_sha256"):
        raise ExperimentError(f"{folder}: {CHAMPION} is not the champion that {SUMMARY} tells of")
    if not isinstance(summary.get("held_out"), dict):
        raise ExperimentError(f"{path} is damaged: it has no held_out")
    figures = summary | summary["held_out"]
    for name in RUN_FIGURES:
        if name not in figures:
            raise ExperimentError(f"{path} has no {name}; delete it, and make it again with --resume {folder}")
        value = figures[name]
        if type(value) not in (int, float) or not 0.0 <= value <= (1.0 if name.endswith("_rate") else 1e15):
            raise ExperimentError(f"{path} is damaged: its {name} is {str(value)[:40]}")
    return Run(
        folder, settings.learner, settings.scenario, settings.seed, settings.traffic, settings.observation,
        champion.sha256, {name: float(figures[name]) for name in RUN_FIGURES},
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------------- errors


Measure = Callable[[Run, str], dict[str, float]]
"""ERROR_FIGURES of a run's champion against a reference: a drive.csv, or "" for the reference driver."""


def series_of(run: Run, reference: str, episodes: int) -> list[Series]:
    """A run's champion and the reference along its held-out drives, or beside the recorded one.

    Raises: ExperimentError.
    """
    from cluster.comparison.errors import series

    try:
        champion = load_champion(run.folder / CHAMPION)
        if reference:  # it brings its own map and traffic
            return series(champion, run.scenario, reference=reference)
        return series(champion, run.scenario, episodes, traffic=run.traffic)
    except (CheckpointError, ValueError) as error:
        raise ExperimentError(f"{run.folder}: no errors can be measured: {error}") from error


def errors_of(run: Run, reference: str) -> dict[str, float]:
    """What `Measure` is. Raises ExperimentError. Who never came forward has no errors: they are not a number."""
    from gridsim.reference.errors import combine

    if not reference:
        _check_drive(run)
    found = series_of(run, reference, HELD_OUT_EPISODES)
    if not found:
        return dict.fromkeys(ERROR_FIGURES, math.nan)
    figures = combine([part.errors() for part in found]).figures()
    return {mine: figures[theirs] for mine, theirs in ERROR_FIGURES.items()}


def _check_drive(run: Run) -> None:
    """Raises ExperimentError where a champion does not come as far as its summary says."""
    try:
        distance = evaluate(load_champion(run.folder / CHAMPION), run.scenario, traffic=run.traffic)["distance_m"]
    except (CheckpointError, ValueError) as error:
        raise ExperimentError(f"{run.folder}: its champion cannot be driven: {error}") from error
    if distance < ALIKE * run.figures["distance_m"]:
        raise ExperimentError(
            f"{run.folder}: its champion drives {distance:,.0f} m where {SUMMARY} says "
            f"{run.figures['distance_m']:,.0f} m: another version of GridSim made it; make it again, or leave it out"
        )


class Errors:
    """Errors of champions, each measured once: they are kept in a file of the comparison's folder."""

    def __init__(self, path: Path, reference: str, measure: Measure):
        """Take up what the file holds; a file that cannot be read is made anew."""
        self._path, self._reference, self._measure = path, reference, measure
        self._digest = hashlib.sha256(Path(reference).read_bytes()).hexdigest() if reference else ""
        self._kept: dict[str, dict[str, float]] = {}
        try:
            content = read_json(path)
            if (content["format"], content["gridsim"]) == (FORMAT, version("gridsim")):
                self._kept = {
                    str(key): {name: float("nan" if values[name] is None else values[name]) for name in ERROR_FIGURES}
                    for key, values in content["errors"].items()
                }
        except (ExperimentError, LookupError, TypeError, ValueError, AttributeError):
            pass  # it can be measured again

    def of(self, run: Run) -> Run:
        """The run with its errors among its figures. Raises ExperimentError, CheckpointError."""
        key = "/".join((run.champion_sha256, label(run.scenario), str(run.traffic), self._digest))
        if key not in self._kept:
            self._kept[key] = self._measure(run, self._reference)
            self._write()
        return dataclasses.replace(run, figures={**run.figures, **self._kept[key]})

    def _write(self) -> None:
        kept = {
            key: {name: value if math.isfinite(value) else None for name, value in values.items()}
            for key, values in self._kept.items()
        }
        content = {"format": FORMAT, "gridsim": version("gridsim"), "errors": kept}
        checkpoint.write_atomic(self._path, (json.dumps(content, indent=1) + "\n").encode(), durable=False)
