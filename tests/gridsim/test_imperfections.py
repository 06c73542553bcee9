"""Noise, dropped rays and latency: their sizes, and that drives under them are the same wherever they are driven."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from evolution.episodes.rollout import trajectory
from evolution.networks.policy import PolicySpec, act_on
from gridsim.config import SensorConfig, SimConfig, VehicleConfig
from gridsim.envs.env import GridSimEnv
from gridsim.maps.map import Map, sample_starts
from gridsim.maps.scenarios import build
from gridsim.simulator import Simulator
from gridsim.state import DISTANCE, SPEED
from gridsim.step import simulations_on
from gridsim.traffic.world import spawn

ALL = SimConfig(
    vehicle=VehicleConfig(latency=0.2),
    sensors=SensorConfig(noise=0.1, noise_share=0.02, dropout=0.05, latency=0.3),
    randomise=(
        ("lateral_grip", 3.0, 4.9),
        ("steering_rate", 40.0, 60.0),
        ("steering_limit", 20.0, 34.0),
        ("latency", 0.1, 0.3),
    ),
)


@pytest.fixture(scope="module")
def road() -> Map:
    return build("curved", 1)


def drive(config: SimConfig, road: Map, actions: np.ndarray, cars: int = 1, traffic: int = 0) -> tuple:
    """States and ranges [steps + 1, cars, ...] of a drive with actions [steps, cars]."""
    simulator = Simulator(cars, config, traffic=traffic)
    simulator.reset(road, sample_starts(road, cars, np.random.default_rng(0)))
    states, ranges = [simulator.cars.copy()], [simulator.ranges.copy()]
    for each in actions:
        simulator.step(each)
        states.append(simulator.cars.copy())
        ranges.append(simulator.ranges.copy())
    return np.array(states), np.array(ranges)


def test_noise_and_dropout_have_their_sizes(road: Map) -> None:
    actions = np.random.default_rng(1).integers(8, size=(12, 2000))
    _, true = drive(SimConfig(), road, actions, 2000)
    noisy_sim = SimConfig(sensors=SensorConfig(noise=0.1, noise_share=0.02, dropout=0.05))
    _, noisy = drive(noisy_sim, road, actions, 2000)
    moved = slice(3, None)  # all cars drive
    true, noisy = true[moved], noisy[moved]
    inside = (true > 2.0) & (true < 45.0)
    dropped = inside & (noisy == 50.0)
    assert dropped.sum() / inside.sum() == pytest.approx(0.05, abs=0.002)
    error = (noisy - true)[inside & ~dropped] / (0.1 + 0.02 * true[inside & ~dropped])
    assert error.mean() == pytest.approx(0.0, abs=0.01)
    assert error.std() == pytest.approx(1.0, abs=0.01)
    assert np.abs(error).max() < np.sqrt(12.0) + 0.01
    assert ((noisy >= 0.0) & (noisy <= 50.0)).all()
    one, next_one = error[:-1], error[1:]
    assert np.corrcoef(one, next_one)[0, 1] == pytest.approx(0.0, abs=0.02), "each reading has noise of its own"


def test_a_ray_that_drops_out_sees_no_car(road: Map) -> None:
    sim, starts = SimConfig(sensors=SensorConfig(dropout=0.5)), sample_starts(road, 50, np.random.default_rng(0))
    simulator = Simulator(50, sim, traffic=8, features=("motion",))
    simulator.reset(road, starts, worlds=spawn(road.network, starts, 8, np.arange(50, dtype=np.uint64), sim))
    simulator.step(np.zeros(50, dtype=np.int64))
    assert simulator.closing.any()
    assert not simulator.closing[simulator.ranges == 50.0].any()


def test_readings_and_commands_are_late_by_the_control_steps_of_their_latency(road: Map) -> None:
    actions = np.random.default_rng(1).choice([0, 5, 6], size=(11, 5))  # too few for a crash
    states, ranges = drive(SimConfig(), road, actions, 5)
    same, late = drive(SimConfig(sensors=SensorConfig(latency=0.3)), road, actions, 5)
    assert same.tobytes() == states.tobytes()
    assert late[3:].tobytes() == ranges[:-3].tobytes()
    assert (late[:3] == ranges[0]).all()
    coming = np.concatenate([np.full((2, 5), 4), actions[:-2]])  # first none
    assert drive(SimConfig(VehicleConfig(latency=0.2)), road, actions, 5)[0].tobytes() == (
        drive(SimConfig(), road, coming, 5)[0].tobytes()
    )
    pedals = np.random.default_rng(2).uniform(0.0, 1.0, size=(11, 5, 2)).astype(np.float32)
    none = np.concatenate([np.zeros((2, 5, 2), np.float32), pedals[:-2]])
    assert drive(SimConfig(VehicleConfig(latency=0.2)), road, pedals, 5)[0].tobytes() == (
        drive(SimConfig(), road, none, 5)[0].tobytes()
    )


@pytest.mark.parametrize("policy", ["mlp:8+steering", "mlp:8+steering+continuous"])
def test_a_network_drives_in_the_environment_as_in_training(road: Map, policy: str) -> None:
    spec, rng = PolicySpec.parse(policy), np.random.default_rng(3)
    start, steps = sample_starts(road, 1, rng)[0], 0
    while steps < 60:
        genome = rng.normal(size=spec.size).astype(np.float32)
        result, states, _ = trajectory(spec, genome, road, start, 2000.0, 300, ALL)
        steps = int(result["steps"])
    env = GridSimEnv("curved", config=ALL, steering=True, max_episode_steps=300, actions=spec.actions)
    seen, _ = env.reset(seed=0, options={"map_seed": 1, "start": start})
    for step in range(1, steps + 1):
        seen, _, terminated, _, info = env.step(act_on(spec, genome, seen, ALL))
        assert info["distance_m"] == pytest.approx(float(states[step, DISTANCE]), abs=1e-3)
        assert env.cars.simulator.cars[0].tobytes() == states[step].tobytes()
    assert terminated or steps == 300
    perfect, *_ = trajectory(spec, genome, road, start, 2000.0, 300, SimConfig())
    assert perfect["distance"] != result["distance"]


def test_vehicles_are_drawn_within_their_ranges_for_each_start(road: Map) -> None:
    starts = sample_starts(road, 200, np.random.default_rng(0))
    drawn = [ALL.drawn(start).vehicle for start in starts]
    grips = np.array([vehicle.lateral_grip for vehicle in drawn])
    assert grips.min() >= 3.0
    assert grips.max() <= 4.9
    assert grips.std() > 0.4
    assert ALL.drawn(starts[7]) == ALL.drawn(starts[7].copy())
    simulator = Simulator(200, replace(SimConfig(), randomise=(("acceleration", 1.0, 3.0),)))
    simulator.reset(road, starts)
    simulator.step(np.zeros(200, dtype=np.int64))
    copy = deepcopy(simulator)
    copy.step(np.zeros(200, dtype=np.int64))
    wanted = [simulator.config.drawn(start).vehicle.acceleration for start in starts]
    np.testing.assert_allclose(simulator.cars[:, SPEED], 0.1 * np.array(wanted), rtol=1e-5)
    np.testing.assert_allclose(copy.cars[:, SPEED], 0.2 * np.array(wanted), rtol=1e-5)


def test_all_episodes_have_delays_if_the_latency_is_drawn(road: Map) -> None:
    """Else kernels would be compiled once more, by the first episode of the other kind."""
    sim = replace(SimConfig(), randomise=(("latency", 0.0, 0.2),))
    starts = [None, *sample_starts(road, 30, np.random.default_rng(0))]
    delays = [simulations_on([road], sim, (), start)[0].delays for start in starts]
    assert None not in delays
    assert {each.commands for each in delays if each} == {0, 1, 2}


def test_imperfections_of_any_kind_have_the_same_kernels(road: Map) -> None:
    alone = SensorConfig(noise=0.1), SensorConfig(noise_share=0.1), SensorConfig(dropout=0.1), SensorConfig(latency=0.1)
    for sim in (SimConfig(VehicleConfig(latency=0.2)), *(SimConfig(sensors=each) for each in alone)):
        simulation = simulations_on([road], sim)[0]
        assert None not in (simulation.imperfections, simulation.delays), sim
    perfect = simulations_on([road], SimConfig())[0]
    assert (perfect.imperfections, perfect.delays) == (None, None)


@pytest.mark.parametrize(
    ("randomise", "said"),
    [
        ((("wings", 1.0, 2.0),), "unknown key randomise.'wings'"),
        ((("model", 1.0, 2.0),), "unknown key randomise.'model'"),
        ((("width", 2.0, 1.0),), "randomise.width must be least and most, not 2 and 1"),
        ((("width", 0.0, 1.0),), "randomise.width must be "),
        ((("lateral_grip", 4.9, np.inf),), "randomise.lateral_grip must be least and most, not 4.9 and inf"),
        ((("rear_axle", 1.2, 2.0), ("wheelbase", 1.8, 3.0)), "rear_axle must be below vehicle.wheelbase, 1.8 m"),
        ((("width", 1.6, 2.0), ("length", 1.0, 4.0)), "randomise.length: roads are not scaled for cars of 1 m"),
    ],
)
def test_wrong_ranges_are_refused(randomise: tuple, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Simulator(1, replace(SimConfig(), randomise=randomise))


def test_ranges_need_only_fit_each_other() -> None:
    replace(SimConfig(), randomise=(("rear_axle", 2.6, 2.8), ("wheelbase", 3.0, 3.2))).check()


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("sensors", "noise", -0.1), ("sensors", "noise_share", np.nan), ("sensors", "dropout", 1.5),
        ("sensors", "latency", 3.0), ("vehicle", "latency", -0.1),
    ],
)  # fmt: skip
def test_wrong_numbers_are_refused(part: str, name: str, value: float) -> None:
    config = replace(SimConfig(), **{part: replace(getattr(SimConfig(), part), **{name: value})})
    with pytest.raises(ValueError, match=rf"^{part}.{name} must be "):
        Simulator(1, config).reset(build("curved", 1), np.zeros((1, 5)))
