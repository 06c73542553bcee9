"""Velocity and steering errors, and the reference driver's profile: closed forms on a straight and a circle."""

import json
import math

import numpy as np
import pytest
from commands import CHAMPION, call, refused

from cluster.commands.cli import evaluate_main
from cluster.compare.results import series
from cluster.store.champion import load_champion
from gridsim.config import VehicleConfig
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import REGISTRY, build
from gridsim.reference import ACCELERATION, BRAKING, LATERAL, Series, arc_length, error_series, profile, top_speed
from gridsim.reference import errors as errors_of

INTERVAL = REGISTRY["seamless"].speed_interval
TOP = top_speed(INTERVAL)
CAR = VehicleConfig()


@pytest.fixture(scope="module")
def road():
    return build("seamless", HELD_OUT_SEED)


def along(points, speed, steering=0.0):
    """Poses [n, 5] along points [n, 2] at a speed (m/s) and steering (rad), or arrays of them."""
    ahead = np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
    rows = np.empty((len(points), 5))
    rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4] = points, np.arctan2(ahead[:, 1], ahead[:, 0]), speed, steering
    return rows


def straight(length):
    s = np.arange(0.0, length + 0.25, 0.5)
    return np.stack([10.0 + s, np.full_like(s, 20.0)], axis=1)


def of(poses, road):
    return error_series(poses, road, CAR)


def test_constant_offsets_on_a_straight_are_the_errors(road):
    found = errors_of([of(along(straight(300.0), TOP + 2.0, math.radians(-3.0)), road)], CAR)
    assert (found["velocity_mean_mps"], found["velocity_max_mps"]) == pytest.approx((2.0, 2.0))
    assert found["reference_mps"] == pytest.approx(TOP)
    assert found["velocity_mean_percent"] == pytest.approx(100 * 2.0 / TOP)
    assert (found["steering_mean_deg"], found["steering_max_deg"]) == pytest.approx((3.0, 3.0))
    assert found["steering_max_percent"] == pytest.approx(100 * 3.0 / 27.0)
    braking = TOP**2 / (2 * BRAKING)  # of the end, and 5 m of the beginning, nothing is known
    assert found["metres"] == pytest.approx(300.0 - 5.0 - braking, abs=0.51)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_circle_wants_the_bicycles_steering(road, side):
    radius, turn = 20.0, np.arange(0.0, 5.0, 0.0125)
    points = (100.0 + radius * np.stack([np.sin(turn), -np.cos(turn)], axis=1)) * [1.0, side]
    speed = math.sqrt(LATERAL * radius)
    wheels = side * math.atan(2.0 * math.tan(math.asin(1.25 / radius)))
    right = errors_of([of(along(points, speed, wheels), road)], CAR)
    assert right["velocity_max_mps"] < 0.02
    assert right["steering_max_deg"] < 0.05
    wrong = errors_of([of(along(points, speed - 1.5, -wheels), road)], CAR)
    assert wrong["steering_max_deg"] == pytest.approx(2 * math.degrees(abs(wheels)), rel=5e-3)
    assert wrong["velocity_max_mps"] == pytest.approx(1.5, abs=0.02)


def test_it_is_metres_that_count_and_not_seconds(road):
    """A stand of a minute."""
    points = np.stack([np.append(np.arange(0.0, 200.0, 0.2), np.arange(200.0, 400.0, 1.0)), np.zeros(1200)], axis=1)
    poses = along(points, np.full(1200, TOP))
    waits = np.concatenate([poses[:300], np.repeat(poses[300:301] * [1, 1, 1, 0, 1], 600, axis=0), poses[300:]])
    waits[300:900, 4] = 0.4
    one, two = of(poses, road), of(waits, road)
    assert two.arc.tolist() == one.arc.tolist()
    moving, waiting = errors_of([one], CAR), errors_of([two], CAR)
    assert waiting["velocity_mean_mps"] == pytest.approx(moving["velocity_mean_mps"], abs=0.05)
    assert waiting["steering_mean_deg"] < 0.05


def test_what_was_reversed_and_driven_again_is_left_out(road):
    ahead, back = along(straight(200.0), 6.0), along(straight(200.0)[180:140:-1], -2.0)
    found, plain = of(np.concatenate([ahead[:181], back, ahead[141:]]), road), of(ahead, road)
    assert plain.arc[-1] > 100.0
    np.testing.assert_allclose(found, plain)


def test_over_the_edge_of_the_torus(road):
    width = float(road.road.width)
    poses = along(straight(300.0), TOP + 1.0)
    poses[:, 0] += width - 100.0
    beyond = poses.copy()
    beyond[:, 0] %= width
    assert errors_of([of(beyond, road)], CAR) == pytest.approx(errors_of([of(poses, road)], CAR))


@pytest.mark.parametrize("poses", [along(straight(50.0), 0.0)[:1], np.repeat(along(straight(1.0), 0.0)[:1], 9, axis=0)])
def test_who_came_nowhere_cannot_be_compared(road, poses):
    with pytest.raises(ValueError, match="nothing was driven"):
        of(poses, road)
    with pytest.raises(ValueError, match="nothing was driven"):
        errors_of([of(along(straight(4.0), 3.0), road)], CAR)  # a few metres


def constant(metres, speed, reference, degrees):
    arc, one = np.array([0.0, metres]), np.ones(2)
    return Series(arc, speed * one, reference * one, math.radians(degrees) * one, 0.0 * one)


def test_episodes_are_weighted_by_metres():
    both = errors_of([constant(300.0, 9.0, 10.0, 3.0), constant(100.0, 9.0, 6.0, -7.0)], CAR)
    assert both == pytest.approx(
        {
            "velocity_mean_mps": 1.5, "velocity_max_mps": 3.0, "velocity_mean_percent": 100 * 1.5 / 9.0,
            "velocity_max_percent": 100 * 3.0 / 9.0, "reference_mps": 9.0, "steering_mean_deg": 4.0,
            "steering_max_deg": 7.0, "steering_mean_percent": 100 * 4.0 / 27.0,
            "steering_max_percent": 100 * 7.0 / 27.0, "metres": 400.0,
        }
    )  # fmt: skip
    with pytest.raises(ValueError, match="nothing was driven"):
        errors_of([], CAR)


def test_the_command_measures_a_champion_against_the_reference_driver(monkeypatch, capsys):
    def run(*arguments):
        return call(evaluate_main, monkeypatch, capsys, CHAMPION, "--episodes", 4, *arguments)

    said = json.loads(run("--json", "--errors")[1])
    found = said["errors"]
    assert said["episodes"] == 4
    assert found["metres"] > 4 * 1900.0
    assert 0.5 < found["velocity_mean_mps"] < 4.0
    assert 1.0 < found["steering_mean_deg"] < 6.0
    champion = load_champion(CHAMPION)
    assert found == errors_of(series(champion, "seamless", 4, HELD_OUT_SEED, 0), CAR)
    assert found != errors_of(series(champion, "seamless", 4, HELD_OUT_SEED, 6), CAR)
    code, shown, _ = run("--errors")
    assert code == 0
    for words in ("success (2,000 m without a collision)", "velocity error, m/s", "steering error, degrees"):
        assert words in shown
    assert "traffic must be 0 to 100" in refused(evaluate_main, monkeypatch, capsys, CHAMPION, "--traffic", -2)[0]


# --- The profile -----------------------------------------------------------------------------------------------------


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
