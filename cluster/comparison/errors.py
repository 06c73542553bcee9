"""How far a champion drives from the reference driver."""

from __future__ import annotations

import numpy as np

from cluster.runs.champion import Champion, held_out
from cluster.training.trainer import Maps
from evolution.episodes.rollout import Limits, trajectory
from evolution.networks.policy import PolicySpec
from gridsim.maps.map import Map
from gridsim.maps.scenarios import HELD_OUT_SEED
from gridsim.reference.errors import Driven, Series, driven, error_series
from gridsim.view.drive import poses_of


def series(
    champion: Champion,
    scenario: str | None = None,
    episodes: int = 64,
    seed: int = HELD_OUT_SEED,
    traffic: int | None = None,
) -> list[Series]:
    """A champion and its reference along each route, in the order of the episodes (`gridsim.reference.errors.errors`).

    An episode without a metre forward has none.

    Args, Raises: as `champion.evaluate`'s.
    """
    name = scenario or champion.scenario
    maps = Maps(name, champion.sim)
    try:
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
