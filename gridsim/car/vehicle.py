"""The driver's commands: the eight driving actions, and continuous ones.

The steering angle changes at the beginning of a control period and then holds. A wheel that turns evenly within the
period would lag half a period behind: 0.8 m to the side after 80 m of changing bends.
"""

from __future__ import annotations

from enum import IntEnum

from gridsim.jit import ONE, ZERO, F, leaf


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


NEUTRAL = F(Action.NONE)  # the discrete action of a car with late commands until its first command arrives


@leaf
def brake(constants, most, speed):
    """Acceleration (m/s2) when braking by `most` m/s2, or by less if the car would stop within the control period.

    It is against the motion, so above 0 for a car that rolls backwards.
    """
    return -min(max(speed / constants.dt, -most), most)


@leaf
def act(constants, action, speed, steering):
    """Acceleration and steering of an action in one control period.

    Returns: (acceleration m/s2, steering angle rad during the period). Without left or right, the wheels turn back
    to the centre. BRAKE stops the car; REVERSE accelerates it backwards, even while it still drives forwards.
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
    Returns: (acceleration m/s2, steering angle rad during the period).
    """
    step = constants.steering_step
    target = min(max(wheel, -ONE), ONE) * constants.steering_limit
    steering = min(max(target, steering - step), steering + step)
    pedal = min(max(pedal, -ONE), ONE)
    if pedal < ZERO:
        return brake(constants, -pedal * constants.braking, speed), steering
    return pedal * constants.acceleration, steering
