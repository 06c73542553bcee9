"""The paper's reward of a control step, for the environment and for the DQN's experience.

0.15 f(distance) + 0.15 f(speed) + 0.7 min(S), each in [0, 1]; -1 for a collision. f(distance) is the new ground gained
in the step, and f(speed) the forward speed after the step, both relative to driving at the scenario's upper speed and
at most 1; min(S) is the shortest ray after the step, relative to the full range.
"""

from __future__ import annotations

from gridsim.jit import F, njit

PROGRESS_SHARE = 0.15  # weight of the distance, and also of the speed
CLEARANCE_SHARE = 0.7  # weight of the shortest ray
CRASH_REWARD = -1.0


# Compiled without reordering sums or replacing divisions, so that it rounds the same in every kernel that inlines it.
@njit(forceinline=True, _nrt=False, fastmath={"contract"})
def reward(ranges, reach, speed, progress, end, fastest, dt):
    """Reward of one control step.

    Args: `ranges` float32 [rays] (m) and `speed` (m/s) after the step; `reach`, the sensor's full range (m);
    `progress`, the metres that the step added to the counted distance (`state.DISTANCE`); `end`, the End after the
    step; `fastest`, the scenario's upper speed (m/s); `dt`, the control period (s).
    """
    if end == 1:
        return F(CRASH_REWARD)
    shortest = reach
    for r in range(ranges.shape[0]):
        shortest = min(shortest, ranges[r])
    distance = min(progress / (fastest * dt), F(1.0))
    pace = min(max(speed / fastest, F(0.0)), F(1.0))
    return F(PROGRESS_SHARE) * (distance + pace) + shortest * (F(CLEARANCE_SHARE) / reach)
