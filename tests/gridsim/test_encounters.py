"""Predicted collisions of traffic with the ego car, in closed form; test_traffic.py tests how the cars react."""

import numpy as np
import pytest
from pictures import cars_on, straight_road

from gridsim.config import SimConfig
from gridsim.maps.lanes import Path, lay_lanes
from gridsim.maps.network import make_network
from gridsim.state import CAR_FIELDS, COS, SIN, SPEED, X, Y
from gridsim.traffic.behaviour import drivers
from gridsim.traffic.encounters import way_to_ego_collision

CONFIG = SimConfig()


@pytest.mark.parametrize(("late", "meet"), [(-1.8, False), (-0.5, True), (0.0, True), (0.5, True), (1.8, False)])
def test_a_collision_is_predicted_where_both_will_be_at_once(late, meet):
    """A car drives eastwards, 2 s from the ego car's path; the ego car comes northwards, `late` s later."""
    lanes = lay_lanes([Path(0.0, 64.0, 0.0, ((128.0, 0.0),))], 128.0, 128.0, 1)
    network = make_network(lanes, straight_road(128.0, 128.0, 12.0), CONFIG)
    car = cars_on(network, (0, 52.0, 6.0, 1.0))[0]
    ego = np.zeros(CAR_FIELDS, dtype=np.float32)
    ego[[X, Y, COS, SIN, SPEED]] = 64.0, 64.0 - 6.0 * (2.0 + late), 0.0, 1.0, 6.0
    way = 12.0 - CONFIG.vehicle.width / 2 if meet else 1e9  # m to the ego car's side; the lane has a point each metre
    assert way_to_ego_collision(network, drivers(CONFIG), car, ego) == pytest.approx(way, abs=1.0)
