"""The paper's reward, once: of a control step of the environment, and of the experience that a learner collects.

0.15 f(distance) + 0.15 f(speed) + 0.7 min(S), each in [0, 1]; -1 for a collision. f(distance) is the step's new ground
and f(speed) the forward speed after it, as shares of what the scenario's upper speed gives and no more than 1; min(S)
is the shortest of the rays then, as a share of their full range.
"""

from __future__ import annotations

import numpy as np

from gridsim.config import CLEARANCE_SHARE, CRASH_REWARD, PROGRESS_SHARE
from gridsim.jit import njit

_F = np.float32


# A leaf whose sums are not reordered, nor divisions replaced: it rounds the same in all kernels that it is part of.
@njit(forceinline=True, _nrt=False, fastmath={"contract"})
def reward(ranges, reach, speed, progress, end, fastest, dt):
    """Reward of one control step.

    Args: ranges float32 [rays] and their full range (m), speed (m/s), new ground (m), and End, all after the step; the
    upper speed of the scenario (m/s); the control period (s).
    """
    if end == 1:
        return _F(CRASH_REWARD)
    shortest = reach
    for r in range(ranges.shape[0]):
        shortest = min(shortest, ranges[r])
    distance = min(progress / (fastest * dt), _F(1.0))
    pace = min(max(speed / fastest, _F(0.0)), _F(1.0))
    return _F(PROGRESS_SHARE) * (distance + pace) + shortest * (_F(CLEARANCE_SHARE) / reach)
