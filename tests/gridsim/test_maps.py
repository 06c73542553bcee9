"""Maps from files: against closed forms, as scenarios like others, and refused in one line whatever they hold."""

import contextlib
import math
import os
import pickle
import re
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import CHAMPION, finish
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import PPM, H, W, crashes, distance, picture, read, ring, save, strip, write_yaml
from PIL import Image

from cluster.commands.cli import _prepare
from cluster.settings import EvolveSettings, from_dict
from cluster.store.champion import Champion, evaluate
from cluster.store.folder import RunError, new_run, open_run, read_config
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig
from gridsim.envs.env import GridSimEnv
from gridsim.errors import GridSimError
from gridsim.maps.files import MAX_PIXELS, MapFile, MapWarning, load_map, map_digest, read_free, read_map_file
from gridsim.maps.map import starts_at
from gridsim.maps.raster import signed_clearance
from gridsim.maps.scenarios import build, label
from gridsim.simulator import Simulator

pytestmark = pytest.mark.filterwarnings("ignore::gridsim.maps.files.MapWarning")  # most are small, or all road


@pytest.fixture(scope="module")
def track(tmp_path_factory):
    return load_map(save(tmp_path_factory.mktemp("maps") / "track.png", picture()))


# --- Against closed forms --------------------------------------------------------------------------------------------


def test_clearance_is_that_of_the_shape(tmp_path):
    road = load_map(write_yaml(tmp_path, picture(), starts=[[47.5, 31.0, 0.5]])).road
    points = np.random.default_rng(0).random((20_000, 2)) * [W, H]
    exact = np.clip(distance(points[:, 0], points[:, 1]), -2.0, 255 / 32 - 2.0)
    error = read(road, points) - exact
    # Within the union of two strips the clearance is more than that of either; without, it is exact.
    outside = exact <= 0.0
    assert np.quantile(np.abs(error[outside]), 0.99) < 0.1
    assert np.abs(error[outside]).max() < 0.35  # between two walls, and at corners, the field's cells smooth a ridge
    assert error.min() > -0.45  # a sharp corner of wall is thickened by 0.4 m
    edge = np.abs(exact) < 0.05
    assert edge.sum() > 50
    assert np.abs(np.median(error[edge])) < 0.02  # neither inwards nor outwards


@pytest.mark.parametrize("degrees", [0, 17, 141])
def test_starts_head_along_a_corridor(tmp_path, degrees):
    angle = math.radians(degrees)
    scenario = load_map(save(tmp_path / "corridor.png", picture(strip(50, 50, angle, 4.0), 100.0, 100.0)))
    starts = scenario.starts
    beside = (starts[:, 2] - angle + math.pi / 2) % math.pi - math.pi / 2  # rad from the corridor's axis
    assert np.degrees(np.abs(beside)).max() < 10.0
    assert 0.4 < (np.cos(starts[:, 2] - angle) > 0).mean() < 0.6  # both ways
    along = (starts[:, 0] - 50) * math.cos(angle) + (starts[:, 1] - 50) * math.sin(angle)
    assert along.min() < -30 < 30 < along.max()
    assert not crashes(scenario.road, starts).any()


@pytest.mark.parametrize(("radius", "half_width", "short"), [(18, 2, True), (30, 5, True), (36, 5, False)])
def test_a_ring_too_short_to_count_is_told(tmp_path, radius, half_width, short):
    with warnings.catch_warnings(record=True, action="always") as said:
        load_map(save(tmp_path / "ring.png", ring(radius, half_width)))
    assert len(said) == short
    if short:
        told = r"^ring has about (\d+) m of road\. Ground driven again within 200 m does not count"
        (about,) = re.findall(told, str(said[0].message))
        assert float(about) == pytest.approx(2 * math.pi * radius, rel=0.1)


def test_an_inverted_picture_is_told_by_environments_and_commands(tmp_path):
    save(tmp_path / "dark.png", 255 - ring(36.0, 5.0))
    expected = "dark has road on 100% of its border. If the road is dark, set negate: 1 in its YAML"
    with pytest.warns(MapWarning, match=expected):
        GridSimEnv(str(tmp_path / "dark.png"))
    done = finish("gridsim-evaluate", str(CHAMPION), "--scenario", "dark.png", "--episodes", "1", cwd=tmp_path)
    assert done.stderr.startswith(f"gridsim-evaluate: warning: {expected}")
    assert done.stderr.count("\n") == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_map(write_yaml(tmp_path, image="dark.png", negate=1))


def test_a_track_in_a_large_picture_has_the_starts_of_one_in_a_small_one(tmp_path):
    """As f1tenth's vegas: 120 m x 60 m at 0.5 m a pixel, 1 km from the picture's corner."""
    x, y = (np.arange(260) * 0.5)[None], (np.arange(140) * 0.5)[:, None]
    away = np.hypot(np.maximum(np.abs(x - 65) - 35, 0), np.maximum(np.abs(y - 35) - 5, 0))
    track = np.where(np.abs(away - 20.0) < 5.0, 254, 205).astype(np.uint8)
    large = np.full((3000, 3000), 205, dtype=np.uint8)
    large[-2240:-2100, 2100:2360] = track
    starts = load_map(write_yaml(tmp_path, track, resolution=0.5)).starts
    further = load_map(write_yaml(tmp_path, large, resolution=0.5)).starts
    np.testing.assert_allclose(further - starts, np.tile([1050.0, 1050.0, 0.0, 0.0, 0.0], (512, 1)), atol=1e-4)


def test_starts_are_on_the_road_and_not_in_a_yard_too_small_to_drive_in(tmp_path):
    plaza, yard = strip(30, 30, 0.0, 24.0, 24.0), strip(80, 30, 0.0, 7.0, 7.0)
    pixels = picture(lambda x, y: np.maximum(plaza(x, y), yard(x, y)), 100.0, 60.0)
    scenario = load_map(save(tmp_path / "plaza.png", pixels))
    assert len(scenario.starts) > 100
    assert not crashes(scenario.road, scenario.starts).any()
    assert scenario.starts[:, 0].max() < 55


# --- What is kept of walls -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degrees", "offset"), [(0, 0.25), (7, 0.13), (45, 0.25)])
def test_walls_of_one_pixel_stop_cars_and_rays(tmp_path, degrees, offset):
    angle = math.radians(degrees)

    def halved(x, y):
        v = -(x - 40 - offset) * math.sin(angle) + (y - 40 - offset) * math.cos(angle)
        return np.where(np.abs(v) <= 0.51 / PPM, -1.0, np.minimum(38 - np.abs(x - 40), 38 - np.abs(y - 40)))

    scenario = load_map(write_yaml(tmp_path, picture(halved, 80.0, 80.0), starts=[[40.0, 60.0, 0.0]]))
    along, left = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    on = 40 + offset + np.linspace(-25, 25, 2001)[:, None] * along
    assert read(scenario.road, on).max() < 0.0
    assert read(scenario.road, on + left).min() > 0.0
    away, tilt = np.linspace(3.0, 16.0, 200), np.random.default_rng(1).uniform(-0.6, 0.6, 200)
    starts = np.zeros((200, 5), dtype=np.float32)
    starts[:, :2] = 40 + offset - away[:, None] * left
    starts[:, 2] = angle + math.pi / 2 + tilt
    simulator = Simulator(200)
    simulator.reset(scenario, starts)
    error = (simulator.ranges[:, 15] + 1.25) * np.cos(tilt) - away + 0.4  # the wall is 0.8 m thick in the field
    assert np.abs(error).max() < 0.3


def test_the_outside_is_wall(tmp_path):
    road = strip(32.0, 16.0, 0.0, 4.0)  # runs out of the picture to the left and to the right
    bounded = load_map(save(tmp_path / "map.png", picture(road, 64.0, 32.0)))
    assert not bounded.torus
    assert read(bounded.road, [[-0.3, 16.0], [64.3, 16.0], [-1.5, 16.0], [66.0, 16.0]]).max() < 0.0
    assert read(bounded.road, [[1.0, 16.0]])[0] == pytest.approx(1.0, abs=0.05)


# --- What a YAML's keys mean -----------------------------------------------------------------------------------------


def test_origin_starts_and_speed(tmp_path):
    pixels = picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0)
    given = [[-40.0, 100.5, 0.1], [20.0, 101.0, math.pi]]
    scenario = load_map(write_yaml(tmp_path, pixels, origin=[-50.0, 81.0, 0.0], starts=given, speed=[3, 7.5]))
    np.testing.assert_allclose(scenario.starts, [[10.0, 19.5, 0.1, 0, 0], [70.0, 20.0, math.pi, 0, 0]], atol=1e-5)
    assert (float(scenario.road.speed_low), float(scenario.road.speed_high)) == (3.0, 7.5)
    assert scenario.seed == 0
    for wrong in ([200.0, 100.0, 0], [-40.0, 105.5, 0], [20.0, 101.0], [20.0, 90.0, 0]):
        with pytest.raises(ValueError, match="start"):
            load_map(write_yaml(tmp_path, starts=[wrong], origin=[-50.0, 81.0, 0.0]))


def test_thresholds_negate_and_the_unknown(tmp_path):
    levels = np.array([0, 50, 100, 205, 206, 254, 255], dtype=np.uint8)
    picture_alone = MapFile(Path(save(tmp_path / "map.png", np.tile(levels, (4, 1)))))

    def free(**keys):
        return levels[read_free(read_map_file(Path(write_yaml(tmp_path, **keys))))[0]].tolist()

    assert free() == [206, 254, 255]  # 205, map_server's unknown, is wall
    assert free(free_thresh=0.25) == [206, 254, 255]
    assert free(free_thresh=0.25, mode="scale") == [205, 206, 254, 255]
    assert free(negate=1) == [0]
    assert free(negate=True, free_thresh="2e-1") == [0, 50]
    assert levels[read_free(picture_alone)[0]].tolist() == [205, 206, 254, 255]
    save(tmp_path / "map.pgm", np.tile(levels, (4, 1)))  # as robots save them
    assert levels[read_free(read_map_file(tmp_path / "map.pgm"))[0]].tolist() == [206, 254, 255]


FORMATS = "png:L pgm:L jpg:L bmp:L png:LA png:RGB png:RGBA png:P png:1 png:I;16 pgm:I;16"


@pytest.mark.parametrize("form", FORMATS.split())
def test_formats(tmp_path, form):
    (suffix, mode), pixels = form.split(":"), np.zeros((40, 60), dtype=np.uint8)
    pixels[8:24, 16:40] = 255
    deep = Image.fromarray(pixels.astype(np.uint16) * 257)
    image = deep if mode == "I;16" else Image.fromarray(pixels).convert(mode)
    image.save(tmp_path / f"picture.{suffix}")
    np.testing.assert_array_equal(read_free(MapFile(tmp_path / f"picture.{suffix}")), pixels[::-1] > 128)


@pytest.mark.parametrize("mode", ["LA", "RGBA", "P"])
def test_transparent_is_wall(tmp_path, mode):
    image = Image.fromarray(np.repeat([0, 255], [12, 12]).astype(np.uint8).reshape(4, 6))
    if mode == "P":  # both of its colours are white
        image.putpalette([255] * 768)
        image.save(tmp_path / "a.png", transparency=0)
    else:
        white = Image.new("L", image.size, 255)
        Image.merge(mode, [white] * (len(mode) - 1) + [image]).save(tmp_path / "a.png")
    assert read_free(MapFile(tmp_path / "a.png")).sum(axis=1).tolist() == [6, 6, 0, 0]


def test_tiles_do_not_show():
    free = np.random.default_rng(3).random((40, 1300)) < 0.97  # 0.25 m: 325 m, three tiles
    free = free.repeat(4, axis=0)
    nodes = signed_clearance(free, 0.25, 1024, 128)
    for shift in (100, 333):
        moved = signed_clearance(np.pad(free[:, 400:700], [(0, 0), (shift * 2, 0)]), 0.25, 1024, 128)
        inner = slice(shift + 20, shift + 130)
        np.testing.assert_allclose(moved[:80, inner], nodes[:80, 200 + 20 : 200 + 130], atol=1e-5)


# --- A scenario like others ------------------------------------------------------------------------------------------


def test_a_map_for_each_part_of_the_seeds(track):
    assert build(track.name, 2_000_000) is build(track.name, 2_000_003)
    assert label(track.name) == "track"
    assert (len(track.network.steps), track.mileage.tolist()) == (0, [0.0])
    assert 100 < len(track.starts) <= 512
    assert not track.starts.flags.writeable
    np.testing.assert_array_equal(starts_at(track, np.array([0.0, np.nextafter(1.0, 0.0)])), track.starts[[0, -1]])
    assert not pickle.loads(pickle.dumps(track)).torus


@pytest.mark.parametrize("by_yaml", [False, True])
def test_a_changed_picture_is_read_again(tmp_path, by_yaml):
    name = image = save(tmp_path / "map.png", picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0))
    if by_yaml:
        name = write_yaml(tmp_path)
    first, digest = load_map(name), map_digest(name)
    save(tmp_path / "map.png", picture(strip(50, 20, 0.0, 7.0), 100.0, 40.0))
    os.utime(image, ns=(1, 1))
    assert load_map(name) is not first
    assert map_digest(name) != digest


def test_environments_and_champions_drive_on_it(track):
    env = GridSimEnv(track.name)
    env.reset(seed=3, options={"map_seed": 7})
    for _ in range(10):
        observation, *_ = env.step(0)
    assert np.isfinite(observation).all()
    assert env.cars.simulator.maps[0].name == track.name
    champion = Champion(np.zeros(PolicySpec.parse("mlp:2").size, np.float32), "mlp:2", track.name, SimConfig())
    assert evaluate(champion, episodes=8)["episodes"] == 8


def test_traffic_that_a_map_cannot_have_changes_nothing(track, capsys):
    road = ["--scenario", track.name, "--traffic"]
    asked, plain = (_prepare("gridsim-evolve", [*road, number])[1].settings for number in "30")
    assert asked == plain
    assert capsys.readouterr().err == f"gridsim-evolve: {track.name} has no lanes for traffic; running without\n"


def test_runs_know_their_map_again(here, monkeypatch):
    pixels = picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0)
    save(here / "a b.png", pixels)
    run = new_run(here / "runs", "", EvolveSettings(scenario="a b.png"))
    assert run.settings.scenario == str(here / "a b.png")
    assert run.name.startswith("a_b-evolution-s0-")
    run.path.mkdir(parents=True)
    run.write_config()
    monkeypatch.chdir("/")
    assert read_config(run.path / "config.json")[0] == run.settings
    save(here / "a b.png", pixels[::-1, 20:])
    with pytest.raises(RunError, match="is not what it was"):
        read_config(run.path / "config.json")
    with pytest.raises(RunError, match="is not what it was"):
        open_run(run.path)
    (here / "a b.png").unlink()
    with pytest.raises(RunError, match="No such file"):
        open_run(run.path)


# --- What is refused -------------------------------------------------------------------------------------------------


def refused(name):
    with pytest.raises(GridSimError, match=r"^[^\n]{1,600}$") as caught:
        load_map(str(name))
    with pytest.raises(GridSimError):
        from_dict(EvolveSettings, {"scenario": str(name)})
    return str(caught.value)


def test_a_bomb_is_not_decoded(tmp_path):
    """A PNG of a few bytes that would be very large: its header, of the bytes 12 to 33, says so."""
    path = tmp_path / "bomb.png"
    png = bytearray(Path(save(path, np.zeros((9, 9), np.uint8))).read_bytes())
    png[16:24] = struct.pack(">II", 10_000, 7_000)
    png[29:33] = struct.pack(">I", zlib.crc32(png[12:29]))
    path.write_bytes(png)
    assert f"{MAX_PIXELS:,}" in refused(path)


def test_pictures_that_are_no_maps(tmp_path):
    whole = Path(save(tmp_path / "whole.png", picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0))).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    assert "truncated" in refused(tmp_path / "cut.png")
    assert "not a readable picture" in refused(tmp_path / "empty.png")
    assert "Is a directory" in refused(tmp_path / "folder.png")
    assert "No such file" in refused(tmp_path / "missing.png")
    assert "not a valid path" in refused("nul\0l.png")
    assert "picture" in refused(tmp_path / "map.tiff")
    assert "all road" in refused(save(tmp_path / "road.png", np.full((99, 99), 255, np.uint8)))
    (tmp_path / "real.pgm").write_bytes(b"Pf\n99 99\n-1.0\n" + np.ones((99, 99), np.float32).tobytes())
    assert "8 or 16 bits" in refused(tmp_path / "real.pgm")
    assert "all wall" in refused(save(tmp_path / "wall.png", np.zeros((99, 99), np.uint8)))
    assert "no room" in refused(save(tmp_path / "path.png", picture(strip(50, 20, 0.0, 1.0), 100.0, 40.0)))
    assert "no room" in refused(save(tmp_path / "yard.png", picture(strip(50, 20, 0.0, 5.0, 6.0), 100.0, 40.0)))


# A YAML, and what the line says.
WRONG = {
    "[1, 2]": "needs image and resolution",
    "[" * 2000: "not valid YAML",
    "!!python/object/apply:os.system ['true']": "not valid YAML",
    "resolution: 0.1": "image",
    "image: map.png": "resolution",
    "{image: map.png, resolution: .nan}": "not nan",
    "{image: map.png, resolution: 1e9}": "from 0.001 to 1",
    "{image: map.png, resolution: 1}": "is too large",
    "{resolution: 0.1, image: [map.png]}": "image must name",
    "{resolution: 0.1, image: link.png}": "own folder",
    "{resolution: 0.1, image: loop.png}": "loop.png",
    "{resolution: 0.1, image: none.png}": "put the picture there",
    "{resolution: 0.1, image: /home/robot/none.png}": "put the picture there",
    "{image: map.png, resolution: 0.1, start: []}": "unknown key 'start'; did you mean starts?",
    "{image: map.png, resolution: 0.1, occ_thresh: 0.65}": "did you mean occupied_thresh?",
    "{image: map.png, resolution: 0.1, free_thresh: 0.7}": "not above occupied_thresh",
    "{image: map.png, resolution: 0.1, negate: 2}": "negate",
    "{image: map.png, resolution: 0.1, mode: raw}": "mode must be trinary or scale",
    "{image: map.png, resolution: 0.1, origin: [0, 0, 90]}": "yaw",
    "{image: map.png, resolution: 0.1, origin: [-nan, 0, 0]}": "origin's x",
    "{image: map.png, resolution: 0.1, speed: [9, 3]}": "speed",
    "{image: map.png, resolution: 0.1, starts: {x: 1}}": "starts",
    "{image: map.png, resolution: 0.1, starts: [[1, 2, 90]]}": "heading",
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


@pytest.mark.parametrize(("text", "expected"), WRONG.items(), ids=range(len(WRONG)))
def test_wrong_yaml_is_one_clear_line(wrong_folder, text, expected):
    path = wrong_folder / "map.yaml"
    path.write_text(text)
    assert expected in refused(path)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A folder and the bytes of a small, good picture."""
    folder = tmp_path_factory.mktemp("fuzz")
    return folder, Path(save(folder / "good.png", picture(strip(20, 8, 0.0, 4.0, 18.0), 40.0, 16.0, 4))).read_bytes()


def loads_or_is_refused(path):
    with contextlib.suppress(GridSimError):
        scenario = load_map(str(path))
        assert len(scenario.starts)
        assert not crashes(scenario.road, scenario.starts).any()


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.dates() | st.binary()
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(scalars, inner, max_size=3))
GOOD = {
    "image": "good.png", "resolution": 0.25, "origin": [0, 0, 0], "negate": 0, "free_thresh": 0.5,
    "occupied_thresh": 0.65, "mode": "scale", "starts": [[20, 8, 0]], "speed": [5, 12],
}  # fmt: skip


@settings(max_examples=40)
@given(changes=st.dictionaries(st.sampled_from([*GOOD, "other"]), values, max_size=3), drop=st.booleans())
def test_any_values(small, changes, drop):
    path = small[0] / "values.yaml"
    keys = {k: v for k, v in GOOD.items() if not (drop and k in ("resolution", "starts"))}
    path.write_text(yaml.safe_dump({**keys, **changes}))
    loads_or_is_refused(path)


@settings(max_examples=25)
@given(st.integers(0, 2**32), st.floats(0.02, 0.98), st.integers(1, 32), st.sampled_from([1, 4, 10]))
def test_any_pixels(small, seed, share, grain, ppm):
    coarse = (np.random.default_rng(seed).random((64 // grain + 1,) * 2) < share).astype(np.uint8) * 255
    save(small[0] / "blobs.png", coarse.repeat(grain, axis=0).repeat(grain, axis=1)[:64, :64])
    path = small[0] / "blobs.yaml"
    path.write_text(f"{{image: blobs.png, resolution: {1 / ppm}}}")
    loads_or_is_refused(path)
