"""Maps as robots save them, and race tracks: what their owners mean is road, and the rest is closed."""

import math
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from pictures import picture, read, ring, save, strip, write_yaml
from PIL import Image

from gridsim.config import SimConfig
from gridsim.maps import closing
from gridsim.maps.files import load_map, read_free, read_map_file

pytestmark = pytest.mark.filterwarnings("ignore::gridsim.maps.files.MapWarning")  # most are small, or all road


def lines(*rings, width=0.5, side=110.0):
    """A picture of circles (radius in m) as lines on white, 4 pixels a metre."""
    away = lambda x, y: np.hypot(x - side / 2, y - side / 2)  # noqa: E731
    return picture(lambda x, y: np.min([np.abs(away(x, y) - r) for r in rings], axis=0) - width / 2, side, side, 4)


def ring_of(x0, y0, radius, half_width):
    """The clearance of a ring."""
    return lambda x, y: half_width - np.abs(np.hypot(x - x0, y - y0) - radius)


def told(name, config=None):
    """A map, and the warnings about it."""
    with warnings.catch_warnings(record=True, action="always") as said:
        scenario = load_map(name, config)
    return scenario, [str(warning.message) for warning in said]


def test_a_track_between_two_lines_is_not_what_surrounds_it_nor_its_middle(tmp_path):
    scenario, said = told(write_yaml(tmp_path, lines(36.0, 46.0), resolution=0.25))
    away = np.hypot(*(scenario.starts[:, :2] - 55.0).T)
    assert len(away) == 512
    assert (away.min(), away.max()) == pytest.approx((41.0, 41.0), abs=2.0)
    assert not said
    around = read(scenario.road, [[55.0, 55.0], [55.0, 30.0], [55.0, 3.0], [4.0, 4.0], [55.0, 14.0]])
    assert (around > 0.0).tolist() == [False, False, False, False, True]


def building(x, y):
    """A hall, its outline 0.5 m thick with a gap of 8 m, and a corridor of 9 m that ends after 60 m."""
    hall, corridor = strip(110, 50, 0.0, 35.0, 35.0)(x, y), strip(45, 50, 0.0, 4.5, 32.0)(x, y)
    gap = (np.abs(x - 110) < 4) & (y > 80)
    inside = np.maximum(hall, corridor)
    return np.where(gap, 1.0, np.abs(inside + 0.25) - 0.25)


@pytest.mark.parametrize(("sim", "unit"), [("default", 1.0), ("f1tenth", 0.125)])
def test_gaps_of_an_outline_and_dead_ends_are_closed_and_told(tmp_path, sim, unit):
    config, pixels = SimConfig.load(sim), picture(building, 170.0, 110.0, 4)
    scenario, said = told(write_yaml(tmp_path, pixels, name="lab", resolution=0.25 * unit), config)
    at = scenario.starts[:, :2] / unit
    assert ((at > [75, 15]) & (at < [145, 85])).all()
    places = unit * np.array([[5.0, 5.0], [110.0, 95.0], [30.0, 50.0], [90.0, 50.0]])
    assert (read(scenario.road, places) > 0).tolist() == [0, 0, 0, 1]
    assert len(said) == 1
    assert re.match(r"lab loses \d+% of its road, .* Give starts in its YAML to keep it as it is drawn$", said[0])
    start = [30.0 * unit, 50.0 * unit, 0.0]
    kept = load_map(write_yaml(tmp_path, name="kept", resolution=0.25 * unit, starts=[start]), config)
    assert read(kept.road, places[:3]).min() > 0


def test_an_open_field_with_obstacles_is_road(tmp_path):
    """It encloses nothing: what surrounds the obstacles is the road."""
    scenario, said = told(save(tmp_path / "field.png", 255 - picture(ring_of(40, 40, 0.0, 4.0), 80.0, 80.0)))
    assert len(scenario.starts)
    assert "has road on 100% of its border" in said[-1]


@pytest.mark.parametrize(("side", "open_"), [(12.0, False), (18.0, True)])
def test_a_narrow_passage_is_closed_unless_it_leads_to_as_much_road_again(tmp_path, side, open_):
    rooms = strip(25, 25, 0.0, 18.0, 18.0), strip(55, 25, 0.0, 1.6, 20.0), strip(80 - 18 + side, 25, 0.0, side, side)
    road = load_map(
        save(tmp_path / "a.png", picture(lambda x, y: np.max([r(x, y) for r in rooms], axis=0), 110, 50))
    ).road
    assert (read(road, [[25.0, 25.0], [53.0, 25.0], [75.0, 25.0]]) > 0).tolist() == [True, open_, open_]


def test_what_is_not_joined_to_the_largest_road_is_closed(tmp_path):
    apart = lambda x, y: np.maximum(ring_of(40, 50, 36, 4)(x, y), ring_of(100, 50, 16, 4)(x, y))  # noqa: E731
    scenario, said = told(save(tmp_path / "two.png", picture(apart, 130.0, 100.0)))
    assert (read(scenario.road, [[4.0, 50.0], [116.0, 50.0]]) > 0).tolist() == [True, False]
    assert scenario.starts[:, 0].max() < 80
    assert "closed by walls" in said[0]


def test_a_long_car_does_not_jump_walls(tmp_path):
    """Its bends are so wide that an arc from heading to heading is longer than a thin wall and the room beside it."""
    halls = strip(42, 45, 0.0, 40.0, 40.0), strip(122, 45, 0.0, 40.0, 39.5)
    pixels = picture(lambda x, y: np.max([hall(x, y) for hall in halls], axis=0), 165.0, 90.0, 4)
    config = SimConfig.of({"vehicle": {"wheelbase": 5.0, "rear_axle": 2.5}})
    road = load_map(write_yaml(tmp_path, pixels, resolution=0.25), config).road
    assert (read(road, [[42.0, 45.0], [122.0, 45.0]]) > 0).tolist() == [True, False]


def block(x, y):
    """A road of 7 m around a square block whose corners are round."""
    x, y = np.abs(x - 60.2) - 32, np.abs(y - 59.9) - 32
    return 3.5 - np.abs(np.hypot(np.maximum(x, 0), np.maximum(y, 0)) + np.minimum(np.maximum(x, y), 0) - 10.0)


@pytest.mark.parametrize("drawn", [ring_of(60, 60, 36, 2.4), block], ids=["ring", "block"])
def test_a_road_without_dead_ends_stays_as_it_is_drawn(tmp_path, drawn):
    road = load_map(save(tmp_path / "road.png", picture(drawn, 120.0, 120.0))).road
    points = np.random.default_rng(0).random((50_000, 2)) * 120.0
    clear = drawn(points[:, 0], points[:, 1])
    assert read(road, points[clear > 0.15]).min() > 0.0
    assert read(road, points[clear < -0.15]).max() < 0.0


def test_the_middle_of_a_hall_stays_open(tmp_path):
    """Its bends are circles along the walls, which do not come back to the middle."""
    road = load_map(save(tmp_path / "hall.png", picture(strip(20, 20, 0.0, 15.0, 15.0), 40.0, 40.0))).road
    assert read(road, [[20.0, 20.0], [18.0, 22.0]]).min() > 4.0


def test_on_a_very_large_road_nothing_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(closing, "_MOST_CELLS", 100)
    road = load_map(write_yaml(tmp_path, 255 - picture(building, 170.0, 110.0, 4), resolution=0.25, negate=1)).road
    assert read(road, [[30.0, 50.0]])[0] > 0


def test_where_no_road_goes_on_for_ever_starts_have_30_m_ahead(tmp_path):
    scenario = load_map(save(tmp_path / "corridor.png", picture(strip(50, 20, 0.0, 4.0), 100.0, 40.0)))
    ahead = np.where(np.cos(scenario.starts[:, 2]) > 0, 95.0 - scenario.starts[:, 0], scenario.starts[:, 0] - 5.0)
    assert 27.0 < ahead.min() < 36.0  # of driving, not of a straight line


def test_origin_may_be_turned_and_its_yaw_unknown(tmp_path):
    pixels = picture(strip(50, 20, 0.0, 5.0), 100.0, 40.0)
    given = [[-40.0, 100.5, 0.1], [20.0, 101.0, 3.0]]
    plain = load_map(write_yaml(tmp_path, pixels, origin=[-50.0, 81.0, 0.0], starts=given)).starts
    unknown = load_map(write_yaml(tmp_path, origin=[-50.0, 81.0, "-nan"], starts=given)).starts
    np.testing.assert_array_equal(unknown, plain)
    c, s = math.cos(3.14), math.sin(3.14)
    turned = [[7 + c * x - s * y, 5 + s * x + c * y, heading + 3.14] for x, y, heading, *_ in plain.tolist()]
    found = load_map(write_yaml(tmp_path, origin=[7.0, 5.0, 3.14], starts=turned)).starts
    np.testing.assert_allclose(found, plain, atol=1e-4)


def test_keys_of_other_programs_are_told_once(tmp_path):
    scenario, said = told(write_yaml(tmp_path, ring(36.0, 5.0), sx=1.0, map_ext=".png"))
    assert said == ["map has keys in its YAML that mean nothing here: map_ext, sx"]
    assert len(scenario.starts)


@pytest.mark.parametrize("form", ["L", "RGB", "RGBA"])
def test_unknown_is_never_road(tmp_path, form):
    """As savers of ROS 2 write it: a free_thresh of 0.25, of which the grey 205 of what is unknown falls short."""
    pixels = np.where(ring(36.0, 5.0) > 128, 254, 205).astype(np.uint8)
    Image.fromarray(pixels).convert(form).save(tmp_path / "map.png")
    free = read_free(read_map_file(Path(write_yaml(tmp_path, free_thresh=0.25, occupied_thresh=0.65))))
    np.testing.assert_array_equal(free, pixels[::-1] == 254)


@pytest.mark.parametrize("image", ["/home/robot/maps/map.png", "../maps/map.png", "C:\\maps\\map.png", "sub/map.png"])
def test_a_picture_of_another_machine_lies_beside_its_yaml(tmp_path, image):
    save(tmp_path / "map.png", ring(36.0, 5.0))
    assert read_map_file(Path(write_yaml(tmp_path, image=image))).image == tmp_path / "map.png"


def test_a_fine_resolution_for_a_small_car(tmp_path):
    pixels = picture(lambda x, y: 0.6 - np.abs(np.hypot(x - 6, y - 6) - 4.6), 12.0, 12.0, 1 / 0.0079)
    scenario = load_map(write_yaml(tmp_path, pixels, resolution=0.0079), SimConfig.load("f1tenth"))
    away = np.hypot(*(scenario.starts[:, :2] - 6.0).T)
    assert (away.min(), away.max()) == pytest.approx((4.6, 4.6), abs=0.15)
