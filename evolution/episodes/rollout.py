"""Drives the episodes of whole populations in one fused kernel: sense, network, act, advance until the end.

`collecting` has the same loop with a recorder and shares its parts. These two are the only users of the simulator in
`evolution`. Results depend only on the arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evolution.networks import convnet
from evolution.networks.policy import (
    RAYS,
    CnnSpec,
    MlpSpec,
    PolicySpec,
    decide,
    encode,
    pack,
    packed_size,
    scratch_size,
)
from gridsim.car.ego import (
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
from gridsim.config import Constants, SimConfig, constants
from gridsim.jit import leaf, njit
from gridsim.maps.map import Map
from gridsim.maps.network import Network
from gridsim.maps.roads import VISIT_CELL, Road, freeze
from gridsim.sensing.grid import CELLS, GridTable, fill_grid, grid_table
from gridsim.sensing.rays import SIMD_RAYS, fan
from gridsim.traffic.behaviour import Drivers, drivers, flow
from gridsim.traffic.world import FIELDS as TRAFFIC_FIELDS

_F = np.float32

#: An episode: index of its map in the task; x, y (m), heading (rad), speed (m/s), steering (rad) at its start; its
#: target (m) and time limit (control steps), or 0 for those of `Limits`; rewind: return the state so many control steps
#: before the end, or 0 for none.
EPISODE = np.dtype([("map", "<i4"), ("start", "<f4", 5), ("target", "<f4"), ("steps", "<i4"), ("rewind", "<i4")])

#: The result of an episode: new ground (m), new ground at a speed within the interval (m), control steps, End.
RESULT = np.dtype([("distance", "<f4"), ("paced", "<f4"), ("steps", "<u2"), ("end", "u1"), ("pad", "u1")])


MAX_STEPS = 65_535


@dataclass(frozen=True)
class Limits:
    """Target (m of new ground) and time limit (control steps) of episodes."""

    target: float
    steps: int


class GridBuffers(NamedTuple):
    """Table and buffers for a policy on the occupancy grid."""

    table: GridTable
    scratch: convnet.Scratch
    grid: np.ndarray  # uint8 [cells]


def make_grid_buffers(spec: PolicySpec, config: SimConfig) -> GridBuffers | None:
    """GridBuffers, or None for a policy on rays. Raises: ValueError if the sensor has a wrong number of rays."""
    if isinstance(spec, CnnSpec):
        return GridBuffers(grid_table(config), convnet.scratch(spec), np.empty(CELLS * CELLS, dtype=np.uint8))
    if config.sensors.rays != RAYS:
        raise ValueError(f"{spec} sees {RAYS} rays, the sensor has {config.sensors.rays}")
    return None


def make_closing(spec: PolicySpec, config: SimConfig) -> np.ndarray | None:
    """A buffer for closing speeds, float32 [rays], or None if the policy does not see them."""
    sees = isinstance(spec, MlpSpec) and spec.motion
    return np.zeros(config.sensors.rays, dtype=np.float32) if sees else None


class Simulation(NamedTuple):
    """A map and the simulator's parameters as kernels read them."""

    road: Road
    network: Network
    constants: Constants
    drivers: Drivers
    fan: np.ndarray
    rays: int


def simulations_on(road_maps: Sequence[Map], config: SimConfig) -> list[Simulation]:
    """A Simulation for each map."""
    k, others = constants(config), drivers(config)
    rays = fan(config.sensors.rays, k.ray_first, k.ray_step)
    return [Simulation(s.road, s.network, k, others, rays, config.sensors.rays) for s in road_maps]


class EpisodeSetup(NamedTuple):
    """Start and limits of an episode as kernels read them."""

    start: np.ndarray  # float32 [5]
    target: np.float32  # m
    steps: int


class Workspace(NamedTuple):
    """State and buffers of an episode; reused for the next one."""

    car: np.ndarray  # float32 [FIELDS]
    visits: np.ndarray  # float32 [cells]
    beams: np.ndarray  # float32 [3, SIMD_RAYS]
    ranges: np.ndarray  # float32 [rays]
    scratch: np.ndarray  # float32, of the network
    ring: np.ndarray  # float32 [n, FIELDS], the last n states: that of step k in row k % n
    world_ring: np.ndarray  # float32 [n, cars, fields], the same of the world


@leaf
def _copy(state, kept):
    """Copy a car's state [fields], element by element: a slice assignment takes a second longer to compile."""
    for i in range(state.shape[0]):
        kept[i] = state[i]


@leaf
def _copy_world(world, kept):
    """Copy a world [cars, fields]."""
    for j in range(world.shape[0]):
        for i in range(world.shape[1]):
            kept[j, i] = world[j, i]


@njit
def make_workspace(simulation, layers, rows, cars):
    """A Workspace that keeps the last `rows` states of a car and of `cars` others."""
    road = simulation.road
    return Workspace(
        np.empty(FIELDS, dtype=np.float32),
        np.empty(int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL), dtype=np.float32),
        np.empty((3, SIMD_RAYS), dtype=np.float32),
        np.empty(simulation.rays, dtype=np.float32),
        np.zeros(scratch_size(layers), dtype=np.float32),
        np.zeros((rows, FIELDS), dtype=np.float32),
        np.zeros((rows, cars, TRAFFIC_FIELDS), dtype=np.float32),
    )


@njit
def packed_genome(genome, layers, grid_buffers):
    """A genome as its network's kernel reads it."""
    if grid_buffers is not None:
        return genome
    packed = np.empty(packed_size(layers), dtype=np.float32)
    pack(genome, layers, packed)
    return packed


@leaf
def observe(simulation, car, world, workspace, closing, grid_buffers):
    """Compute a car's ranges, then the network's inputs in `workspace.scratch`, or `grid_buffers.grid`."""
    look(simulation.road, simulation.constants, simulation.fan, car, world, workspace.beams, workspace.ranges, closing)
    if grid_buffers is None:
        encode(workspace.ranges, closing, car[SPEED], car[STEERING], workspace.scratch)
    else:
        fill_grid(grid_buffers.table, workspace.ranges, grid_buffers.grid)


@leaf
def choose_action(packed, layers, car, workspace, grid_buffers, begun):
    """Index of the action for the observation, which is overwritten; -1 if an output is NaN."""
    if grid_buffers is None:
        return decide(packed, layers, workspace.scratch)
    convnet.push(grid_buffers.grid, begun, grid_buffers.scratch)
    return convnet.decide(packed, layers, car[SPEED], grid_buffers.scratch)


@leaf
def control_step(simulation, setup, car, visits, world, action, steps):
    """One control step of the car and its world, after `steps` steps of the episode. Returns: End as a number."""
    if world is not None:
        flow(simulation.network, simulation.drivers, world, car)
    end = drive(simulation.road, simulation.constants, car, visits, world, action)
    if end == 0:
        if car[DISTANCE] >= setup.target:
            return 3
        if steps + 1 >= setup.steps:
            return 4
    return end


@njit
def _run(simulation, packed, layers, setup, workspace, world, closing, grid_buffers):
    """One episode of one car, driven by an `mlp`, or by a `cnn` if there are grid_buffers.

    What may be None is a separate argument, because Numba removes dead branches only for arguments.

    Returns: End as a number.
    """
    car = workspace.car
    place(simulation.road, setup.start, car, workspace.visits)
    keep = workspace.ring.shape[0]
    end = 0
    steps = 0
    while end == 0:
        observe(simulation, car, world, workspace, closing, grid_buffers)
        action = choose_action(packed, layers, car, workspace, grid_buffers, steps == 0)
        if action < 0:  # NaN: the episode ends
            end = 2
            break
        if keep > 0:
            _copy(car, workspace.ring[steps % keep])
            if world is not None:
                _copy_world(world, workspace.world_ring[steps % keep])
        end = control_step(simulation, setup, car, workspace.visits, world, action, steps)
        steps += 1
    return end


@leaf
def write_result(car, end, row):
    """Fill a RESULT."""
    row["distance"] = car[DISTANCE]
    row["paced"] = car[PACED]
    row["steps"] = car[STEPS]
    row["end"] = end


@njit(nogil=True)
def _rollout(
    simulation, genomes, layers, setup, traffic, closing, grid_buffers, rewind, results, rewound, rewound_worlds
):
    """Drive all genomes [n, genes] through one episode with traffic [cars, fields] or None; fills results [n].

    If rewind > 0, also fills rewound [n, 5] and rewound_worlds [n, cars, fields].
    """
    workspace = make_workspace(simulation, layers, rewind, 0 if traffic is None else traffic.shape[0])
    car = workspace.car
    for i in range(genomes.shape[0]):
        packed = packed_genome(genomes[i], layers, grid_buffers)
        world = None if traffic is None else traffic.copy()
        end = _run(simulation, packed, layers, setup, workspace, world, closing, grid_buffers)
        write_result(car, end, results[i])
        if rewind > 0:
            row_back = max(int(car[STEPS]) - rewind, 0) % rewind
            back = workspace.ring[row_back]
            if traffic is not None:
                _copy_world(workspace.world_ring[row_back], rewound_worlds[i])
            rewound[i, 0] = back[X]
            rewound[i, 1] = back[Y]
            rewound[i, 2] = math.atan2(back[SIN], back[COS])
            rewound[i, 3] = back[SPEED]
            rewound[i, 4] = back[STEERING]


def episode_setup(episode: np.void, limits: Limits) -> EpisodeSetup:
    """The EpisodeSetup of an EPISODE, with `limits` as defaults."""
    target, steps = episode["target"] or limits.target, episode["steps"] or limits.steps
    return EpisodeSetup(freeze(episode["start"].copy()), _F(target), int(steps))


def targets(episodes: np.ndarray, limits: Limits) -> np.ndarray:
    """Target (m) of each episode: float64 [e]."""
    return np.where(episodes["target"] > 0, episodes["target"], limits.target).astype(np.float64)


def checked_worlds(episodes: np.ndarray, limits: Limits, worlds: np.ndarray | None) -> np.ndarray:
    """The traffic float32 [e, cars, world.FIELDS] of episodes; None becomes traffic without cars.

    Raises: ValueError if its shape does not fit or the time limit is out of range.
    """
    if not 0 < limits.steps <= MAX_STEPS:
        raise ValueError(f"an episode has 1 to {MAX_STEPS} steps, not {limits.steps}")
    if worlds is None:
        worlds = no_traffic(len(episodes))
    if worlds.shape[:1] + worlds.shape[2:] != (len(episodes), TRAFFIC_FIELDS):
        raise ValueError(f"the traffic of {len(episodes)} episodes is [e, cars, {TRAFFIC_FIELDS}], not {worlds.shape}")
    return worlds


def kernel_world(worlds: np.ndarray, k: int) -> np.ndarray | None:
    """Worlds[k] for kernels: read-only, or None without cars."""
    return freeze(worlds[k].copy()) if worlds.shape[1] else None


def evaluate(
    spec: PolicySpec,
    genomes: np.ndarray,
    road_maps: Sequence[Map],
    episodes: np.ndarray,
    limits: Limits,
    config: SimConfig,
    worlds: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive every genome through every episode.

    Args:
        genomes: float32 [n, spec.size].
        road_maps: the maps that the episodes index.
        episodes: EPISODE [e].
        worlds: the traffic that each episode begins with, float32 [e, cars, world.FIELDS]; None is no traffic.

    Returns: (RESULT [n, e]; for the k episodes with a `rewind`, the states so many steps before their ends, or at the
    start of shorter ones, as starts float32 [n, k, 5]; and the traffic then, float32 [n, k, cars, world.FIELDS]).
    Raises: ValueError if shapes do not fit.
    """
    if genomes.ndim != 2 or genomes.shape[1] != spec.size:
        raise ValueError(f"genomes of {spec} are [n, {spec.size}], not {genomes.shape}")
    grid_buffers, worlds = make_grid_buffers(spec, config), checked_worlds(episodes, limits, worlds)
    genomes = freeze(genomes.astype(np.float32, copy=False))
    # Transposed, because the kernel fills one episode at a time.
    results = np.zeros((len(episodes), len(genomes)), dtype=RESULT)
    kept = np.cumsum(episodes["rewind"] > 0) - 1
    k = int(kept[-1]) + 1 if len(kept) else 0
    rewound = np.zeros((max(k, 1), len(genomes), 5), dtype=np.float32)
    rewound_worlds = np.zeros((max(k, 1), len(genomes), *worlds.shape[1:]), dtype=np.float32)
    simulations = simulations_on(road_maps, config)
    for column, episode in enumerate(episodes):
        _rollout(
            simulations[episode["map"]],
            genomes,
            spec.layers,
            episode_setup(episode, limits),
            kernel_world(worlds, column),
            make_closing(spec, config),
            grid_buffers,
            int(episode["rewind"]),
            results[column],
            rewound[kept[column]],
            rewound_worlds[kept[column]],
        )
    return results.T.copy(), rewound[:k].swapaxes(0, 1), rewound_worlds[:k].swapaxes(0, 1)


def no_traffic(episodes: int) -> np.ndarray:
    """Worlds float32 [episodes, 0, fields] without cars."""
    return np.zeros((episodes, 0, TRAFFIC_FIELDS), dtype=np.float32)


def trajectory(
    spec: PolicySpec,
    genome: np.ndarray,
    road_map: Map,
    start: np.ndarray,
    limits: Limits,
    config: SimConfig,
    world: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive one genome through one episode and record all states.

    Args: as `evaluate`'s; start float32 [5], world float32 [cars, world.FIELDS].
    Returns: (RESULT [], states float32 [steps + 1, FIELDS] before each step and at the end, with fields as in
    `gridsim.car.ego`, and the traffic at these times, float32 [steps + 1, cars, world.FIELDS]).
    """
    result, states, worlds = _trajectory(
        simulations_on([road_map], config)[0],
        freeze(genome),
        spec.layers,
        EpisodeSetup(freeze(start), _F(limits.target), limits.steps),
        None if world is None or not len(world) else freeze(world.copy()),
        make_closing(spec, config),
        make_grid_buffers(spec, config),
    )
    row = np.zeros((), dtype=RESULT)
    row["distance"], row["paced"], row["steps"], row["end"] = result
    return row, states[: int(row["steps"]) + 1], worlds[: int(row["steps"]) + 1]


@njit(nogil=True)
def _trajectory(simulation, genome, layers, setup, traffic, closing, grid_buffers):
    workspace = make_workspace(simulation, layers, setup.steps + 1, 0 if traffic is None else traffic.shape[0])
    car = workspace.car
    world = None if traffic is None else traffic.copy()
    end = _run(
        simulation, packed_genome(genome, layers, grid_buffers), layers, setup, workspace, world, closing, grid_buffers
    )
    _copy(car, workspace.ring[int(car[STEPS])])
    if traffic is not None:
        _copy_world(world, workspace.world_ring[int(car[STEPS])])
    return (car[DISTANCE], car[PACED], car[STEPS], end), workspace.ring, workspace.world_ring
