"""Experience for the DQN: episodes of one policy with some random actions (epsilon-greedy).

The loop is that of `rollout`, and records observations, actions and rewards. Results depend only on the arguments, and
those of an episode only on its own row, world, epsilon and key.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evolution.dqn.experience import NO_ACTION, Experience, empty, join, store_grid, store_rays
from evolution.episodes.rollout import (
    RESULT,
    Limits,
    checked_worlds,
    choose_action,
    control_step,
    episode_setup,
    kernel_world,
    make_closing,
    make_grid_buffers,
    make_workspace,
    observe,
    packed_genome,
    simulations_on,
    write_result,
)
from evolution.networks.policy import PolicySpec
from gridsim.car.ego import DISTANCE, SPEED, place
from gridsim.car.reward import reward
from gridsim.config import SimConfig
from gridsim.counter import GOLDEN, mix, uniform
from gridsim.jit import leaf, njit
from gridsim.maps.map import Map
from gridsim.maps.roads import freeze

_F, _U = np.float32, np.uint64
_IDLE = 2


@leaf
def _explore(key, step, epsilon, actions):
    """A random action with probability epsilon, else -1 for the policy's action. Uses one random number a step."""
    bits = mix(key + _U(step) * GOLDEN)
    if uniform(bits) < epsilon:
        return int((bits & _U(0xFFFFFFFF)) * _U(actions) >> _U(32))
    return -1


@leaf
def _keep(car, workspace, grid_buffers, row):
    """Store the observation in a row."""
    if grid_buffers is None:
        store_rays(workspace.scratch, row)
    else:
        store_grid(grid_buffers.grid, car[SPEED], row)


@njit(nogil=True)
def _collect(simulation, packed, layers, setup, traffic, closing, grid_buffers, epsilon, key, kept, results, column):
    """Drive one episode; fills the first rows of `kept` and results[column]. Returns: its control steps."""
    workspace = make_workspace(simulation, layers, 0, 0)
    world = None if traffic is None else traffic.copy()
    road, constants, car = simulation.road, simulation.constants, workspace.car
    observations, actions, rewards, ends = kept
    key = mix(key)
    place(road, setup.start, car, workspace.visits)
    end = 0
    steps = 0
    observe(simulation, car, world, workspace, closing, grid_buffers)
    _keep(car, workspace, grid_buffers, observations[0])
    while end == 0:
        action = choose_action(packed, layers, car, workspace, grid_buffers, steps == 0)
        if action < 0:  # NaN: the episode ends, as in `rollout`
            end = _IDLE
            if steps > 0:
                ends[steps - 1] = end
            break
        explored = _explore(key, steps, epsilon, layers[layers.shape[0] - 1])
        if explored >= 0:
            action = explored
        before = car[DISTANCE]
        end = control_step(simulation, setup, car, workspace.visits, world, action, steps)
        observe(simulation, car, world, workspace, closing, grid_buffers)
        gained = car[DISTANCE] - before
        actions[steps], ends[steps] = action, end
        rewards[steps] = reward(
            workspace.ranges, constants.ray_range, car[SPEED], gained, end, road.speed_high, constants.dt
        )
        steps += 1
        _keep(car, workspace, grid_buffers, observations[steps])
    actions[steps], rewards[steps], ends[steps] = NO_ACTION, _F(0.0), 0
    write_result(car, end, results[column])
    return steps


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

    If an output is NaN, the episode ends as IDLE, as in `rollout.evaluate`; so does the last recorded step, if any.

    Returns: (the experience, in the order of the episodes; RESULT [e]).
    Raises: ValueError with one line if shapes or numbers do not fit.
    """
    if weights.shape != (spec.size,):
        raise ValueError(f"the weights of {spec} are [{spec.size}], not {weights.shape}")
    for name, values in (("epsilons", epsilons), ("keys", keys)):
        if values.shape != (len(episodes),):
            raise ValueError(f"{name} are one for each of {len(episodes)} episodes, not {values.shape}")
    if not ((epsilons >= 0.0) & (epsilons <= 1.0)).all():
        raise ValueError("epsilons are shares, from 0 to 1")
    grid_buffers, worlds = make_grid_buffers(spec, config), checked_worlds(episodes, limits, worlds)
    packed = freeze(packed_genome(freeze(weights.astype(np.float32, copy=False)), spec.layers, grid_buffers))
    simulations, closing = simulations_on(road_maps, config), make_closing(spec, config)
    longest = int(max(episodes["steps"].max(initial=0), limits.steps))
    kept = empty(spec, longest + 1)
    results = np.zeros(len(episodes), dtype=RESULT)
    parts = []
    for k, episode in enumerate(episodes):
        steps = _collect(
            simulations[episode["map"]],
            packed,
            spec.layers,
            episode_setup(episode, limits),
            kernel_world(worlds, k),
            closing,
            grid_buffers,
            _F(epsilons[k]),
            _U(keys[k]),
            kept,
            results,
            k,
        )
        parts.append(Experience(*(array[: steps + 1].copy() for array in kept)))
    return join(spec, parts), results
