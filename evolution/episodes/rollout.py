"""Drives episodes in one fused kernel: in each step it senses, asks the network for an action, and moves the cars.

`evaluate` drives whole populations; `collect` drives one policy with some random actions and records its experience.
Results depend only on the arguments. In `collect`, an episode's experience does not depend on the other episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evolution.dqn.experience import NO_ACTION, Experience, empty, store_grid, store_rays
from evolution.episodes import comfort
from evolution.episodes.comfort import NOTES
from evolution.networks import convnet
from evolution.networks.policy import RAYS, CnnSpec, PolicySpec, decide, pack, scratch_size
from gridsim.car.reward import reward
from gridsim.config import MOST_STEPS, SimConfig
from gridsim.counter import GOLDEN, mix, uniform
from gridsim.errors import GridSimError
from gridsim.jit import ZERO, F, U, exact, freeze, leaf, njit, row_of
from gridsim.maps.map import Map
from gridsim.sensing.grid import CELLS, GridTable, fill_grid, grid_table
from gridsim.sensing.imperfections import History, new_history
from gridsim.sensing.observation import OWN_SPEED, normalise
from gridsim.state import CAR_FIELDS, DISTANCE, PACED, SPEED, START_FIELDS, TRAFFIC_FIELDS, End
from gridsim.step import look, obey, place, simulations_on, start_from, step, visit_cells

_IDLE = int(End.IDLE)

#: An episode: index of its map in a list of maps; start (`state.START_FIELDS`); target (m of new ground); time limit
#: (control steps); rewind: if above 0, `evaluate` also returns the state that many control steps before the end.
EPISODE = np.dtype(
    [("map", "<i4"), ("start", "<f4", START_FIELDS), ("target", "<f4"), ("steps", "<i4"), ("rewind", "<i4")]
)

#: The result of an episode: new ground (m), new ground at a speed within the scenario's interval (m), control steps,
#: End. Then the figures of comfort if they are asked for, else 0: mean square (m2/s4) and largest (m/s2) lateral
#: acceleration, mean square of the jerk (m2/s6, along and across), least gap to another car (m; inf without one), and
#: for how long (s) a car straight ahead was less than a second away.
RESULT = np.dtype(
    [("distance", "<f4"), ("paced", "<f4"), ("steps", "<u2"), ("end", "u1"), ("pad", "u1")]
    + [(name, "<f4") for name in ("lateral", "lateral_peak", "jerk", "gap", "close")]
)


class GridBuffers(NamedTuple):
    """Table and buffers for a policy on the occupancy grid."""

    table: GridTable
    scratch: convnet.Scratch
    grid: np.ndarray  # uint8 [cells]


Buffers = tuple[GridBuffers | None, np.ndarray | None]


def policy_buffers(spec: PolicySpec, config: SimConfig) -> Buffers:
    """A GridBuffers, or None for a policy on rays, and float32 [2] for pedal and wheel, or None for discrete actions.

    Raises: GridSimError if the policy is on rays and the sensor has another number of rays.
    """
    command = None if spec.actions == "discrete" else np.zeros(2, dtype=np.float32)
    if isinstance(spec, CnnSpec):
        grid = np.empty(CELLS * CELLS, dtype=np.uint8)
        return GridBuffers(grid_table(config), convnet.scratch(spec), grid), command
    if config.sensors.rays != RAYS:
        raise GridSimError(f"{spec} sees {RAYS} rays, the sensor has {config.sensors.rays}: set sensors.rays to {RAYS}")
    return None, command


class EpisodeSetup(NamedTuple):
    """Start and limits of an episode as kernels read them."""

    start: np.ndarray  # float32 [8]
    target: np.float32  # m
    steps: int


class Workspace(NamedTuple):
    """State and buffers of an episode; reused for the next one."""

    car: np.ndarray  # float32 [CAR_FIELDS]
    visits: np.ndarray  # float32 [visit cells], the car's odometer (m) at its latest visit
    ranges: np.ndarray  # float32 [rays]
    closing: np.ndarray  # float32 [rays], closing speeds of other cars, m/s; empty if the policy does not see them
    observation: np.ndarray  # float32 [values]
    scratch: np.ndarray  # float32, buffer of a perceptron's forward pass
    ring: np.ndarray  # float32 [n, CAR_FIELDS], the car before each of the last n steps: step k in row k % n
    world_ring: np.ndarray  # float32 [n, cars, fields], the traffic before each of these steps, in the same rows
    history: History | None  # None if nothing is imperfect
    command: np.ndarray | None  # float32 [2], pedal and wheel; None for a policy with discrete actions


@leaf
def _copy(state, kept):
    """Copy a car's state [fields], element by element: a slice assignment takes a second longer to compile."""
    for i in range(state.shape[0]):
        kept[i] = state[i]


@leaf
def _copy_world(world, kept):
    """Copy the traffic's state [cars, fields]."""
    for j in range(world.shape[0]):
        for i in range(world.shape[1]):
            kept[j, i] = world[j, i]


@leaf
def _keep(workspace, car, world, step):
    """Keep the states of car and traffic before a step in the workspace's rings."""
    _copy(car, workspace.ring[step % workspace.ring.shape[0]])
    if world is not None:
        _copy_world(world, workspace.world_ring[step % workspace.world_ring.shape[0]])


@njit
def make_workspace(simulation, layers, rows, cars, command, history):
    """A Workspace that keeps the last `rows` states of a car and of `cars` others."""
    return Workspace(
        np.empty(CAR_FIELDS, dtype=np.float32),
        np.empty(visit_cells(simulation.road), dtype=np.float32),
        np.empty(simulation.constants.rays, dtype=np.float32),
        np.zeros(simulation.encoding.first[2] - simulation.encoding.first[1], dtype=np.float32),
        np.empty(simulation.encoding.first[-1], dtype=np.float32),
        np.zeros(scratch_size(layers), dtype=np.float32),
        np.zeros((rows, CAR_FIELDS), dtype=np.float32),
        np.zeros((rows, cars, TRAFFIC_FIELDS), dtype=np.float32),
        history,
        command,
    )


@njit
def packed_genome(genome, layers, grid_buffers):
    """A genome as its network's kernel reads it."""
    return pack(genome, layers) if grid_buffers is None else genome


class Recorder(NamedTuple):
    """Where an episode's experience is written, and what decides its random actions."""

    experience: Experience  # room for one row more than the episode's time limit in steps
    epsilon: np.float32  # share of random actions, which are uniform over all actions
    key: np.uint64  # seed of the episode's random numbers


@leaf
def _observe(simulation, car, world, workspace, grid_buffers):
    """Look around, then write the network's inputs: on rays to `workspace.scratch`, else the grid to `grid_buffers`."""
    ranges, closing, observation = workspace.ranges, workspace.closing, workspace.observation
    look(simulation, car, world, ranges, closing, observation, workspace.history)
    if grid_buffers is None:
        normalise(simulation.encoding, observation, workspace.scratch)
    else:
        fill_grid(grid_buffers.table, workspace.ranges, grid_buffers.grid)


@exact
def _observed_speed(simulation, observation):
    """The speed (m/s) that a network on the grid sees: the observation's last value times its full scale."""
    return observation[observation.shape[0] - 1] * simulation.encoding.full[OWN_SPEED]


@leaf
def _record(simulation, car, workspace, grid_buffers, experience, row, gained, end):
    """Record a row's observation and, in the row before it if there is one, the reward and end of the step between.

    That step `gained` m of new ground.
    """
    observations, actions, rewards, ends = experience
    if grid_buffers is None:
        store_rays(workspace.scratch, observations[row])
    else:
        store_grid(grid_buffers.grid, _observed_speed(simulation, workspace.observation), observations[row])
    actions[row], rewards[row], ends[row] = NO_ACTION, F(0.0), 0
    if row > 0:
        k, ranges = simulation.constants, workspace.ranges
        fastest = simulation.road.speed_high
        rewards[row - 1] = reward(ranges, k.ray_range, car[SPEED], gained, end, fastest, k.dt)
        ends[row - 1] = end


@leaf
def _choose_action(simulation, packed, layers, workspace, grid_buffers, begun):
    """The action (`policy.choose`) for the latest observation; `begun` if that is the episode's first."""
    if grid_buffers is None:
        return decide(packed, layers, workspace.scratch, workspace.command)
    convnet.push(grid_buffers.grid, begun, grid_buffers.scratch)
    speed = _observed_speed(simulation, workspace.observation)
    return convnet.decide(packed, layers, speed, grid_buffers.scratch, workspace.command)


@leaf
def _explore(recorder, steps, action, actions):
    """A random action with probability epsilon, else the given one. Uses one random number a step."""
    bits = mix(mix(recorder.key) + U(steps) * GOLDEN)
    if uniform(bits) < recorder.epsilon:
        return int((bits & U(0xFFFFFFFF)) * U(actions) >> U(32))
    return action


@leaf
def _obey(constants, car, history, action, command):
    """Acceleration (m/s2) and steering (rad) of an action, or of a command (pedal and wheel); see `step.obey`."""
    if command is None:
        return obey(constants, car, history, True, F(action), ZERO)
    return obey(constants, car, history, False, command[0], command[1])


@leaf
def _drive(simulation, setup, car, workspace, world, action):
    """One control step with an action. Returns an End as a number.

    As a `leaf`, this code is inlined without counting references to arrays. Written out in `run_episode`, it would
    count them, and drives among 8 cars would be 15 % slower.
    """
    acceleration, steering = _obey(simulation.constants, car, workspace.history, action, workspace.command)
    return step(simulation, car, workspace.visits, world, acceleration, steering, setup.target, setup.steps)


@njit(nogil=True)
def run_episode(simulation, packed, layers, setup, workspace, world, grid_buffers, recorder, notes, result):
    """One episode of one car, driven by an `mlp`, or by a `cnn` if there are grid_buffers; fills a RESULT.

    Args: notes, float32 [comfort.NOTES], sum up the figures of comfort; with None the result does not get these.

    If an output of the network is NaN, the episode ends as IDLE, which is also recorded as the end of the last step, if
    there was one. `world`, the traffic, changes in place. `world`, `grid_buffers`, `recorder` and `notes` may be None.
    They are arguments, not fields of a record, because Numba prunes `is None` branches on arguments but not on fields.
    """
    car, keep = workspace.car, workspace.ring.shape[0]
    place(simulation, setup.start, car, workspace.visits)
    end, steps, before = 0, 0, F(0.0)
    if notes is not None:
        comfort.begin(car, notes)
    if keep > 0:
        _keep(workspace, car, world, 0)  # for an episode that ends before its first step because an output is NaN
    while True:
        if recorder is None and end != 0:
            break
        _observe(simulation, car, world, workspace, grid_buffers)
        if recorder is not None:
            gained = car[DISTANCE] - before
            _record(simulation, car, workspace, grid_buffers, recorder.experience, steps, gained, end)
            if end != 0:
                break
        action = _choose_action(simulation, packed, layers, workspace, grid_buffers, steps == 0)
        if action < 0:
            end = _IDLE
            if recorder is not None and steps > 0:
                recorder.experience.ends[steps - 1] = end
            break
        if recorder is not None:
            action = _explore(recorder, steps, action, layers[layers.shape[0] - 1])
            recorder.experience.actions[steps] = action
        if keep > 0:
            _keep(workspace, car, world, steps)
        before = car[DISTANCE]
        end = _drive(simulation, setup, car, workspace, world, action)
        if notes is not None:
            comfort.note(simulation.constants, simulation.road, car, world, steps, notes)
        steps += 1
    result["distance"], result["paced"] = car[DISTANCE], car[PACED]
    result["steps"], result["end"] = steps, end
    if notes is not None:
        comfort.finish(simulation.constants, steps, notes, result)


@njit(nogil=True)
def _rollout(
    simulation, genomes, layers, setup, traffic, world, grid_buffers, command, history, rewind, notes, results, rewound,
    rewound_worlds,
):  # fmt: skip
    """Drive all genomes [n, genes] through one episode with traffic [cars, fields] or None; fills results [n].

    `world` is an array for a copy of the traffic, or None. If rewind > 0, also fills rewound [n, 8] and rewound_worlds
    [n, cars, fields].
    """
    workspace = make_workspace(simulation, layers, rewind, rewound_worlds.shape[1], command, history)
    for i in range(genomes.shape[0]):
        packed = packed_genome(genomes[i], layers, grid_buffers)
        if traffic is not None:
            _copy_world(traffic, world)
        run_episode(simulation, packed, layers, setup, workspace, world, grid_buffers, None, notes, results[i])
        if rewind > 0:
            row_back = max(int(results[i]["steps"]) - rewind, 0) % rewind
            start_from(workspace.ring[row_back], rewound[i])
            if traffic is not None:
                _copy_world(workspace.world_ring[row_back], rewound_worlds[i])


@njit(nogil=True)
def _collect(
    simulation, genome, layers, which, starts, targets, steps, worlds, grid_buffers, command, history, epsilons, keys,
    experience, results,
):  # fmt: skip
    """Drive a genome through episodes `which` [k] on one map; fills their rows of experience and results.

    Args: experience [e, rows, ...]; starts, targets, steps, worlds, epsilons, keys and results [e, ...]. `worlds`, the
    traffic at the episodes' starts or None, change.
    """
    workspace = make_workspace(simulation, layers, 0, 0, command, history)
    packed = packed_genome(genome, layers, grid_buffers)
    observations, actions, rewards, ends = experience
    for k in which:
        setup = EpisodeSetup(starts[k], targets[k], steps[k])
        recorder = Recorder(Experience(observations[k], actions[k], rewards[k], ends[k]), epsilons[k], keys[k])
        run_episode(
            simulation, packed, layers, setup, workspace, row_of(worlds, k), grid_buffers, recorder, None, results[k]
        )


def _check_steps(episodes: np.ndarray) -> None:
    wrong = episodes["steps"][(episodes["steps"] < 1) | (episodes["steps"] > MOST_STEPS)]
    if len(wrong):
        raise ValueError(f"an episode has 1 to {MOST_STEPS} steps, not {wrong[0]}")


def evaluate(
    spec: PolicySpec,
    genomes: np.ndarray,
    road_maps: Sequence[Map],
    episodes: np.ndarray,
    config: SimConfig,
    worlds: np.ndarray,
    with_comfort: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive every genome through every episode.

    Args: `genomes` float32 [n, spec.size]; `road_maps`, which the episodes index; `episodes` EPISODE [e]; `worlds`, the
    traffic at their starts, float32 [e, cars, TRAFFIC_FIELDS]; `with_comfort`: results have the figures of comfort.
    Returns: (RESULT [n, e]; for the k episodes with `rewind` above 0, states `rewind` steps before their ends, or at
    the start of shorter ones, as starts float32 [n, k, 8]; the traffic then, float32 [n, k, cars, TRAFFIC_FIELDS]).
    Raises: ValueError if the genomes do not fit or a time limit is out of range.
    """
    if genomes.ndim != 2 or genomes.shape[1] != spec.size:
        raise ValueError(f"genomes of {spec} are [n, {spec.size}], not {genomes.shape}")
    _check_steps(episodes)
    buffers = policy_buffers(spec, config)
    genomes = freeze(genomes.astype(np.float32, copy=False))
    # Transposed, because the kernel fills one episode at a time.
    results = np.zeros((len(episodes), len(genomes)), dtype=RESULT)
    kept = np.cumsum(episodes["rewind"] > 0) - 1
    k = int(kept[-1]) + 1 if len(kept) else 0
    rewound = np.zeros((max(k, 1), len(genomes), START_FIELDS), dtype=np.float32)
    rewound_worlds = np.zeros((max(k, 1), len(genomes), *worlds.shape[1:]), dtype=np.float32)
    simulations = simulations_on(road_maps, config, spec.features)
    notes = np.empty(NOTES, np.float32) if with_comfort else None
    for column, episode in enumerate(episodes):
        simulation = simulations[episode["map"]]
        if config.randomise:
            simulation = simulations_on([road_maps[episode["map"]]], config, spec.features, episode["start"])[0]
        setup = EpisodeSetup(freeze(episode["start"].copy()), episode["target"], int(episode["steps"]))
        traffic = freeze(worlds[column].copy()) if worlds.shape[1] else None
        world = np.empty(worlds.shape[1:], dtype=np.float32) if worlds.shape[1] else None
        history = new_history(simulation.delays, config.sensors.rays)
        row = kept[column]
        _rollout(
            simulation, genomes, spec.layers, setup, traffic, world, *buffers, history, int(episode["rewind"]), notes,
            results[column], rewound[row], rewound_worlds[row],
        )  # fmt: skip
    return results.T.copy(), rewound[:k].swapaxes(0, 1), rewound_worlds[:k].swapaxes(0, 1)


def collect(
    spec: PolicySpec,
    weights: np.ndarray,
    road_maps: Sequence[Map],
    episodes: np.ndarray,
    epsilons: np.ndarray,
    keys: np.ndarray,
    config: SimConfig,
    worlds: np.ndarray,
) -> tuple[Experience, np.ndarray]:
    """Drive one policy (discrete actions) through every episode, some actions at random; record its experience.

    Args: as `evaluate`'s; `weights` float32 [spec.size]; `epsilons`, each episode's share of random actions, float32
    [e]; `keys`, the seed of each episode's random numbers, uint64 [e].
    Returns: (the experience, in the order of the episodes; RESULT [e]).
    Raises: ValueError if a time limit is out of range.
    """
    _check_steps(episodes)
    buffers, simulations = policy_buffers(spec, config), simulations_on(road_maps, config, spec.features)
    weights = freeze(weights.astype(np.float32, copy=False))
    setups = freeze(episodes["start"]), freeze(episodes["target"]), freeze(episodes["steps"].astype(np.int64))
    traffic = worlds.copy() if worlds.shape[1] else None
    exploration = freeze(epsilons.astype(np.float32)), freeze(keys.astype(np.uint64))
    results = np.zeros(len(episodes), dtype=RESULT)
    # Every episode has room for the rows of the longest time limit.
    experience = empty(spec, len(episodes), int(episodes["steps"].max(initial=0)) + 1)
    together = episodes["map"] if not config.randomise else np.arange(len(episodes))  # equal if they share a simulation
    for group in np.unique(together):
        which = np.flatnonzero(together == group)
        m = int(episodes["map"][which[0]])
        simulation = simulations[m]
        if config.randomise:
            simulation = simulations_on([road_maps[m]], config, spec.features, episodes["start"][group])[0]
        history = new_history(simulation.delays, config.sensors.rays)
        _collect(
            simulation, weights, spec.layers, which, *setups, traffic, *buffers, history, *exploration, experience,
            results,
        )  # fmt: skip
    driven = np.arange(experience.actions.shape[1]) <= results["steps"][:, None]
    return Experience(*(array[driven] for array in experience)), results


def trajectory(
    spec: PolicySpec,
    genome: np.ndarray,
    road_map: Map,
    start: np.ndarray,
    target: float,
    steps: int,
    config: SimConfig,
    world: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drive one genome through one episode and record all states.

    Args: as `evaluate`'s; start, target and steps as in EPISODE, world float32 [cars, TRAFFIC_FIELDS].
    Returns: (RESULT []; the car's states before each driven step and at the end, float32 [driven + 1, CAR_FIELDS]; the
    traffic at the same times, float32 [driven + 1, cars, TRAFFIC_FIELDS]).
    """
    simulation = simulations_on([road_map], config, spec.features, start)[0]
    cars = 0 if world is None else len(world)
    grid_buffers, command = policy_buffers(spec, config)
    history = new_history(simulation.delays, config.sensors.rays)
    workspace = make_workspace(simulation, spec.layers, steps + 1, cars, command, history)
    world = world.copy() if world is not None and cars else None
    result = np.zeros(1, dtype=RESULT)
    packed = packed_genome(freeze(genome), spec.layers, grid_buffers)
    setup, recorder = EpisodeSetup(freeze(start), F(target), steps), None
    run_episode(simulation, packed, spec.layers, setup, workspace, world, grid_buffers, recorder, None, result[0])
    last = int(result[0]["steps"])
    workspace.ring[last] = workspace.car
    if world is not None:
        workspace.world_ring[last] = world
    return result[0], workspace.ring[: last + 1], workspace.world_ring[: last + 1]
