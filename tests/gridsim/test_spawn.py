"""Where traffic is at the start of an episode, and what a network says about its lanes."""

import numpy as np
import pytest
from scipy import stats

from gridsim.config import SimConfig
from gridsim.maps.network import lane_length
from gridsim.maps.roads import clearances, freeze
from gridsim.maps.scenarios import HELD_OUT_SEED, REGISTRY, build
from gridsim.traffic.world import ALONG, LANE, SPEED_FACTOR, X, Y, spawn

F = np.float32
CONFIG = SimConfig()
LENGTH = CONFIG.vehicle.length
FAR = np.full(5, 1e6, dtype=F)  # a start that is near nothing


@pytest.mark.parametrize("scenario", ["seamless", "highway", "city"])
def test_cars_spawn_uniformly_over_the_lanes_outside_junctions(scenario):
    network = build(scenario, 1).network
    keys = np.arange(4000, dtype=np.uint64)
    cars = spawn(network, np.repeat(FAR[None], 4000, axis=0), 1, keys, CONFIG)[:, 0].astype(float)
    assert (cars[:, LANE] >= 0).mean() > 0.99
    cars = cars[cars[:, LANE] >= 0]
    lane = cars[:, LANE].astype(int)
    lengths = np.array([lane_length(network, k) for k in range(len(network.steps))])
    free = np.diff(network.crossing_offsets) == 0
    assert free[lane].all()
    # No part of a car is in a junction: neither its nose past the line nor its rear.
    before = np.array([not free[network.successors[k, 0]] for k in range(len(free))])
    behind = np.isin(np.arange(len(free)), network.successors[~free])
    first, last = behind * LENGTH / 2, lengths - before * (LENGTH / 2 + 0.25)
    assert (cars[:, ALONG] >= first[lane] - 1e-3).all()
    assert (cars[:, ALONG] <= last[lane] + 1e-3).all()
    counts = np.bincount(lane, minlength=len(lengths))
    expected = np.where(free, last - first, 0.0) / (last - first)[free].sum() * len(cars)
    assert stats.chisquare(counts[free], expected[free]).pvalue > 1e-3
    assert stats.kstest((cars[:, ALONG] - first[lane]) / (last - first)[lane], "uniform").pvalue > 1e-3
    assert stats.kstest(cars[:, SPEED_FACTOR], "uniform", args=(0.9, 0.3)).pvalue > 1e-3


@pytest.mark.parametrize("scenario", REGISTRY)
def test_spawned_cars_keep_their_distance(scenario):
    road_map = build(scenario, 2)
    network, rng = road_map.network, np.random.default_rng(0)
    starts = np.zeros((40, 5), dtype=F)
    starts[:, :2] = network.points[rng.integers(len(network.points), size=40)] % [network.width, network.height]
    worlds = spawn(network, starts, 12, np.arange(40, dtype=np.uint64), CONFIG).astype(float)
    for world, start in zip(worlds, starts, strict=True):
        here = world[world[:, LANE] >= 0][:, [X, Y]]
        assert len(here) >= 8
        assert np.hypot(*road_map.shortest(here - start[:2]).T).min() >= CONFIG.traffic.spawn_gap_ego - 1e-3
        for k in range(1, len(here)):
            assert np.hypot(*road_map.shortest(here[:k] - here[k]).T).min() >= CONFIG.traffic.spawn_gap - 1e-3


@pytest.mark.parametrize("name", sorted(REGISTRY))
def test_boxes_are_as_large_as_their_lanes(name):
    """What is nowhere near a lane's box is not looked for on the lane."""
    network = build(name, HELD_OUT_SEED).network
    for first, stop, (x, y, half_x, half_y) in zip(network.offsets, network.offsets[1:], network.boxes, strict=False):
        points = network.points[first:stop].astype(float)
        reach = np.abs(points - [x, y]).max(axis=0)
        assert (reach <= [half_x, half_y]).all()
        assert [half_x, half_y] == pytest.approx(reach, abs=2e-3)


def test_no_car_keeps_further_right_than_there_is_room():
    for name in ("seamless", "roundabout", "city", "curved", "highway"):
        scenario = build(name, 3)
        network, width, traffic = scenario.network, CONFIG.vehicle.width, CONFIG.traffic
        room = network.room
        first = np.setdiff1d(np.arange(len(room)), network.offsets[1:] - 1)
        along = network.points[first + 1] - network.points[first]
        along /= np.hypot(*along.T)[:, None]
        right = network.points[first] + room[first, None] * np.stack([along[:, 1], -along[:, 0]], axis=1)
        kerb = clearances(scenario.road, freeze(right.astype(F)))
        assert (room >= 0.0).all()
        assert (kerb[room[first] > 0] >= width / 2 + traffic.verge - 0.02).all()
        assert room.max() == (0.0 if name == "highway" else pytest.approx(traffic.give_way))
        # Gently, from lane to lane as well.
        steps = np.repeat(network.steps, np.diff(network.offsets))
        assert (np.abs(np.diff(room))[first] <= traffic.taper * steps[first] + 1e-4).all()
        for lane, onward in np.argwhere(network.successors >= 0):
            begin = network.offsets[network.successors[lane, onward]]
            gap = abs(room[network.offsets[lane + 1] - 1] - room[begin])
            assert gap <= traffic.taper * network.steps[lane] + 1e-4
