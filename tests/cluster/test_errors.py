"""Velocity and steering errors: closed forms on a straight and a circle, zero for the reference, recorded drives."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from commands import call

from cluster.commands.cli import evaluate_main
from cluster.comparison.errors import series
from cluster.runs.champion import load_champion
from evolution.episodes.rollout import Limits, trajectory
from evolution.networks.policy import PolicySpec
from gridsim.config import VehicleConfig
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import HELD_OUT_SEED, REGISTRY, build
from gridsim.reference.errors import APART, TURN, Series, driven, error_series, error_series_beside
from gridsim.reference.errors import errors as errors_of
from gridsim.reference.profile import BRAKING, LATERAL, top_speed
from gridsim.view.drive import DriveError, Recorder, poses_of

INTERVAL = REGISTRY["seamless"].speed_interval
TOP = top_speed(INTERVAL)
CAR = VehicleConfig()
BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
CHAMPION = BENCHMARKS / "champion.npz"


@pytest.fixture(scope="module")
def road():
    return build("seamless", HELD_OUT_SEED)


@pytest.fixture(scope="module")
def champion():
    return load_champion(CHAMPION)


def errors(champion, *args, **options):
    return errors_of(series(champion, *args, **options), CAR)


def along(points, speed, steering=0.0):
    """Poses [n, 5] along points [n, 2] at a speed (m/s) and steering (rad), or arrays of them."""
    ahead = np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
    rows = np.empty((len(points), 5))
    rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4] = points, np.arctan2(ahead[:, 1], ahead[:, 0]), speed, steering
    return rows


def straight(length, step=0.5):
    s = np.arange(0.0, length + step / 2, step)
    return np.stack([10.0 + s, np.full_like(s, 20.0)], axis=1)


def circle(radius, length, step=0.25):
    turn = np.arange(0.0, length / radius, step / radius)
    return 100.0 + radius * np.stack([np.sin(turn), -np.cos(turn)], axis=1)


def of(poses, road):
    return error_series(driven(poses, road), road, CAR)


def test_constant_offsets_on_a_straight_are_the_errors(road):
    found = errors_of([of(along(straight(300.0), TOP + 2.0, math.radians(-3.0)), road)], CAR)
    assert found["velocity_mean_mps"] == pytest.approx(2.0)
    assert found["velocity_max_mps"] == pytest.approx(2.0)
    assert found["reference_mps"] == pytest.approx(TOP)
    assert found["velocity_mean_percent"] == pytest.approx(100 * 2.0 / TOP)
    assert (found["steering_mean_deg"], found["steering_max_deg"]) == pytest.approx((3.0, 3.0))
    assert found["steering_max_percent"] == pytest.approx(100 * 3.0 / 27.0)
    braking = TOP**2 / (2 * BRAKING)  # of the end, and 5 m of the beginning, nothing is known
    assert found["metres"] == pytest.approx(300.0 - 5.0 - braking, abs=0.51)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_circle_wants_the_bicycles_steering(road, side):
    radius = 20.0
    points = circle(radius, 100.0) * [1.0, side]
    speed = math.sqrt(LATERAL * radius)
    wheels = side * math.atan(2.0 * math.tan(math.asin(1.25 / radius)))
    right = errors_of([of(along(points, speed, wheels), road)], CAR)
    assert right["velocity_max_mps"] < 0.02
    assert right["steering_max_deg"] < 0.05
    none = errors_of([of(along(points, speed, 0.0), road)], CAR)
    assert none["steering_mean_deg"] == pytest.approx(math.degrees(abs(wheels)), rel=5e-3)
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
    assert errors_of([two], CAR)["velocity_mean_mps"] == pytest.approx(
        errors_of([one], CAR)["velocity_mean_mps"], abs=0.05
    )
    assert errors_of([two], CAR)["steering_mean_deg"] < 0.05


def test_what_was_reversed_and_driven_again_is_left_out(road):
    ahead, back = along(straight(100.0), 6.0), along(straight(100.0)[180:140:-1], -2.0)
    poses = np.concatenate([ahead[:181], back, ahead[141:]])
    path = driven(poses, road)
    assert path.arc[-1] == pytest.approx(100.0)
    assert np.all(path.speed == 6.0)
    assert np.array_equal(poses[path.rows, 0], ahead[:, 0])


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
        driven(poses, road)
    with pytest.raises(ValueError, match="nothing was driven"):
        errors_of([of(along(straight(4.0), 3.0), road)], CAR)  # a few metres


def constant(metres, speed, reference, degrees):
    """A drive at constant speeds (m/s), with the wheels so far off."""
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


def test_recorded_drive_is_compared_at_the_same_place(road):
    """Beside the recording, in steps of another size: what counts is how far along it the agent is."""
    recorded = driven(along(straight(200.0), 4.0 + straight(200.0)[:, 0] / 50.0, 0.02), road)
    points = straight(230.0, 0.7) + np.array([0.0, 1.0])
    path = driven(along(points, 3.0 + points[:, 0] / 50.0, 0.02), road)
    found, reached = error_series_beside(path, recorded, road)
    assert reached == pytest.approx(200.0, abs=0.7)
    assert found.velocity_error == pytest.approx(-1.0, abs=1e-9)
    assert found.steering_error == pytest.approx(0.0, abs=1e-9)


def test_who_leaves_the_recorded_path_is_compared_up_to_there(road):
    recorded = driven(along(straight(200.0), 8.0), road)
    turn = np.arange(0.25, 20.0, 0.25) / 12.0
    bend = [60.0, 20.0] + 12.0 * np.stack([np.sin(turn), 1.0 - np.cos(turn)], axis=1)
    path = driven(along(np.concatenate([straight(50.0), bend]), 6.0, 0.3), road)
    found, reached = error_series_beside(path, recorded, road)
    lateral = 50.0 + 12.0 * math.sin(math.acos(1.0 - APART / 12.0))
    assert reached == pytest.approx(min(lateral, 50.0 + 12.0 * math.sin(math.radians(45.0))), abs=0.3)
    assert found.arc[-1] == pytest.approx(50.0, abs=TURN / 4)
    assert errors_of([found], CAR)["velocity_mean_mps"] == pytest.approx(2.0)
    other, reached = error_series_beside(
        driven(along(straight(50.0) + np.array([0.0, 5.0]), 6.0), road), recorded, road
    )
    assert (len(other.arc), reached) == (0, 0.0)


def record(path, champion, road, start, target):
    """A champion's own drive, written as a person's: bit for bit what its rollout does."""
    spec = PolicySpec.parse(champion.policy)
    _, states, _ = trajectory(spec, champion.genome, road, start, Limits(target, 4000), champion.sim)
    poses = poses_of(states)
    poses[0] = start
    env = champion.make_env(traffic=0)
    observation, _ = env.reset(seed=1, options={"map_seed": road.seed, "start": start})
    with Recorder(path, road, 0.1) as recorder:
        for step, pose in enumerate(poses[:-1]):
            action = int(champion.act(observation))
            recorder.write(step, pose, action, 0)
            observation, *_ = env.step(action)
    env.close()


@pytest.fixture(scope="module")
def recorded(champion, tmp_path_factory):
    """A drive of the champion's own, and one of another champion."""
    folder, road = tmp_path_factory.mktemp("drives"), build("seamless", 11)
    start = sample_starts(road, 1, np.random.default_rng(0))[0]
    record(folder / "own.csv", champion, road, start, 300.0)
    record(folder / "drive.csv", load_champion(BENCHMARKS / "champion_traffic.npz"), road, start, 500.0)
    return folder


def test_champion_against_its_own_recording_is_zero(champion, recorded):
    found = errors(champion, reference=recorded / "own.csv")
    assert found["metres"] > 290.0
    assert (found["velocity_max_mps"], found["steering_max_deg"]) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_champion_begins_anew_where_it_leaves_the_recording(champion, recorded):
    parts = series(champion, reference=recorded / "drive.csv")
    found = errors_of(parts, CAR)
    assert 250.0 < found["metres"] < 510.0
    assert len(parts) > 1
    assert all(abs(part.velocity_error[0]) < 0.5 for part in parts)
    assert 0.1 < found["velocity_mean_mps"] < 2.0  # of another driver


def test_recording_of_elsewhere_is_refused(champion, recorded, tmp_path):
    with pytest.raises(DriveError, match="driven on seamless, not on city"):
        errors(champion, "city", reference=recorded / "own.csv")
    with pytest.raises(DriveError, match="among 0 cars, not 3"):
        errors(champion, traffic=3, reference=recorded / "own.csv")
    text = (recorded / "own.csv").read_text().replace(",11\n", ",12\n")
    (tmp_path / "moved.csv").write_text(text)
    with pytest.raises(DriveError, match="another map"):
        errors(champion, reference=tmp_path / "moved.csv")
    lines = (recorded / "own.csv").read_text().splitlines(keepends=True)
    (tmp_path / "still.csv").write_text("".join(lines[:2]))
    with pytest.raises(ValueError, match="nothing was driven"):
        errors(champion, reference=tmp_path / "still.csv")


def test_champion_against_the_reference_driver(champion):
    found = errors(champion, episodes=4)
    assert found["metres"] > 4 * 1900.0
    assert 0.5 < found["velocity_mean_mps"] < 4.0
    assert 1.0 < found["steering_mean_deg"] < 6.0
    assert found != errors(champion, episodes=4, traffic=6)
    for wrong in ({"episodes": 0}, {"scenario": "moon"}, {"traffic": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            errors(champion, **wrong)


def test_command_prints_them(champion, recorded, monkeypatch, capsys):
    def run(*arguments):
        return call(evaluate_main, monkeypatch, capsys, CHAMPION, "--episodes", 2, *arguments)

    said = json.loads(run("--json", "--errors")[1])
    assert said.pop("errors") == errors(champion, episodes=2)
    assert said["episodes"] == 2
    code, shown, _ = run("--reference", recorded / "own.csv")
    assert code == 0
    for words in ("success (2,000 m without a collision)", "velocity error, m/s", "steering error, degrees"):
        assert words in shown
    code, _, said = run("--scenario", "city", "--reference", recorded / "own.csv")
    assert code == 2
    assert said.startswith("gridsim-evaluate: error: ")
    assert "driven on seamless, not on city" in said
