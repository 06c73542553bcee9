"""Traffic lights: their programs, what the ego car sees of them and must do, and that traffic obeys."""

from __future__ import annotations

import numpy as np
import pytest
from written_roads import commonroad, osm, street

from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.lights import CLEARING, GO, STOP, programs_of_lines
from gridsim.maps.real.lights import program
from gridsim.maps.real.load import read_road
from gridsim.maps.roads import clearance
from gridsim.maps.scenarios import build
from gridsim.simulator import Simulator
from gridsim.state import CAR_FIELDS, CLOCK, COS, IDLE, LANE, SIN, START_FIELDS, End, X, Y
from gridsim.step import start_from
from gridsim.traffic.behaviour import drivers, step_traffic
from gridsim.traffic.world import spawn
from gridsim.view import paint
from gridsim.view.render import Renderer

SIM, LIT = SimConfig(), SimConfig.load("lights")
CROSSING = [street((-120.0, 0.0), (0.0, 0.0), (120.0, 0.0)), street((0.0, -120.0), (0.0, 0.0), (0.0, 120.0))]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("lights") / "crossing.osm"
    path.write_text(osm(CROSSING, lights=[(0.0, 0.0)]))
    return str(path)


@pytest.fixture(scope="module")
def crossing(file):
    return build(file, 0)


def clock_at(network, k, shows, last=False):
    """The first or last control step of a program's cycle in which a stop line's light shows this."""
    seconds = np.flatnonzero(programs_of_lines(network)[k] == shows)
    return seconds[-1] * 10 + 9 if last else seconds[0] * 10


def before_line(here, away, k=0, speed=0.0, **given):
    """A simulator with a car that drives towards line k, its middle `away` m before it and to the right of its own."""
    x, y, cosine, sine, _ = here.network.lines[k]
    x, y = x - away * cosine + 1.6 * sine, y - away * sine - 1.6 * cosine
    simulator = Simulator(1, SIM, max_steps=60_000)
    simulator.reset(here, np.array([[x, y, np.arctan2(sine, cosine), speed, 0.0]], dtype=np.float32))
    return simulator


def test_programs():
    assert program([("r", 2.0), ("g", 3.0), ("y", 1.0)]) == "rrgggy"
    assert program([("r", 2.0), ("g", 3.0), ("y", 1.0)], 1.0) == "yrrggg"  # it begins a second later
    assert program([("g", 10_000.0), ("r", 2.5), ("y", 0.5)]) == 30 * "g" + "rry"  # of which nobody asks for the end
    assert program([("g", 90.0)]) == program([("r", 90.0)]) == ""


def test_lights_of_openstreetmap(crossing):
    network = crossing.network
    assert len(network.lines) == 4
    assert (network.signals[np.diff(network.crossing_offsets) > 0] >= 0).sum() == 12
    shows = np.stack(programs_of_lines(network))
    across = np.abs(network.lines[:, 2:4] @ network.lines[:, 2:4].T) < 0.1
    assert across.sum() == 8
    for one, other in zip(*np.nonzero(across), strict=True):
        assert ((shows[one] == STOP) | (shows[other] == STOP)).all()
    # They end where the road does: it is 6.4 m wide, more at its corners.
    assert network.lines[:, 4] == pytest.approx(3.8, abs=0.5)


def test_lights_of_commonroad(tmp_path):
    there = [(0.0, 0.0), (50.0, 0.0)], [(0.0, -3.0), (50.0, -3.0)]
    on = [(50.0, 0.0), (90.0, 0.0)], [(50.0, -3.0), (90.0, -3.0)]
    path = tmp_path / "a.xml"
    path.write_text(commonroad([there, on], {1: [2]}, {1: 200}))
    lanes = read_road(path).lanes
    assert (lanes["1"].light, lanes["2"].light) == ("", 20 * "r" + "r" + 30 * "g" + 3 * "y")
    path.write_text(commonroad([there, on], {1: [2]}, {1: 20}).replace(">300<", ">30<"))
    assert read_road(path).lanes["2"].light == 30 * "r" + 30 * "g" + 30 * "y"  # a cycle of 9 s would be too short


def test_lights_of_the_city():
    """In the middle of two streets, one each way; the line reaches across the road, and every lane there ends at it."""
    for seed in range(8):
        here = build("city", seed, LIT)
        network, size = here.network, 256.0
        assert len(network.lines) == 4
        shows = programs_of_lines(network)
        for one, other in ((0, 1), (2, 3)):
            assert (shows[one] == shows[other]).all()
            assert network.lines[one, 2:4] == pytest.approx(-network.lines[other, 2:4], abs=1e-6)
        ends = network.points[network.offsets[1:] - 1]
        for k, (x, y, cosine, sine, half) in enumerate(network.lines):
            for side in (-half, half):
                assert clearance(here.road, (x - side * sine) % size, (y + side * cosine) % size) < 0.0
            lane = x + 1.5 * sine, y - 1.5 * cosine
            away = (ends - lane + size / 2) % size - size / 2
            before = np.flatnonzero(np.hypot(*away.T) < 0.01)
            assert len(before) == 1
            onward = network.successors[before[0]]
            assert [network.signals[lane] for lane in onward if lane >= 0] == [k]
        assert np.sort(network.signals[network.signals >= 0]).tolist() == [0, 1, 2, 3]


def test_the_city_is_the_same_without_lights_and_a_small_car_meets_none():
    here, without = build("city", 3, LIT), build("city", 3)
    assert len(here.network.lines) > 0 == len(without.network.lines)
    assert (here.road.field == without.road.field).all()
    assert len(here.network.successors) == len(without.network.successors) + 4
    for other in ({"lights": False}, {}):
        off = SimConfig.of({"base": "lights" if other else "f1tenth", "traffic": {"city_lights": True, **other}})
        assert len(build("city", 3, off).network.lines) == 0


def test_rays_end_at_a_line_that_is_closed(crossing):
    simulator = before_line(crossing, 20.0)
    ahead = {}
    for shows in (GO, CLEARING, STOP):
        simulator.cars[0, CLOCK] = clock_at(crossing.network, 0, shows)
        simulator.step(np.array([[0.0, 0.0]]))
        ahead[shows] = simulator.ranges[0, 15]
    assert ahead[CLEARING] == ahead[STOP] == pytest.approx(20.0 - 1.25, abs=0.01)
    assert ahead[GO] > 40.0
    simulator.cars[0, [COS, SIN]] *= -1.0  # it has come from there
    x, y, cosine, sine, _ = crossing.network.lines[0]
    simulator.cars[0, [X, Y]] = x + 8.0 * cosine, y + 8.0 * sine
    simulator.step(np.array([[0.0, 0.0]]))
    assert simulator.ranges[0, 15] > 15.0


@pytest.mark.parametrize(("shows", "end"), [(GO, End.RUNNING), (CLEARING, End.RUNNING), (STOP, End.COLLISION)])
def test_crossing_a_line_while_it_is_red_is_a_collision(crossing, shows, end):
    simulator = before_line(crossing, 2.5, speed=8.0)
    simulator.cars[0, CLOCK] = clock_at(crossing.network, 0, shows)
    simulator.step(np.array([[0.0, 0.0]]))
    assert simulator.ends[0] == end
    if shows == STOP:  # but not behind it
        simulator = before_line(crossing, 1.5, speed=8.0)
        simulator.cars[0, CLOCK] = clock_at(crossing.network, 0, shows)
        simulator.step(np.array([[0.0, 0.0]]))
        assert simulator.ends[0] == End.RUNNING


def test_waiting_at_a_light_is_not_idleness(crossing):
    simulator = before_line(crossing, 6.0)
    simulator.cars[0, CLOCK] = clock_at(crossing.network, 0, STOP)
    for _ in range(300):
        simulator.step(np.array([[0.0, 0.0]]))
    assert (simulator.ends[0], simulator.cars[0, IDLE]) == (End.RUNNING, 0)
    simulator.cars[0, CLOCK] = clock_at(crossing.network, 0, GO)
    for _ in range(300):
        simulator.step(np.array([[0.0, 0.0]]))
    assert simulator.ends[0] == End.IDLE


def test_clock_follows_from_the_start_and_goes_on_when_rewound(crossing):
    clocks = [before_line(crossing, away).cars[0, CLOCK] for away in (5.0, 5.0, 6.0, 7.0)]
    assert clocks[0] == clocks[1]
    assert len(set(clocks)) == 3
    simulator, start = before_line(crossing, 30.0), np.zeros(START_FIELDS, dtype=np.float32)
    for _ in range(5):
        simulator.step(np.array([[0.0, 0.0]]))
    start_from(simulator.cars[0], start)
    again = Simulator(1, SIM)
    again.reset(crossing, start[None])
    assert again.cars[0, CLOCK] == simulator.cars[0, CLOCK] == before_line(crossing, 30.0).cars[0, CLOCK] + 5


def driven(here, world, ego, steps):
    """Lanes [steps, cars] of traffic, and what the light of each of these lanes shows in that step."""
    lanes, network, shown = [], here.network, []
    for _ in range(steps):
        step_traffic(network, drivers(SIM), world, ego)
        own = network.signals[world[:, LANE].astype(int)]
        first, last = network.program_offsets[np.maximum(own, 0)], network.program_offsets[np.maximum(own, 0) + 1]
        shown.append(network.programs[first + int(ego[CLOCK] * 0.1) % (last - first)])
        lanes.append(np.where(own >= 0, world[:, LANE], -1))
        ego[CLOCK] += 1.0
    return np.array(lanes), np.array(shown)


@pytest.mark.parametrize("where", ["crossing", "city"])
def test_traffic_obeys(crossing, where):
    crossing = build("city", 3, LIT) if where == "city" else crossing
    nobody = np.zeros(CAR_FIELDS, dtype=np.float32)
    nobody[X] = np.inf
    world = spawn(crossing.network, np.full((1, 5), 1e6, np.float32), 12, np.zeros(1, np.uint64), SIM)[0]
    lanes, shown = driven(crossing, world, nobody, 3000)
    enters = (lanes[1:] >= 0) & (lanes[1:] != lanes[:-1])
    assert enters.sum() > 40
    assert (shown[1:][enters] < STOP).all()  # who can stop when it becomes yellow, stops
    assert (shown[1:][enters] == CLEARING).any()
    assert (world[:, LANE] >= 0).all()


def test_ego_car_at_a_red_light_does_not_hold_up_traffic(crossing):
    """Nor does it on its way there: the right of way that it has ends at the line."""
    network, k = crossing.network, int(np.argmax(np.abs(crossing.network.lines[:, 2])))
    across = np.flatnonzero(np.abs(network.lines[:, 3]) > 0.9)
    spawned = spawn(network, np.full((1, 5), 1e6, np.float32), 12, np.zeros(1, np.uint64), SIM)[0]
    entered = []
    for speed, away in ((0.0, 3.0), (8.0, 25.0)):
        ego, world = before_line(crossing, away, k, speed).cars[0], spawned.copy()
        ego[CLOCK] = clock_at(network, across[0], GO)
        lanes, _ = driven(crossing, world, ego, 300)
        entered.append(((lanes[1:] >= 0) & (lanes[1:] != lanes[:-1])).sum())
    assert min(entered) >= 3


def test_option_switches_them_off(file):
    off = SimConfig.of({"traffic": {"lights": False}})
    assert len(build(file, 0, off).network.lines) == 0
    assert SimConfig.of({"traffic": {"lights": True}}) == SIM
    for name in ("lights", "city_lights"):
        with pytest.raises(GridSimError, match=rf"traffic\.{name} must be true or false, not 'no'"):
            SimConfig.of({"traffic": {name: "no"}})


def test_pictures_show_them(crossing):
    simulator = before_line(crossing, 20.0)
    renderer = Renderer(crossing, (320, 240))
    for shows in (GO, CLEARING, STOP):
        simulator.cars[0, CLOCK] = clock_at(crossing.network, 0, shows)
        picture = renderer.draw(simulator.cars[0])
        x, y = renderer.pixel(crossing.network.lines[0, :2])[0].astype(int)
        assert np.abs(picture[y, x].astype(int) - paint.SIGNALS[shows]).max() < 30
