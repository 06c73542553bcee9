"""Finished training runs as a comparison reads them: settings, figures, and errors against the reference driver."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from cluster import stopping
from cluster.settings import RunSettings
from cluster.store.champion import Champion, held_out, load_champion
from cluster.store.checkpoint import CHAMPION, CONFIG, SUMMARY
from cluster.store.folder import read_config
from cluster.text import as_argument
from evolution.episodes.curriculum import HELD_OUT_EPISODES
from evolution.episodes.rollout import trajectory
from evolution.networks.policy import PolicySpec
from gridsim.config import VehicleConfig
from gridsim.errors import GridSimError
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import Traffic
from gridsim.reference import Series, error_series, errors
from gridsim.state import poses_of

Learner = Literal["evolution", "two-parents", "dqn", "random"]
LEARNERS: tuple[Learner, ...] = get_args(Learner)

ERROR_FIGURES = {
    "velocity_error_mps": "velocity_mean_mps",
    "velocity_error_percent": "velocity_mean_percent",
    "velocity_error_max_mps": "velocity_max_mps",
    "steering_error_deg": "steering_mean_deg",
    "steering_error_max_deg": "steering_max_deg",
    "compared_m": "metres",
}
"""A champion's errors against the reference driver: their names here, and those in `gridsim.reference`."""
RUN_FIGURES = (
    "success_rate", "distance_m", "speed_mps", "collision_rate", "km_per_collision", "car_steps", "wall_s",
    "training_s", "best_car_steps", "best_wall_s",
)  # fmt: skip
"""A run's figures: of its held-out drives; `car_steps`, those of learning; `wall_s`, to the run's end; `training_s`, to
the end of learning; `best_...`, car-steps and wall time to the end of the step in which the champion was found."""


@dataclass(frozen=True)
class Run:
    """A finished training run, of a comparison or any other; in tables also a missing one, which has no figures."""

    folder: Path
    settings: RunSettings
    champion_sha256: str  # digest of its genome
    figures: Mapping[str, float]  # RUN_FIGURES, and ERROR_FIGURES once they are measured; nan where they could not be


def read_run(folder: Path) -> Run:
    """A finished run from its folder. Raises GridSimError."""
    path, again = folder / SUMMARY, f"--resume {as_argument(folder)}"
    if not (folder / CONFIG).is_file():
        raise GridSimError(f"{folder} is not a run's folder: there is no {CONFIG}")
    settings, _ = read_config(folder / CONFIG)
    again = f"{settings.command} {again}"
    if not path.is_file():
        raise GridSimError(f"{folder} is not finished: there is no {SUMMARY}; finish it with: {again}")
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        held_out = {"km_per_collision": math.nan} | summary["held_out"]  # earlier versions did not write this figure
        figures = {name: float((summary | held_out)[name]) for name in RUN_FIGURES}
        return Run(folder, settings, str(summary["champion_sha256"]), figures)
    except (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
        raise GridSimError(f"{path} is damaged; delete it, and make it again with: {again}") from error


def measured(run: Run) -> Run:
    """A run with its ERROR_FIGURES, nan if all drives of its champion are too short. Raises GridSimError, Stopped."""
    road, traffic = run.settings.scenario, run.settings.traffic
    champion, again = load_champion(run.folder / CHAMPION), f"{run.settings.command} --resume {as_argument(run.folder)}"
    if champion.sha256 != run.champion_sha256:
        files = f"{CHAMPION} and {SUMMARY} do not belong together"
        raise GridSimError(f"{run.folder}: {files}; delete {SUMMARY}, and make both again with: {again}")
    found = series(champion, road, HELD_OUT_EPISODES, HELD_OUT_SEED, traffic)
    figures = errors(found, VehicleConfig()) if found else {}
    missed = {name: figures.get(original, math.nan) for name, original in ERROR_FIGURES.items()}
    return dataclasses.replace(run, figures={**run.figures, **missed})


def series(champion: Champion, scenario: str, episodes: int, seed: int, traffic: Traffic | None) -> list[Series]:
    """Drives of a champion beside the reference driver, one for each episode, in order; see `gridsim.reference`.

    Drives that are too short to compare are left out.

    Args: as for `champion.evaluate`. Raises: GridSimError as `evaluate` does; Stopped.
    """
    sim, episode, spec = champion.sim, champion.sim.episode, PolicySpec.parse(champion.policy)
    limits, found = (episode.target, episode.steps, sim), list[Series]()
    for _, _, chosen, maps in held_out(champion, scenario, episodes, seed, traffic):
        for row, world in zip(chosen.rows, chosen.worlds, strict=True):
            stopping.check()
            road_map = maps[row["map"]]
            _, states, _ = trajectory(spec, champion.genome, road_map, row["start"], *limits, world)
            with contextlib.suppress(ValueError):  # raised if the car did not move forward
                found.append(error_series(poses_of(states), road_map, sim.vehicle))
    return [part for part in found if len(part.arc) > 1]
