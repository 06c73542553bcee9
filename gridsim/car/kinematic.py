"""The kinematic bicycle about the centre of mass (Kong et al. 2015).

With l_r the distance from the centre of mass to the rear axle and L the wheelbase:
    beta = atan(l_r / L * tan(steering))        slip angle
    x' = v cos(psi + beta),  y' = v sin(psi + beta),  psi' = v / l_r * sin(beta),  v' = a
The path's curvature is sin(beta) / l_r, but at most grip / v^2: a car that is too fast for its tyres runs wide.
"""

from __future__ import annotations

import math
from typing import Any

from gridsim.jit import HALF, ONE, ZERO, F, leaf
from gridsim.state import SPEED, STEERING

Parameters = type(None)  # this model reads nothing besides `Constants`


def parameters(vehicle: Any) -> None:
    """A vehicle's parameters of this model: none."""


@leaf
def path_curvature(constants, speed, steering):
    """Curvature (1/m, left positive) of the centre of mass's path: the bicycle model's, limited by lateral grip."""
    tangent = constants.rear_share * math.tan(steering)  # tangent of the slip angle
    curvature = tangent / (math.sqrt(ONE + tangent * tangent) * constants.rear_axle)
    bound = constants.grip / max(speed * speed, F(1e-6))
    return min(max(curvature, -bound), bound)


@leaf
def front_velocity(model, constants, car):
    """Velocity (m/s) of the front axle along the heading and to the left.

    The centre of mass moves at the slip angle to the heading, and the axle turns about the centre of mass.
    """
    speed, curvature = car[SPEED], path_curvature(constants, car[SPEED], car[STEERING])
    sine_slip = curvature * constants.rear_axle
    along = speed * math.sqrt(max(ONE - sine_slip * sine_slip, ZERO))
    return along, speed * curvature * (constants.rear_axle + constants.front_axle)


@leaf
def move(model, constants, car, curvature, x, y, cosine, sine, speed, acceleration, dt):
    """Move on an arc of constant curvature: exact for constant speed and steering."""
    after = min(max(speed + acceleration * dt, -constants.reverse_limit), constants.speed_limit)
    length = HALF * (speed + after) * dt
    # The heading changes by `length * curvature`, called turn here; the chord points along heading + slip + turn / 2.
    half = HALF * length * curvature
    square = half * half
    sine_half = half * (ONE - square * (F(1.0 / 6.0) - square * F(1.0 / 120.0)))
    cosine_half = ONE - square * (HALF - square * (F(1.0 / 24.0) - square * F(1.0 / 720.0)))
    chord = length * (ONE - square * (F(1.0 / 6.0) - square * F(1.0 / 120.0)))
    sine_slip = curvature * constants.rear_axle
    cosine_slip = math.sqrt(max(ONE - sine_slip * sine_slip, ZERO))
    # Unit vector along heading + turn / 2, then rotated by the slip angle.
    ch, sh = cosine * cosine_half - sine * sine_half, sine * cosine_half + cosine * sine_half
    x += chord * (ch * cosine_slip - sh * sine_slip)
    y += chord * (sh * cosine_slip + ch * sine_slip)
    c, s = ch * cosine_half - sh * sine_half, sh * cosine_half + ch * sine_half
    norm = F(1.5) - HALF * (c * c + s * s)  # one Newton step of 1 / sqrt keeps the vector's length 1
    return x, y, c * norm, s * norm, after, length
