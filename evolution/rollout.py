"""Episodes of whole populations: the fused loop sense -> network -> act -> advance, until done.

The only user of the simulator within `evolution`. Pure functions: what is returned depends on the arguments alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evolution.policy import BLOCK, CnnSpec, PolicySpec, decide, encode, pack, packed_size
from gridsim.config import SimConfig, constants
from gridsim.jit import njit
from gridsim.roads import VISIT_CELL, freeze
from gridsim.scenarios import Scenario
from gridsim.sensors import LANES, fan
from gridsim.simulator import (
    COS,
    DISTANCE,
    FIELDS,
    PACED,
    SIN,
    SPEED,
    STEERING,
    STEPS,
    X,
    Y,
    drive,
    look,
    place,
)

_F = np.float32

#: An episode: index of its map among the task's; x, y (m), heading (rad), speed (m/s), steering (rad) at its start;
#: its own target (m) and limit (control steps), where these are not 0.
EPISODE = np.dtype([("map", "<i4"), ("start", "<f4", 5), ("target", "<f4"), ("steps", "<i4")])

#: What comes back of an episode: new ground (m), new ground at a speed within the interval (m), control steps, End.
RESULT = np.dtype([("distance", "<f4"), ("paced", "<f4"), ("steps", "<u2"), ("end", "u1"), ("pad", "u1")])

#: The same with the state some steps before the end, as a start: what a race returns.
RACED = np.dtype([*RESULT.descr, ("rewound", "<f4", 5)])

MAX_STEPS = 65_535


@dataclass(frozen=True)
class Limits:
    """Where an episode ends if nothing happens: m of new ground, and control steps."""

    target: float
    steps: int


@njit
def _run(road, constants, fan, packed, layers, start, target, max_steps, car, visits, beams, ranges, scratch, ring):
    """One episode of one car. ring float32 [n, FIELDS] is left with its last n states: that of step k in row k % n."""
    place(road, start, car, visits)
    keep = ring.shape[0]
    end = 0
    steps = 0
    while end == 0:
        look(road, constants, fan, car, beams, ranges)
        encode(ranges, car[SPEED], scratch)
        action = decide(packed, layers, scratch)
        if action < 0:  # not a number: the genome loses what is left
            end = 2
            break
        if keep > 0:
            ring[steps % keep] = car
        end = drive(road, constants, car, visits, action)
        steps += 1
        if end == 0:
            if car[DISTANCE] >= target:
                end = 3
            elif steps >= max_steps:
                end = 4
    return end


@njit(nogil=True)
def _rollout(road, constants, fan, genomes, layers, start, target, max_steps, rewind, results, column, rewound):
    """All genomes [n, genes] on one episode; fills results[:, column] and, if rewind > 0, rewound[:, column]."""
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car = np.empty(FIELDS, dtype=np.float32)
    visits = np.empty(cells, dtype=np.float32)
    beams = np.empty((3, LANES), dtype=np.float32)
    ranges = np.empty(layers[0] - 1, dtype=np.float32)
    scratch = np.zeros(2 * (layers.max() + BLOCK), dtype=np.float32)
    packed = np.empty(packed_size(layers), dtype=np.float32)
    ring = np.zeros((rewind, FIELDS), dtype=np.float32)
    for i in range(genomes.shape[0]):
        pack(genomes[i], layers, packed)
        end = _run(
            road, constants, fan, packed, layers, start, target, max_steps, car, visits, beams, ranges, scratch, ring
        )
        row = results[i, column]
        row["distance"] = car[DISTANCE]
        row["paced"] = car[PACED]
        row["steps"] = car[STEPS]
        row["end"] = end
        if rewind > 0:
            back = ring[max(int(car[STEPS]) - rewind, 0) % rewind]
            rewound[i, column, 0] = back[X]
            rewound[i, column, 1] = back[Y]
            rewound[i, column, 2] = math.atan2(back[SIN], back[COS])
            rewound[i, column, 3] = back[SPEED]
            rewound[i, column, 4] = back[STEERING]


def targets(episodes: np.ndarray, limits: Limits) -> np.ndarray:
    """Target of each episode in m: float64 [e]."""
    return np.where(episodes["target"] > 0, episodes["target"], limits.target).astype(np.float64)


def evaluate(
    spec: PolicySpec,
    genomes: np.ndarray,
    scenarios: Sequence[Scenario],
    episodes: np.ndarray,
    limits: Limits,
    config: SimConfig,
    rewind: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Drive every genome through every episode.

    Args:
        genomes: float32 [n, spec.size].
        scenarios: the maps that the episodes index.
        episodes: EPISODE [e].
        rewind: control steps before each end whose state is wanted, 0 for none.

    Returns: (RESULT [n, e], the states `rewind` steps before the ends, or at the starts of shorter episodes, as starts
    float32 [n, e, 5]; [n, e, 0] if none are wanted).
    Raises: ValueError where shapes do not fit.
    """
    if genomes.ndim != 2 or genomes.shape[1] != spec.size:
        raise ValueError(f"genomes of {spec} are [n, {spec.size}], not {genomes.shape}")
    if not 0 < limits.steps <= MAX_STEPS:
        raise ValueError(f"an episode has 1 to {MAX_STEPS} steps, not {limits.steps}")
    if isinstance(spec, CnnSpec):
        from evolution import grid_rollout  # here, because it is made of this file's parts

        return grid_rollout.evaluate(spec, genomes, scenarios, episodes, limits, config, rewind)
    if spec.inputs != config.sensors.rays + 1:
        raise ValueError(f"{spec} sees {spec.inputs - 1} rays, the sensor has {config.sensors.rays}")
    k = constants(config)
    rays = fan(config.sensors.rays, k.ray_first, k.ray_step)
    genomes = freeze(genomes.astype(np.float32, copy=False))
    results = np.zeros((len(genomes), len(episodes)), dtype=RESULT)
    rewound = np.zeros((len(genomes), len(episodes), 5 if rewind else 0), dtype=np.float32)
    for column, episode in enumerate(episodes):
        _rollout(
            scenarios[episode["map"]].road,
            k,
            rays,
            genomes,
            spec.layers,
            freeze(episode["start"].copy()),
            _F(episode["target"] or limits.target),
            int(episode["steps"] or limits.steps),
            rewind,
            results,
            column,
            rewound,
        )
    return results, rewound


def trajectory(
    spec: PolicySpec, genome: np.ndarray, scenario: Scenario, start: np.ndarray, limits: Limits, config: SimConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Drive one genome through one episode and keep its path.

    Returns: (RESULT [], states float32 [steps, FIELDS] before each step; fields as in `gridsim.simulator`).
    """
    if isinstance(spec, CnnSpec):
        from evolution import grid_rollout  # here, because it is made of this file's parts

        return grid_rollout.trajectory(spec, genome, scenario, start, limits, config)
    k = constants(config)
    rays = fan(config.sensors.rays, k.ray_first, k.ray_step)
    result, states = _trajectory(
        scenario.road, k, rays, freeze(genome), spec.layers, freeze(start), _F(limits.target), limits.steps
    )
    row = np.zeros((), dtype=RESULT)
    row["distance"], row["paced"], row["steps"], row["end"] = result
    return row, states[: int(row["steps"])]


@njit(nogil=True)
def _trajectory(road, constants, fan, genome, layers, start, target, max_steps):
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car = np.empty(FIELDS, dtype=np.float32)
    visits = np.empty(cells, dtype=np.float32)
    beams = np.empty((3, LANES), dtype=np.float32)
    ranges = np.empty(layers[0] - 1, dtype=np.float32)
    scratch = np.zeros(2 * (layers.max() + BLOCK), dtype=np.float32)
    packed = np.empty(packed_size(layers), dtype=np.float32)
    pack(genome, layers, packed)
    ring = np.zeros((max_steps, FIELDS), dtype=np.float32)
    end = _run(
        road, constants, fan, packed, layers, start, target, max_steps, car, visits, beams, ranges, scratch, ring
    )
    return (car[DISTANCE], car[PACED], car[STEPS], end), ring
