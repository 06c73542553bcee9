"""The observation of rays: what a car senses, as shares of what its sensor and the car can do.

It is encoded here alone: the environment returns it, and policies, exported networks and the DQN read it.
"""

from __future__ import annotations

import numpy as np

from gridsim.config import Constants
from gridsim.jit import ONE, exact, njit
from gridsim.state import SPEED, STEERING


@exact
def speed_share(constants, speed):
    """A speed (m/s) as a share of the speed limit, at least that of the reverse limit."""
    return min(max(speed / constants.speed_limit, -constants.reverse_limit / constants.speed_limit), ONE)


@exact
def encode(constants, ranges, closing, speed, steering, observation):
    """Write the observation of ranges (m), closing speeds (m/s) or None, speed (m/s) and steering (rad).

    Writes: observation float32 [rays + 1], [2 * rays + 1] with closing speeds; the steering angle where there is room.
    """
    rays = ranges.shape[0]
    for r in range(rays):
        observation[r] = min(ranges[r] / constants.ray_range, ONE)
    last = rays
    if closing is not None:
        for r in range(rays):
            observation[rays + r] = min(max(closing[r] / constants.speed_limit, -ONE), ONE)
        last = 2 * rays
    observation[last] = speed_share(constants, speed)
    if last + 1 < observation.shape[0]:
        observation[last + 1] = min(max(steering / constants.steering_limit, -ONE), ONE)


@njit(nogil=True)
def _encode_all(constants, ranges, closing, cars, observations):
    for i in range(ranges.shape[0]):
        speeds = None if closing is None else closing[i]
        encode(constants, ranges[i], speeds, cars[i, SPEED], cars[i, STEERING], observations[i])


def observations(
    constants: Constants, ranges: np.ndarray, closing: np.ndarray | None, cars: np.ndarray, steering: bool
) -> np.ndarray:
    """Observations of cars in states [n, CAR_FIELDS], with closing speeds if not None, and the angle of the wheels.

    Args: ranges (m) and closing speeds (m/s), float32 [n, rays].
    """
    rays = ranges.shape[1]
    encoded = np.empty((len(ranges), (1 if closing is None else 2) * rays + 1 + steering), dtype=np.float32)
    _encode_all(constants, ranges, closing, cars, encoded)
    return encoded
