"""The car's motion against closed forms and against the oracle."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gridsim.car.vehicle import Action, act, advance, path_curvature
from gridsim.config import Constants, EpisodeConfig, SensorConfig, SimConfig, VehicleConfig, constants

CONFIG = SimConfig()
K = constants(CONFIG)
F = np.float32
DT = 0.1  # s
STILL = 1e-6  # m/s, rounding: what stands still may seem to move by as much
R_SHARP = 1.25 / math.sin(math.atan(0.5 * math.tan(math.radians(27.0))))  # m, the tightest circle: l_r / sin(beta)

speeds = st.floats(-3.0, 30.0, width=32)
steerings = st.floats(-27.0, 27.0).map(math.radians).map(F)
actions = st.sampled_from(list(Action))


class Driver:
    """A car on an endless plane: poses as lists, one entry a control period and one for the start."""

    def __init__(self, speed: float = 0.0, steering: float = 0.0, k: Constants = K):
        self.k, self.steering = k, F(steering)
        self.state: tuple[np.float32, ...] = (F(0.0), F(0.0), F(1.0), F(0.0), F(speed))
        self.x, self.y, self.heading, self.speeds, self.driven = [0.0], [0.0], [0.0], [float(speed)], 0.0

    @property
    def speed(self) -> float:
        return float(self.state[4])

    def step(self, acceleration: float) -> None:
        kappa = path_curvature(self.k, self.state[4], self.steering)
        *state, length = advance(self.k, *self.state, F(acceleration), kappa, self.k.dt)
        self.state = tuple(map(F, state))
        x, y, cosine, sine, speed = map(float, self.state)
        self.x.append(x)
        self.y.append(y)
        self.heading.append(math.atan2(sine, cosine))
        self.speeds.append(speed)
        self.driven += float(length)

    def do(self, action: Action, times: int = 1) -> "Driver":
        for _ in range(times):
            acceleration, self.steering = act(self.k, int(action), self.state[4], self.steering)
            self.steering = F(self.steering)
            self.step(acceleration)
        return self


# --- Straight ahead --------------------------------------------------------------------------------------------------


def test_20_mps_for_2_s_is_40_m():
    car = Driver(speed=20.0).do(Action.NONE, 20)
    assert car.x[-1] == pytest.approx(40.0, abs=1e-4)
    assert car.y[-1] == 0.0
    assert car.speed == 20.0


def test_uniform_acceleration():
    car = Driver().do(Action.ACCELERATE, 40)  # 4 s at 3 m/s2
    assert car.speed == pytest.approx(12.0, abs=1e-4)
    assert car.x[-1] == pytest.approx(0.5 * 3.0 * 4.0**2, abs=1e-3)


def test_top_speed_is_reached_and_kept():
    car = Driver().do(Action.ACCELERATE, 150)
    assert max(car.speeds) == 30.0
    assert car.speeds[99] == pytest.approx(29.7, abs=1e-3)
    assert car.speeds[101:] == [30.0] * 50


@pytest.mark.parametrize("speed", [0.3, 0.8, 5.0, 12.0, 20.0, 30.0])
def test_stopping_distance(speed):
    car = Driver(speed=speed)
    periods = 0
    while car.speed > 1e-4:  # rounding leaves a little of the last 0.8 m/s
        car.do(Action.BRAKE)
        periods += 1
    assert periods == math.ceil(speed / 8.0 / DT - 1e-5)
    # v^2 / 2a; the last period brakes no harder than it must, so it takes its whole 0.1 s.
    rest = speed % 0.8
    late = rest * DT / 2 - rest**2 / (2 * 8.0)
    assert car.x[-1] == pytest.approx(speed**2 / (2 * 8.0) + late, abs=1e-3)
    assert late < 0.011


def test_reverse_goes_to_its_limit_and_no_further():
    car = Driver().do(Action.REVERSE, 30)
    assert min(car.speeds) == -3.0
    assert car.speeds[-15:] == [-3.0] * 15
    # 1 s to the limit, then 2 s at it.
    assert car.x[-1] == pytest.approx(-(0.5 * 3.0 * 1.0**2 + 3.0 * 2.0), abs=1e-3)


@given(speed=speeds)
def test_brake_slows_down_and_never_reverses(speed):
    car = Driver(speed=speed)
    for _ in range(45):
        before = car.speed
        car.do(Action.BRAKE)
        assert -STILL <= math.copysign(1.0, before) * car.speed <= max(abs(before), STILL)
        assert abs(before) - abs(car.speed) <= 0.8 * (1 + 1e-5)
    assert abs(car.speed) <= STILL
    assert car.x[-1] * speed >= 0.0


@given(speed=speeds, steering=steerings, taken=st.lists(actions, min_size=1, max_size=60))
def test_limits_hold_whatever_is_done(speed, steering, taken):
    car = Driver(speed=speed, steering=steering)
    for action in taken:
        steering = float(car.steering)
        car.do(action)
        assert -3.0 <= car.speed <= 30.0
        assert abs(float(car.steering)) <= math.radians(27.0) + 1e-6
        assert abs(float(car.steering) - steering) <= math.radians(6.0) + 1e-6
    assert all(map(math.isfinite, (*car.x, *car.y, *car.heading)))


# --- Steering --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("action", "sign"),
    [(Action.LEFT, 1), (Action.RIGHT, -1), (Action.ACCELERATE_LEFT, 1), (Action.ACCELERATE_RIGHT, -1)],
)
def test_steering_is_rate_limited_and_returns(action, sign):
    car, angles = Driver(speed=1.0), []
    for what in [action] * 6 + [Action.NONE] * 6:
        car.do(what)
        angles.append(math.degrees(car.steering))
    assert angles == pytest.approx([sign * a for a in (6, 12, 18, 24, 27, 27, 21, 15, 9, 3, 0, 0)], abs=1e-4)


@pytest.mark.parametrize(
    ("action", "acceleration", "steering"),
    [
        (Action.ACCELERATE, 3.0, 0.0),
        (Action.LEFT, 0.0, 6.0),
        (Action.RIGHT, 0.0, -6.0),
        (Action.BRAKE, -8.0, 0.0),
        (Action.NONE, 0.0, 0.0),
        (Action.ACCELERATE_LEFT, 3.0, 6.0),
        (Action.ACCELERATE_RIGHT, 3.0, -6.0),
        (Action.REVERSE, -3.0, 0.0),
    ],
)
def test_the_eight_actions_are_the_papers(action, acceleration, steering):
    got = act(K, int(action), F(10.0), F(0.0))
    assert float(got[0]) == pytest.approx(acceleration)
    assert math.degrees(got[1]) == pytest.approx(steering, abs=1e-4)


@given(action=actions, speed=speeds, steering=steerings)
def test_act_is_the_oracles(action, speed, steering):
    acceleration, angle = act(K, int(action), F(speed), steering)
    expected = oracle.act(CONFIG, int(action), float(speed), float(steering))
    assert (float(acceleration), float(angle)) == pytest.approx(expected, abs=2e-6, rel=1e-6)


# --- Bends -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1, -1])
def test_circle_radius(side):
    speed = 4.0  # v^2 / R is 3.2 m/s2: within the grip
    car = Driver(speed=speed, steering=side * math.radians(27.0))
    for _ in range(round(2 * math.pi * R_SHARP / speed / DT)):
        car.step(0.0)
    # The centre lies R to the left of the course, which is the heading and the slip angle.
    slip = side * math.atan(0.5 * math.tan(math.radians(27.0)))
    cx, cy = -side * R_SHARP * math.sin(slip), side * R_SHARP * math.cos(slip)
    radii = np.hypot(np.array(car.x) - cx, np.array(car.y) - cy)
    assert radii == pytest.approx(np.full(len(radii), R_SHARP), abs=1e-3)
    assert math.hypot(car.x[-1], car.y[-1]) < 0.5 * speed * DT + 1e-3  # round once


def test_too_fast_the_car_runs_wide():
    speed = 14.0
    car = Driver(speed=speed, steering=math.radians(27.0))
    for _ in range(60):
        car.step(0.0)
    turned = np.diff(np.unwrap(car.heading))
    assert speed * DT / turned == pytest.approx(np.full(60, speed**2 / 4.9), rel=1e-3)


@given(speed=speeds, steering=steerings)
def test_lateral_acceleration_is_bounded(speed, steering):
    kappa = float(path_curvature(K, F(speed), steering))
    assert float(speed) ** 2 * abs(kappa) <= 4.9 * (1 + 1e-6)
    assert abs(kappa) <= 1 / R_SHARP + 1e-6
    assert kappa * float(steering) >= 0.0
    assert kappa == pytest.approx(oracle.curvature(CONFIG, float(speed), float(steering)), abs=1e-6)


@given(speed=speeds, steering=steerings)
def test_without_a_grip_limit_it_is_the_pure_model(speed, steering):
    pure = constants(SimConfig(vehicle=VehicleConfig(lateral_grip=math.inf)))
    beta = math.atan(1.25 / 2.5 * math.tan(float(steering)))
    assert float(path_curvature(pure, F(speed), steering)) == pytest.approx(math.sin(beta) / 1.25, abs=1e-6)


def kong(state: np.ndarray, steering: float, acceleration: float) -> np.ndarray:
    """Kong et al. 2015, equations 1: derivatives of x, y, psi, v."""
    _, _, psi, v = state
    beta = math.atan(1.25 / 2.5 * math.tan(steering))
    return np.array([v * math.cos(psi + beta), v * math.sin(psi + beta), v / 1.25 * math.sin(beta), acceleration])


@settings(max_examples=50)
@given(speed=st.floats(0.0, 29.5, width=32), steering=steerings, acceleration=st.sampled_from([0.0, 3.0]))
def test_advance_solves_kongs_equations(speed, steering, acceleration):
    state, h = np.array([0.0, 0.0, 0.0, float(speed)]), DT / 20
    for _ in range(20):  # Runge and Kutta's fourth order
        k1 = kong(state, steering, acceleration)
        k2 = kong(state + h / 2 * k1, steering, acceleration)
        k3 = kong(state + h / 2 * k2, steering, acceleration)
        k4 = kong(state + h * k3, steering, acceleration)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    pure = constants(SimConfig(vehicle=VehicleConfig(lateral_grip=math.inf)))
    car = Driver(speed=speed, steering=steering, k=pure)
    car.step(acceleration)
    assert (car.x[-1], car.y[-1], car.heading[-1], car.speed) == pytest.approx(tuple(state), abs=2e-5)


@given(speed=speeds, steering=steerings, heading=st.floats(-math.pi, math.pi), action=actions)
def test_a_period_is_the_oracles(speed, steering, heading, action):
    acceleration, angle = act(K, int(action), F(speed), steering)
    kappa = path_curvature(K, F(speed), F(angle))
    start = (F(3.0), F(-2.0), F(math.cos(heading)), F(math.sin(heading)), F(speed))
    x, y, cosine, sine, after, length = advance(K, *start, F(acceleration), kappa, K.dt)
    expected, looks = oracle.advance(
        CONFIG, oracle.Car(3.0, -2.0, heading, float(speed), float(angle)), float(acceleration)
    )
    # A speed limit reached within the period: the kernel's mean speed is that of its ends, the oracle's is exact.
    clipped = not -3.0 <= float(speed) + float(acceleration) * DT <= 30.0
    tolerance = 6e-3 if clipped else 1e-5
    assert float(length) == pytest.approx(looks[-1, 4], abs=tolerance)
    assert (float(x), float(y)) == pytest.approx((looks[-1, 0], looks[-1, 1]), abs=tolerance)
    assert float(after) == pytest.approx(expected.speed, abs=1e-5)
    turn = math.remainder(math.atan2(sine, cosine) - looks[-1, 2], 2 * math.pi)
    assert abs(turn) < tolerance


@given(speed=speeds, steering=steerings, parts=st.integers(2, 6))
def test_one_period_is_as_many_parts_as_one_likes(speed, steering, parts):
    kappa = path_curvature(K, F(speed), steering)
    state: tuple[np.float32, ...] = (F(0.0), F(0.0), F(1.0), F(0.0), F(speed))
    whole = advance(K, *state, F(0.0), kappa, K.dt)[:5]
    for _ in range(parts):
        state = tuple(map(F, advance(K, *state, F(0.0), kappa, F(K.dt / parts))[:5]))
    assert np.array(state) == pytest.approx(np.array(whole, dtype=F), abs=1e-5)


@given(speed=st.floats(-3.0, 3.0, width=32), steering=steerings)
def test_there_and_back_is_where_it_was(speed, steering):
    kappa = path_curvature(K, F(speed), steering)
    state = (F(1.0), F(2.0), F(0.6), F(0.8), F(speed))
    x, y, cosine, sine, *_ = advance(K, *state, F(0.0), kappa, K.dt)
    back = advance(K, F(x), F(y), F(cosine), F(sine), F(-speed), F(0.0), kappa, K.dt)
    assert np.array(back[:4]) == pytest.approx(np.array(state[:4]), abs=2e-6)


@given(taken=st.lists(actions, min_size=1, max_size=40), speed=speeds)
def test_left_and_right_are_mirror_images(taken, speed):
    mirror = {
        Action.LEFT: Action.RIGHT,
        Action.RIGHT: Action.LEFT,
        Action.ACCELERATE_LEFT: Action.ACCELERATE_RIGHT,
        Action.ACCELERATE_RIGHT: Action.ACCELERATE_LEFT,
    }
    car, other = Driver(speed=speed), Driver(speed=speed)
    for action in taken:
        car.do(action)
        other.do(mirror.get(action, action))
    assert other.x == pytest.approx(car.x, abs=1e-4)
    assert other.y == pytest.approx([-y for y in car.y], abs=1e-4)


def test_the_heading_stays_a_unit_vector():
    car = Driver(speed=5.0, steering=math.radians(20.0))
    for _ in range(4000):
        car.step(0.0)
    assert math.hypot(car.state[2], car.state[3]) == pytest.approx(1.0, abs=1e-6)


# --- The configuration -----------------------------------------------------------------------------------------------


def test_constants_are_si_and_radians():
    assert K.half_length == 2.0
    assert K.half_width == 1.0
    assert K.front_axle == 1.25
    assert K.steering_limit == pytest.approx(math.radians(27.0))
    assert K.ray_first == pytest.approx(-math.radians(60.0))
    assert K.ray_first + 30 * K.ray_step == pytest.approx(math.radians(60.0), abs=1e-6)


@pytest.mark.parametrize(
    "config",
    [
        SimConfig(vehicle=VehicleConfig(length=0.0)),
        SimConfig(vehicle=VehicleConfig(width=-1.0)),
        SimConfig(vehicle=VehicleConfig(wheelbase=math.nan)),
        SimConfig(vehicle=VehicleConfig(lateral_grip=0.0)),
        SimConfig(vehicle=VehicleConfig(rear_axle=2.5)),
        SimConfig(vehicle=VehicleConfig(rear_axle=math.nan)),
        SimConfig(sensors=SensorConfig(rays=1)),
        SimConfig(sensors=SensorConfig(field_of_view=361.0)),
        SimConfig(sensors=SensorConfig(range=0.0)),
        SimConfig(episode=EpisodeConfig(control_period=0.0)),
    ],
)
def test_numbers_that_make_no_sense_are_refused_in_one_line(config):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        constants(config)
