"""The car's motion against closed forms and against the oracle."""

import math

import numpy as np
import oracle
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from gridsim.car.vehicle import Action, act, act_continuous, advance, path_curvature
from gridsim.config import Constants, EpisodeConfig, SensorConfig, SimConfig, VehicleConfig, constants

CONFIG = SimConfig()
K = constants(CONFIG)
F = np.float32
DT = 0.1  # s
STILL = 1e-6  # m/s, rounding: what stands still may seem to move by as much

speeds = st.floats(-3.0, 30.0, width=32)
steerings = st.floats(-27.0, 27.0).map(math.radians).map(F)
actions = st.sampled_from(list(Action))


class Driver:
    """A car on an endless plane, that begins at its origin: x, y, cosine, sine, speed."""

    def __init__(self, speed: float = 0.0, steering: float = 0.0, k: Constants = K):
        self.k, self.steering = k, F(steering)
        self.state: tuple[np.float32, ...] = (F(0.0), F(0.0), F(1.0), F(0.0), F(speed))

    def step(self, acceleration: float) -> None:
        kappa = path_curvature(self.k, self.state[4], self.steering)
        *state, _ = advance(self.k, *self.state, F(acceleration), kappa, self.k.dt)
        self.state = tuple(map(F, state))

    def do(self, action: Action) -> None:
        acceleration, self.steering = act(self.k, int(action), self.state[4], self.steering)
        self.steering = F(self.steering)
        self.step(acceleration)


# --- Straight ahead --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pedal", [-1.0, -0.3])
@pytest.mark.parametrize("speed", [12.3, 0.5, -2.0])
def test_the_pedal_brakes_to_a_stand_and_not_further(pedal, speed):
    car = Driver(speed=speed)
    for _ in range(60):
        acceleration, _ = act_continuous(K, F(pedal), F(0.0), car.state[4], F(0.0))
        assert abs(acceleration) <= -8.0 * pedal * (1 + 1e-6)
        car.step(acceleration)
    assert abs(car.state[4]) <= STILL
    assert car.state[0] * speed > 0.0


def test_braking_in_a_bend_stays_within_the_friction_circle():
    """Of 1 g, whatever an action asks for at any speed; CommonRoad's cars may have 11.5 m/s2."""
    assert float(act(K, Action.BRAKE, F(30.0), F(0.0))[0]) == -8.0
    for speed in np.linspace(0.0, 30.0, 61):
        lateral = speed**2 * float(path_curvature(K, F(speed), K.steering_limit))
        assert max(math.hypot(lateral, float(act(K, a, F(speed), F(0.0))[0])) for a in Action) < 9.81


@given(action=actions, speed=speeds, steering=steerings)
def test_act_is_the_oracles(action, speed, steering):
    acceleration, angle = act(K, int(action), F(speed), steering)
    expected = oracle.act(CONFIG, int(action), float(speed), float(steering))
    assert (float(acceleration), float(angle)) == pytest.approx(expected, abs=2e-6, rel=1e-6)


# --- Bends -----------------------------------------------------------------------------------------------------------


def kong(_t: float, state: np.ndarray, steering: float, acceleration: float) -> list[float]:
    """Kong et al. 2015, equations 1: derivatives of x, y, psi, v."""
    _, _, psi, v = state
    beta = math.atan(1.25 / 2.5 * math.tan(steering))
    return [v * math.cos(psi + beta), v * math.sin(psi + beta), v / 1.25 * math.sin(beta), acceleration]


def test_ten_seconds_of_stepwise_steering_are_kongs():
    """A command acts at the beginning of its period: Kong's equations under the same steps, without a grip limit."""
    rng, state = np.random.default_rng(0), [0.0, 0.0, 0.0, 8.0]
    car = Driver(8.0, k=constants(SimConfig(vehicle=VehicleConfig(lateral_grip=math.inf))))
    for action in rng.choice([Action.LEFT, Action.RIGHT, Action.NONE], 100):
        car.do(action)
        drive = (float(car.steering), 0.0)
        state = list(solve_ivp(kong, (0.0, DT), state, args=drive, rtol=1e-9, atol=1e-9).y[:, -1])
    assert math.hypot(car.state[0] - state[0], car.state[1] - state[1]) < 1e-3


@given(speed=speeds, steering=steerings, heading=st.floats(-math.pi, math.pi), action=actions)
def test_a_period_is_the_oracles(speed, steering, heading, action):
    acceleration, angle = act(K, int(action), F(speed), steering)
    kappa = path_curvature(K, F(speed), F(angle))
    start = (F(3.0), F(-2.0), F(math.cos(heading)), F(math.sin(heading)), F(speed))
    x, y, cosine, sine, after, length = advance(K, *start, F(acceleration), kappa, K.dt)
    looks = oracle.advance(CONFIG, (3.0, -2.0, heading), float(speed), float(angle), float(acceleration))
    # A speed limit reached within the period: the kernel's mean speed is that of its ends, the oracle's is exact.
    clipped = not -3.0 <= float(speed) + float(acceleration) * DT <= 30.0
    tolerance = 6e-3 if clipped else 1e-5
    assert float(length) == pytest.approx(looks[-1, 4], abs=tolerance)
    assert (float(x), float(y)) == pytest.approx((looks[-1, 0], looks[-1, 1]), abs=tolerance)
    assert float(after) == pytest.approx(looks[-1, 3], abs=1e-5)
    assert abs(math.remainder(math.atan2(sine, cosine) - looks[-1, 2], 2 * math.pi)) < tolerance


# --- The configuration -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "config",
    [
        SimConfig(vehicle=VehicleConfig(width=-1.0)),
        SimConfig(vehicle=VehicleConfig(wheelbase=math.nan)),
        SimConfig(vehicle=VehicleConfig(rear_axle=2.5)),
        SimConfig(sensors=SensorConfig(rays=1)),
        SimConfig(sensors=SensorConfig(field_of_view=361.0)),
        SimConfig(episode=EpisodeConfig(control_period=0.0)),
        SimConfig(vehicle=VehicleConfig(length=12.5)),  # longer than the gaps at the start of an episode
    ],
)
def test_numbers_that_make_no_sense_are_refused_in_one_line(config):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        constants(config)
