"""Experience for a learner: episodes of one policy that now and then does something else (epsilon-greedy).

The same fused loop as in `rollout`, of the same parts, that keeps what was seen, done and gained. Pure functions: what
is returned depends on the arguments alone, and an episode on its own row, world, epsilon and key.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evolution.dqn.experience import NO_ACTION, Experience, empty, join, keep_grid, keep_rays
from evolution.episodes.rollout import (
    RESULT,
    Limits,
    advance,
    bounds_of,
    checked_worlds,
    choose,
    closing_of,
    eye_of,
    make_room,
    note,
    packed_genome,
    see,
    settings_on,
    world_of,
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
    """A random action, or -1 where the policy is to act: a number a step, of which the upper 24 bits decide that."""
    bits = mix(key + _U(step) * GOLDEN)
    if uniform(bits) < epsilon:
        return int((bits & _U(0xFFFFFFFF)) * _U(actions) >> _U(32))
    return -1


@leaf
def _keep(car, room, eye, row):
    """Keep what was seen as a row of observations."""
    if eye is None:
        keep_rays(room.scratch, row)
    else:
        keep_grid(eye.grid, car[SPEED], row)


@njit(nogil=True)
def _collect(setting, packed, layers, bounds, traffic, closing, eye, epsilon, key, kept, results, column):
    """One episode; fills the first rows of `kept` and results[column]. Returns: its control steps."""
    room = make_room(setting, layers, 0, 0)
    world = None if traffic is None else traffic.copy()
    road, constants, car = setting.road, setting.constants, room.car
    observations, actions, rewards, ends = kept
    key = mix(key)
    place(road, bounds.start, car, room.visits)
    end = 0
    steps = 0
    see(setting, car, world, room, closing, eye)
    _keep(car, room, eye, observations[0])
    while end == 0:
        action = choose(packed, layers, car, room, eye, steps == 0)
        if action < 0:  # not a number: what is left is lost, as in `rollout`
            end = _IDLE
            if steps > 0:
                ends[steps - 1] = end
            break
        explored = _explore(key, steps, epsilon, layers[layers.shape[0] - 1])
        if explored >= 0:
            action = explored
        before = car[DISTANCE]
        end = advance(setting, bounds, car, room.visits, world, action, steps)
        see(setting, car, world, room, closing, eye)
        gained = car[DISTANCE] - before
        actions[steps], ends[steps] = action, end
        rewards[steps] = reward(
            room.ranges, constants.ray_range, car[SPEED], gained, end, road.speed_high, constants.dt
        )
        steps += 1
        _keep(car, room, eye, observations[steps])
    actions[steps], rewards[steps], ends[steps] = NO_ACTION, _F(0.0), 0
    note(car, end, results[column])
    return steps


def collect(
    spec: PolicySpec,
    weights: np.ndarray,
    scenarios: Sequence[Map],
    episodes: np.ndarray,
    epsilons: np.ndarray,
    keys: np.ndarray,
    limits: Limits,
    config: SimConfig,
    worlds: np.ndarray | None = None,
) -> tuple[Experience, np.ndarray]:
    """Drive one policy through every episode, at times by a random action, and keep all of it.

    Args:
        weights: float32 [spec.size].
        scenarios: the maps that the episodes index.
        episodes: EPISODE [e].
        epsilons: float32 [e], each episode's share of random actions, which are uniform over all.
        keys: uint64 [e], of each episode's random numbers.
        worlds: the traffic that each episode begins with, float32 [e, cars, world.FIELDS]; None is no traffic.

    Where the network gives no number the episode ends as in `rollout.evaluate`, IDLE: so does the last row before, if
    there is one.

    Returns: (the experience, in the order of the episodes; RESULT [e]).
    Raises: ValueError with one line where shapes or numbers do not fit.
    """
    if weights.shape != (spec.size,):
        raise ValueError(f"the weights of {spec} are [{spec.size}], not {weights.shape}")
    for name, values in (("epsilons", epsilons), ("keys", keys)):
        if values.shape != (len(episodes),):
            raise ValueError(f"{name} are one for each of {len(episodes)} episodes, not {values.shape}")
    if not ((epsilons >= 0.0) & (epsilons <= 1.0)).all():
        raise ValueError("epsilons are shares, from 0 to 1")
    eye, worlds = eye_of(spec, config), checked_worlds(episodes, limits, worlds)
    packed = freeze(packed_genome(freeze(weights.astype(np.float32, copy=False)), spec.layers, eye))
    settings, closing = settings_on(scenarios, config), closing_of(spec, config)
    longest = int(max(episodes["steps"].max(initial=0), limits.steps))
    kept = empty(spec, longest + 1)
    results = np.zeros(len(episodes), dtype=RESULT)
    parts = []
    for k, episode in enumerate(episodes):
        steps = _collect(
            settings[episode["map"]],
            packed,
            spec.layers,
            bounds_of(episode, limits),
            world_of(worlds, k),
            closing,
            eye,
            _F(epsilons[k]),
            _U(keys[k]),
            kept,
            results,
            k,
        )
        parts.append(Experience(*(array[: steps + 1].copy() for array in kept)))
    return join(spec, parts), results
