"""The sides of the road: who is on a lane that runs its way, and what that is worth among traffic."""

import math

import numpy as np
import pytest

from evolution.episodes import lane_starts
from evolution.policy import PolicySpec
from evolution.rollout import Limits, evaluate
from gridsim.config import SimConfig
from gridsim.jit import njit
from gridsim.lanes import Path, lay_lanes
from gridsim.scenarios import REGISTRY, build, sample_starts
from gridsim.sides import keeps_side, make_sides
from gridsim.world import FIELDS, LANE

F = np.float32
WIDTH, HEIGHT = 64.0, 32.0


@njit
def _keeps(sides, width, poses, kept):
    for i in range(len(poses)):
        kept[i] = keeps_side(sides, width, poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3])


def keeps(sides, width, poses):
    """Whether cars at poses [n, 3] are on their own side: bool [n]."""
    poses = np.asarray(poses, dtype=float).reshape(-1, 3)
    table = np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])]).astype(F)
    kept = np.zeros(len(table), dtype=bool)
    _keeps(sides, F(width), table, kept)
    return kept


@pytest.fixture(scope="module")
def two_way():
    """Sides of a road along x: eastwards at y = 10.5, westwards at y = 14.5."""
    straight = ((WIDTH, 0.0),)
    lanes = lay_lanes([Path(0.0, 10.5, 0.0, straight), Path(WIDTH, 14.5, math.pi, straight)], WIDTH, HEIGHT)
    return make_sides(lanes, WIDTH, HEIGHT)


@pytest.mark.parametrize("x", [0.0, 0.3, 31.7, 63.9])
def test_a_lane_is_for_who_goes_its_way(two_way, x):
    for turn in np.radians([-44.0, 0.0, 44.0]):
        assert keeps(two_way, WIDTH, [[x, 10.5, turn], [x, 14.5, math.pi + turn]]).all()
        assert not keeps(two_way, WIDTH, [[x, 14.5, turn], [x, 10.5, math.pi + turn]]).any()
    for turn in (math.pi / 2 + 0.01, -math.pi / 2 - 0.01):
        assert not keeps(two_way, WIDTH, [[x, 10.5, turn]]).any()


def test_the_middle_of_the_road_and_the_ground_beside_it_are_nobodys(two_way):
    """Half of APART from the middle, 12.5, and REACH from a lane's middle; cells are half a metre."""
    for y, east, west in [
        (5.9, 0, 0),
        (8.3, 1, 0),
        (11.6, 1, 0),
        (12.4, 0, 0),
        (12.6, 0, 0),
        (13.4, 0, 1),
        (19.0, 0, 0),
    ]:
        assert keeps(two_way, WIDTH, [[20.0, y, 0.0], [20.0, y, math.pi]]).tolist() == [east, west]


@pytest.mark.parametrize("scenario", REGISTRY)
def test_starts_are_on_their_side_and_not_when_turned_round(scenario):
    road = build(scenario, 5)
    starts = sample_starts(road, 400, np.random.default_rng(0))
    starts[:, :2] %= [road.road.width, road.road.height]
    assert keeps(road.sides, road.road.width, starts[:, :3]).mean() > 0.995, "but for points right on a cell's corner"
    turned = starts[:, :3] + [0.0, 0.0, math.pi]
    wrong = keeps(road.sides, road.road.width, turned)
    assert wrong.mean() < 0.25, "inside junctions lanes of all directions cross, and in the city lanes are narrow"


def test_among_traffic_only_the_own_side_counts_as_paced():
    """A straight genome on a bend-free stretch of the highway, along the lanes and against them."""
    scenario, spec = build("highway", 2), PolicySpec.parse("mlp:1")
    genome = np.zeros((1, spec.size), dtype=F)  # argmax of equal outputs: the first action, accelerate
    rows, _ = lane_starts([scenario], np.zeros(8, dtype=int), np.random.default_rng(1))
    rows["start"][:, 3] = 16.0  # m/s, within the interval
    nobody = np.zeros((len(rows), 1, FIELDS), dtype=F)
    nobody[:, :, LANE] = -1.0
    limits = Limits(500.0, 12)
    along = evaluate(spec, genome, [scenario], rows, limits, SimConfig(), worlds=nobody)[0][0]
    alone = evaluate(spec, genome, [scenario], rows, limits, SimConfig())[0][0]
    assert (alone["paced"] > 10.0).all()
    assert np.array_equal(along["distance"], alone["distance"])
    assert along["paced"].mean() > 0.7 * alone["paced"].mean()
    rows["start"][:, 2] += math.pi
    against = evaluate(spec, genome, [scenario], rows, limits, SimConfig(), worlds=nobody)[0][0]
    assert (against["distance"] > 10.0).all()
    assert (against["paced"] == 0.0).all()
    assert (evaluate(spec, genome, [scenario], rows, limits, SimConfig())[0][0]["paced"] > 10.0).all()
