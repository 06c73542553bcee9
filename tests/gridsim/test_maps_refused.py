"""Maps from files: whatever bytes a file may hold, it is a map, or refused with one clear line."""

import contextlib
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import crashes, picture, save, strip

from cluster.settings import EvolveSettings, from_dict
from gridsim.errors import GridSimError
from gridsim.maps.files import MAX_PIXELS, load_map

pytestmark = pytest.mark.filterwarnings("ignore::gridsim.maps.files.MapWarning")


def refused(name):
    """The one line with which a file is refused."""
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
    road = picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0)
    whole = Path(save(tmp_path / "whole.png", road)).read_bytes()
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
    "[1, 2]": "mapping",
    "[" * 2000: "not valid YAML",
    "!!python/object/apply:os.system ['true']": "not valid YAML",
    "resolution: 0.1": "image",
    "image: map.png": "resolution",
    "{image: map.png, resolution: .nan}": "not nan",
    "{image: map.png, resolution: 1e9}": "from 0.01 to 1",
    "{image: map.png, resolution: 1}": "is too large",
    "{resolution: 0.1, image: [map.png]}": "image must name",
    "{resolution: 0.1, image: /map.png}": "own folder",
    "{resolution: 0.1, image: link.png}": "own folder",
    "{resolution: 0.1, image: loop.png}": "loop.png",
    "{resolution: 0.1, image: none.png}": "No such file",
    "{image: map.png, resolution: 0.1, start: []}": "unknown key 'start'",
    "{image: map.png, resolution: 0.1, free_thresh: 0.7}": "not above occupied_thresh",
    "{image: map.png, resolution: 0.1, negate: 2}": "negate",
    "{image: map.png, resolution: 0.1, origin: [0, 0, 0.5]}": "yaw",
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
    good = Path(save(folder / "good.png", picture(strip(20, 8, 0.0, 4.0, 18.0), 40.0, 16.0, 4)))
    return folder, good.read_bytes()


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
    """Blobs of any size."""
    coarse = (np.random.default_rng(seed).random((64 // grain + 1,) * 2) < share).astype(np.uint8) * 255
    save(small[0] / "blobs.png", coarse.repeat(grain, axis=0).repeat(grain, axis=1)[:64, :64])
    path = small[0] / "blobs.yaml"
    path.write_text(f"{{image: blobs.png, resolution: {1 / ppm}}}")
    loads_or_is_refused(path)
