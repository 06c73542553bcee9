"""Traffic that a caller gives: what the simulator itself comes to is taken, what kernels cannot read is refused."""

import math

import numpy as np
import pytest
from pictures import picture, save

from gridsim.car.vehicle import Action
from gridsim.config import SimConfig
from gridsim.envs.simulator import Simulator
from gridsim.maps.files import load_map
from gridsim.maps.map import sample_starts
from gridsim.maps.network import lane_length
from gridsim.maps.scenarios import REGISTRY, build
from gridsim.traffic.behaviour import drivers, flow
from gridsim.traffic.world import (
    ALONG,
    DRAWS,
    FIELDS,
    JUNCTION_BEHIND,
    LANE,
    NEXT,
    PERMIT,
    SECOND_NEXT,
    SEED,
    SPEED,
    SPEED_FACTOR,
    check_worlds,
    spawn,
)

F = np.float32
CONFIG = SimConfig()
NOBODY = np.zeros(14, dtype=F)  # an ego car that is not there
FAR = np.full((1, 5), 1e6, dtype=F)  # a start that is near nothing
LANES, LENGTH = "lanes", "length"  # of the map, and m of the car's lane


@pytest.mark.parametrize("name", REGISTRY)
def test_what_traffic_comes_to_is_taken(name):
    """Forty seconds of a crowd, some of whom find no room."""
    network = build(name, 3).network
    world = spawn(network, FAR, 150, np.array([4], dtype=np.uint64), CONFIG)[0]
    assert (world[:, LANE] >= 0).sum() > 20
    for _ in range(400):
        check_worlds(world, network)
        check_worlds(world)
        flow(network, drivers(CONFIG), world, NOBODY)
    assert (world[:, DRAWS] > 4).any()


@pytest.fixture(scope="module")
def maps_with_traffic():
    """(scenarios, starts, worlds): four cars on two maps of one kind."""
    scenarios = [build("city", seed) for seed in (3, 5)]
    rng = np.random.default_rng(0)
    starts = np.concatenate([sample_starts(scenarios[k % 2], 1, rng) for k in range(4)])
    keys = np.arange(4, dtype=np.uint64)
    worlds = np.concatenate(
        [spawn(scenarios[k % 2].network, starts[k : k + 1], 3, keys[k : k + 1], CONFIG) for k in range(4)]
    )
    assert (worlds[..., LANE] >= 0).all()
    return scenarios, starts, worlds


WRONG = [
    (LANE, -2.0, "LANE must be a whole number from 0"),
    (LANE, 0.5, "LANE must be a whole number from 0"),
    (NEXT, LANES, "NEXT must be a whole number from 0"),
    (SECOND_NEXT, -1.0, "SECOND_NEXT must be a whole number from 0"),
    (JUNCTION_BEHIND, -2.0, "JUNCTION_BEHIND must be a whole number from -1"),
    (PERMIT, LANES, "PERMIT must be a whole number from -1"),
    (ALONG, -0.01, "ALONG"),
    (ALONG, LENGTH, "ALONG"),
    (SPEED, 1e9, "SPEED"),
    (SEED, -1.0, "SEED"),
    (DRAWS, 2.5, "DRAWS"),
    (SPEED_FACTOR, math.nan, "finite"),
]


@pytest.mark.parametrize(("field", "number", "text"), WRONG)
def test_traffic_that_kernels_cannot_read_is_refused(maps_with_traffic, field, number, text):
    """And then nothing has changed, though all cars were to be on another map."""
    scenarios, starts, worlds = maps_with_traffic
    here, twin = (Simulator(scenarios, 4, CONFIG, traffic=3) for _ in range(2))
    for simulator in (here, twin):
        simulator.reset(starts[::2].repeat(2, axis=0), 0, worlds=worlds[::2].repeat(2, axis=0))
    wrong = worlds[1::2].repeat(2, axis=0)
    network, car = scenarios[1].network, wrong[2, 1]
    known = {LANES: len(network.steps), LENGTH: lane_length(network, int(car[LANE])) + F(0.01)}
    car[field] = known.get(number, number)
    with pytest.raises(ValueError, match=text) as error:
        here.reset(starts[1::2].repeat(2, axis=0), 1, worlds=wrong)
    assert "\n" not in str(error.value)
    for each in (here, twin):
        each.step(np.full(4, Action.ACCELERATE))
    for ours, theirs in zip(here.state, twin.state, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_each_world_is_held_against_its_own_map(maps_with_traffic):
    scenarios, starts, worlds = maps_with_traffic
    fewer, more = sorted(range(2), key=lambda m: len(scenarios[m].network.steps))
    count = len(scenarios[fewer].network.steps)
    assert count < len(scenarios[more].network.steps)
    last = worlds.copy()
    last[more::2, :, NEXT] = count
    simulator = Simulator(scenarios, 4, CONFIG, traffic=3)
    simulator.reset(starts, np.arange(4) % 2, worlds=last)
    last[fewer, 0, NEXT] = count
    with pytest.raises(ValueError, match=f"NEXT must be a whole number from 0 to {count - 1}, not {count}"):
        simulator.reset(starts, np.arange(4) % 2, worlds=last)


def test_who_is_not_there_may_be_anywhere(maps_with_traffic, tmp_path):
    scenarios, starts, _ = maps_with_traffic
    absent = np.full((4, 3, FIELDS), 1e9, dtype=F)
    absent[..., LANE] = -1.0
    Simulator(scenarios, 4, CONFIG, traffic=3).reset(starts, worlds=absent)
    drawn = load_map(save(tmp_path / "track.png", picture()))  # a map without lanes
    simulator = Simulator([drawn], 1, CONFIG, traffic=3)
    simulator.reset(drawn.starts[:1], worlds=absent[:1])
    absent[0, 0] = 0.0
    with pytest.raises(ValueError, match="no lanes for traffic"):
        simulator.reset(drawn.starts[:1], worlds=absent[:1])
