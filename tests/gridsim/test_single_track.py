"""The dynamic single-track model, held against CommonRoad's own implementation."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st

from gridsim.car import single_track
from gridsim.config import SimConfig, VehicleConfig, constants
from gridsim.jit import njit
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.simulator import Simulator
from gridsim.state import CAR_FIELDS, SLIP, SPEED, STEERING, YAW_RATE
from gridsim.step import parameters

THEIRS = parameters_vehicle2()
SEDAN = VehicleConfig(
    length=4.508, width=1.61, wheelbase=THEIRS.a + THEIRS.b, rear_axle=THEIRS.b, model="single_track",
    mass=THEIRS.m, yaw_inertia=THEIRS.I_z, mass_height=THEIRS.h_s, friction=THEIRS.tire.p_dy1,
    cornering_stiffness=-THEIRS.tire.p_ky1 / THEIRS.tire.p_dy1,
)  # fmt: skip


@njit
def move(model, constants, car, x, y, cosine, sine, speed, acceleration, dt):
    return single_track.move(model, constants, car, 0.0, x, y, cosine, sine, speed, acceleration, dt)


@pytest.mark.parametrize("seed", range(6))
def test_ten_seconds_of_changing_steering_and_speed_are_commonroads(seed: int) -> None:
    rng, model, steering = np.random.default_rng(seed), single_track.parameters(SEDAN), 0.0
    k, car = constants(SimConfig(SEDAN)), np.zeros(CAR_FIELDS, np.float32)
    speed = rng.uniform(5.0, 25.0)
    wanted, state = np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0]), np.array([0, 0, 1, 0, speed], np.float32)
    for _ in range(100):
        grip = min(0.47, SEDAN.lateral_grip * SEDAN.wheelbase / wanted[3] ** 2)
        steering = float(np.clip(steering + rng.uniform(-0.1, 0.1), -grip, grip))
        acceleration = 3.0 if wanted[3] < 4.0 else -3.0 if wanted[3] > 28.0 else float(rng.choice([3.0, 0.0, -3.0]))
        wanted[2] = steering
        change = solve_ivp(
            lambda _, x, a=acceleration: vehicle_dynamics_st(x, [0.0, a], THEIRS), (0.0, 0.1), wanted, rtol=1e-8
        )
        wanted = change.y[:, -1]
        car[STEERING] = steering
        *moved, length = move(model, k, car, *state, *np.array([acceleration, 0.1], np.float32))
        state = np.array(moved, np.float32)
        assert math.hypot(state[0] - wanted[0], state[1] - wanted[1]) < 0.05
        assert length == pytest.approx(0.1 * (state[4] - 0.05 * acceleration), rel=1e-4)
    assert [state[4], car[YAW_RATE], car[SLIP]] == pytest.approx(wanted[[3, 5, 6]], abs=5e-3)
    assert math.atan2(state[3], state[2]) == pytest.approx(math.remainder(wanted[4], math.tau), abs=5e-3)


def test_a_car_of_this_model_drives_and_slides_outwards_in_a_bend() -> None:
    """At walking pace it follows the kinematic bicycle; when it is fast, its rear points out of the bend."""
    road = build("highway", 0)
    start = sample_starts(road, 1, np.random.default_rng(0))
    for speed, outwards in ((3.0, False), (20.0, True)):
        start[:, 3] = speed
        driven = {}
        for model in ("kinematic", "single_track"):
            simulator = Simulator(1, SimConfig(VehicleConfig(**{**vars(SEDAN), "model": model})))
            simulator.reset(road, start)
            for _ in range(6):
                simulator.step(np.array([[0.0, 0.06]]))
            driven[model] = simulator.cars[0].copy()
        car = driven["single_track"]
        assert car[SPEED] == pytest.approx(speed, abs=1e-4)
        assert car[YAW_RATE] > 0.0, "it turns to the left"
        assert (car[SLIP] < 0.0) == outwards
        assert np.abs(car[:2] - driven["kinematic"][:2]).max() < (0.5 if outwards else 0.1)


def test_it_backs_along_its_arc() -> None:
    road, driven = build("highway", 0), []
    start = sample_starts(road, 1, np.random.default_rng(0))
    start[:, 3:] = -1.5, 0.4
    for model in ("kinematic", "single_track"):
        simulator = Simulator(1, SimConfig(VehicleConfig(**{**vars(SEDAN), "model": model})))
        simulator.reset(road, start)
        for _ in range(6):
            simulator.step(np.array([7]))
        driven.append(simulator.cars[0, :4].copy())
    assert np.abs(driven[0] - driven[1]).max() < 0.2


def test_wrong_numbers_are_refused() -> None:
    for wrong, said in (({"model": "wheels"}, "kinematic or single_track"), ({"mass": 0.0}, "vehicle.mass must be ")):
        with pytest.raises(ValueError, match=said):
            parameters(SimConfig(VehicleConfig(**{**vars(SEDAN), **wrong})))
