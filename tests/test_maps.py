"""Maps from files: against closed forms, and on whatever bytes a file may hold."""

import math
import os
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import oracle
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from cluster.champion import Champion, evaluate
from cluster.run import RunError, new_run, open_run, read_config
from cluster.settings import EvolveSettings, SettingsError, from_dict
from evolution.policy import PolicySpec
from gridsim.config import SimConfig, constants
from gridsim.ego import collides
from gridsim.env import GridSimEnv, GridSimVectorEnv
from gridsim.jit import njit
from gridsim.maps import MAX_PIXELS, MapFile, load_map, map_digest, read_free, read_map_file
from gridsim.raster import signed_clearance
from gridsim.roads import Strips, clearance, freeze
from gridsim.scenarios import Scenario, build, label, sample_starts, starts_at
from gridsim.simulator import Simulator

PPM = 16
W, H = 100.0, 72.0  # m
LINES = np.array([[15.0, 12.0, 80.0, 50.0, 4.0], [15.0, 12.0, 85.0, 15.0, 3.5]])
ARCS = np.array([[40.0, 45.0, 16.0, 0.0, 2 * math.pi, 3.5]])
STRIPS = Strips(LINES, ARCS)


def distance(x, y):
    """Clearance (m) of the strips above, in closed form."""
    best = np.full(np.broadcast(x, y).shape, -np.inf)
    for ax, ay, bx, by, w in LINES:
        dx, dy = bx - ax, by - ay
        t = np.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        best = np.maximum(best, w - np.hypot(x - ax - t * dx, y - ay - t * dy))
    for cx, cy, r, *_, w in ARCS:
        best = np.maximum(best, w - np.abs(np.hypot(x - cx, y - cy) - r))
    return best


def picture(shape=distance, width=W, height=H, ppm=PPM):
    """An anti-aliased picture uint8 [rows, columns] of a shape, its highest row first, as pictures are."""
    x = (np.arange(round(width * ppm)) + 0.5) / ppm
    y = (np.arange(round(height * ppm)) + 0.5) / ppm
    d = shape(*np.meshgrid(x, y[::-1]))
    return np.clip(127.5 + 255 * ppm * d, 0, 255).round().astype(np.uint8)


def save(path, pixels):
    Image.fromarray(pixels).save(path)
    return str(path)


def write_yaml(folder, pixels=None, name="map", **values):
    if pixels is not None:
        save(folder / "map.png", pixels)
    values = {"image": "map.png", "resolution": 1 / PPM, "origin": [0, 0, 0], **values}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in values.items() if v is not None}))
    return str(path)


@njit
def clearances(road, points, out):
    for k in range(len(points)):
        out[k] = clearance(road, points[k, 0], points[k, 1])


@njit
def crashed(road, constants, starts, out):
    for k in range(len(starts)):
        out[k] = collides(
            road, constants, starts[k, 0], starts[k, 1], np.float32(math.cos(starts[k, 2])),
            np.float32(math.sin(starts[k, 2])),
        )  # fmt: skip


def read(road, points):
    out = np.empty(len(points), dtype=np.float32)
    clearances(road, freeze(np.asarray(points, dtype=np.float32)), out)
    return out


def crashes(scenario):
    out = np.empty(len(scenario.starts), dtype=np.bool_)
    crashed(scenario.road, constants(SimConfig()), scenario.starts, out)
    return out


def strip(cx, cy, angle, half_width, half_length=45.0):
    """A corridor's clearance, its ends closed."""

    def shape(x, y):
        u = (x - cx) * math.cos(angle) + (y - cy) * math.sin(angle)
        v = -(x - cx) * math.sin(angle) + (y - cy) * math.cos(angle)
        return np.minimum(half_width - np.abs(v), half_length - np.abs(u))

    return shape


@pytest.fixture(scope="module")
def track(tmp_path_factory):
    return load_map(save(tmp_path_factory.mktemp("maps") / "track.png", picture()))


# ---------------------------------------------------------------------------------------------- against closed forms


def test_clearance_is_that_of_the_shape(track):
    rng = np.random.default_rng(0)
    points = rng.random((20_000, 2)) * [W, H]
    exact = np.clip(distance(points[:, 0], points[:, 1]), -2.0, 255 / 32 - 2.0)
    error = read(track.road, points) - exact
    # Within the union of two strips the clearance is more than that of either; without, it is exact.
    outside = exact <= 0.0
    assert np.quantile(np.abs(error[outside]), 0.99) < 0.1
    assert np.abs(error[outside]).max() < 0.35  # between two walls, and at corners, the field's cells smooth a ridge
    assert error.min() > -0.45  # a sharp corner of wall is thickened by 0.4 m
    edge = np.abs(exact) < 0.05
    assert edge.sum() > 50
    assert np.abs(np.median(error[edge])) < 0.02  # neither inwards nor outwards


@pytest.mark.parametrize("degrees", [None, 10, 45])
def test_clearance_of_a_disc_and_of_corridors(tmp_path, degrees):
    angle = math.radians(degrees or 0)

    def disc(x, y):
        return 25.0 - np.hypot(x - 35.3, y - 30.1)

    shape = disc if degrees is None else strip(35.0, 30.0, angle, 4.0, 24.0)
    scenario = load_map(save(tmp_path / "shape.png", picture(shape, 70.0, 60.0)))
    points = np.random.default_rng(2).random((20_000, 2)) * [70.0, 60.0]
    if degrees is not None:  # off the ends, where the shape's formula is no distance
        along = (points[:, 0] - 35) * math.cos(angle) + (points[:, 1] - 30) * math.sin(angle)
        points = points[np.abs(along) < 18.0]
    exact = np.clip(shape(points[:, 0], points[:, 1]), -2.0, 255 / 32 - 2.0)
    error = np.abs(read(scenario.road, points) - exact)
    assert len(error) > 5_000
    assert np.quantile(error, 0.99) < 0.1
    # The field's cells smooth the ridge in a corridor's middle, and the kink where the field ends.
    assert error.max() < 0.3
    assert error[(exact > -1.2) & (exact < 3.2)].max() < 0.05
    assert np.median(error[np.abs(exact) < 0.5]) < 0.02


@pytest.mark.parametrize("ppm", [2, 5])
def test_resolutions_agree(tmp_path, ppm):
    name = write_yaml(tmp_path, picture(ppm=ppm), resolution=None, scale=ppm, free_thresh=0.5)
    rng = np.random.default_rng(1)
    points = rng.random((5_000, 2)) * [W, H]
    exact = distance(points[:, 0], points[:, 1])
    points, exact = points[exact <= 0.0], np.maximum(exact[exact <= 0.0], -2.0)
    error = np.abs(read(load_map(name).road, points) - exact)
    assert np.quantile(error, 0.99) < 0.1 + 0.35 / ppm


def test_rays_meet_the_shape(track):
    exact = oracle.ExactRoad(STRIPS, W, H, torus=False)
    simulator = Simulator([track], len(track.starts))
    ranges, _ = simulator.reset(track.starts)
    sensors = SimConfig().sensors
    x, y, heading = track.starts[:, :3].astype(float).T
    origins = np.column_stack([x + 1.25 * np.cos(heading), y + 1.25 * np.sin(heading)])
    angles = heading[:, None] + np.radians(np.linspace(-60, 60, sensors.rays))
    errors = np.abs(ranges - exact.cast(origins, angles, sensors.range))
    assert np.quantile(errors, 0.98) < 0.3
    assert np.median(errors) < 0.05


@pytest.mark.parametrize("degrees", [0, 17, 141])
def test_starts_head_along_a_corridor(tmp_path, degrees):
    angle = math.radians(degrees)
    name = save(tmp_path / "corridor.png", picture(strip(50, 50, angle, 4.0), 100.0, 100.0))
    scenario = load_map(name)
    turn = np.abs((scenario.starts[:, 2] - angle + math.pi / 2) % math.pi - math.pi / 2)
    assert np.degrees(turn).max() < 10.0
    ahead = np.cos(scenario.starts[:, 2] - angle) > 0
    assert 0.4 < ahead.mean() < 0.6  # both ways
    along = (scenario.starts[:, 0] - 50) * math.cos(angle) + (scenario.starts[:, 1] - 50) * math.sin(angle)
    assert along.min() < -30 < 30 < along.max()
    assert not crashes(scenario).any()


def test_starts_head_along_a_ring(tmp_path):
    def ring(x, y):
        return 4.0 - np.abs(np.hypot(x - 30, y - 30) - 18.0)

    starts = load_map(save(tmp_path / "ring.png", picture(ring, 60.0, 60.0))).starts
    tangent = np.arctan2(starts[:, 1] - 30, starts[:, 0] - 30) + math.pi / 2
    turn = np.abs((starts[:, 2] - tangent + math.pi / 2) % math.pi - math.pi / 2)
    assert np.degrees(turn).max() < 10.0
    assert np.histogram(tangent, 8)[0].min() > 20  # all around


def test_starts_are_on_the_road_and_not_in_the_shed(tmp_path):
    """A plaza has no direction, and there are starts on it; none in a yard that is too small to drive in."""

    def places(x, y):
        plaza = np.minimum(24.0 - np.abs(x - 30), 24.0 - np.abs(y - 30))
        yard = np.minimum(7.0 - np.abs(x - 80), 7.0 - np.abs(y - 30))
        return np.maximum(plaza, yard)

    scenario = load_map(save(tmp_path / "plaza.png", picture(places, 100.0, 60.0)))
    assert len(scenario.starts) > 100
    assert not crashes(scenario).any()
    assert scenario.starts[:, 0].max() < 55


# --------------------------------------------------------------------------------------------- what is kept of walls


@pytest.mark.parametrize(("degrees", "offset"), [(0, 0.0), (0, 0.25), (7, 0.13), (45, 0.25), (80, 0.0)])
def test_walls_of_one_pixel_stop_cars_and_rays(tmp_path, degrees, offset):
    angle = math.radians(degrees)

    def halved(x, y):
        v = -(x - 40 - offset) * math.sin(angle) + (y - 40 - offset) * math.cos(angle)
        return np.where(np.abs(v) <= 0.51 / PPM, -1.0, np.minimum(38 - np.abs(x - 40), 38 - np.abs(y - 40)))

    scenario = load_map(save(tmp_path / "thin.png", picture(halved, 80.0, 80.0)))
    t = np.linspace(-25, 25, 2001)
    on = np.column_stack([40 + offset + t * math.cos(angle), 40 + offset + t * math.sin(angle)])
    assert read(scenario.road, on).max() < 0.0
    beside = on + 1.0 * np.array([-math.sin(angle), math.cos(angle)])
    assert read(scenario.road, beside).min() > 0.0
    # From afar a ray takes long steps, and some step over a wall of less than a metre; from near none does.
    away, tilt = np.linspace(3.0, 16.0, 200), np.random.default_rng(1).uniform(-0.6, 0.6, 200)
    starts = np.zeros((200, 5), dtype=np.float32)
    starts[:, 0] = 40 + offset + away * math.sin(angle)
    starts[:, 1] = 40 + offset - away * math.cos(angle)
    starts[:, 2] = angle + math.pi / 2 + tilt
    ranges, _ = Simulator([scenario], 200).reset(starts)
    error = (ranges[:, 15] + 1.25) * np.cos(tilt) - away + 0.4  # the wall is 0.8 m thick in the field
    assert np.abs(error[away < 6.0]).max() < 0.3
    assert (np.abs(error) > 0.3).mean() < 0.05


def test_a_speck_is_an_obstacle(tmp_path):
    pixels = picture(strip(50, 20, 0.0, 8.0), 100.0, 40.0)
    where = [(30.0, 20.0), (42.3, 17.7), (61.25, 23.1)]
    for x, y in where:
        pixels[-1 - int(y * PPM), int(x * PPM)] = 0
    scenario = load_map(save(tmp_path / "specks.png", pixels))
    assert read(scenario.road, where).max() < 0.0
    far = np.add(where, [1.5, 0.0])
    assert read(scenario.road, far).min() > 0.8


def test_the_outside_is_wall_unless_it_is_a_torus(tmp_path):
    def road(x, y):  # runs out of the picture to the left and to the right
        return 4.0 - np.abs(y - 16.0)

    bounded = load_map(save(tmp_path / "map.png", picture(road, 64.0, 32.0)))
    assert not bounded.torus
    assert read(bounded.road, [[-0.3, 16.0], [64.3, 16.0], [-1.5, 16.0], [66.0, 16.0]]).max() < 0.0
    assert read(bounded.road, [[1.0, 16.0]])[0] == pytest.approx(1.0, abs=0.05)
    torus = load_map(write_yaml(tmp_path, torus=True))
    assert torus.torus
    assert (float(torus.road.width), float(torus.road.height)) == (64.0, 32.0)
    assert read(torus.road, [[-0.3, 16.0], [64.3, 16.0], [0.0, 16.0]]).min() > 3.9
    assert np.quantile(np.abs(np.sin(torus.starts[:, 2])), 1.0) < 0.1
    with pytest.raises(ValueError, match="torus"):
        load_map(write_yaml(tmp_path, torus=True, resolution=0.05))


# -------------------------------------------------------------------------------------------- what a YAML's keys mean


def test_origin_starts_and_speed(tmp_path):
    pixels = picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0)
    given = [[-40.0, 100.5], [20.0, 101.0, math.pi]]
    name = write_yaml(tmp_path, pixels, origin=[-50.0, 81.0, 0.0], starts=given, speed=[3, 7.5])
    scenario = load_map(name)
    np.testing.assert_allclose(scenario.starts[0], [10.0, 19.5, 0.0, 0.0, 0.0], atol=0.06)  # the longer way
    np.testing.assert_allclose(scenario.starts[1], [70.0, 20.0, math.pi, 0.0, 0.0], atol=1e-5)
    assert (float(scenario.road.speed_low), float(scenario.road.speed_high)) == (3.0, 7.5)
    assert scenario.seed == 0
    for wrong in ([200.0, 100.0], [-40.0, 105.5], [20.0, 101.0, math.pi / 2, 1.0], [20.0, 90.0]):
        with pytest.raises(ValueError, match="start"):
            load_map(write_yaml(tmp_path, starts=[wrong], origin=[-50.0, 81.0, 0.0]))


def test_thresholds_negate_and_the_unknown(tmp_path):
    levels = np.array([0, 50, 100, 205, 206, 254, 255], dtype=np.uint8)
    path = tmp_path / "map.png"
    save(path, np.tile(levels, (4, 1)))

    def free(**keys):
        return read_free(read_map_file(Path(write_yaml(tmp_path, **keys))))[0].tolist()

    assert free() == [False, False, False, False, True, True, True]  # 205, map_server's unknown, is wall
    assert free(free_thresh=0.25) == [False, False, False, True, True, True, True]
    assert free(negate=1) == [True, False, False, False, False, False, False]
    assert free(negate=True, free_thresh="2e-1") == [True, True, False, False, False, False, False]
    assert read_free(MapFile(path))[0].tolist() == [False, False, False, True, True, True, True]


FORMATS = ["png", "pgm", "jpg", "bmp", "la.png", "rgba.png", "p.png", "1.png", "16.png", "16.pgm"]


@pytest.mark.parametrize("suffix", FORMATS)
def test_formats(tmp_path, suffix):
    pixels = np.zeros((40, 60), dtype=np.uint8)
    pixels[8:24, 16:40] = 255
    image = Image.fromarray(pixels)
    kind = suffix.split(".")[0]
    if suffix.startswith("16"):
        image = Image.fromarray(pixels.astype(np.uint16) * 257)
    elif "." in suffix:
        image = image.convert({"la": "LA", "rgba": "RGBA", "p": "P", "1": "1"}[kind])
    path = tmp_path / f"picture.{suffix}"
    image.save(path)
    np.testing.assert_array_equal(read_free(MapFile(path)), pixels[::-1] > 128)


def test_transparent_is_wall(tmp_path):
    pixels = np.full((4, 6, 4), 255, dtype=np.uint8)
    pixels[:2, :, 3] = 0
    path = tmp_path / "a.png"
    save(path, pixels)
    assert read_free(MapFile(path)).sum(axis=1).tolist() == [6, 6, 0, 0]


def test_tiles_do_not_show():
    """A picture cut up gives what it gives whole."""
    free = np.random.default_rng(3).random((40, 1300)) < 0.97  # 0.25 m: 325 m, three tiles
    free = free.repeat(4, axis=0)
    nodes = signed_clearance(free, 0.25, 1024, 128, False)
    for shift in (100, 333):
        moved = signed_clearance(np.pad(free[:, 400:700], [(0, 0), (shift * 2, 0)]), 0.25, 1024, 128, False)
        inner = slice(shift + 20, shift + 130)
        np.testing.assert_allclose(moved[:80, inner], nodes[:80, 200 + 20 : 200 + 130], atol=1e-5)


# ----------------------------------------------------------------------------------------------- a scenario like others


def test_one_map_for_all_seeds(track):
    name = track.name
    assert build(name, 0) is build(name, 2_000_003)
    assert len(track.lanes) == 0
    assert track.mileage.tolist() == [0.0]
    assert 100 < len(track.starts) <= 512
    assert not track.starts.flags.writeable
    a = sample_starts(track, 300, np.random.default_rng(1))
    np.testing.assert_array_equal(a, sample_starts(track, 300, np.random.default_rng(1)))
    assert len(np.unique(a, axis=0)) > 100
    edges = starts_at(track, np.array([0.0, np.nextafter(1.0, 0.0)]))
    np.testing.assert_array_equal(edges, track.starts[[0, -1]])
    assert label(name) == "track"


def test_arrays_and_back(track):
    again = Scenario.from_arrays({k: v.copy() for k, v in track.arrays().items()})
    for key, array in track.arrays().items():
        np.testing.assert_array_equal(again.arrays()[key], array)
    assert again.name == track.name
    assert not again.torus
    assert sum(a.nbytes for a in track.arrays().values()) < 8 << 20


def test_a_changed_file_is_read_again(tmp_path):
    name = save(tmp_path / "a.png", picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0))
    first, digest = load_map(name), map_digest(name)
    save(tmp_path / "a.png", picture(strip(50, 20, 0.0, 7.0), 100.0, 40.0))
    os.utime(name, ns=(1, 1))
    assert load_map(name) is not first
    assert map_digest(name) != digest


def test_environments_and_champions_drive_on_it(track, tmp_path):
    env = GridSimVectorEnv(8, scenario=track.name)
    observations, _ = env.reset(seed=3)
    for _ in range(20):
        observations, *_ = env.step(np.zeros(8, dtype=np.int64))
    assert np.isfinite(observations).all()
    assert [s.name for s in env.simulator.scenarios] == [track.name]
    env.reset(options={"map_seed": 7})
    assert len(env.simulator.scenarios) == 1
    assert GridSimEnv(track.name).reset(seed=1)[0].shape == (32,)
    champion = Champion(np.zeros(PolicySpec.parse("mlp:2").size, np.float32), "mlp:2", track.name, SimConfig())
    assert evaluate(champion, episodes=8)["episodes"] == 8


def test_runs_know_their_map_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pixels = picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0)
    save(tmp_path / "a b.png", pixels)
    run = new_run(tmp_path / "runs", "", EvolveSettings(scenario="a b.png"))
    assert run.settings.scenario == str(tmp_path / "a b.png")
    assert run.name.startswith("a_b-evolution-s0-")
    run.path.mkdir(parents=True)
    run.write_config()
    monkeypatch.chdir("/")
    assert read_config(run.path / "config.json")[0] == run.settings
    save(tmp_path / "a b.png", pixels[::-1, 20:])
    with pytest.raises(RunError, match="is not what it was"):
        read_config(run.path / "config.json")
    with pytest.raises(RunError, match="is not what it was"):
        open_run(run.path)
    (tmp_path / "a b.png").unlink()
    with pytest.raises(RunError, match="No such file"):
        open_run(run.path)


# --------------------------------------------------------------------------------------------------------- bad input


def refused(name):
    """The one line with which a file is refused."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011, what it says is looked at
        load_map(str(name))
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 600
    with pytest.raises(SettingsError):
        from_dict({"scenario": str(name)})
    return message


def bomb(path, width, height):
    """A PNG of a few bytes that would be very large."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    return path


@pytest.mark.parametrize(("width", "height"), [(10_000, 7_000), (20_000, 20_000), (2**31 - 1, 2**31 - 1), (0, 5)])
def test_bombs_are_not_decoded(tmp_path, width, height):
    started = time.perf_counter()
    message = refused(bomb(tmp_path / "bomb.png", width, height))
    assert f"{MAX_PIXELS:,}" in message or not width or width > 1 << 30
    assert time.perf_counter() - started < 2.0


def test_pictures_that_are_no_maps(tmp_path):
    road = picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0)
    whole = Path(save(tmp_path / "whole.png", road)).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    assert "truncated" in refused(tmp_path / "cut.png")
    assert "no picture" in refused(tmp_path / "empty.png")
    assert "not a file" in refused(tmp_path / "folder.png")
    assert "No such file" in refused(tmp_path / "missing.png")
    assert "no path" in refused("nul\0l.png")
    assert "picture" in refused(tmp_path / "map.tiff")
    assert "all road" in refused(save(tmp_path / "road.png", np.full((99, 99), 255, np.uint8)))
    assert "all wall" in refused(save(tmp_path / "wall.png", np.zeros((99, 99), np.uint8)))
    assert "no room" in refused(save(tmp_path / "path.png", picture(strip(50, 20, 0.0, 1.0), 100.0, 40.0)))
    assert "no room" in refused(save(tmp_path / "yard.png", picture(strip(50, 20, 0.0, 5.0, 6.0), 100.0, 40.0)))
    noise = np.random.default_rng(0).integers(0, 256, (800, 800), dtype=np.uint8)
    assert "no room" in refused(save(tmp_path / "noise.png", noise))


WRONG = {
    "no mapping": ("[1, 2]", "mapping"),
    "empty": ("", "mapping"),
    "no YAML": ("image: [", "no plain YAML"),
    "deep": ("[" * 5000, "no plain YAML"),
    "tag": ("!!python/object/apply:os.system ['true']", "no plain YAML"),
    "no image": ("resolution: 0.1", "image"),
    "no resolution": ("image: map.png", "resolution"),
    "both": ("{image: map.png, resolution: 0.1, scale: 10}", "either"),
    "unknown key": ("{image: map.png, resolution: 0.1, start: []}", "unknown key 'start'"),
    "negative": ("{image: map.png, resolution: -0.1}", "from 0.01 to 1, not -0.1"),
    "zero": ("{image: map.png, resolution: 0}", "from 0.01 to 1"),
    "nan": ("{image: map.png, resolution: .nan}", "not nan"),
    "infinite": ("{image: map.png, scale: .inf}", "from 1 to 100, not inf"),
    "absurd": ("{image: map.png, resolution: 1e9}", "from 0.01 to 1"),
    "bool": ("{image: map.png, resolution: true}", "not True"),
    "huge number": ("{image: map.png, resolution: 0x" + "f" * 9000 + "}", "resolution"),
    "image type": ("{image: [map.png], resolution: 0.1}", "image must name"),
    "absolute": ("{image: /map.png, resolution: 0.1}", "own folder"),
    "outside": ("{image: ../map.png, resolution: 0.1}", "own folder"),
    "null": ('{image: "a\\0.png", resolution: 0.1}', "no path"),
    "link": ("{image: link.png, resolution: 0.1}", "own folder"),
    "loop": ("{image: loop.png, resolution: 0.1}", "loop.png"),
    "missing": ("{image: none.png, resolution: 0.1}", "No such file"),
    "thresholds": ("{image: map.png, resolution: 0.1, free_thresh: 0.7}", "not above occupied_thresh"),
    "threshold": ("{image: map.png, resolution: 0.1, free_thresh: 2}", "from 0 to 1"),
    "negate": ("{image: map.png, resolution: 0.1, negate: 2}", "negate"),
    "mode": ("{image: map.png, resolution: 0.1, mode: raw}", "mode"),
    "mode type": ("{image: map.png, resolution: 0.1, mode: {}}", "mode"),
    "yaw": ("{image: map.png, resolution: 0.1, origin: [0, 0, 0.5]}", "yaw"),
    "origin": ("{image: map.png, resolution: 0.1, origin: [0, 0]}", "origin"),
    "speed": ("{image: map.png, resolution: 0.1, speed: [9, 3]}", "speed"),
    "speed limit": ("{image: map.png, resolution: 0.1, speed: [9, 300]}", "speed"),
    "starts": ("{image: map.png, resolution: 0.1, starts: {x: 1}}", "starts"),
    "degrees": ("{image: map.png, resolution: 0.1, starts: [[1, 2, 90]]}", "heading"),
    "itself": ("{image: map.png, resolution: 0.1, starts: &a [*a, *a]}", "start"),
    "laughs": ("{image: map.png, resolution: [" + "&a [1,1,1]," + "*a," * 99 + "]}", "resolution"),
    "huge": ("#" * 70_000, "too many"),
    "torus": ("{image: map.png, resolution: 0.1, torus: yes please}", "torus"),
    "large": ("{image: map.png, resolution: 1}", "is too large"),
}


@pytest.fixture(scope="module")
def wrong_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("outer") / "inner"
    folder.mkdir()
    pixels = np.zeros((3000, 3000), dtype=np.uint8)
    pixels[5:-5, 5:-5] = 255
    save(folder / "map.png", pixels)
    save(folder.parent / "map.png", pixels[:50])
    (folder / "link.png").symlink_to("../map.png")
    (folder / "loop.png").symlink_to("loop.png")
    return folder


@pytest.mark.parametrize("name", WRONG)
def test_wrong_yaml_is_one_clear_line(wrong_folder, name):
    text, expected = WRONG[name]
    path = wrong_folder / "map.yaml"
    path.write_text(text)
    assert expected in refused(path)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A folder and the bytes of a small, good picture."""
    folder = tmp_path_factory.mktemp("fuzz")
    good = Path(save(folder / "good.png", picture(strip(20, 8, 0.0, 4.0, 18.0), 40.0, 16.0, 4)))
    return folder, good.read_bytes()


def only_value_errors(path):
    started = time.perf_counter()
    scenario = message = None
    try:
        scenario = load_map(str(path))
    except ValueError as error:
        message = str(error)
    if scenario is not None:
        assert len(scenario.starts)
        assert not crashes(scenario).any()
    assert not message or "\n" not in message
    assert time.perf_counter() - started < 10.0


FUZZ = settings(max_examples=40)


@FUZZ
@given(data=st.binary(max_size=300), suffix=st.sampled_from(["png", "pgm", "jpg", "bmp", "yaml"]))
def test_any_bytes(small, data, suffix):
    starts = {"png": b"\x89PNG\r\n\x1a\n", "pgm": b"P5 ", "jpg": b"\xff\xd8\xff", "bmp": b"BM", "yaml": b""}
    path = small[0] / f"fuzz.{suffix}"
    for content in (data, starts[suffix] + data):
        path.write_bytes(content)
        only_value_errors(path)


@FUZZ
@given(
    edits=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=4),
    cut=st.one_of(st.none(), st.integers(0, 10_000)),
)
def test_mutated_pictures(small, edits, cut):
    folder, good = small
    content = bytearray(good)
    for at, value in edits:
        content[at % len(content)] = value
    path = folder / "mutated.png"
    path.write_bytes(content[: cut % len(content)] if cut is not None else content)
    (folder / "mutated.yaml").write_text("{image: mutated.png, scale: 4, free_thresh: 0.5}")
    only_value_errors(folder / "mutated.yaml")


scalars = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.dates(), st.binary(max_size=4)
)
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(scalars, inner, max_size=3))
GOOD = {
    "image": "good.png", "scale": 4, "origin": [0, 0, 0], "negate": 0, "free_thresh": 0.5, "occupied_thresh": 0.65,
    "mode": "scale", "starts": [[20, 8]], "torus": False, "speed": [5, 12],
}  # fmt: skip


@FUZZ
@given(changes=st.dictionaries(st.sampled_from([*GOOD, "resolution", "other"]), values, max_size=3), drop=st.booleans())
def test_any_values(small, changes, drop):
    path = small[0] / "values.yaml"
    keys = {k: v for k, v in GOOD.items() if not (drop and k in ("scale", "starts"))}
    path.write_text(yaml.safe_dump({**keys, **changes}))
    only_value_errors(path)


@FUZZ
@given(starts=st.lists(st.lists(st.floats(-5, 45), min_size=2, max_size=3), max_size=4), speed=st.floats(0, 40))
def test_any_starts(small, starts, speed):
    path = small[0] / "starts.yaml"
    path.write_text(yaml.safe_dump({**GOOD, "starts": starts, "speed": [speed / 2, speed]}))
    only_value_errors(path)


@settings(max_examples=25)
@given(st.integers(0, 2**32), st.floats(0.02, 0.98), st.integers(1, 40), st.sampled_from([1, 4, 10]), st.booleans())
def test_any_pixels(small, seed, share, grain, ppm, torus):
    """Blobs of any size: a map, or one clear line."""
    rng = np.random.default_rng(seed)
    coarse = (rng.random((64 // min(grain, 32) + 1,) * 2) < share).astype(np.uint8) * 255
    save(small[0] / "blobs.png", coarse.repeat(grain, axis=0).repeat(grain, axis=1)[:64, :64])
    path = small[0] / "blobs.yaml"
    path.write_text(f"{{image: blobs.png, scale: {ppm}, torus: {str(torus).lower()}}}")
    only_value_errors(path)
