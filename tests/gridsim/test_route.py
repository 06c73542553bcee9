"""Routes: a walk over lanes that one can drive, where its points are, what counts, and how going astray ends."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from pictures import picture, write_yaml
from written_roads import osm, street

import gridsim  # noqa: F401, registers the environments
from cluster.settings import EvolveSettings
from evolution.episodes.rollout import evaluate, trajectory
from evolution.episodes.starts import lane_starts
from evolution.networks.export import layers_of
from evolution.networks.policy import PolicySpec, act_on
from gridsim.car.vehicle import Action
from gridsim.config import EpisodeConfig, SimConfig
from gridsim.envs.env import GridSimEnv
from gridsim.errors import GridSimError
from gridsim.maps.lanes import Path, lay_lanes, strips_along
from gridsim.maps.map import Map, sample_starts
from gridsim.maps.network import make_network
from gridsim.maps.roads import clearance_nodes, make_road
from gridsim.maps.scenarios import REGISTRY, build
from gridsim.sensing.route import points_ahead
from gridsim.simulator import Simulator
from gridsim.state import COS, DISTANCE, ODOMETER, ROUTE_ALONG, ROUTE_KEY, ROUTE_LANE, SIN, SPEED, End, X, Y
from gridsim.view import paint
from gridsim.view.render import Renderer

SEES = ("steering", "route")
AHEAD = np.array([5.0, 10.0, 20.0, 40.0])


def place_on(road_map, lane, along):
    """x, y (m) at a length along a lane, from its points alone."""
    points = road_map.network.points[road_map.network.offsets[lane] : road_map.network.offsets[lane + 1]].astype(float)
    at = along / float(road_map.network.steps[lane])
    return np.array([np.interp(at, np.arange(len(points)), column) for column in points.T])


def pursue(simulator, road_map):
    """Pedal and wheel float32 [n, 2] at 3.5 m/s, towards the route 3 m ahead: on the parabola of 0, 5 and 10 m."""
    config, cars = simulator.config, simulator.cars
    here = np.array([place_on(road_map, int(car[ROUTE_LANE]), car[ROUTE_ALONG]) for car in cars]) - cars[:, [X, Y]]
    dx, dy = road_map.shortest(here).T
    here = np.stack([dx * cars[:, COS] + dy * cars[:, SIN], dy * cars[:, COS] - dx * cars[:, SIN]])
    five, ten = (metres * config.unit * simulator.observations[:, [k, k + 4]].T for metres, k in ((5, -8), (10, -7)))
    ahead, left = 0.28 * here + 0.84 * five - 0.12 * ten
    wheel = np.arctan(2.0 * left / (ahead**2 + left**2) * config.vehicle.wheelbase)
    pedal = np.clip((3.5 * config.pace - cars[:, SPEED]) / config.pace, -1.0, 1.0)
    return np.stack([pedal, wheel / math.radians(config.vehicle.steering_limit)], axis=1)


def along_route(road_map, cars):
    """How far (m) along its route a car is in each of its states [n]; its lanes follow each other."""
    network, total, found = road_map.network, 0.0, []
    lengths = (np.diff(network.offsets) - 1) * network.steps.astype(float)
    lane = int(cars[0][ROUTE_LANE])
    for car in cars:
        if int(car[ROUTE_LANE]) != lane:
            assert int(car[ROUTE_LANE]) in network.successors[lane]
            total += lengths[lane]
            lane = int(car[ROUTE_LANE])
        found.append(total + car[ROUTE_ALONG])
    return np.array(found)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "town.osm"
    path.write_text(
        osm([street((-120.0, 0.0), (0.0, 0.0), (120.0, 0.0)), street((0.0, -120.0), (0.0, 0.0), (0.0, 120.0))])
    )
    return str(path)


@pytest.mark.parametrize("name", [*REGISTRY, "town", "city f1tenth"])
def test_one_can_drive_it_its_points_are_where_it_leads_and_distance_is_along_it(name, town):
    name, sim = [*name.split(), "default"][:2]
    road_map = build(town if name == "town" else name, 3, config := SimConfig.load(sim))
    simulator = Simulator(12, config, features=SEES)
    simulator.reset(road_map, sample_starts(road_map, 12, np.random.default_rng(5)))
    states, seen = [simulator.cars.copy()], [simulator.observations[:, -8:].copy()]
    for _ in range(500):
        simulator.step(pursue(simulator, road_map))
        states.append(simulator.cars.copy())
        seen.append(simulator.observations[:, -8:].copy())
    # This driver cuts corners, which is too much for turning loops, and for a car as large as f1tenth at its scale.
    assert (simulator.ends == End.RUNNING).all() or name == "town" or config.unit < 1.0
    assert (simulator.ends != End.ASTRAY).all()
    ways = AHEAD * config.unit
    turns = 0
    for cars, views in zip(np.swapaxes(states, 0, 1), np.swapaxes(seen, 0, 1), strict=True):
        way = along_route(road_map, cars)
        driven = cars[:, DISTANCE]
        assert driven == pytest.approx(way - way[0], abs=0.03 * config.unit)
        assert driven[-1] == pytest.approx(cars[-1, ODOMETER], rel=0.08)
        turns += len(np.unique(cars[:, ROUTE_LANE]))
        # Where the route leads is where the car is later on it.
        places = np.array([place_on(road_map, int(car[ROUTE_LANE]), car[ROUTE_ALONG]) for car in cars])
        places = np.cumsum([places[0], *road_map.shortest(np.diff(places, axis=0))], axis=0)
        for k in range(0, 500, 25):
            car = cars[k].astype(float)
            for point, metres in enumerate(ways):
                if way[k] + metres > way[-1]:
                    continue
                later = [np.interp(way[k] + metres, way, column) for column in places.T]
                dx, dy = road_map.shortest(later - car[[X, Y]])
                offset = [dx * car[COS] + dy * car[SIN], dy * car[COS] - dx * car[SIN]]
                assert views[k, [point, point + 4]] * metres == pytest.approx(offset, abs=0.06 * config.unit)
    assert turns > 20 or name in ("highway", "curved")


def test_the_same_start_has_the_same_route_in_evolution_and_in_an_environment_and_others_differ():
    road_map, config = build("city", 3), SimConfig()
    spec = PolicySpec.parse("mlp:5+route")
    env = GridSimEnv("city", maps=[road_map], traffic=0, route=True)
    keys = set()
    for seed in range(8):
        observation, _ = env.reset(seed=seed)
        start = env.cars.simulator._starts[0].copy()
        genome = (0.3 * np.random.default_rng(seed).normal(size=spec.size)).astype(np.float32)
        _, states, _ = trajectory(spec, genome, road_map, start, 2000.0, 200, config)
        for car in states[1:]:
            observation, *_ = env.step(act_on(spec, genome, observation, config))
            assert env.cars.simulator.cars[0].tobytes() == car.tobytes()
        keys.add(states[0, ROUTE_KEY])
    assert len(keys) == 8


def test_all_ways_of_a_fork_are_taken_alike():
    road_map = build("city", 3)
    network, simulator = road_map.network, Simulator(4000, features=SEES)
    simulator.reset(road_map, sample_starts(road_map, 4000, np.random.default_rng(1)))
    points, taken = points_ahead(road_map, simulator.cars)[:, 3], np.zeros(3, dtype=int)
    lengths = (np.diff(network.offsets) - 1) * network.steps
    for car, point in zip(simulator.cars, points, strict=True):
        lane = int(car[ROUTE_LANE])
        ways, into = network.successors[lane], 40.0 - lengths[lane] + car[ROUTE_ALONG]
        if ways.min() >= 0 and 6.0 < into < lengths[ways].min():
            off = [np.hypot(*road_map.shortest(place_on(road_map, way, into) - point)) for way in ways]
            taken[np.argmin(off)] += 1
            assert min(off) < 0.01
    assert taken.sum() > 50
    assert taken.min() > 0.2 * taken.sum()


def astray(features):
    """A car on the leftmost lane of a highway that drives to the right, to its end; and its distance from its lane."""
    road_map = build("highway", 2)
    start = sample_starts(road_map, 200, np.random.default_rng(0))
    simulator = Simulator(1, features=features)
    for pose in start:
        simulator.reset(road_map, pose[None])
        lane = int(simulator.cars[0, ROUTE_LANE])
        if simulator.features and road_map.network.left[lane] < 0:
            break
    pose[2:4] -= 0.15, -8.0
    simulator.reset(road_map, pose[None])
    away = []
    while not simulator.ends[0]:
        car = simulator.cars[0]
        centre = place_on(road_map, int(car[ROUTE_LANE]), car[ROUTE_ALONG])
        away.append(float(np.hypot(*road_map.shortest(centre - car[[X, Y]]))))
        simulator.step(np.array([4]))
    centre = place_on(road_map, int(car[ROUTE_LANE]), car[ROUTE_ALONG])
    return simulator, [*away, float(np.hypot(*road_map.shortest(centre - simulator.cars[0, [X, Y]])))]


def test_more_than_six_metres_from_it_an_episode_ends():
    simulator, away = astray(SEES)
    assert simulator.ends[0] == End.ASTRAY
    assert max(away[:-1]) <= 6.0 < away[-1] < 6.3
    env = gymnasium.make("GridSim/Highway-v0", route=True, traffic=0)
    env.reset(seed=1, options={"map_seed": 2, "start": simulator._starts[0]})
    for _ in range(len(away) - 1):
        _, reward, terminated, truncated, info = env.step(4)
    assert (terminated, truncated, info["end"]) == (True, False, End.ASTRAY)
    assert float(reward) > 0.0, "it is rewarded as any other step"


@pytest.fixture(scope="module")
def ring():
    """A ring of 12 m radius, driven counter-clockwise."""
    path = Path(64.0, 20.0, 0.0, ((2.0 * math.pi * 12.0, 1.0 / 12.0),))
    strips, lanes = strips_along(path, 4.0), lay_lanes([path], 64.0, 64.0)
    road = make_road(clearance_nodes(strips, 64.0, 64.0), (5.0, 12.0), 3.0)
    return Map("ring", 0, road, strips, make_network(lanes, road, SimConfig()))


def test_every_round_counts_and_ground_driven_back_does_not(ring):
    ends = {}
    for features in ((), SEES):
        simulator = Simulator(1, target=150.0, features=features)
        simulator.reset(ring, np.array([[64.0, 20.0, 0.0, 5.0, 0.0]]))
        while not simulator.ends[0]:
            simulator.step(np.array([[0.0, math.atan(2.5 / 12.0) / math.radians(27.0)]]))
        ends[features] = simulator.ends[0], float(simulator.cars[0, DISTANCE])
    assert ends[()][0] == End.IDLE
    assert ends[SEES][0] == End.SUCCESS
    assert 150.0 <= ends[SEES][1] < 150.6

    patient = SimConfig(episode=EpisodeConfig(patience=10.0))
    road_map, simulator = build("highway", 2), Simulator(1, patient, features=SEES)
    simulator.reset(road_map, sample_starts(road_map, 1, np.random.default_rng(0)))
    states = [simulator.cars[0].copy()]
    for action, steps in ((0, 30), (3, 12), (7, 25), (0, 30)):  # forward, brake, back, forward
        for _ in range(steps):
            simulator.step(np.array([action]))
            states.append(simulator.cars[0].copy())
    way = along_route(road_map, states)
    assert (np.maximum.accumulate(way) - way).max() > 3.0
    assert np.array(states)[:, DISTANCE] == pytest.approx(np.maximum.accumulate(way) - way[0], abs=0.02)


def steers_along(spec):
    """The genome of an `mlp:2+route` that turns to where the point 10 m ahead is, at about 4 m/s."""
    (first, first_bias), (last, last_bias) = layers_of(spec, genome := np.zeros(spec.size, dtype=np.float32))
    first[spec.inputs - 3, 0], first[31, 1], first_bias[1] = 6.0, 5.0, 3.0
    last[0, [Action.LEFT, Action.RIGHT]], last[1, [Action.ACCELERATE, Action.BRAKE]] = [2.0, -2.0], [-0.8, 0.8]
    last_bias[Action.BRAKE] = -0.5
    return genome


def test_what_is_rewound_goes_on_along_the_same_route():
    road_map, spec, config = build("city", 4), PolicySpec.parse("mlp:2+route"), SimConfig()
    episodes, worlds = lane_starts([road_map], np.zeros(30, dtype=int), np.random.default_rng(2))
    episodes["rewind"] = 10
    genome = steers_along(spec)
    _, starts, _ = evaluate(spec, genome[None], [road_map], episodes, config, worlds)
    turned = 0
    for episode, start in zip(episodes, starts[0], strict=True):
        result, states, _ = trajectory(spec, genome, road_map, episode["start"].copy(), 2000.0, 4000, config)
        at = max(int(result["steps"]) - 10, 0)
        _, again, _ = trajectory(spec, genome, road_map, start.copy(), 2000.0, 4000, config)
        assert again[0, [ROUTE_LANE, ROUTE_KEY]].tolist() == states[at, [ROUTE_LANE, ROUTE_KEY]].tolist()
        # A car that cuts a corner may be nearer to a point further on than to the one that it was followed to.
        assert again[0, ROUTE_ALONG] == pytest.approx(states[at, ROUTE_ALONG], abs=1.0)
        turned += states[at, ROUTE_LANE] != states[0, ROUTE_LANE]
    assert turned > 8


def test_a_picture_has_no_route(tmp_path):
    name = write_yaml(tmp_path, picture(lambda x, y: 5.0 - np.abs(y - 8.0), 256.0, 16.0))
    with pytest.raises(GridSimError, match="no lanes to follow; leave out"):
        EvolveSettings(scenario=name, policy="mlp:3+route").check()
    road_map, spec = build(name, 0), PolicySpec.parse("mlp:3+route")
    with pytest.raises(GridSimError, match="no lanes to follow"):
        Simulator(1, features=SEES).reset(road_map, sample_starts(road_map, 1, np.random.default_rng(0)))
    genome = np.zeros(spec.size, dtype=np.float32)
    with pytest.raises(GridSimError, match="no lanes to follow"):
        trajectory(spec, genome, road_map, road_map.starts[0], 100.0, 10, SimConfig())


def test_pictures_show_its_points():
    road_map = build("city", 3)
    simulator = Simulator(1, features=SEES)
    simulator.reset(road_map, sample_starts(road_map, 1, np.random.default_rng(1)))
    points = points_ahead(road_map, simulator.cars)[0]
    renderer = Renderer(road_map, (640, 480), simulator.config)
    shown = renderer.draw(simulator.cars[0], route=points)
    column, row = renderer.pixel(points).astype(int).T
    seen = (row >= 0) & (column >= 0) & (column < 640)
    assert seen.sum() >= 2
    assert np.abs(shown[row[seen], column[seen]].astype(int) - np.array(paint.ROUTE)).max() <= 2
    assert points_ahead(road_map, np.zeros_like(simulator.cars)).shape == (1, 0, 2)
