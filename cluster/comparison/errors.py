"""How far a champion deviates from the reference driver."""

from __future__ import annotations

import contextlib

from cluster.runs.champion import Champion, held_out
from cluster.training.trainer import Maps
from evolution.episodes.rollout import Limits, trajectory
from evolution.networks.policy import PolicySpec
from gridsim.maps.scenarios import HELD_OUT_SEED
from gridsim.reference.errors import Series, error_series
from gridsim.view.drive import poses_of


def series(
    champion: Champion,
    scenario: str | None = None,
    episodes: int = 64,
    seed: int = HELD_OUT_SEED,
    traffic: int | None = None,
) -> list[Series]:
    """A champion beside the reference along each route, in the order of the episodes; see `gridsim.reference.errors`.

    Episodes in which it does not drive a metre forward are left out.

    Args: as for `champion.evaluate`.
    Raises: ValueError, as `champion.evaluate` does.
    """
    name = scenario or champion.scenario
    sim, spec, maps = champion.sim, PolicySpec.parse(champion.policy), Maps(name, champion.sim)
    limits = Limits(sim.episode.target, sim.episode.steps)
    found = []
    with contextlib.closing(maps):
        chosen = held_out(champion, maps, name, episodes, seed, traffic)
        for row, world in zip(chosen.rows, chosen.worlds, strict=True):
            road = maps.get(chosen.maps[row["map"]])
            _, states, _ = trajectory(spec, champion.genome, road, row["start"], limits, sim, world)
            with contextlib.suppress(ValueError):  # not a metre forward
                found.append(error_series(poses_of(states), road, sim.vehicle))
    return [part for part in found if len(part.arc) > 1]
