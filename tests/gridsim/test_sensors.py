"""Rays against exact geometry and cars, the occupancy grid cell by cell; what overlaps, and that nothing tunnels."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from pictures import cars_on, small_map, straight_road

from gridsim.car.vehicle import Action
from gridsim.collision import hits_box, stands_ahead, top_speed_near
from gridsim.config import SensorConfig, SimConfig, TrafficConfig, VehicleConfig, constants
from gridsim.jit import njit
from gridsim.maps.lanes import Path, lay_lanes
from gridsim.maps.map import Map
from gridsim.maps.network import make_network
from gridsim.maps.roads import THICK_WALL, Strips, clearance_nodes, make_road
from gridsim.maps.scenarios import build
from gridsim.sensing.grid import grid_table, grids
from gridsim.sensing.rays import cast_boxes, fan, sense
from gridsim.simulator import Simulator
from gridsim.state import COS, DISTANCE, IDLE, LANE, SIN, SPEED, TRAFFIC_FIELDS, End, X, Y

F = np.float32
CONFIG = SimConfig()
K = constants(CONFIG)
SIDE = 256.0
REACH = 50.0
ANGLES = np.radians(np.linspace(-60.0, 60.0, 31))


def look(road, points, headings, k=K, count=31):
    """Kernel ranges [n, rays] from points [n, 2] with headings [n]."""
    table = fan(count, k.ray_first, k.ray_step)
    ranges = np.full((len(points), count), np.nan, dtype=F)
    for (x, y), heading, row in zip(points, headings, ranges, strict=True):
        sense(road, table, k.ray_range, F(x), F(y), F(np.cos(heading)), F(np.sin(heading)), row)
    return ranges


def random_points(exact, n, rng, margin=0.0):
    """Points float32 [n, 2], uniform over what is road with `margin` (m) to its edge."""
    points = rng.uniform(0.0, exact.width, (n * 8 + 4000, 2)).astype(F)
    points = points[exact.clearance(points) > margin]
    assert len(points) >= n
    return points[:n]


@pytest.fixture(scope="module")
def places():
    """Of each of four maps: its road, the exact one, and on it 2,500 points [n, 2] with headings [n]."""
    found = []
    for seed in range(4):
        scenario, rng = build("seamless", seed), np.random.default_rng(1000 + seed)
        exact = oracle.ExactRoad(scenario.strips, SIDE, SIDE)
        points = random_points(exact, 2500, rng)
        found.append((scenario.road, exact, points, rng.uniform(-math.pi, math.pi, len(points)).astype(F)))
    return found


def test_rays_are_those_of_the_exact_geometry(places):
    """10,000 poses: any place on the road, any heading."""
    ranges = [look(road, points, headings).astype(float) for road, _, points, headings in places]
    exact_ranges = [exact.cast(points, headings[:, None] + ANGLES, REACH) for _, exact, points, headings in places]
    seen, true = np.concatenate(ranges), np.concatenate(exact_ranges)
    error = np.abs(seen - true)
    assert np.quantile(error, 0.5) <= 0.03
    assert np.quantile(error, 0.99) <= 0.2
    assert seen.min() >= 0.0
    assert seen.max() == REACH
    # A ray far off is one that grazes an edge: the road 10 cm narrower or wider explains it.
    _, exact, points, headings = places[0]
    inner = np.flatnonzero(exact.clearance(points) > 0.15)[:1000]
    low, high = (exact.widened(by).cast(points[inner], headings[inner, None] + ANGLES, REACH) for by in (-0.1, 0.1))
    assert ((ranges[0][inner] < low - 0.2) | (ranges[0][inner] > high + 0.2)).mean() < 0.003


@pytest.mark.parametrize(
    ("half", "wall", "thinnest"),
    [
        *((half, wall, 0.8) for half in (3.0, 4.0, 8.0) for wall in (0.8, 1.3)),
        *((half, wall, 1.0) for half in (3.0, 4.0, 8.0) for wall in (1.0, 1.3, 2.0)),
        *((4.0, wall, THICK_WALL) for wall in (3.0, 4.0)),
    ],
)
def test_no_ray_passes_a_wall(half, wall, thinnest):
    """Two roads side by side, a wall between them: rays from one never reach the other, from wherever they start."""
    strips = [[0, 20.2, 64, 20.2, half], [0, 20.2 + 2 * half + wall, 64, 20.2 + 2 * half + wall, half]]
    road = small_map(strips).road._replace(thinnest=F(thinnest))
    rng = np.random.default_rng(3)
    points = np.stack([rng.uniform(0, 64, 1000), 20.2 + (half - 0.5) * rng.uniform(-1, 1, 1000)], axis=1).astype(F)
    headings = rng.uniform(0.1, math.pi - 0.1, 1000)
    top = points[:, 1:] + look(road, points, headings) * np.sin(headings[:, None] + ANGLES)
    assert top.max() < 20.2 + half + 0.1
    assert top.max() > 20.2 + half - 0.1


def test_rays_see_parked_cars():
    """Posts of 1 m x 1 m and cars of 1.8 m x 4 m on a wide road: a ray that meets one's inner part ends there.

    Inner, by 0.36 m: then the way through the block is 1 m or more even across a corner, and rays look out for that.
    """
    rng = np.random.default_rng(8)
    blocks = []
    for size in ((0.5, 0.5), (2.0, 0.9)):
        x, y = np.meshgrid(np.arange(8, 128, 16), np.arange(8, 128, 16))
        at = np.stack([x.ravel(), y.ravel() + (8.0 if size[0] > 1 else 0.0)], axis=1) + rng.uniform(-2, 2, (64, 2))
        blocks += [[*p, rng.uniform(0, 3), *size] for p in at]
    strips = Strips.of(np.array([[0.0, y, 128.0, y, 24.0] for y in (16.0, 48.0, 80.0, 112.0)]), (), blocks)
    exact, inner = oracle.ExactRoad(strips, 128.0, 128.0), oracle.ExactRoad(strips, 128.0, 128.0)
    inner.blocks[:, 3:5] -= 0.36
    road = make_road(clearance_nodes(strips, 128.0, 128.0), (5.0, 12.0), 1.0)
    points = random_points(exact, 1500, rng, margin=0.3)
    headings = rng.uniform(-math.pi, math.pi, len(points))
    ends = inner.cast(points, headings[:, None] + ANGLES, REACH) + 0.5
    careful, quick = (look(road._replace(thinnest=F(wall)), points, headings) for wall in (1.0, THICK_WALL))
    assert (careful > ends).mean() < 2e-4
    assert (quick > ends).mean() > 5 * (careful > ends).mean()


@pytest.mark.parametrize(("rays", "view"), [(2, 120.0), (32, 60.0), (33, 200.0), (64, 240.0)])
def test_any_number_of_rays(places, rays, view):
    k = constants(SimConfig(sensors=SensorConfig(rays=rays, field_of_view=view)))
    road, exact, points, headings = places[0]
    points, headings = points[:300], headings[:300]
    seen = look(road, points, headings, k, rays)
    angles = headings[:, None] + np.radians(np.linspace(-view / 2, view / 2, rays))
    error = np.abs(seen - exact.cast(points, angles, REACH))
    assert np.quantile(error, 0.5) <= 0.03
    assert np.quantile(error, 0.97) <= 0.2


# --- The occupancy grid ----------------------------------------------------------------------------------------------


def cell_by_cell(config, ranges):
    """The textbook, float64: each cell on its own, from its centre's angle and distance; where float32 may differ."""
    sensors, at = config.sensors, 0.5 * np.arange(80) + 0.25
    rays = np.radians(np.linspace(-sensors.field_of_view / 2, sensors.field_of_view / 2, sensors.rays))
    ahead, left = 40.0 - at[:, None], 20.0 - at
    angle, distance = np.arctan2(left, ahead), np.hypot(left, ahead)
    hit = ranges[np.abs(rays - angle[..., None]).argmin(axis=2)].astype(float)
    free = hit >= sensors.range
    near, far = (np.where(free, sensors.range, hit + h) for h in (-math.hypot(0.25, 0.25), math.hypot(0.25, 0.25)))
    seen = np.abs(angle) <= math.radians(sensors.field_of_view / 2)
    grid = np.where(distance < near, 127, np.where(~free & (distance <= far), 255, 0))
    near_an_edge = np.minimum(np.abs(distance - near), np.abs(distance - far)) < 1e-4
    return np.where(seen, grid, 0), seen & near_an_edge


SHARES = st.floats(0.0, 1.0, width=32) | st.just(1.0)
OTHERS = [SensorConfig(rays=61), SensorConfig(rays=7, field_of_view=60.0, range=30.0)]


@settings(max_examples=40, derandomize=True, deadline=None)
@example(sensors=CONFIG.sensors, shares=np.zeros(61, dtype=F))
@example(sensors=CONFIG.sensors, shares=np.ones(61, dtype=F))
@example(sensors=CONFIG.sensors, shares=np.where(np.arange(61) % 2, 0.2, 1.0).astype(F))
@given(sensors=st.sampled_from([CONFIG.sensors, *OTHERS]), shares=arrays.arrays(F, 61, elements=SHARES))
def test_every_cell_is_what_geometry_says(sensors, shares):
    config, ranges = SimConfig(sensors=sensors), shares[: sensors.rays] * F(sensors.range)
    expected, unsure = cell_by_cell(config, ranges)
    assert (grids(grid_table(config), ranges[None])[0] == expected)[~unsure].all()
    assert unsure.mean() < 0.1


# --- Other cars as boxes ---------------------------------------------------------------------------------------------


FAN = fan(31, K.ray_first, K.ray_step)


def parked(*poses):
    """A world with cars at poses (x, y, heading)."""
    world = np.zeros((len(poses), TRAFFIC_FIELDS), dtype=F)
    world[:, [X, Y, COS, SIN]] = directed(np.array(poses, dtype=float))
    return world


@njit
def _cast(k, rays, side, poses, worlds, ranges):
    closing = np.empty(ranges.shape[1], dtype=np.float32)
    for i in range(len(poses)):
        x, y, cosine, sine = poses[i]
        cast_boxes(k, rays, side, side, x, y, cosine, sine, (F(0.0), F(0.0)), worlds[i], ranges[i], closing)


@njit
def _hits(k, poses, worlds, hits):
    for i in range(len(poses)):
        x, y, cosine, sine = poses[i]
        hits[i] = hits_box(k, worlds[i], F(0.0), F(0.1), F(SIDE), F(SIDE), x, y, cosine, sine)


def directed(poses):
    """Poses [n, 3] as kernels read them: float32 [n, 4], x, y, cosine, sine."""
    return np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])]).astype(F)


# --- Rays that meet cars ---------------------------------------------------------------------------------------------


def test_rays_are_the_oracles():
    """Sensors and boxes anywhere on the torus, most of them near each other, some overlapping, some across the seam."""
    rng = np.random.default_rng(3)
    n, cars = 1500, 3
    sensors = np.column_stack([rng.uniform(0, SIDE, (n, 2)), rng.uniform(-math.pi, math.pi, n)])
    sensors[:300, 0] = rng.uniform(-3.0, 3.0, 300) % SIDE  # at the seam
    away = rng.gamma(2.0, 8.0, (n, cars))
    bearing = rng.uniform(-math.pi, math.pi, (n, cars))
    offsets = np.stack([away * np.cos(bearing), away * np.sin(bearing)], axis=-1)
    turns = rng.uniform(-math.pi, math.pi, (n, cars, 1))
    boxes = np.concatenate([(sensors[:, None, :2] + offsets) % SIDE, turns], axis=-1)
    boxes[300:600, :, 2] = sensors[300:600, 2, None]  # rays that are parallel to two sides
    boxes, sensors = boxes.astype(F).astype(float), sensors.astype(F).astype(float)
    ranges = np.full((n, 31), 50.0, dtype=F)
    _cast(K, FAN, F(SIDE), directed(sensors), np.stack([parked(*row) for row in boxes]), ranges)
    grazing = 0  # rays that graze a corner: either answer is right
    for pose, near, seen in zip(sensors, boxes, ranges, strict=True):
        larger, smaller = (
            np.minimum(oracle.rays_to_boxes(CONFIG, (SIDE, SIDE), pose[:2], pose[2] + ANGLES, near, margin), 50.0)
            for margin in (2e-4, -2e-4)
        )
        assert (seen >= larger - 1e-3).all()
        assert (seen <= smaller + 1e-3).all()
        grazing += (np.abs(smaller - larger) >= 0.01).sum()
    assert grazing < 0.02 * ranges.size
    assert 0.03 < (ranges == 0.0).all(axis=1).mean() < 0.3  # from within a box
    assert 0.2 < (ranges < 50.0).mean() < 0.8


# --- Overlap ---------------------------------------------------------------------------------------------------------


def outlines_meet(one, other):
    """Whether rectangles [n, 4, 2] share ground with others, as none lies before the other along an edge: bool [n]."""
    apart = np.zeros(len(one), dtype=bool)
    for of in (one, other):
        for edge in (of[:, 1] - of[:, 0], of[:, 2] - of[:, 1]):
            a, b = (np.vecdot(corners, edge[:, None]) for corners in (one, other))
            apart |= (a.max(axis=1) < b.min(axis=1)) | (b.max(axis=1) < a.min(axis=1))
    return ~apart


@pytest.mark.parametrize("vehicle", [VehicleConfig(), VehicleConfig(length=6.0, width=2.2)])
def test_all_contacts_are_found(vehicle):
    """100,000 pairs of cars, some across the seam, some parallel."""
    config, rng, n = SimConfig(vehicle=vehicle), np.random.default_rng(4), 100_000
    away, bearing = rng.uniform(0.0, 7.5, n), rng.uniform(-math.pi, math.pi, n)
    one = np.column_stack([rng.uniform(0.0, SIDE, (n, 2)), rng.uniform(-math.pi, math.pi, n)]).astype(F)
    other = one + np.column_stack([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-3.0, 3.0, n)])
    other[:10_000, 2] = one[:10_000, 2]
    hits = np.zeros(n, dtype=bool)
    a, b = vehicle.length / 2, vehicle.width / 2
    _hits(constants(config), directed(one), parked(*np.column_stack([other[:, :2] % SIDE, other[:, 2]]))[:, None], hits)
    smaller, larger = (
        outlines_meet(*(oracle.corners(pose.astype(float), a + margin, b + margin) for pose in (one, other)))
        for margin in (-1e-3, 1e-3)
    )
    assert hits[smaller].all()
    assert larger[hits].all()
    assert (hits & (away > vehicle.length - 1.0)).sum() > 1000


@njit
def _met(k, world, width, height, x, y, cosine, sine):
    speed = top_speed_near(world, F(10.0), width, height, x, y)
    hit = hits_box(k, world, F(0.0), F(0.1), width, height, x, y, cosine, sine)
    return speed, hit, stands_ahead(k, world, width, height, x, y, cosine, sine)


@pytest.mark.parametrize(("pose", "other"), [((1023, 60, 0.0), (2, 60)), ((500, 127, math.pi / 2), (500, 2))])
def test_a_car_is_met_across_both_seams_of_a_map_that_is_not_square(pose, other):
    world = parked((*other, pose[2]))
    world[0, SPEED] = 0.25
    assert _met(K, world, F(1024.0), F(128.0), *directed(np.array([pose], dtype=float))[0]) == (0.25, True, True)


# --- Collisions in the simulator -------------------------------------------------------------------------------------

BLIND = SimConfig(traffic=TrafficConfig(braking=1e-6, acceleration=1e-6))  # keeps its speed, whatever is ahead


@pytest.fixture(scope="module")
def cross():
    """A road of 20 m along x, one along y, and a lane in the middle of each, one westwards and one northwards."""
    strips = Strips.of([[0.0, 128.0, SIDE, 128.0, 10.0], [128.0, 0.0, 128.0, SIDE, 10.0]])
    straight = ((SIDE, 0.0),)
    lanes = lay_lanes([Path(SIDE, 128.0, math.pi, straight), Path(128.0, 0.0, math.pi / 2, straight)], SIDE, SIDE)
    road = make_road(clearance_nodes(strips, SIDE, SIDE), (5.0, 12.0), 1.0)
    return Map("cross", 0, road, strips, make_network(lanes, straight_road(SIDE, SIDE, 30.0), CONFIG))


def meet(scenario, start, lane, along):
    """Drive in a `BLIND` world of one car, `along` m along a lane, until the episode ends; (simulator, End)."""
    world = cars_on(scenario.network, (lane, along, 30.0, 1.0))
    simulator = Simulator(1, BLIND, traffic=1)
    simulator.reset(scenario, np.array([start], dtype=F), worlds=world[None])
    for _ in range(40):
        simulator.step(np.array([Action.NONE]))
        if simulator.ends[0]:
            break
    return simulator, End(int(simulator.ends[0]))


@pytest.mark.parametrize("aside", [0.0, -1.9, 2.1])
def test_nothing_tunnels_through_head_on_at_60_mps(cross, aside):
    """6 m a control period, at every phase of it, over the seam; and past each other with 10 cm to spare."""
    for phase in np.arange(0.0, 6.0, 0.4):
        simulator, end = meet(cross, [229.0, 128.0 + aside, 0.0, 30.0, 0.0], 0, SIDE - 23.0 - phase)
        assert end == (End.COLLISION if abs(aside) < 2.0 else End.RUNNING)
        car, other = simulator.cars[0], simulator.worlds[0, 0]
        assert other[SPEED] == pytest.approx(30.0, abs=1e-3)
        if end == End.COLLISION:
            # They met half way; each moves half a metre at most between two looks.
            meeting = 229.0 + (50.0 + phase) / 2 - 2.0
            assert -0.01 <= car[X] - meeting < 0.5


@pytest.mark.parametrize(("speed", "steering"), [(5.0, 0.0), (8.0, 0.1), (8.0, -0.4), (20.0, 0.3), (-2.0, 0.4)])
@pytest.mark.parametrize(("heading", "pace"), [(math.pi, 7.0), (0.0, 7.0), (0.0, 0.0), (math.pi / 2, 7.0)])
def test_a_ray_tells_how_fast_the_car_that_it_meets_comes_closer(cross, speed, steering, heading, pace):
    """It comes towards us, drives away, stands, crosses. By finite differences of the middle of the front axle, which a
    turning car moves sideways."""
    simulator = Simulator(1, CONFIG, traffic=1, features=("motion",))
    world = parked((116.0, 128.0, heading))
    world[0, SPEED] = pace
    simulator.closing[:] = 99.0
    simulator.reset(cross, np.array([[100.0, 128.0, 0.0, speed, steering]]), worlds=world[None])
    kappa, step = oracle.curvature(CONFIG, speed, steering), 1e-4
    poses = [oracle.on_arc(CONFIG, (0.0, 0.0, 0.0), kappa, way) for way in (-step * speed, step * speed)]
    before, after = (np.array([x + 1.25 * math.cos(turn), y + 1.25 * math.sin(turn)]) for x, y, turn in poses)
    velocity = (after - before) / (2 * step) - pace * np.array([math.cos(heading), math.sin(heading)])
    rays = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    met = (simulator.ranges[0] < 15.0) & (np.abs(ANGLES) < math.radians(9.0))
    assert met.sum() >= 3
    assert simulator.closing[0][met] == pytest.approx(rays[met] @ velocity, abs=1e-3)
    assert (simulator.closing[0][~met] == 0.0).all(), "the road's edge has no motion"


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.5])
def test_mirrors_show_how_far_behind_the_next_cars_to_the_right_and_to_the_left_are(cross, heading):
    """Places in the car's own frame: m ahead of its middle and m to its left; some are over the seam."""
    start = np.array([[1.0, 128.0, heading, 6.0, 0.0]])
    ahead, aside = np.array([math.cos(heading), math.sin(heading)]), np.array([-math.sin(heading), math.cos(heading)])
    shown = {  # of two cars, and the angle of their headings to ours: ways back on the right and on the left
        ((-9.0, -3.0), (-12.0, 3.0), 0.1): (5.0, 8.0),
        ((-14.0, -3.0), (-9.0, -4.0), -0.7): (5.0, 20.0),  # the next one
        ((-1.0, 2.3), (1.5, -2.3), 0.1): (0.0, 0.0),  # alongside
        ((-9.0, 0.5), (-9.0, 6.0), 0.1): (20.0, 20.0),  # straight behind; two lanes away
        ((3.0, 2.5), (-30.0, -3.0), 0.1): (20.0, 20.0),  # ahead, where rays are; too far
        ((-9.0, -3.0), (-12.0, 3.0), 0.9): (20.0, 20.0),  # they come from the side
        ((-9.0, -3.0), (-12.0, 3.0), math.pi): (20.0, 20.0),  # they drive the other way
    }
    simulator = Simulator(1, CONFIG, traffic=2, features=("mirrors",))
    for (*places, turn), expected in shown.items():
        poses = [(*(start[0, :2] + x * ahead + y * aside) % SIDE, heading + turn) for x, y in places]
        simulator.reset(cross, start, worlds=parked(*poses)[None])
        assert simulator.observations[0, -2:] * 20.0 == pytest.approx(expected, abs=1e-4), places
    simulator.reset(cross, start)
    assert (simulator.observations[0, -2:] == 1.0).all()


@pytest.mark.parametrize("offset", [-2.8, 0.0, 2.8])
def test_nothing_tunnels_through_crosswise(cross, offset):
    """Both at 30 m/s, at right angles, so that the middle of one is `offset` m short when that of the other crosses."""
    for phase in np.arange(0.0, 3.0, 0.4):
        _, end = meet(cross, [98.0 - phase - offset, 128.0, 0.0, 30.0, 0.0], 1, 98.0 - phase)
        assert end == End.COLLISION


# --- Standing behind a standing car ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("gap", "ends"), [(3.0, False), (9.5, False), (11.0, True), (-11.0, True), (None, True)])
def test_waiting_behind_a_standing_car_is_not_idle(cross, gap, ends):
    """Standing 5 s, bumper to bumper so many m behind a car that stands, 3 m in front of it, and alone."""
    simulator = Simulator(1, BLIND, traffic=1)
    world = cars_on(cross.network, (0, 100.0, 0.0, 1.0))
    if gap is None:
        world[0, LANE] = -1.0
    start = [SIDE - 100.0 + 4.0 + (gap or 3.0), 128.0, math.pi, 0.0, 0.0]
    simulator.reset(cross, np.array([start], dtype=F), worlds=world[None])
    for step in range(50):
        simulator.step(np.array([Action.NONE]))
        assert simulator.ends[0] == (End.IDLE if ends and step >= 14 else End.RUNNING)
    assert simulator.cars[0, DISTANCE] == 0.0
    assert simulator.cars[0, IDLE] == (15 if ends else 0)
