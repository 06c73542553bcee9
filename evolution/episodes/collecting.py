"""Experience for the DQN: episodes of one policy with some random actions (epsilon-greedy).

Results depend only on the arguments, and those of an episode only on its own row, world, epsilon and key.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evolution.dqn.experience import Experience, empty, join
from evolution.episodes.rollout import (
    RESULT,
    Limits,
    Recorder,
    checked_worlds,
    episode_setup,
    make_workspace,
    packed_genome,
    policy_buffers,
    run_episode,
    simulations_on,
)
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.roads import freeze


def collect(
    spec: PolicySpec,
    weights: np.ndarray,
    road_maps: Sequence[Map],
    episodes: np.ndarray,
    epsilons: np.ndarray,
    keys: np.ndarray,
    limits: Limits,
    config: SimConfig,
    worlds: np.ndarray | None = None,
) -> tuple[Experience, np.ndarray]:
    """Drive one policy through every episode, with some random actions, and record its experience.

    Args:
        weights: float32 [spec.size].
        road_maps: the maps that the episodes index.
        episodes: EPISODE [e].
        epsilons: float32 [e], each episode's share of random actions, which are uniform over all actions.
        keys: uint64 [e], seeds of each episode's random numbers.
        worlds: the traffic that each episode begins with, float32 [e, cars, world.FIELDS]; None is no traffic.

    Returns: (the experience, in the order of the episodes; RESULT [e]).
    Raises: ValueError with one line if the weights or worlds do not fit.
    """
    if weights.shape != (spec.size,):
        raise ValueError(f"the weights of {spec} are [{spec.size}], not {weights.shape}")
    (closing, grid_buffers), worlds = policy_buffers(spec, config), checked_worlds(episodes, limits, worlds)
    packed = packed_genome(freeze(weights.astype(np.float32, copy=False)), spec.layers, grid_buffers)
    simulations = simulations_on(road_maps, config)
    workspaces = [make_workspace(simulation, spec.layers, 0, 0) for simulation in simulations]
    longest = int(max(episodes["steps"].max(initial=0), limits.steps))
    rows = empty(spec, longest + 1)
    results = np.zeros(len(episodes), dtype=RESULT)
    parts = []
    for k, episode in enumerate(episodes):
        run_episode(
            simulations[episode["map"]],
            packed,
            spec.layers,
            episode_setup(episode, limits),
            workspaces[episode["map"]],
            worlds[k].copy() if worlds.shape[1] else None,
            closing,
            grid_buffers,
            Recorder(rows, epsilons[k], keys[k]),
            results[k],
        )
        parts.append(Experience(*(array[: int(results[k]["steps"]) + 1].copy() for array in rows)))
    return join(spec, parts), results
