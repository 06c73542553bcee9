"""The 31 rays against exact geometry, and the vector code against the plain kernel."""

import math

import numba
import numpy as np
import oracle
import pytest

from gridsim.config import SensorConfig, SimConfig, constants
from gridsim.maps.roads import HEADING_BINS, Strips, clearance_nodes, make_road
from gridsim.maps.scenarios import build
from gridsim.sensing.rays import AMONG_THIN_WALLS, PLAIN, fan, fast_march, fast_march_thin, march, sense
from gridsim.sensing.simd import SIMD_RAYS

F = np.float32
K = constants(SimConfig())
SIDE = 256.0
REACH = 50.0
RAYS = np.radians(np.linspace(-60.0, 60.0, 31))
POSES_A_MAP = 2500
MAPS = (0, 1, 2, 3)


@numba.njit
def vector_march(field, columns, rows, px, py, reach, beams):
    fast_march(field, columns, rows, px, py, reach, beams)


@numba.njit
def vector_march_thin(field, columns, rows, px, py, reach, beams):
    fast_march_thin(field, columns, rows, px, py, reach, beams)


def look(road, points, headings, k=K, count=31):
    """Kernel ranges [n, rays] from points [n, 2] with headings [n]."""
    table = fan(count, k.ray_first, k.ray_step)
    beams = np.empty((3, SIMD_RAYS), dtype=F)
    ranges = np.full((len(points), count), np.nan, dtype=F)
    for (x, y), heading, row in zip(points, headings, ranges, strict=True):
        sense(road, table, k.ray_first, k.ray_range, F(x), F(y), F(np.cos(heading)), F(np.sin(heading)), beams, row)
    return ranges


def random_points(exact, n, rng, margin=0.0, side=SIDE):
    """Points float32 [n, 2], uniform over what is road with `margin` (m) to its edge."""
    points = rng.uniform(0.0, side, (n * 8 + 4000, 2)).astype(F)
    points = points[exact.clearance(points) > margin]
    assert len(points) >= n
    return points[:n]


class Views:
    """Poses on the road of one map, what the kernel sees there, and what is there."""

    def __init__(self, seed, name="seamless", count=POSES_A_MAP):
        self.scenario = build(name, seed)
        self.exact = oracle.ExactRoad(self.scenario.strips, SIDE, SIDE)
        rng = np.random.default_rng(1000 + seed)
        self.points = random_points(self.exact, count, rng)
        self.headings = rng.uniform(-math.pi, math.pi, count).astype(F)
        self.angles = self.headings[:, None].astype(float) + RAYS
        self.seen = look(self.scenario.road, self.points, self.headings).astype(float)
        self.true = self.exact.cast(self.points, self.angles, REACH)

    def with_edges_moved(self, margin, of=slice(None)):
        return self.exact.widened(margin).cast(self.points[of], self.angles[of], REACH)


@pytest.fixture(scope="module")
def views():
    return [Views(seed) for seed in MAPS]


@pytest.fixture(scope="module")
def scenario(views):
    return views[0].scenario


def test_rays_are_those_of_the_exact_geometry(views):
    """10,000 poses: any place on the road, any heading."""
    seen, true = (np.concatenate([getattr(v, name) for v in views]) for name in ("seen", "true"))
    assert seen.shape == (10_000, 31)
    error = np.abs(seen - true).ravel()
    # A ray grazes an edge where a shift of the edges by 3 cm changes its range most: told from the geometry alone.
    shift = np.concatenate([v.with_edges_moved(0.03) - v.with_edges_moved(-0.03) for v in views]).ravel()
    kept = error[np.argsort(shift, kind="stable")[: round(0.995 * error.size)]]
    p50, p99 = np.quantile(kept, [0.5, 0.99])
    print(f"rays, without the 0.5 % that graze an edge: p50 {p50:.4f} m, p99 {p99:.4f} m; ", end="")
    print("all of them: p50 {:.4f} m, p99 {:.4f} m".format(*np.quantile(error, [0.5, 0.99])))
    assert p50 <= 0.03
    assert p99 <= 0.2
    assert np.quantile(error, 0.99) <= 0.2


def test_a_ray_far_off_is_a_grazing_one(views):
    """Nearly every ray lies between the exact ranges of a road with edges 0.1 m further in and 0.1 m further out."""
    view = views[0]
    inner = np.flatnonzero(view.exact.clearance(view.points) > 0.15)[:1000]
    low, high = view.with_edges_moved(-0.1, inner), view.with_edges_moved(0.1, inner)
    seen = view.seen[inner]
    outside = (seen < low - 0.2) | (seen > high + 0.2)
    print(f"rays not explained by edges 0.1 m off: {outside.mean():.5f}")
    assert outside.mean() < 0.003


def test_ranges_are_within_the_sensors_reach(views):
    seen = np.concatenate([v.seen for v in views])
    assert np.isfinite(seen).all()
    assert seen.min() >= 0.0
    assert seen.max() <= REACH
    assert (seen == REACH).any()


def test_the_first_ray_is_the_rightmost():
    road, _ = strip_road([[0, 32, 64, 32, 4.0]])
    ranges = look(road, [(20.0, 34.0)], [0.0])[0]
    # 2 m of road to the left, 6 m to the right.
    assert ranges[30] == pytest.approx(2.0 / math.sin(math.radians(60.0)), abs=0.05)
    assert ranges[0] == pytest.approx(6.0 / math.sin(math.radians(60.0)), abs=0.05)
    assert ranges[15] == REACH


def strip_road(lines=(), arcs=(), side=64.0):
    strips = Strips(np.array(lines, dtype=float).reshape(-1, 5), np.array(arcs, dtype=float).reshape(-1, 6))
    return make_road(clearance_nodes(strips, side, side), (5.0, 12.0), REACH), oracle.ExactRoad(strips, side, side)


def test_rays_on_a_ring():
    road, exact = strip_road(arcs=[[32, 32, 16, 0.0, 2 * math.pi, 4.0]])
    angle = np.linspace(0.0, 2 * math.pi, 50)
    points = np.stack([32 + 17 * np.cos(angle), 32 + 17 * np.sin(angle)], axis=1).astype(F)
    headings = angle + math.pi / 2
    true = exact.cast(points, headings[:, None] + RAYS, REACH)
    assert np.ptp(true, axis=0).max() < 1e-4  # it looks the same from everywhere, save for rounding of the point
    assert np.quantile(np.abs(look(road, points, headings) - true), 0.99) < 0.1


@pytest.mark.parametrize(
    ("half", "wall", "thin"),
    [
        *((half, wall, True) for half in (3.0, 4.0, 8.0) for wall in (1.0, 1.3, 2.0)),
        (4.0, 2.5, False),
        (4.0, 4.0, False),
    ],
)
def test_no_ray_passes_a_wall(half, wall, thin):
    """Two roads side by side, a wall between them: rays from one never reach the other, from wherever they start."""
    strips = [[0, 20.2, 64, 20.2, half], [0, 20.2 + 2 * half + wall, 64, 20.2 + 2 * half + wall, half]]
    road = strip_road(strips)[0]._replace(thin=np.uint32(thin))
    rng = np.random.default_rng(3)
    points = np.stack([rng.uniform(0, 64, 1000), 20.2 + (half - 0.5) * rng.uniform(-1, 1, 1000)], axis=1).astype(F)
    headings = rng.uniform(0.1, math.pi - 0.1, 1000)
    ranges = look(road, points, headings)
    angles = headings[:, None] + RAYS
    top = points[:, 1:] + ranges * np.sin(angles)
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
    strips = Strips(lines, np.zeros((0, 6)), np.array(blocks))
    exact, inner = oracle.ExactRoad(strips, 128.0, 128.0), oracle.ExactRoad(strips, 128.0, 128.0)
    inner.blocks[:, 3:5] -= 0.36
    road = make_road(clearance_nodes(strips, 128.0, 128.0), (5.0, 12.0), REACH)
    points = random_points(exact, 1500, rng, margin=0.3, side=128.0)
    headings = rng.uniform(-math.pi, math.pi, len(points))
    angles = headings[:, None] + RAYS
    missed = {}
    for thin in (True, False):
        seen = look(road._replace(thin=np.uint32(thin)), points, headings)
        missed[thin] = (seen > inner.cast(points, angles, REACH) + 0.5).mean()
    print(f"rays that miss a block: {missed[True]:.5f}, without looking out for it {missed[False]:.5f}")
    assert missed[True] < 2e-4
    assert missed[False] > 5 * missed[True]


@pytest.mark.parametrize("seed", [0, 1])
def test_rays_in_the_city(seed):
    """Corners of parked cars, which the field rounds by 0.1 m, make one ray in a hundred a far one: hence p97."""
    view = Views(seed, "city", 1200)
    error = np.abs(view.seen - view.true).ravel()
    shift = (view.with_edges_moved(0.03) - view.with_edges_moved(-0.03)).ravel()
    kept = error[np.argsort(shift, kind="stable")[: round(0.995 * error.size)]]
    print("city rays: p50 {:.3f}, p97 {:.3f}, p99 {:.3f} m".format(*np.quantile(kept, [0.5, 0.97, 0.99])))
    assert np.quantile(kept, 0.5) <= 0.03
    assert np.quantile(kept, 0.97) <= 0.2
    inner = np.flatnonzero(view.exact.clearance(view.points) > 0.2)
    low, high = view.with_edges_moved(-0.15, inner), view.with_edges_moved(0.15, inner)
    outside = (view.seen[inner] < low - 0.2) | (view.seen[inner] > high + 0.2)
    print(f"city rays not explained by edges 0.15 m off: {outside.mean():.5f}")
    assert outside.mean() < 0.003


def test_an_empty_world_and_a_full_one():
    road, _ = strip_road([[0, 0, 64, 0, 40.0], [0, 32, 64, 32, 40.0]])
    assert (look(road, [(10.0, 10.0)], [1.0]) == REACH).all()
    road, _ = strip_road([[10, 10, 11, 10, 2.0]])
    assert look(road, [(40.0, 40.0)], [1.0]).max() == 0.0  # far off the road everything is hidden


@pytest.mark.parametrize(("rays", "view"), [(2, 120.0), (5, 60.0), (32, 120.0), (33, 200.0), (61, 120.0), (64, 240.0)])
def test_any_number_of_rays(scenario, views, rays, view):
    k = constants(SimConfig(sensors=SensorConfig(rays=rays, field_of_view=view)))
    points, headings = views[0].points[:300], views[0].headings[:300]
    seen = look(scenario.road, points, headings, k, rays)
    angles = headings[:, None] + np.radians(np.linspace(-view / 2, view / 2, rays))
    error = np.abs(seen - views[0].exact.cast(points, angles, REACH))
    assert np.quantile(error, 0.5) <= 0.03
    assert np.quantile(error, 0.97) <= 0.2


def test_a_short_reach_cuts_what_a_long_one_sees(scenario, views):
    short = constants(SimConfig(sensors=SensorConfig(range=20.0)))
    points, headings, seen = views[0].points[:300], views[0].headings[:300], views[0].seen[:300]
    cut = look(scenario.road, points, headings, short)
    assert cut.max() == 20.0
    assert np.quantile(np.abs(cut - np.minimum(seen, 20.0)), 0.98) < 0.05


def test_the_sensor_knows_no_border(scenario, views):
    """Seen from a map's width further on, and after whole turns, everything is as it was."""
    points, headings = np.round(views[0].points[:200] * 64) / 64, views[0].headings[:200]
    seen = look(scenario.road, points, headings)
    moved = look(scenario.road, points + np.array([SIDE, -2 * SIDE]), headings)
    assert np.quantile(np.abs(moved - seen), 0.99) < 1e-3
    turned = look(scenario.road, points, headings.astype(float) + 2 * math.pi)
    assert np.quantile(np.abs(turned - seen), 0.98) < 1e-3


def march_both(road, point, angles, start=0.0, thin=False):
    """Ranges [2, SIMD_RAYS] by the plain kernel and by the vector code, of rays from one point."""
    results = []
    how, vector = (AMONG_THIN_WALLS, vector_march_thin) if thin else (PLAIN, vector_march)
    for kernel, more in ((march, (how,)), (vector, ())):
        beams = np.stack([np.cos(angles), np.sin(angles), np.full(SIMD_RAYS, start)]).astype(F)
        kernel(road.field, road.columns, road.rows, F(2 * point[0]), F(2 * point[1]), F(REACH), beams, *more)
        results.append(beams[2])
    return np.array(results)


@pytest.mark.parametrize("thin", [False, True])
def test_vector_code_is_the_plain_kernel(scenario, views, thin):
    """One ray in all lanes: then no lane marches on for another's sake, and the two are the same arithmetic."""
    rng = np.random.default_rng(4)
    inner = np.flatnonzero(views[0].exact.clearance(views[0].points) > 0.2)[:400]
    both = []
    for point in views[0].points[inner]:
        plain, vector = march_both(scenario.road, point, np.full(SIMD_RAYS, rng.uniform(-math.pi, math.pi)), thin=thin)
        assert (vector == vector[0]).all()
        assert (plain == plain[0]).all()
        both.append((plain[0], vector[0]))
    plain, vector = np.array(both).T
    assert 0.02 < (plain == REACH).mean() < 0.5
    assert np.abs(plain - vector).max() < 2e-3


@pytest.mark.parametrize("thin", [False, True])
def test_vector_code_is_the_plain_kernel_lane_by_lane(scenario, views, thin):
    """A ray that has arrived keeps coming closer to the edge while others of its block are on their way."""
    rng = np.random.default_rng(5)
    inner = np.flatnonzero(views[0].exact.clearance(views[0].points) > 0.2)[:600]
    points = views[0].points[inner]
    angles = rng.uniform(-math.pi, math.pi, (len(points), 1)) + np.radians(np.linspace(-60, 60, SIMD_RAYS))
    plain, vector = np.stack(
        [march_both(scenario.road, p, a, thin=thin) for p, a in zip(points, angles, strict=True)], axis=1
    )
    true = views[0].exact.cast(points, angles, REACH)
    away = np.abs(plain - vector)
    print("plain and vector march: p50 {:.1e}, p90 {:.1e}, p99 {:.1e} m".format(*np.quantile(away, [0.5, 0.9, 0.99])))
    assert np.quantile(away, 0.9) < 1e-3
    assert np.quantile(away, 0.985) < 0.1
    for q in (0.9, 0.97, 0.99):
        assert np.quantile(np.abs(vector - true), q) <= np.quantile(np.abs(plain - true), q) + 0.01


@pytest.mark.parametrize("start", [0.0, 30.0, REACH, 60.0])
def test_both_marches_take_a_start_and_stay_within_reach(scenario, start):
    plain, vector = march_both(scenario.road, (5.0, 5.0), np.linspace(0, 6, SIMD_RAYS), start)
    for ranges in (plain, vector):
        assert ranges.min() >= 0.0
        assert ranges.max() <= REACH
    if start >= REACH:
        assert (plain == REACH).all()
        assert (vector == REACH).all()


@pytest.mark.parametrize("view", [300.0, 360.0])
def test_wider_fans_than_the_start_table_holds_are_refused(view):
    with pytest.raises(ValueError, match="240 degrees"):
        constants(SimConfig(sensors=SensorConfig(rays=64, field_of_view=view)))


@pytest.mark.parametrize("view", [120.0, 240.0])
def test_the_start_table_holds_the_widest_fan_that_is_allowed(scenario, view):
    """A fan never wraps: the bins repeated behind the last are as many as any fan needs."""
    k = constants(SimConfig(sensors=SensorConfig(rays=64, field_of_view=view)))
    stride = scenario.road.start.size // (int(scenario.road.start_row.max()) + 1)
    assert stride >= HEADING_BINS + math.ceil(fan(64, k.ray_first, k.ray_step)[2].max())


def test_the_fan_pads_to_whole_blocks():
    table = fan(31, K.ray_first, K.ray_step)
    assert table.shape == (3, 32)
    assert table[0, :31] == pytest.approx(np.cos(RAYS), abs=1e-6)
    assert table[1, :31] == pytest.approx(np.sin(RAYS), abs=1e-6)
    assert (table[:, 31] == table[:, 30]).all()
    assert fan(33, K.ray_first, K.ray_step).shape == (3, 64)
