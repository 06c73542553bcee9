"""Episodes as data: starts on lanes with the traffic around them, from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evolution.episodes.rollout import EPISODE
from gridsim.config import SimConfig
from gridsim.maps.map import Map, sample_starts
from gridsim.state import POSE
from gridsim.traffic.world import empty_worlds, spawn


class Episodes(NamedTuple):
    """Episodes with their maps and traffic."""

    maps: list[int]  # seeds of the maps
    rows: np.ndarray  # EPISODE [e]; their `map` indexes `maps`
    worlds: np.ndarray  # float32 [e, cars, TRAFFIC_FIELDS], the traffic that each begins with

    def and_then(self, others: Episodes) -> Episodes:
        """Concatenate these and other episodes, whose `worlds` have places for as many cars."""
        rows = others.rows.copy()
        rows["map"] += len(self.maps)
        return Episodes(
            self.maps + others.maps, np.concatenate([self.rows, rows]), np.concatenate([self.worlds, others.worlds])
        )


def lane_starts(
    road_maps: Sequence[Map],
    maps: np.ndarray,
    rng: np.random.Generator,
    traffic: int | Sequence[int] = 0,
    config: SimConfig | None = None,
    room: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Episodes in which the ego car starts at rest; the k-th start is uniform over the lanes of `road_maps[maps[k]]`.

    There are `traffic` other cars around it. Episodes have the configuration's target and time limit.
    Args: `traffic`, one number for all maps or one for each; `room`, the least number of cars that the arrays have
    places for. Cars beyond `traffic`, and those for which lanes have no room, are absent.
    Returns: (EPISODE [len(maps)], their traffic float32 [len(maps), cars, TRAFFIC_FIELDS]).
    """
    config = config or SimConfig()
    episodes = np.zeros(len(maps), dtype=EPISODE)
    cars = np.broadcast_to(traffic, len(road_maps)).tolist()
    worlds = empty_worlds(len(maps), max([room, *cars]))
    episodes["map"], episodes["target"], episodes["steps"] = maps, config.episode.target, config.episode.steps
    on_each = [(m, np.flatnonzero(maps == m)) for m in np.unique(maps)]
    for m, of in on_each:
        episodes["start"][of, :POSE] = sample_starts(road_maps[m], len(of), rng)
    if worlds.shape[1]:
        keys = rng.integers(1 << 63, size=len(maps), dtype=np.uint64)
        for m, of in on_each:
            worlds[of, : cars[m]] = spawn(road_maps[m].network, episodes["start"][of], cars[m], keys[of], config)
    return episodes, worlds
