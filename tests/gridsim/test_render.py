"""Pictures are held against the map and the state they show: which pixel is what, and where things are."""

import dataclasses

import numpy as np
import pytest
from pictures import read

from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.simulator import Simulator
from gridsim.state import CAR_FIELDS, COS, SIN, X, Y
from gridsim.view import paint, render
from gridsim.view.render import Renderer


@pytest.fixture(scope="module")
def scenario():
    return build("seamless", 3)


@pytest.fixture(scope="module")
def state(scenario):
    """A car that stands at a start, and what it sees."""
    simulator = Simulator(1)
    simulator.reset(scenario, sample_starts(scenario, 1, np.random.default_rng(5)))
    return simulator.cars[0].copy(), simulator.ranges[0]


def car_at(x, y, heading=0.0):
    car = np.zeros(CAR_FIELDS, dtype=np.float32)
    car[[X, Y, COS, SIN]] = x, y, np.cos(heading), np.sin(heading)
    return car


def distance(pixels, colour):
    return np.abs(pixels.astype(int) - np.array(colour)).max(axis=-1)


def world(renderer, car, column, row):
    """Where pixels' middles are, by the textbook's turning: metres ahead and to the right of the car."""
    ahead = (renderer.size[1] * render.CAR_AT - (row + 0.5)) / renderer.pixels_per_m
    right = (column + 0.5 - renderer.size[0] / 2) / renderer.pixels_per_m
    return car[X] + ahead * car[COS] + right * car[SIN], car[Y] + ahead * car[SIN] - right * car[COS]


def test_every_pixel_is_road_where_the_map_has_road(scenario):
    renderer = Renderer(scenario, (320, 240))
    for pose in sample_starts(scenario, 4, np.random.default_rng(1)):
        car = car_at(*pose[:3])
        image = renderer.draw(car)
        row, column = np.mgrid[0:240, 0:320]
        x, y = world(renderer, car, column, row)
        clear = read(scenario.road, np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
        wall = clear < -paint.VERGE_WIDTH - 0.3
        assert wall.sum() > 10_000
        assert np.minimum(distance(image, paint.GROUND), distance(image, paint.GROUND_OTHER))[wall].max() <= 1
        # Well inside, there is asphalt but for the car and the marks.
        inside = clear > 0.8
        off = distance(image, paint.ASPHALT) > 1
        near = np.hypot(x - car[X], y - car[Y]) < 3.5
        assert off[inside & ~near].mean() < 0.05
        # The white line runs along the inner side of the edge.
        line = (np.abs(clear - paint.EDGE_AT) < 0.04) & ~near
        assert np.median(image[line].min(axis=-1)) > 130


def test_car_covers_its_own_outline(scenario, state):
    car, _ = state
    renderer = Renderer(scenario, (1280, 960))
    image = renderer.draw(car)

    def painted(colour, tolerance):
        """How far pixels of about a colour are along the car and to its left, m."""
        row, column = np.nonzero(distance(image, colour) < tolerance)
        x, y = world(renderer, car, column, row)
        dx, dy = x - car[X], y - car[Y]
        return dx * car[COS] + dy * car[SIN], dy * car[COS] - dx * car[SIN]

    along, across = painted(paint.EGO, 25)
    assert np.abs(along).max() == pytest.approx(2.0, abs=0.25)
    assert np.abs(across).max() == pytest.approx(1.0, abs=0.25)
    # Its front is told by the headlights: pale pixels ahead of the centre, none behind.
    along, across = painted(paint.LIGHT, 12)
    near = np.hypot(along, across) < 2.2
    assert near.any()
    assert along[near].min() > 1.2


def test_other_cars_are_where_the_boxes_are_also_over_the_seam(scenario):
    renderer = Renderer(scenario, (320, 240))
    car = car_at(float(scenario.road.width) - 2.0, 128.0)
    box = np.array([[8.0, 130.0, 1.0, 0.0]])  # 10 m ahead, beyond the edge of the torus, and 2 m to the left
    blue = distance(renderer.draw(car, boxes=box), paint.OTHER) < 25
    blue &= ~(distance(renderer.draw(car), paint.OTHER) < 25)
    assert blue.sum() > 30
    row, column = np.nonzero(blue)
    assert 240 * render.CAR_AT - row.mean() == pytest.approx(10.0 * renderer.pixels_per_m, abs=2.5)
    assert 160 - column.mean() == pytest.approx(2.0 * renderer.pixels_per_m, abs=2.0)


def test_rays_end_where_the_ranges_say(scenario, state):
    car, ranges = state
    renderer = Renderer(scenario, (640, 480))
    car.setflags(write=False)
    image = renderer.draw(car, ranges=ranges)
    renderer.draw(car_at(10.0, 10.0, 2.0))
    assert (renderer.draw(car, ranges=ranges) == image).all()  # drawing leaves nothing behind
    seen = 0
    for turn, reach in zip(np.radians(np.linspace(-60.0, 60.0, 31)), ranges, strict=True):
        column = 320 - reach * np.sin(turn) * renderer.pixels_per_m
        row = 480 * render.CAR_AT - (1.25 + reach * np.cos(turn)) * renderer.pixels_per_m
        if reach < 49.0 and 0 <= column < 639 and 0 <= row < 479:
            seen += 1
            assert distance(image[int(row), int(column)], paint.RAY) < 40
    assert seen > 15


def test_off_a_map_that_is_no_torus_there_is_ground(scenario):
    flat = dataclasses.replace(scenario, torus=False)
    image = Renderer(flat, (320, 240)).draw(car_at(0.0, 100.0, np.pi))  # heading out of the map
    ahead = image[: int(240 * render.CAR_AT) - 25]
    assert np.minimum(distance(ahead, paint.GROUND), distance(ahead, paint.GROUND_OTHER)).max() <= 1
