"""The dynamic single-track model: linear tyres, and load that shifts between the axles with the acceleration.

Althoff, Koschi, Manzinger 2017, "CommonRoad: Composable Benchmarks for Motion Planning on Roads", model ST. With
speed v, yaw rate w, slip angle b, steering angle d, acceleration a, friction mu, mass m, yaw inertia I, height h of the
centre of mass and its distances lf and lr to the axles, the yaw rate and the slip angle follow

    w' = mu m / (I L) (-(lf^2 F + lr^2 R) w / v + (lr R - lf F) b + lf F d)
    b' = mu / (v L) ((lr R - lf F) w / v - (R + F) b + F d) - w

where F = C_f (g lr - a h) and R = C_r (g lf + a h) are the axles' stiffnesses under load, and L = lf + lr. Where
v is below KINEMATIC_BELOW, the equations would divide by almost 0, and in reverse they are unstable: there, w and b are
the kinematic bicycle's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gridsim.jit import HALF, ONE, ZERO, F, I, leaf
from gridsim.reading import quantity
from gridsim.state import SLIP, SPEED, STEERING, YAW_RATE

GRAVITY = F(9.81)  # m/s2
KINEMATIC_BELOW = F(1.0)  # m/s
LONGEST_STEP = F(0.0125)  # s that one step of the integration takes, at most


@dataclass(frozen=True)
class Numbers:
    """The vehicle's numbers that only this model reads; by default, those of CommonRoad's vehicle 2, a BMW 320i."""

    mass: float = quantity(1093.3, 0.1, 1e5, "kg")
    yaw_inertia: float = quantity(1791.6, 1e-4, 1e7, "kg m2")
    mass_height: float = quantity(0.6137, 0.001, 5.0, "m")  # of the centre of mass
    friction: float = quantity(1.0489, 0.05, 3.0)  # of tyres and road
    cornering_stiffness: float = quantity(20.898, 0.5, 200.0, "1/rad")  # of an axle, per load


class Parameters(NamedTuple):
    """A car's masses and tyres as kernels read them."""

    height: np.float32  # m, of the centre of mass, h
    yaw_share: np.float32  # 1/m2, mass / moment of inertia about the vertical axis
    stiffness: np.float32  # 1/rad, C_f and C_r: cornering stiffness of an axle, per load
    friction: np.float32  # mu


def parameters(vehicle: Any) -> Parameters:
    """A vehicle's parameters of this model."""
    yaw_share = vehicle.mass / vehicle.yaw_inertia
    return Parameters(*map(F, (vehicle.mass_height, yaw_share, vehicle.cornering_stiffness, vehicle.friction)))


@leaf
def move(model, constants, car, curvature, x, y, cosine, sine, speed, acceleration, dt):
    """Move for dt seconds, and update the yaw rate and the slip angle in the car's state.

    It integrates by the implicit midpoint rule, which is stable however stiff the tyres are at low speed.
    """
    after = min(max(speed + acceleration * dt, -constants.reverse_limit), constants.speed_limit)
    acceleration = (after - speed) / dt
    yaw_rate, slip, steering = car[YAW_RATE], car[SLIP], car[STEERING]
    front, rear = constants.front_axle, constants.rear_axle
    base = front + rear
    ahead = model.friction * model.stiffness * (GRAVITY * rear - acceleration * model.height)
    behind = model.friction * model.stiffness * (GRAVITY * front + acceleration * model.height)
    turning, moment = rear * behind - front * ahead, model.yaw_share / base
    damping = front * front * ahead + rear * rear * behind
    parts = I(1) + I(dt / LONGEST_STEP)
    h = dt / F(parts)
    length = ZERO
    for _ in range(parts):
        middle = speed + HALF * h * acceleration
        if middle < KINEMATIC_BELOW:
            tangent = rear / base * math.tan(steering)
            slip_after = math.atan(tangent)
            rate_after = middle * math.sin(slip_after) / rear
        else:
            # (1 - h/2 A) z = z0 + h/2 c for z = (yaw rate, slip) in the middle of the step; at its end, it is 2 z - z0.
            half = HALF * h
            a, b = ONE + half * moment * damping / middle, -half * moment * turning
            c = half * (ONE - turning / (base * middle * middle))
            d = ONE + half * (ahead + behind) / (base * middle)
            first = yaw_rate + half * moment * front * ahead * steering
            second = slip + half * ahead * steering / (base * middle)
            scale = ONE / (a * d - b * c)
            rate_after = F(2.0) * (first * d - b * second) * scale - yaw_rate
            slip_after = F(2.0) * (a * second - c * first) * scale - slip
        turn = h * HALF * (yaw_rate + rate_after)
        course = HALF * (slip + slip_after) + HALF * turn
        moved = h * middle
        step_cosine, step_sine = math.cos(course), math.sin(course)
        x += moved * (cosine * step_cosine - sine * step_sine)
        y += moved * (sine * step_cosine + cosine * step_sine)
        turn_cosine, turn_sine = math.cos(turn), math.sin(turn)
        cosine, sine = cosine * turn_cosine - sine * turn_sine, sine * turn_cosine + cosine * turn_sine
        length += moved
        speed += h * acceleration
        yaw_rate, slip = rate_after, slip_after
    norm = F(1.5) - HALF * (cosine * cosine + sine * sine)  # one Newton step of 1 / sqrt keeps the vector's length 1
    car[YAW_RATE], car[SLIP] = yaw_rate, slip
    return x, y, cosine * norm, sine * norm, speed, length


@leaf
def front_velocity(model, constants, car):
    """Velocity (m/s) of the front axle along the heading and to the left.

    The centre of mass moves at the slip angle to the heading, and the axle turns about the centre of mass.
    """
    along, aside = car[SPEED] * math.cos(car[SLIP]), car[SPEED] * math.sin(car[SLIP])
    return along, aside + constants.front_axle * car[YAW_RATE]
