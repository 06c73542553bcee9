"""The reference driver's profile: closed forms on a straight and a circle, and its bounds on a lane."""

import math

import numpy as np
import pytest

from gridsim.config import VehicleConfig
from gridsim.reference import ACCELERATION, BRAKING, arc_length, profile, top_speed

INTERVAL = (5.0, 12.0)
TOP = top_speed(INTERVAL)
CAR = VehicleConfig()


def test_profile_of_a_straight_is_flat_out_and_then_steady():
    points = np.stack([np.linspace(0.0, 200.0, 401), np.full(401, 3.0)], axis=1)
    speed, steering = profile(points, INTERVAL, 0.0, CAR)
    assert speed[[0, 6, 20, 200]] == pytest.approx([0.0, math.sqrt(18.0), math.sqrt(60.0), TOP], rel=1e-6)
    assert steering == pytest.approx(0.0, abs=1e-12)
    assert profile(points, INTERVAL, TOP, CAR)[0][0] == pytest.approx(TOP)


def test_profile_brakes_and_accelerates_no_harder_than_it_may():
    """A bend of 12 m radius to the right, between two straights."""
    heading = np.interp(np.arange(0.0, 240.0, 0.5), [100.0, 100.0 + 12.0 * math.pi], [0.0, -math.pi])
    points = 0.5 * np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    speed, steering = profile(points, INTERVAL, 2.0, CAR)
    rate = np.diff(speed**2) / (2.0 * np.diff(arc_length(points)))
    assert -BRAKING - 1e-6 <= rate.min() < -1.0
    assert 1.0 < rate.max() <= ACCELERATION + 1e-6
    assert np.abs(steering).max() <= math.radians(27.0) + 1e-9
    assert 2.0 < speed[1:].min() < speed.max() <= TOP + 1e-9
