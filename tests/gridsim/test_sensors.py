"""The 31 rays against exact geometry, and the occupancy grid against the textbook, cell by cell."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from pictures import small_map

from gridsim.config import SensorConfig, SimConfig, constants
from gridsim.maps.roads import THICK_WALL, Strips, clearance_nodes, make_road
from gridsim.maps.scenarios import build
from gridsim.sensing.grid import grid_table, grids
from gridsim.sensing.rays import fan, sense

F = np.float32
CONFIG = SimConfig()
K = constants(CONFIG)
SIDE = 256.0
REACH = 50.0
RAYS = np.radians(np.linspace(-60.0, 60.0, 31))


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
    exact_ranges = [exact.cast(points, headings[:, None] + RAYS, REACH) for _, exact, points, headings in places]
    seen, true = np.concatenate(ranges), np.concatenate(exact_ranges)
    error = np.abs(seen - true)
    assert np.quantile(error, 0.5) <= 0.03
    assert np.quantile(error, 0.99) <= 0.2
    assert seen.min() >= 0.0
    assert seen.max() == REACH
    # A ray far off is one that grazes an edge: the road 10 cm narrower or wider explains it.
    _, exact, points, headings = places[0]
    inner = np.flatnonzero(exact.clearance(points) > 0.15)[:1000]
    angles = headings[inner, None] + RAYS
    low, high = (exact.widened(by).cast(points[inner], angles, REACH) for by in (-0.1, 0.1))
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
    ranges = look(road, points, headings)
    top = points[:, 1:] + ranges * np.sin(headings[:, None] + RAYS)
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
    lines = np.array([[0.0, y, 128.0, y, 24.0] for y in (16.0, 48.0, 80.0, 112.0)])
    strips = Strips.of(lines, (), blocks)
    exact, inner = oracle.ExactRoad(strips, 128.0, 128.0), oracle.ExactRoad(strips, 128.0, 128.0)
    inner.blocks[:, 3:5] -= 0.36
    road = make_road(clearance_nodes(strips, 128.0, 128.0), (5.0, 12.0), 1.0)
    points = random_points(exact, 1500, rng, margin=0.3)
    headings = rng.uniform(-math.pi, math.pi, len(points))
    angles = headings[:, None] + RAYS
    ends = inner.cast(points, angles, REACH) + 0.5
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
    """Of ranges that are shares of the sensor's."""
    config, ranges = SimConfig(sensors=sensors), shares[: sensors.rays] * F(sensors.range)
    expected, unsure = cell_by_cell(config, ranges)
    assert (grids(grid_table(config), ranges[None])[0] == expected)[~unsure].all()
    assert unsure.mean() < 0.1
