"""How far a champion drives from a reference: the reference driver, or a person's recorded drive."""

from __future__ import annotations

import contextlib
import os

import numpy as np

from cluster.runs.champion import Champion, held_out
from cluster.training.trainer import Maps
from evolution.episodes.rollout import Limits, trajectory
from evolution.networks.policy import PolicySpec
from gridsim.maps.map import Map
from gridsim.maps.scenarios import HELD_OUT_SEED
from gridsim.reference.errors import TURN, Driven, Series, driven, error_series, error_series_beside
from gridsim.view.drive import Drive, DriveError, poses_of, read_drive, replay

_SHORTEST = 1.0  # m that must be left of a recording for another start
_MAX_DRIFT = 0.5  # m from a recorded position to the replayed one


def series(
    champion: Champion,
    scenario: str | None = None,
    episodes: int = 64,
    seed: int = HELD_OUT_SEED,
    traffic: int | None = None,
    reference: str | os.PathLike[str] | None = None,
) -> list[Series]:
    """A champion and its reference along each route, in the order of the episodes (`gridsim.reference.errors.errors`).

    An episode without a metre forward has none. Beside a recorded drive there is one for each stretch of it that the
    champion followed.

    Args: as `champion.evaluate`'s; or a recorded drive, which brings its own map, start and traffic.
    Raises: ValueError with one line as `champion.evaluate`; DriveError (a ValueError) for a file that is no recorded
    drive, or of another map.
    """
    name = scenario or champion.scenario
    maps = Maps(name, champion.sim)
    try:
        if reference is not None:
            return _beside(champion, maps, name, traffic, reference)
        chosen = held_out(champion, maps, name, episodes, seed, traffic)
        found = []
        for row, world in zip(chosen.rows, chosen.worlds, strict=True):
            road = maps.get(chosen.maps[row["map"]])
            path = _drive(champion, road, row["start"], world, champion.sim.episode.target)
            found += [error_series(path, road, champion.sim.vehicle)] if path else []
        return [part for part in found if len(part.arc) > 1]
    finally:
        maps.close()


def _drive(champion: Champion, road: Map, start: np.ndarray, world: np.ndarray, target: float) -> Driven | None:
    """The path of an episode of so many m; None without a metre forward."""
    episode = champion.sim.episode
    limits = Limits(target, round(episode.time_limit / episode.control_period))
    spec = PolicySpec.parse(champion.policy)
    _, states, _ = trajectory(spec, champion.genome, road, start, limits, champion.sim, world)
    try:
        return driven(poses_of(states), road)
    except ValueError:
        return None


def _beside(
    champion: Champion, maps: Maps, name: str, traffic: int | None, reference: str | os.PathLike[str]
) -> list[Series]:
    """A champion beside a recorded drive: where their paths part, it starts again a bit further on.

    Of several episodes in the file, the longest is taken.
    """
    recording = read_drive(reference)
    if recording.scenario != name:
        raise DriveError(f"{reference} was driven on {recording.scenario}, not on {name}: choose that scenario")
    if traffic not in (None, recording.traffic):
        raise DriveError(f"{reference} was driven among {recording.traffic} cars, not {traffic}: leave traffic out")
    road = maps.get(recording.map_seed)
    poses, _, _, worlds = replay(recording, road)
    drift = np.abs(poses[:, :2] - recording.poses[:, :2]).max()
    if drift > _MAX_DRIFT:
        raise DriveError(f"{reference}: replayed, the drive is {drift:.1f} m off: it was driven on another map")
    rows, recorded = _longest(recording, road)
    found = []
    arc, end = 0.0, float(recorded.arc[-1])
    while end - arc > _SHORTEST:
        k = int(np.searchsorted(recorded.arc, arc))
        row, reached = rows[recorded.rows[k]], float(recorded.arc[k])
        path = _drive(champion, road, recording.poses[row], worlds[row], end - reached)
        if path is not None:
            part, reached = error_series_beside(path, recorded, road, k)
            found.append(part)
        arc = reached + TURN
    return [part for part in found if len(part.arc) > 1]


def _longest(recording: Drive, road: Map) -> tuple[np.ndarray, Driven]:
    """The rows of the longest episode of a recording, and its path."""
    episodes = []
    for episode in range(int(recording.episodes[-1]) + 1):
        rows = np.flatnonzero(recording.episodes == episode)
        with contextlib.suppress(ValueError):  # an episode without a metre forward
            episodes.append((rows, driven(recording.poses[rows], road)))
    if not episodes:
        raise DriveError("nothing was driven in the recording that could be compared with")
    return max(episodes, key=lambda found: float(found[1].arc[-1]))
