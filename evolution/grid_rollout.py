"""Episodes of `cnn` policies: sense -> occupancy grid -> network -> act -> advance, until done.

What `rollout.evaluate` and `rollout.trajectory` do for a policy that sees the grid; the same episodes, limits, results.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from evolution.convnet import decide, push, scratch
from evolution.policy import CnnSpec
from evolution.rollout import RESULT, Limits
from gridsim.config import SimConfig, constants
from gridsim.grid import CELLS, fill_grid, grid_table
from gridsim.jit import njit
from gridsim.roads import VISIT_CELL, freeze
from gridsim.scenarios import Scenario
from gridsim.sensors import LANES, fan
from gridsim.simulator import COS, DISTANCE, FIELDS, PACED, SIN, SPEED, STEERING, STEPS, X, Y, drive, look, place

_F = np.float32


@njit
def _run(
    road, constants, fan, table, genome, layers, start, target, max_steps, car, visits, beams, ranges, grid, room, ring
):
    """One episode of one car. ring float32 [n, FIELDS] is left with its last n states: that of step k in row k % n."""
    place(road, start, car, visits)
    keep = ring.shape[0]
    end = 0
    steps = 0
    while end == 0:
        look(road, constants, fan, car, beams, ranges)
        fill_grid(table, ranges, grid)
        push(grid, steps == 0, room)
        action = decide(genome, layers, car[SPEED], room)
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
def _rollout(
    road, constants, fan, table, genomes, layers, start, target, max_steps, rewind, room, results, column, rewound
):
    """All genomes [n, genes] on one episode; fills results[:, column] and, if rewind > 0, rewound[:, column]."""
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car = np.empty(FIELDS, dtype=np.float32)
    visits = np.empty(cells, dtype=np.float32)
    beams = np.empty((3, LANES), dtype=np.float32)
    ranges = np.empty(table.first.shape[0] - 1, dtype=np.float32)
    grid = np.empty(CELLS * CELLS, dtype=np.uint8)
    ring = np.zeros((rewind, FIELDS), dtype=np.float32)
    for i in range(genomes.shape[0]):
        end = _run(
            road, constants, fan, table, genomes[i], layers, start, target, max_steps, car, visits, beams, ranges,
            grid, room, ring,
        )  # fmt: skip
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


def evaluate(
    spec: CnnSpec,
    genomes: np.ndarray,
    scenarios: Sequence[Scenario],
    episodes: np.ndarray,
    limits: Limits,
    config: SimConfig,
    rewind: int,
) -> tuple[np.ndarray, np.ndarray]:
    """As `rollout.evaluate`, which checks the arguments."""
    k = constants(config)
    rays, table, room = fan(config.sensors.rays, k.ray_first, k.ray_step), grid_table(config), scratch(spec)
    genomes = freeze(genomes.astype(np.float32, copy=False))
    results = np.zeros((len(genomes), len(episodes)), dtype=RESULT)
    rewound = np.zeros((len(genomes), len(episodes), 5 if rewind else 0), dtype=np.float32)
    for column, episode in enumerate(episodes):
        _rollout(
            scenarios[episode["map"]].road,
            k,
            rays,
            table,
            genomes,
            spec.layers,
            freeze(episode["start"].copy()),
            _F(episode["target"] or limits.target),
            int(episode["steps"] or limits.steps),
            rewind,
            room,
            results,
            column,
            rewound,
        )
    return results, rewound


def trajectory(
    spec: CnnSpec, genome: np.ndarray, scenario: Scenario, start: np.ndarray, limits: Limits, config: SimConfig
) -> tuple[np.ndarray, np.ndarray]:
    """As `rollout.trajectory`."""
    k = constants(config)
    rays, table, room = fan(config.sensors.rays, k.ray_first, k.ray_step), grid_table(config), scratch(spec)
    result, states = _trajectory(
        scenario.road, k, rays, table, freeze(genome), spec.layers, freeze(start), _F(limits.target), limits.steps, room
    )
    row = np.zeros((), dtype=RESULT)
    row["distance"], row["paced"], row["steps"], row["end"] = result
    return row, states[: int(row["steps"])]


@njit(nogil=True)
def _trajectory(road, constants, fan, table, genome, layers, start, target, max_steps, room):
    cells = int(road.width) // VISIT_CELL * (int(road.height) // VISIT_CELL)
    car = np.empty(FIELDS, dtype=np.float32)
    visits = np.empty(cells, dtype=np.float32)
    beams = np.empty((3, LANES), dtype=np.float32)
    ranges = np.empty(table.first.shape[0] - 1, dtype=np.float32)
    grid = np.empty(CELLS * CELLS, dtype=np.uint8)
    ring = np.zeros((max_steps, FIELDS), dtype=np.float32)
    end = _run(
        road, constants, fan, table, genome, layers, start, target, max_steps, car, visits, beams, ranges, grid, room,
        ring,
    )  # fmt: skip
    return (car[DISTANCE], car[PACED], car[STEPS], end), ring
