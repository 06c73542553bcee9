"""Experience for the DQN: episodes of one policy with some random actions (epsilon-greedy).

Results depend only on the arguments, and those of an episode only on its own row, world, epsilon and key.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evolution.dqn.experience import Experience, empty
from evolution.episodes.rollout import (
    RESULT,
    EpisodeSetup,
    Limits,
    Recorder,
    checked_worlds,
    make_workspace,
    packed_genome,
    policy_buffers,
    run_episode,
    simulations_on,
    with_limits,
)
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig
from gridsim.jit import njit
from gridsim.maps.map import Map
from gridsim.maps.roads import freeze


@njit(nogil=True)
def _collect(
    simulation, genome, layers, which, starts, targets, steps, worlds, closing, grid_buffers, epsilons, keys,
    experience, results,
):  # fmt: skip
    """Drive a genome through episodes `which` [k] on one map; fills their rows of experience and results.

    Args: experience [e, rows, ...]; starts, targets, steps, worlds, epsilons, keys and results [e, ...].
    """
    workspace = make_workspace(simulation, layers, 0, 0)
    packed = packed_genome(genome, layers, grid_buffers)
    observations, actions, rewards, ends = experience
    for k in which:
        setup = EpisodeSetup(starts[k], targets[k], steps[k])
        world = None if worlds is None else worlds[k].copy()
        recorder = Recorder(Experience(observations[k], actions[k], rewards[k], ends[k]), epsilons[k], keys[k])
        run_episode(simulation, packed, layers, setup, workspace, world, closing, grid_buffers, recorder, results[k])


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
    worlds, episodes = checked_worlds(episodes, limits, worlds), with_limits(episodes, limits)
    buffers, simulations = policy_buffers(spec, config), simulations_on(road_maps, config)
    weights = freeze(weights.astype(np.float32, copy=False))
    setups = freeze(episodes["start"]), freeze(episodes["target"]), freeze(episodes["steps"].astype(np.int64))
    traffic = freeze(worlds.copy()) if worlds.shape[1] else None
    exploration = freeze(epsilons.astype(np.float32)), freeze(keys.astype(np.uint64))
    results = np.zeros(len(episodes), dtype=RESULT)
    # Room for episodes of any length: memory that is not written to is not taken.
    experience = empty(spec, len(episodes), int(episodes["steps"].max(initial=0)) + 1)
    for m in np.unique(episodes["map"]):
        which = np.flatnonzero(episodes["map"] == m)
        _collect(
            simulations[m], weights, spec.layers, which, *setups, traffic, *buffers, *exploration, experience, results
        )
    driven = np.arange(experience.actions.shape[1]) <= results["steps"][:, None]
    return Experience(*(array[driven] for array in experience)), results
