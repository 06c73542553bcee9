"""The car: kinematic bicycle about the centre of mass (Kong et al. 2015) and the eight driving actions.

Equations, with l_r the distance from the centre of mass to the rear axle and L the wheelbase:
    beta = atan(l_r / L * tan(steering))        slip angle
    x' = v cos(psi + beta),  y' = v sin(psi + beta),  psi' = v / l_r * sin(beta),  v' = a
The path's curvature is sin(beta) / l_r, but at most grip / v^2: a car that is too fast for its tyres runs wide.

The steering angle changes at the beginning of a control period and then holds. A wheel that turns evenly within the
period would lag half a period behind: 0.8 m to the side after 80 m of changing bends.
"""

from __future__ import annotations

import math
from enum import IntEnum

from gridsim.jit import HALF, ONE, ZERO, F, leaf


class Action(IntEnum):
    """The paper's eight actions, in its order."""

    ACCELERATE = 0
    LEFT = 1
    RIGHT = 2
    BRAKE = 3
    NONE = 4
    ACCELERATE_LEFT = 5
    ACCELERATE_RIGHT = 6
    REVERSE = 7


NEUTRAL = F(Action.NONE)  # what a car does before the first command that comes late


@leaf
def brake(constants, most, speed):
    """Acceleration (m/s2) when braking by `most` m/s2, or by less if the car would stop within the control period."""
    return -min(max(speed / constants.dt, -most), most)


@leaf
def act(constants, action, speed, steering):
    """Acceleration and steering of an action in one control period.

    Returns: (acceleration m/s2, steering angle rad after the period). Without left or right the wheels return to the
    centre. Braking ends at standstill; reverse continues backwards.
    """
    target = ZERO
    if action == 1 or action == 5:
        target = constants.steering_limit
    elif action == 2 or action == 6:
        target = -constants.steering_limit
    step = constants.steering_step
    steering = min(max(target, steering - step), steering + step)
    acceleration = ZERO
    if action == 0 or action == 5 or action == 6:
        acceleration = constants.acceleration
    elif action == 3:
        acceleration = brake(constants, constants.braking, speed)
    elif action == 7:
        acceleration = -constants.acceleration
    return acceleration, steering


@leaf
def act_continuous(constants, pedal, wheel, speed, steering):
    """Acceleration and steering of a continuous action in one control period, `pedal` and `wheel` each in [-1, 1].

    Above 0, pedal is a share of the maximum acceleration; below 0, of the maximum braking, which ends at standstill.
    There is no reverse gear. wheel is a share of the steering limit, left positive; the wheels turn towards it at the
    steering rate.
    Returns: (acceleration m/s2, steering angle rad after the period).
    """
    step = constants.steering_step
    target = min(max(wheel, -ONE), ONE) * constants.steering_limit
    steering = min(max(target, steering - step), steering + step)
    pedal = min(max(pedal, -ONE), ONE)
    if pedal < ZERO:
        return brake(constants, -pedal * constants.braking, speed), steering
    return pedal * constants.acceleration, steering


@leaf
def path_curvature(constants, speed, steering):
    """Curvature (1/m, left positive) of the centre of mass's path: the bicycle model's, limited by lateral grip."""
    tangent = constants.rear_share * math.tan(steering)  # of the slip angle
    curvature = tangent / (math.sqrt(ONE + tangent * tangent) * constants.rear_axle)
    bound = constants.grip / max(speed * speed, F(1e-6))
    return min(max(curvature, -bound), bound)


@leaf
def front_velocity(constants, speed, steering):
    """Velocity (m/s) of the middle of the front axle, where the sensor is: (along the heading, to the left).

    The centre of mass moves at the slip angle, and the axle turns about it.
    """
    curvature = path_curvature(constants, speed, steering)
    sine_slip = curvature * constants.rear_axle
    along = speed * math.sqrt(max(ONE - sine_slip * sine_slip, ZERO))
    return along, speed * curvature * (constants.rear_axle + constants.front_axle)


@leaf
def advance(constants, x, y, cosine, sine, speed, acceleration, curvature, dt):
    """Move on an arc of constant curvature for dt seconds: exact for constant speed and steering.

    Args: pose (m, m, heading as cosine and sine), speed m/s, acceleration m/s2, curvature 1/m, dt s.
    Returns: (x, y, cosine, sine, speed, signed path length in m).
    """
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
