"""States of cars as float32 rows: what each column means, for the ego car and for the other cars."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

# Columns of every car.
X, Y = 0, 1  # m, centre of mass
COS, SIN = 2, 3  # heading
SPEED = 4  # m/s, negative backwards

# Further columns of the ego car.
STEERING = 5  # rad, left positive
DISTANCE = 6  # m of new ground
PACED = 7  # m of new ground at a speed within the scenario's interval
ODOMETER = 8  # m driven, either way
DEBT = 9  # m reversed that must be driven forward again before distance counts
IDLE = 10  # control steps without progress since the last one with progress; steps of waiting do not count
STEPS = 11  # control steps since the start of the episode
CELL = 12  # index of the visit cell the car is in
FRESH = 13  # 1 if driving in this cell, or along a route, gains new ground, else 0
YAW_RATE, SLIP = 14, 15  # rad/s, and rad between heading and course, of a dynamic vehicle model; else 0
ROUTE_LANE, ROUTE_ALONG = 16, 17  # the car's place on its route: a lane, and m along it
ROUTE_KEY = 18  # whole number that decides which lanes come after ROUTE_LANE; 0 without a route
CLOCK = 19  # control steps on the clock of the traffic lights; 0 on a map without lights
CAR_FIELDS = 20

# Further columns of a car of the traffic.
LANE = 5  # index of its lane; -1 for an absent car, which is ignored
ALONG = 6  # m along its lane
NEXT, SECOND_NEXT = 7, 8  # its next two lanes
JUNCTION_BEHIND = 9  # junction lane on which its rear may still be, or -1
PERMIT = 10  # junction lane that it may enter next; if none, -1 minus the control steps that it has stood in a junction
SHIFT = 11  # m to the left of its lane, while it changes lanes or keeps to the right
SPEED_FACTOR = 12  # its desired speed, relative to the lane's
SEED = 13  # seed of its random turns, below 2 ** 24
DRAWS = 14  # random numbers drawn so far, one for each lane chosen
ACCELERATION = 15  # m/s2, its acceleration in this step
HORIZON = 16  # m ahead that it looks in this step
GAP = 17  # m from its middle to the nearest obstacle within HORIZON; 1e9 if there is none
LEAD_SPEED = 18  # m/s, speed of that obstacle along this car's heading
LANE_TIMER = 19  # control steps until its next decision on a change of lanes
SWAY = 20  # m to the left per m driven, the slope of SHIFT while this changes
TRAFFIC_FIELDS = 21

# A start has the numbers of a pose: x, y (m), heading (rad), speed (m/s), steering (rad). If the car continues a drive,
# the start also has its route's lane and key, and the clock of the traffic lights.
POSE, START_FIELDS = 5, 8


class End(IntEnum):
    """How an episode ended.

    A collision, idling and going astray terminate: the value of what follows is 0. Success and time truncate: the road
    goes on, and the observation shows neither the distance nor the time driven, so that the value of what follows is
    estimated from the last observation (Pardo et al. 2018, "Time limits in reinforcement learning", section 4).
    """

    RUNNING = 0
    COLLISION = 1  # off the road, into a car, or over the stop line of a red light
    IDLE = 2  # too many steps without progress
    SUCCESS = 3  # the target distance is reached
    TIME = 4  # the time limit is reached
    ASTRAY = 5  # too far from the route


TERMINATES = np.isin(list(End), [End.COLLISION, End.IDLE, End.ASTRAY])  # bool [ends]
TRUNCATES = np.isin(list(End), [End.SUCCESS, End.TIME])


def poses_of(states: np.ndarray) -> np.ndarray:
    """Poses float32 [..., 5] of the ego car's states: x, y (m), heading (rad), speed (m/s), steering (rad)."""
    poses = states[..., [X, Y, SIN, SPEED, STEERING]]
    poses[..., 2] = np.arctan2(states[..., SIN], states[..., COS])
    return poses
