"""Traffic: where its cars begin, its laws against closed forms and the oracle, who waits for whom, and that it neither
crashes nor stops."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pictures import cars_on, crashes, straight_road
from scipy import stats

from gridsim import state
from gridsim.car.kinematic import path_curvature
from gridsim.collision import boxes_touch, hits_box
from gridsim.config import SimConfig, VehicleConfig, constants
from gridsim.jit import njit
from gridsim.maps.lanes import Path, lay_lanes
from gridsim.maps.map import sample_starts
from gridsim.maps.network import lane_length, make_network, wrapped
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import REGISTRY, build
from gridsim.state import ALONG, COS, LANE, LANE_TIMER, PERMIT, SIN, SPEED, SPEED_FACTOR, STEERING, X, Y
from gridsim.traffic.behaviour import drivers, idm, step_traffic
from gridsim.traffic.world import spawn

F = np.float32
CONFIG = SimConfig()
K, D = constants(CONFIG), drivers(CONFIG)
LENGTH = CONFIG.vehicle.length
NOBODY = np.array([math.inf, *np.zeros(13)], dtype=F)  # an ego car that is near nothing
FAR = np.full(5, 1e6, dtype=F)  # a start that is near nothing
DT = CONFIG.episode.control_period


def network_of(paths, width, height, limit=12.0, abreast=1, half_width=0.0, config=CONFIG):
    road = straight_road(width, height, limit, half_width)
    return make_network(lay_lanes(paths, width, height, abreast), road, config)


@pytest.fixture(scope="module")
def ring():
    """One straight lane round a torus of 1,024 m, along x at y = 32, where 12 m/s are allowed."""
    return network_of([Path(0.0, 32.0, 0.0, ((1024.0, 0.0),))], 1024.0, 64.0)


def crossing_paths():
    """Two straight lanes of 256 m that cross: lanes 0, 1, 2 eastwards (before, in and after the junction), 3, 4, 5
    northwards. The junction reaches 8 m either way of (128, 128)."""
    ways = ((0.0, 120.0), (120.0, 16.0), (136.0, 120.0))
    east = [Path(at, 128.0, 0.0, ((length, 0.0),)) for at, length in ways]
    return east + [Path(128.0, at, math.pi / 2, ((length, 0.0),)) for at, length in ways]


@pytest.fixture(scope="module")
def crossing():
    return network_of(crossing_paths(), 256.0, 256.0)


def two_lanes(piece):
    """Two lanes side by side, left and right, round a torus of 1,024 m along x, in pieces of so many m: lane 2 k is the
    left one of piece k, 2 k + 1 the right one."""
    starts = np.arange(0.0, 1024.0, piece)
    paths = [Path(x, y, 0.0, ((piece, 0.0),)) for x in starts for y in (35.75, 32.0)]
    return network_of(paths, 1024.0, 64.0, 20.0, 2)


@pytest.fixture(scope="module")
def abreast():
    """Two lanes side by side, left (0) and right (1), round a torus of 1,024 m along x."""
    return two_lanes(1024.0)


def ego(x, y, heading=0.0, speed=0.0):
    car = NOBODY.copy()
    car[[X, Y, COS, SIN, SPEED]] = x, y, math.cos(heading), math.sin(heading), speed
    return car


@njit(nogil=True)
def _watch(network, drivers, constants, world, ego, history):
    """Let traffic flow, kept in history [steps, cars, TRAFFIC_FIELDS]; returns how often a car overlapped another."""
    overlaps, width, height = 0, network.width, network.height
    for step in range(len(history)):
        step_traffic(network, drivers, world, ego)
        history[step] = world
        for i in range(len(world)):
            x, y, cosine, sine = world[i, X], world[i, Y], world[i, COS], world[i, SIN]
            hits = hits_box(constants, world[:i], F(0.0), constants.dt, width, height, x, y, cosine, sine)
            overlaps += world[i, LANE] >= 0.0 and hits
    return overlaps


def watch(network, world, seconds, ego=NOBODY, config=CONFIG):
    """States [steps, cars, TRAFFIC_FIELDS] of a world after each step; no two cars overlap in any of them."""
    history = np.zeros((round(seconds / DT), *world.shape), dtype=F)
    assert _watch(network, drivers(config), constants(config), world.copy(), ego, history) == 0
    return history


# --- Where cars begin, and how much room they have --------------------------------------------------------------------


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
    before, behind = ~free[network.successors[:, 0]], np.isin(np.arange(len(free)), network.successors[~free])
    first, last = behind * LENGTH / 2, lengths - before * (LENGTH / 2 + 0.25)
    assert ((first[lane] - 1e-3 <= cars[:, ALONG]) & (cars[:, ALONG] <= last[lane] + 1e-3)).all()
    counts, expected = np.bincount(lane, minlength=len(lengths))[free], (last - first)[free]
    assert stats.chisquare(counts, expected / expected.sum() * len(cars)).pvalue > 1e-3
    assert stats.kstest((cars[:, ALONG] - first[lane]) / (last - first)[lane], "uniform").pvalue > 1e-3
    assert stats.kstest(cars[:, SPEED_FACTOR], "uniform", args=(0.9, 0.3)).pvalue > 1e-3


@pytest.mark.parametrize("scenario", REGISTRY)
def test_spawned_cars_keep_their_distance(scenario):
    road_map = build(scenario, 2)
    network, rng = road_map.network, np.random.default_rng(0)
    starts = np.zeros((40, 5), dtype=F)
    starts[:, :2] = network.points[rng.integers(len(network.points), size=40)] % [network.width, network.height]
    worlds = spawn(network, starts, 400, np.arange(40, dtype=np.uint64), CONFIG).astype(float)
    for world, start in zip(worlds, starts, strict=True):
        here = world[world[:, LANE] >= 0][:, [X, Y]]
        assert 8 <= len(here) < 400  # those that there is no room for are left out
        assert np.hypot(*road_map.shortest(here - start[:2]).T).min() >= CONFIG.traffic.spawn_gap_ego - 1e-3
        for k in range(1, len(here)):
            assert np.hypot(*road_map.shortest(here[:k] - here[k]).T).min() >= CONFIG.traffic.spawn_gap - 1e-3


# --- How they drive --------------------------------------------------------------------------------------------------

speeds = st.floats(0.0, 30.0, width=32)


@given(speeds, st.floats(2.0, 30.0, width=32), st.floats(0.5, 200.0, width=32), speeds)
def test_the_law_is_the_oracles(speed, desired, gap, leader):
    expected = oracle.idm(CONFIG, speed, desired, gap, leader)
    assert idm(D, F(speed), F(desired), F(gap), F(leader)) == pytest.approx(expected, rel=1e-4, abs=1e-4)
    assert idm(D, F(speed), F(max(speed, 2.0)), F(1e9), F(0.0)) >= -1e-6  # the free road


@pytest.mark.parametrize("share", [0.25, 0.8])
def test_a_platoon_settles_at_the_equilibrium_gap(ring, share):
    """Six cars behind one that wants less: all gaps are s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    rows = [(0, 700.0, 5.0, share)] + [(0, 700.0 - 30.0 * k - 7.0 * (k % 2), 5.0, 1.0) for k in range(1, 7)]
    last = watch(ring, cars_on(ring, *rows), 900)[-1].astype(float)
    speed = share * 12.0
    assert last[:, SPEED] == pytest.approx(speed, abs=5e-3)
    gaps = (last[:-1, ALONG] - last[1:, ALONG]) % 1024.0 - LENGTH
    assert gaps == pytest.approx(oracle.equilibrium_gap(CONFIG, speed, 12.0), rel=5e-3)


@pytest.mark.parametrize("speed", [0.0, 3.0, 30.0])
def test_behind_a_standing_car_a_queue_forms_without_touching(ring, speed):
    """A car stands in the lane. One comes at any speed, from where full braking is just enough, and four follow it."""
    every = LENGTH + 4.0 + speed * DT + speed**2 / (2 * CONFIG.traffic.braking)
    world = cars_on(ring, *[(0, 500.0 - every * k, speed, 1.0) for k in range(1, 5)])
    history = watch(ring, world, 240, ego(500.0, 32.0)).astype(float)
    x = history[:, :, ALONG]
    assert (x < 500.0 - LENGTH).all()
    assert (history[-1, :, SPEED] < 0.02).all()
    assert x[-1, :-1] - x[-1, 1:] - LENGTH == pytest.approx(CONFIG.traffic.jam, abs=0.3)
    assert 2.0 - 0.3 < 500.0 - x[-1, 0] - LENGTH < 5.0
    deceleration = -np.diff(history[:, :, SPEED], axis=0) / DT
    assert deceleration.max() <= CONFIG.traffic.braking + 1e-3


def test_the_ego_car_in_the_lane_is_followed_and_waited_for(ring):
    """Traffic keeps behind an ego car at 4 m/s, whose lateral place in the lane is not exact."""
    world = cars_on(ring, (0, 400.0, 12.0, 1.0), (0, 380.0, 12.0, 1.2))
    car = ego(440.0, 32.7, 0.05, 4.0)
    for _ in range(600):
        car[X] = (car[X] + 0.4) % 1024
        step_traffic(ring, D, world, car)
        assert (car[X] - world[0, ALONG]) % 1024 > LENGTH
    assert world[:, SPEED] == pytest.approx(4.0, abs=0.1)
    assert (car[X] - world[0, ALONG]) % 1024 < LENGTH + oracle.equilibrium_gap(CONFIG, 4.0, 12.0) + 3.0


@pytest.mark.parametrize("heading", np.arange(0, 8, 3) * math.pi / 4)
@pytest.mark.parametrize("radius", [math.inf, 16.0, -16.0])
def test_lanes_are_as_fast_as_their_bends_allow(heading, radius):
    """All along the lanes of a loop, their ends included, whichever way they point: the limit, or sqrt(a R)."""
    if math.isinf(radius):  # round the torus
        piece = (128.0 if heading % (math.pi / 2) == 0.0 else 128.0 * math.sqrt(2.0), 0.0)
        dx, dy = piece[0] * math.cos(heading), piece[0] * math.sin(heading)
        paths = [Path(k * dx, k * dy, heading, (piece,)) for k in range(2)]
    else:
        piece = (math.pi / 2 * abs(radius), 1.0 / radius)
        at = [(heading + k * math.copysign(math.pi / 2, radius)) for k in range(4)]
        paths = [Path(100.0 + radius * math.sin(h), 100.0 - radius * math.cos(h), h, (piece,)) for h in at]
    network = network_of(paths, 256.0, 256.0)
    assert network.speeds == pytest.approx(min(12.0, math.sqrt(CONFIG.traffic.lateral * abs(radius))), rel=2e-3)


@pytest.fixture(scope="module")
def narrow():
    """A road of two lanes along x, eastwards at y = 30.25 and westwards at 33.75, 4 m either side of its middle."""
    paths = [Path(0.0, 30.25, 0.0, ((1024.0, 0.0),)), Path(1024.0, 33.75, math.pi, ((1024.0, 0.0),))]
    return network_of(paths, 1024.0, 64.0, 8.5, half_width=4.0)


@pytest.mark.parametrize("length", [4.0, 6.0])
@pytest.mark.parametrize("lane", [0, 1])
def test_who_meets_the_ego_car_keeps_to_the_right_and_passes(narrow, lane, length):
    """The ego car comes along the middle of the road, on a car's own half."""
    config = SimConfig(vehicle=VehicleConfig(length=length))
    others, k = drivers(config), constants(config)
    world = cars_on(narrow, (lane, 400.0, 8.0, 1.0))
    ahead = 1.0 - 2.0 * lane
    car = ego(world[0, X] + 80.0 * ahead, 32.0, math.pi * (1 - lane), 6.0)
    right, speeds = [], []
    for _ in range(300):
        step_traffic(narrow, others, world, car)
        car[X] -= 6.0 * DT * ahead
        dx = wrapped(F(car[X] - world[0, X]), narrow.width)
        assert not boxes_touch(k, dx, car[Y] - world[0, Y], world[0, COS], world[0, SIN], car[COS], car[SIN])
        right.append((abs(float(world[0, Y]) - 32.0) - 1.75, abs(dx)))
        speeds.append(world[0, SPEED])
    aside, apart = np.array(right).T
    assert aside[apart > 36.0] == pytest.approx(0.0, abs=0.2)
    assert aside[apart < length] == pytest.approx(CONFIG.traffic.give_way, abs=1e-3)
    assert aside[-1] == 0.0
    assert min(speeds) > 7.0  # no car has to wait
    assert np.abs(np.diff(aside)).max() < CONFIG.traffic.lane_change_speed * DT + 1e-3


@pytest.mark.parametrize("turn", [0.0, 0.25])
@pytest.mark.parametrize("late", np.arange(-1.5, 0.1, 0.5))
def test_a_car_in_a_junction_foresees_the_ego_car(crossing, turn, late):
    """The ego car comes northwards, up to 1.5 s before a car on the eastern way is where these cross, straight on or
    on the arc that it steers; they never touch, and they do where nobody looks ahead."""
    radius = 1.0 / float(path_curvature(K, F(6.0), F(turn))) if turn else math.inf

    def drive(foresees):
        world = cars_on(crossing, (1, 0.0, 7.0, 1.0))
        touched = False
        for step in range(60):
            way = 6.0 * (step * DT - 8.0 / 7.0 - late)  # m of the ego car's to where it crosses the car's lane
            x, y, heading = (128.0, 128.0 + way, math.pi / 2)
            if turn:
                angle = way / radius
                x, y = 128.0 - radius * (1.0 - math.cos(angle)), 128.0 + radius * math.sin(angle)
                heading += angle
            car = ego(x, y, heading, 6.0)
            car[STEERING] = turn
            step_traffic(crossing, D, world, car if foresees else NOBODY)
            dx, dy = car[X] - world[0, X], car[Y] - world[0, Y]
            touched |= boxes_touch(K, dx, dy, world[0, COS], world[0, SIN], car[COS], car[SIN])
        return touched

    assert not drive(True)
    assert drive(False) == (late > -1.25)


def front(world, i=0):
    return world[..., i, ALONG] + LENGTH / 2


@pytest.mark.parametrize("offset", np.arange(-24.0, 25.0, 3.0))
def test_of_two_that_cross_one_waits(crossing, offset):
    history = watch(crossing, cars_on(crossing, (0, 70.0, 9.0, 1.0), (3, 70.0 + offset, 9.0, 1.0)), 25)
    lane, permit = history[:, :, LANE], history[:, :, PERMIT]
    for i in (0, 1):
        into = np.flatnonzero(lane[:, i] == 3 * i + 1)
        assert len(into)  # both get there
        assert permit[into[0] - 1, i] == 3 * i + 1  # by a permit
        before = lane[:, i] == 3 * i
        assert (front(history, i)[before & (permit[:, i] < 0)] <= 120.0).all()  # without one, not over the line
    # Nobody has a permit while the other's rear is still on its way.
    for i, j in ((0, 1), (1, 0)):
        inside = (lane[:, j] == 3 * j + 1) & (history[:, j, ALONG] - LENGTH / 2 < 8.0 + 1.0)
        assert not (inside & (permit[:, i] == 3 * i + 1)).any()
        assert not (inside & (lane[:, i] == 3 * i + 1)).any()


@pytest.mark.parametrize("speed", [4.0, 8.0, 15.0])
@pytest.mark.parametrize("phase", np.arange(0.0, 15.0, 2.5))
def test_the_ego_car_that_comes_crosswise_goes_first(crossing, speed, phase):
    """It is two to three seconds from the junction; a car that would be there as soon lets it pass, but does not wait
    while it drives away."""
    world = cars_on(crossing, (0, 105.0, 6.0, 1.0))
    car = ego(128.0, 128.0 - 2.0 * speed - phase * speed / 15.0, math.pi / 2, speed)
    while car[Y] < 132.0:
        step_traffic(crossing, D, world, car)
        assert world[0, LANE] == 0
        car[Y] += speed * DT
    car[Y] = 150.0
    assert {1, 2} <= set(watch(crossing, world, 15, car)[:, 0, LANE])


def test_a_junction_is_left_free_while_there_is_no_room_behind(crossing):
    """Cars stand behind the junction: who would have to stop in it stays before it."""
    rows = [(0, 110.0 - 12.0 * k, 6.0, 1.0) for k in range(5)]
    history = watch(crossing, cars_on(crossing, *rows, (3, 20.0, 6.0, 1.0)), 120, ego(150.0, 128.0))
    queue = history[-1, :-1]
    inside = (queue[:, LANE] == 1) | ((queue[:, LANE] == 2) & (queue[:, ALONG] < LENGTH / 2))
    assert (queue[:, SPEED] < 0.02).all()
    assert {0, 2} <= set(queue[:, LANE])
    assert not inside.any()
    assert 5 in history[:, -1, LANE]  # and the crossing way is open


def test_a_car_that_stands_in_a_junction_for_long_is_taken_away(crossing):
    """Else two cars in a junction that wait for each other would stop all traffic for ever."""
    world = cars_on(crossing, (1, 6.0, 0.0, 1.0), (0, 100.0, 0.0, 0.0))
    world[0, [state.NEXT, state.SECOND_NEXT]] = 4, 5  # across the way of the other one,
    world[1, PERMIT] = 1  # which may enter and never does
    history = watch(crossing, world, 90)
    gone = np.flatnonzero(history[:, 0, LANE] < 0)
    assert 60.0 < gone[0] * DT < 75.0
    assert (history[:, 1, LANE] == 0).all()


def test_the_second_of_a_queue_has_no_permit_before_the_first():
    """Else two queues could wait for each other for ever, each first car for the second of the other. Here the ego car
    is in the first car's way, while the second wants to turn right, where the road is free."""
    turn = Path(120.0, 128.0, 0.0, ((math.pi / 2 * 8.0, -1.0 / 8.0),))  # lane 6, from the eastern way
    south = Path(128.0, 120.0, -math.pi / 2, ((256.0, 0.0),))  # lane 7, round the torus into itself
    network = network_of([*crossing_paths(), turn, south], 256.0, 256.0)
    world = cars_on(network, (0, 116.0, 0.0, 1.0), (0, 110.0, 0.0, 1.0))
    world[1, [state.NEXT, state.SECOND_NEXT]] = 6, 7
    assert {6} < set(network.successors[0])
    stuck = watch(network, world, 20, ego(134.0, 128.0))
    assert (stuck[:, :, PERMIT] == -1.0).all()
    assert (stuck[:, :, LANE] == 0).all()
    after = watch(network, stuck[-1], 20)
    assert 1 in after[:, 0, LANE]
    assert 6 in after[:, 1, LANE]
    assert 6 in watch(network, world[1:], 20, ego(134.0, 128.0))[:, 0, LANE]  # alone it does not wait


def test_a_fast_car_passes_a_slow_one(abreast):
    world = cars_on(abreast, (1, 200.0, 8.0, 0.5), (1, 150.0, 15.0, 1.0))
    world[0, LANE_TIMER] = 1e6  # it does not give way
    history = watch(abreast, world, 60)
    assert 0 in history[:, 1, LANE]
    assert history[-200:, 1, SPEED] == pytest.approx(20.0, abs=0.3)
    assert history[:, 0, SPEED].max() < 10.5
    # It moves over: never a jump of more than what a lane change's speed allows.
    y = history[:, 1, Y].astype(float)
    assert np.abs(np.diff(y)).max() < CONFIG.traffic.lane_change_speed * DT + 1e-3
    assert y.max() == pytest.approx(35.75, abs=0.05)
    heading = np.degrees(np.arctan2(history[:, 1, SIN], history[:, 1, COS]))
    assert np.abs(heading).max() > 2.0
    assert np.abs(np.diff(heading)).max() < 2.0  # and it turns as gently as in a bend


@pytest.mark.parametrize(("behind", "gives_way"), [(40.0, False), (16.0, True)])
def test_a_car_changes_lanes_for_a_faster_one_behind(abreast, behind, gives_way):
    """Equation 2 of Kesting et al. 2007: a car that gains nothing itself moves over for what its follower gains."""
    world = cars_on(abreast, (1, 200.0, 8.0, 0.4), (1, 200.0 - behind, 8.0, 1.0))
    world[1, LANE_TIMER] = 9.0
    step_traffic(abreast, D, world, NOBODY)
    assert (world[0, LANE] == 0) == gives_way


@pytest.mark.parametrize("piece", [1024.0, 16.0])
@pytest.mark.parametrize(("behind", "changes"), [(36.0, False), (44.0, True)])
def test_no_car_cuts_in_where_its_new_follower_would_have_to_brake_hard(piece, behind, changes):
    """MOBIL's safety criterion, for a car that is held up and does not care what others lose; its follower may be some
    pieces of the lane behind."""
    abreast = two_lanes(piece)
    rows = (1, 214.8, 8.0, 0.4), (1, 200.0, 8.0, 1.0), (0, 200.0 - behind, 16.0, 1.2)
    world = cars_on(abreast, *((int(2 * (x // piece) + side), x % piece, *more) for side, x, *more in rows))
    world[[0, 2], LANE_TIMER] = 9.0
    brakes = -oracle.idm(CONFIG, 16.0, 24.0, behind - LENGTH, 8.0)
    assert (brakes <= CONFIG.traffic.safe_braking) == changes
    step_traffic(abreast, D._replace(politeness=F(0.0)), world, NOBODY)
    assert (world[1, LANE] % 2 == 0) == changes


@pytest.mark.parametrize(
    ("scenario", "length", "width"),
    [*((name, 4.0, 2.0) for name in REGISTRY), ("highway", 6.0, 2.2), ("city", 4.0, 2.2), ("seamless", 4.0, 3.0)],
)
def test_nobody_drives_into_an_ego_car_that_stands_or_off_the_road(scenario, length, width):
    """Six starts among 24 cars, two minutes each; on the highway cars behind it change lanes."""
    config = SimConfig(vehicle=VehicleConfig(length=length, width=width))
    k = constants(config)
    for seed in (3, 5, 6, 8, 10, 12):
        here = build(scenario, HELD_OUT_SEED + seed, config)
        start = sample_starts(here, 1, np.random.default_rng(seed))
        world = spawn(here.network, start, 24, np.array([seed], dtype=np.uint64), config)[0]
        sides = np.array([here.network.width, here.network.height])
        x, y = start[0, :2] % sides
        stands = ego(x, y, start[0, 2])
        history = watch(here.network, world, 120, stands, config)
        cars = history[history[..., LANE] >= 0]
        away = (stands[[X, Y]] - cars[:, [X, Y]] + sides / 2) % sides - sides / 2
        close = np.hypot(*away.T) < k.contact
        for near, between in zip(cars[close], away[close], strict=True):
            assert not boxes_touch(k, *between, near[COS], near[SIN], stands[COS], stands[SIN])
        poses = np.column_stack([cars[:, X], cars[:, Y], np.arctan2(cars[:, SIN], cars[:, COS])])
        assert not crashes(here.road, poses, config).any()


@pytest.mark.parametrize(("seed", "cars"), [(1, 0), (2, 30)])
@pytest.mark.parametrize("scenario", REGISTRY)
def test_traffic_alone_neither_crashes_nor_stops(scenario, seed, cars):
    """Five minutes at the default density (6 where that is none), and at several times it; `benchmarks/traffic.py`
    is the same for hours."""
    network = build(scenario, seed).network
    count = cars or REGISTRY[scenario].traffic or 6
    world = spawn(network, FAR[None], count, np.array([seed], dtype=np.uint64), CONFIG)
    history = watch(network, world[0], 300).astype(float)
    there = history[0, :, LANE] >= 0
    assert there.sum() >= (cars or 4) * 0.8
    assert (history[-1, ~there, LANE] < 0).all()  # those that there was no room for
    metres = np.repeat(network.steps.astype(np.float64), np.diff(network.offsets))
    alone = metres.sum() / (metres / network.speeds).sum()  # m/s over all lanes, as fast as they allow
    assert min(history[:, there, SPEED].mean(), history[-600:, there, SPEED].mean()) > alone / 2
    # Each car is always on its lane.
    for lane, along in zip(history[::50, there, LANE].ravel(), history[::50, there, ALONG].ravel(), strict=True):
        assert 0.0 <= along < lane_length(network, int(lane))
