"""Episodes of whole populations: the fused loop sense -> network -> act -> advance, until done.

The only user of the simulator within `evolution`. Pure functions: what is returned depends on the arguments alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evolution import convnet
from evolution.policy import BLOCK, INPUTS, CnnSpec, MlpSpec, PolicySpec, decide, encode, pack, packed_size
from gridsim.config import SimConfig, constants
from gridsim.ego import (
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
from gridsim.grid import CELLS, GridTable, fill_grid, grid_table
from gridsim.jit import njit
from gridsim.roads import VISIT_CELL, freeze
from gridsim.scenarios import Scenario
from gridsim.sensors import LANES, fan
from gridsim.sides import keeps_side
from gridsim.traffic import drivers, flow
from gridsim.world import FIELDS as TRAFFIC_FIELDS

_F = np.float32

#: An episode: index of its map among the task's; x, y (m), heading (rad), speed (m/s), steering (rad) at its start;
#: its own target (m) and limit (control steps), where these are not 0.
EPISODE = np.dtype([("map", "<i4"), ("start", "<f4", 5), ("target", "<f4"), ("steps", "<i4")])

#: What comes back of an episode: new ground (m); new ground at a speed within the interval and, among traffic, on the
#: own side of the road (m); control steps; End.
RESULT = np.dtype([("distance", "<f4"), ("paced", "<f4"), ("steps", "<u2"), ("end", "u1"), ("pad", "u1")])


def raced_dtype(traffic: int) -> np.dtype:
    """RESULT with the state some steps before the end, as a start, and the traffic of then: what a race returns."""
    return np.dtype([*RESULT.descr, ("rewound", "<f4", 5), ("world", "<f4", (traffic, TRAFFIC_FIELDS))])


MAX_STEPS = 65_535


@dataclass(frozen=True)
class Limits:
    """Where an episode ends if nothing happens: m of new ground, and control steps."""

    target: float
    steps: int


class Eye(NamedTuple):
    """What a policy on the occupancy grid needs beside its genome."""

    table: GridTable
    room: convnet.Scratch
    grid: np.ndarray  # uint8 [cells]


def _eye(spec: PolicySpec, config: SimConfig) -> Eye | None:
    """None for a policy on rays. Raises: ValueError if it sees another number of them."""
    if isinstance(spec, CnnSpec):
        return Eye(grid_table(config), convnet.scratch(spec), np.empty(CELLS * CELLS, dtype=np.uint8))
    if config.sensors.rays != INPUTS - 1:
        raise ValueError(f"{spec} sees {INPUTS - 1} rays, the sensor has {config.sensors.rays}")
    return None


def _closing(spec: PolicySpec, config: SimConfig) -> np.ndarray | None:
    """Room for the motion that a policy sees, if it sees any."""
    sees = isinstance(spec, MlpSpec) and spec.motion
    return np.zeros(config.sensors.rays, dtype=np.float32) if sees else None


@njit
def _packed(genome, layers, eye):
    """A genome as its network reads it."""
    if eye is not None:
        return genome
    packed = np.empty(packed_size(layers), dtype=np.float32)
    pack(genome, layers, packed)
    return packed


@njit
def _run(
    road,
    network,
    sides,
    constants,
    drivers,
    fan,
    packed,
    layers,
    start,
    target,
    max_steps,
    car,
    visits,
    world,
    beams,
    ranges,
    closing,
    scratch,
    eye,
    ring,
    world_ring,
):
    """One episode of one car, by an `mlp` whose genome is packed, or by a `cnn` where there is an Eye.

    Returns: (End as a number, m of PACED that were not on the car's own side of the road; 0 without traffic).

    ring float32 [n, FIELDS] is left with its last n states: that of step k in row k % n.
    world_ring float32 [n, cars, fields] is the same of its world.
    """
    place(road, start, car, visits)
    keep = ring.shape[0]
    end = 0
    steps = 0
    strayed = _F(0.0)
    while end == 0:
        look(road, constants, fan, car, world, beams, ranges, closing)
        if eye is None:
            encode(ranges, closing, car[SPEED], scratch)
            action = decide(packed, layers, scratch)
        else:
            fill_grid(eye.table, ranges, eye.grid)
            convnet.push(eye.grid, steps == 0, eye.room)
            action = convnet.decide(packed, layers, car[SPEED], eye.room)
        if action < 0:  # not a number: the genome loses what is left
            end = 2
            break
        if keep > 0:
            ring[steps % keep] = car
        if world is not None:
            if keep > 0:
                world_ring[steps % keep] = world
            flow(network, drivers, world, car)
        paced = car[PACED]
        end = drive(road, constants, car, visits, world, action)
        if world is not None and not keeps_side(sides, road.width, car[X], car[Y], car[COS], car[SIN]):
            strayed += car[PACED] - paced
        steps += 1
        if end == 0:
            if car[DISTANCE] >= target:
                end = 3
            elif steps >= max_steps:
                end = 4
    return end, strayed


@njit(nogil=True)
def _rollout(
    road,
    network,
    sides,
    constants,
    drivers,
    fan,
    genomes,
    layers,
    start,
    traffic,
    target,
    max_steps,
    rewind,
    rays,
    closing,
    eye,
    results,
    column,
    rewound,
    rewound_worlds,
):
    """All genomes [n, genes] on one episode with traffic [cars, fields], or None; fills results[:, column].

    If rewind > 0 also rewound[:, column] and rewound_worlds[:, column].
    """
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car = np.empty(FIELDS, dtype=np.float32)
    visits = np.empty(cells, dtype=np.float32)
    beams = np.empty((3, LANES), dtype=np.float32)
    ranges = np.empty(rays, dtype=np.float32)
    scratch = np.zeros(2 * (layers.max() + BLOCK), dtype=np.float32)
    ring = np.zeros((rewind, FIELDS), dtype=np.float32)
    world = None
    world_ring = np.zeros((0, 0, 0), dtype=np.float32)
    if traffic is not None:
        world_ring = np.zeros((rewind, traffic.shape[0], traffic.shape[1]), dtype=np.float32)
    for i in range(genomes.shape[0]):
        packed = _packed(genomes[i], layers, eye)
        if traffic is not None:
            world = traffic.copy()
        end, strayed = _run(
            road,
            network,
            sides,
            constants,
            drivers,
            fan,
            packed,
            layers,
            start,
            target,
            max_steps,
            car,
            visits,
            world,
            beams,
            ranges,
            closing,
            scratch,
            eye,
            ring,
            world_ring,
        )
        row = results[i, column]
        row["distance"] = car[DISTANCE]
        row["paced"] = car[PACED] - strayed
        row["steps"] = car[STEPS]
        row["end"] = end
        if rewind > 0:
            row_back = max(int(car[STEPS]) - rewind, 0) % rewind
            back = ring[row_back]
            if traffic is not None:
                rewound_worlds[i, column] = world_ring[row_back]
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
    worlds: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive every genome through every episode.

    Args:
        genomes: float32 [n, spec.size].
        scenarios: the maps that the episodes index.
        episodes: EPISODE [e].
        rewind: control steps before each end whose state is wanted, 0 for none.
        worlds: the traffic that each episode begins with, float32 [e, cars, world.FIELDS]; None is no traffic.

    Returns: (RESULT [n, e], the states `rewind` steps before the ends, or at the starts of shorter episodes, as starts
    float32 [n, e, 5] and the traffic of then, float32 [n, e, cars, world.FIELDS]; empty if none are wanted).
    Raises: ValueError where shapes do not fit.
    """
    if genomes.ndim != 2 or genomes.shape[1] != spec.size:
        raise ValueError(f"genomes of {spec} are [n, {spec.size}], not {genomes.shape}")
    if not 0 < limits.steps <= MAX_STEPS:
        raise ValueError(f"an episode has 1 to {MAX_STEPS} steps, not {limits.steps}")
    eye = _eye(spec, config)
    if worlds is None:
        worlds = no_traffic(len(episodes))
    if worlds.shape[:1] + worlds.shape[2:] != (len(episodes), TRAFFIC_FIELDS):
        raise ValueError(f"the traffic of {len(episodes)} episodes is [e, cars, {TRAFFIC_FIELDS}], not {worlds.shape}")
    k, others = constants(config), drivers(config)
    rays = fan(config.sensors.rays, k.ray_first, k.ray_step)
    genomes = freeze(genomes.astype(np.float32, copy=False))
    results = np.zeros((len(genomes), len(episodes)), dtype=RESULT)
    rewound = np.zeros((len(genomes), len(episodes), 5 if rewind else 0), dtype=np.float32)
    cars = worlds.shape[1] if rewind else 0
    rewound_worlds = np.zeros((len(genomes), len(episodes), cars, TRAFFIC_FIELDS), dtype=np.float32)
    for column, episode in enumerate(episodes):
        _rollout(
            scenarios[episode["map"]].road,
            scenarios[episode["map"]].network,
            scenarios[episode["map"]].sides,
            k,
            others,
            rays,
            genomes,
            spec.layers,
            freeze(episode["start"].copy()),
            freeze(worlds[column].copy()) if worlds.shape[1] else None,
            _F(episode["target"] or limits.target),
            int(episode["steps"] or limits.steps),
            rewind,
            config.sensors.rays,
            _closing(spec, config),
            eye,
            results,
            column,
            rewound,
            rewound_worlds,
        )
    return results, rewound, rewound_worlds


def no_traffic(episodes: int) -> np.ndarray:
    """Worlds float32 [episodes, 0, fields] with nobody in them."""
    return np.zeros((episodes, 0, TRAFFIC_FIELDS), dtype=np.float32)


def trajectory(
    spec: PolicySpec,
    genome: np.ndarray,
    scenario: Scenario,
    start: np.ndarray,
    limits: Limits,
    config: SimConfig,
    world: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive one genome through one episode and keep its path.

    Args: as `evaluate`'s; start float32 [5], world float32 [cars, world.FIELDS].
    Returns: (RESULT [], states float32 [steps + 1, FIELDS] before each step and at the end, with fields as in
    `gridsim.ego`, and the traffic then, float32 [steps + 1, cars, world.FIELDS]).
    """
    k = constants(config)
    rays = fan(config.sensors.rays, k.ray_first, k.ray_step)
    result, states, worlds = _trajectory(
        scenario.road,
        scenario.network,
        scenario.sides,
        k,
        drivers(config),
        rays,
        freeze(genome),
        spec.layers,
        freeze(start),
        None if world is None or not len(world) else freeze(world.copy()),
        _F(limits.target),
        limits.steps,
        config.sensors.rays,
        _closing(spec, config),
        _eye(spec, config),
    )
    row = np.zeros((), dtype=RESULT)
    row["distance"], row["paced"], row["steps"], row["end"] = result
    return row, states[: int(row["steps"]) + 1], worlds[: int(row["steps"]) + 1]


@njit(nogil=True)
def _trajectory(
    road, network, sides, constants, drivers, fan, genome, layers, start, traffic, target, max_steps, rays, closing, eye
):
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car = np.empty(FIELDS, dtype=np.float32)
    visits = np.empty(cells, dtype=np.float32)
    beams = np.empty((3, LANES), dtype=np.float32)
    ranges = np.empty(rays, dtype=np.float32)
    scratch = np.zeros(2 * (layers.max() + BLOCK), dtype=np.float32)
    packed = _packed(genome, layers, eye)
    ring = np.zeros((max_steps + 1, FIELDS), dtype=np.float32)
    world = None if traffic is None else traffic.copy()
    cars = 0 if traffic is None else traffic.shape[0]
    world_ring = np.zeros((max_steps + 1, cars, TRAFFIC_FIELDS), dtype=np.float32)
    end, strayed = _run(
        road,
        network,
        sides,
        constants,
        drivers,
        fan,
        packed,
        layers,
        start,
        target,
        max_steps,
        car,
        visits,
        world,
        beams,
        ranges,
        closing,
        scratch,
        eye,
        ring,
        world_ring,
    )
    ring[int(car[STEPS])] = car
    if traffic is not None:
        world_ring[int(car[STEPS])] = world
    return (car[DISTANCE], car[PACED] - strayed, car[STEPS], end), ring, world_ring
