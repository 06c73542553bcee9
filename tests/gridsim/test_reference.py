"""The reference driver and its profile: closed forms on a straight and a circle, and drives on every scenario."""

import math
from dataclasses import replace

import numpy as np
import pytest

from evolution.episodes.starts import lane_starts
from gridsim.car.ego import DISTANCE, STEPS, End
from gridsim.config import TrafficConfig
from gridsim.maps.lanes import Path, lay_lanes, strips_along
from gridsim.maps.map import Map, sample_starts
from gridsim.maps.network import make_network
from gridsim.maps.roads import Lanes, clearance_nodes, freeze, make_road
from gridsim.maps.scenarios import HELD_OUT_SEED, REGISTRY, build
from gridsim.reference.driver import drive_reference
from gridsim.reference.routes import ACCELERATION, BRAKING, LATERAL, locate, plan, profile, top_speed
from gridsim.traffic.world import ALONG, COS, FIELDS, JUNCTION_BEHIND, LANE, PERMIT, SPEED_FACTOR, X, Y

INTERVAL = (5.0, 12.0)
TOP = top_speed(INTERVAL)
TRAFFIC = {"seamless": 6, "curved": 6}
NOBODY = np.zeros((0, FIELDS), dtype=np.float32)
START = np.array([10.0, 32.0, 0.0, 0.0, 0.0], dtype=np.float32)


def on_path(path: Path, width: float, height: float) -> Map:
    """A map of one lane, 8 m wide."""
    strips = strips_along(path, 4.0)
    lanes = lay_lanes([path], width, height)
    lanes = Lanes(**{name: freeze(array) for name, array in vars(lanes).items()})
    return Map(
        name="one lane",
        seed=0,
        road=make_road(clearance_nodes(strips, width, height), INTERVAL, 50.0),
        lanes=lanes,
        strips=strips,
        network=make_network(lanes, width, height, 8.0, TrafficConfig()),
    )


@pytest.fixture(scope="module")
def straight():
    return on_path(Path(0.0, 32.0, 0.0, ((512.0, 0.0),)), 512.0, 64.0)


@pytest.fixture(scope="module")
def seamless():
    return build("seamless", HELD_OUT_SEED)


def lateral(drive, scenario):
    """M to the left of the route, at each step of a drive."""
    sides = np.array([scenario.road.width, scenario.road.height])
    points, arc = drive.route.points.astype(float), drive.route.arc
    k = np.clip(np.searchsorted(arc, drive.arc) - 1, 0, len(arc) - 2)
    along = points[k + 1] - points[k]
    away = drive.poses[:, :2] - points[k]
    away -= np.round(away / sides) * sides
    return (along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]) / np.hypot(*along.T)


def test_straight_road_is_driven_straight_at_the_speed_it_should(straight):
    drive = drive_reference(straight, START, NOBODY, 0, max_steps=300)
    steady, speed = drive.arc > drive.arc[0] + 40.0, drive.poses[:, 3]
    assert steady.sum() > 200
    assert np.abs(speed[steady] - TOP).max() < 0.3
    assert np.abs(lateral(drive, straight)).max() < 0.1
    assert speed[20] == pytest.approx(20 * 0.3, abs=1e-4)  # flat out from rest
    beside = START + np.array([0, 1.5, 0.1, 0, 0], dtype=np.float32)
    off = lateral(drive_reference(straight, beside, NOBODY, 0, max_steps=200), straight)
    assert off[0] == pytest.approx(1.5, abs=1e-3)
    assert np.abs(off[100:]).max() < 0.1


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_circle_is_driven_at_the_lateral_acceleration_it_should(side):
    radius = 20.0
    ring = on_path(Path(64.0, 64.0 - side * radius, 0.0, ((2 * math.pi * radius, side / radius),)), 128.0, 128.0)
    start = np.array([64.0, 64.0 - side * radius, 0.0, 0.0, 0.0], dtype=np.float32)
    drive = drive_reference(ring, start, NOBODY, 0, target=110.0)
    steady = slice(40, None)
    assert drive.end == End.SUCCESS
    assert np.abs(drive.poses[steady, 3] - math.sqrt(LATERAL * radius)).max() < 0.35
    assert np.abs(lateral(drive, ring)[steady]).max() < 0.25
    slip = math.asin(1.25 / radius)
    assert np.mean(drive.poses[steady, 4]) == pytest.approx(side * math.atan(2.0 * math.tan(slip)), abs=0.04)


def test_profile_of_a_straight_is_flat_out_and_then_steady():
    points = np.stack([np.linspace(0.0, 200.0, 401), np.full(401, 3.0)], axis=1)
    found = profile(points, INTERVAL)
    assert found.speed[[0, 6, 20, 200]] == pytest.approx([0.0, math.sqrt(18.0), math.sqrt(60.0), TOP], rel=1e-6)
    assert found.steering == pytest.approx(0.0, abs=1e-12)
    assert profile(points, INTERVAL, start_speed=TOP).speed[0] == pytest.approx(TOP)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_profile_of_a_circle_is_the_bicycles(side):
    angle = np.linspace(0.0, 3.0, 500)
    points = 15.0 * np.stack([np.sin(angle), side * (1.0 - np.cos(angle))], axis=1)
    found = profile(points, INTERVAL, start_speed=30.0)
    inside = slice(1, -1)
    assert found.speed[inside] == pytest.approx(math.sqrt(LATERAL * 15.0), rel=2e-3)
    slip = math.asin(1.25 / 15.0)
    assert found.steering[inside] == pytest.approx(side * math.atan(2.0 * math.tan(slip)), rel=5e-3)


def test_profile_brakes_and_accelerates_no_harder_than_it_may(seamless):
    start = sample_starts(seamless, 1, np.random.default_rng(3))[0]
    route = plan(seamless, start, 600.0, 1)
    found = profile(route.points, INTERVAL, start_speed=2.0)
    rate = np.diff(found.speed**2) / (2.0 * np.diff(found.arc))
    assert rate.min() >= -BRAKING - 1e-6
    assert rate.max() <= ACCELERATION + 1e-6
    assert np.abs(found.steering).max() <= math.radians(27.0) + 1e-9
    assert found.speed[1:].min() > 2.0
    assert found.speed.max() <= TOP + 1e-9


@pytest.mark.parametrize("points", [np.zeros((1, 2)), np.ones((5, 2)), np.zeros((4, 3)), np.full((4, 2), np.nan)])
def test_path_that_leads_nowhere_is_refused(points):
    with pytest.raises(ValueError, match="path"):
        profile(points, INTERVAL)


def test_map_without_lanes_is_refused(straight):
    none = replace(straight, lanes=lay_lanes([], 512.0, 64.0))
    with pytest.raises(ValueError, match="lanes"):
        plan(none, START, 100.0, 0)


@pytest.mark.parametrize("name", REGISTRY)
def test_starts_are_located_and_routes_are_continuous(name):
    scenario = build(name, HELD_OUT_SEED)
    for k, start in enumerate(sample_starts(scenario, 12, np.random.default_rng(0))):
        lane, along = locate(scenario, start)
        points = scenario.lanes.lane(lane).astype(float)
        at = along / scenario.lanes.steps[lane]
        where = [np.interp(at, np.arange(len(points)), axis) for axis in points.T]
        assert np.hypot(*(where - start[:2])) < 0.02
        route = plan(scenario, start, 300.0, k)
        assert np.hypot(*np.diff(route.points, axis=0).T).max() < 1.2
        assert route.lanes[0] == lane
        for before, after in zip(route.lanes[:-1], route.lanes[1:], strict=True):
            assert after in scenario.lanes.successors[before]


@pytest.mark.parametrize("name", REGISTRY)
@pytest.mark.parametrize("traffic", [0, None])
def test_it_finishes_inside_the_interval_and_in_its_lane(name, traffic):
    spec = REGISTRY[name]
    cars = (spec.traffic or TRAFFIC[name]) if traffic is None else 0
    scenarios = [build(name, HELD_OUT_SEED + k) for k in range(2)]
    rows, worlds = lane_starts(scenarios, np.arange(6) % 2, np.random.default_rng(1), cars)
    low, high = spec.speed_interval
    for k, (row, world) in enumerate(zip(rows, worlds.reshape(6, cars, FIELDS), strict=True)):
        road = scenarios[row["map"]]
        drive = drive_reference(road, row["start"], world, k)
        assert drive.end == End.SUCCESS
        assert low <= drive.car[DISTANCE] / drive.car[STEPS] * 10.0 <= high
        assert drive.poses[:, 3].max() <= high
        away = np.abs(lateral(drive, road))
        assert away.mean() < 0.25
        assert away.max() < 0.9  # of lanes 3 m wide and more, by a car that is 2 m wide


def test_same_seed_same_drive_other_seed_other_route(seamless):
    rows, worlds = lane_starts([seamless], np.zeros(1, dtype=int), np.random.default_rng(2), 6)
    one, two, other = (drive_reference(seamless, rows["start"][0], worlds[0], seed) for seed in (4, 4, 5))
    assert np.array_equal(one.poses, two.poses)
    assert np.array_equal(one.actions, two.actions)
    assert not np.array_equal(one.route.lanes, other.route.lanes)


def test_it_keeps_behind_a_car_that_hardly_moves(straight):
    world = np.zeros((1, FIELDS), dtype=np.float32)
    world[0, [LANE, JUNCTION_BEHIND, PERMIT]] = 0, -1, -1
    world[0, [ALONG, X, Y, COS, SPEED_FACTOR]] = 90, 90, 32, 1, 0  # IDM then creeps at up to 0.1 m/s
    drive = drive_reference(straight, START, world, 0, max_steps=250)
    speed = drive.poses[:, 3]
    assert drive.end == End.TIME
    assert speed.max() > 8.0
    assert np.abs(speed[-50:]).max() < 0.35
    assert 1.0 < 92.4 - drive.car[X] - 4.0 < 4.5  # m from bumper to bumper, after 24 s at 0.1 m/s
