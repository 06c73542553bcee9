"""Figures of comfort: how smoothly a car drives and how far from others. Summed up during an episode, if asked for."""

from __future__ import annotations

import math

from gridsim.collision import separation
from gridsim.jit import ONE, ZERO, F, leaf
from gridsim.maps.network import wrapped
from gridsim.state import COS, LANE, SIN, SPEED, X, Y

# Entries of an episode's notes, float32 [NOTES].
_COS, _SIN, _SPEED = 0, 1, 2  # the car's heading and speed (m/s) before the step
_ALONG, _ACROSS = 3, 4  # m/s2, the car's acceleration in the previous step: forwards, and to the side
_LATERAL, _PEAK, _JERK = 5, 6, 7  # lateral acceleration: sum of squares, and largest; jerk: sum of squares
_GAP, _CLOSE = 8, 9  # m, least gap so far; steps with less than a second to the car ahead
NOTES = 10


@leaf
def begin(car, notes):
    """Fill an episode's notes, float32 [NOTES], at its start."""
    notes[:] = ZERO
    notes[_COS], notes[_SIN], notes[_SPEED], notes[_GAP] = car[COS], car[SIN], car[SPEED], F(math.inf)


@leaf
def note(constants, road, car, world, steps, notes):
    """Add to `notes` the control step that the car has just driven, after `steps` earlier ones.

    Accelerations derive from changed speed and heading.
    """
    per_s = ONE / constants.dt
    turned = math.atan2(
        notes[_COS] * car[SIN] - notes[_SIN] * car[COS], notes[_COS] * car[COS] + notes[_SIN] * car[SIN]
    )
    along = (car[SPEED] - notes[_SPEED]) * per_s
    across = F(0.5) * (car[SPEED] + notes[_SPEED]) * turned * per_s
    notes[_LATERAL] += across * across
    notes[_PEAK] = max(notes[_PEAK], abs(across))
    if steps > 0:
        jerk_along, jerk_across = (along - notes[_ALONG]) * per_s, (across - notes[_ACROSS]) * per_s
        notes[_JERK] += jerk_along * jerk_along + jerk_across * jerk_across
    notes[_COS], notes[_SIN], notes[_SPEED] = car[COS], car[SIN], car[SPEED]
    notes[_ALONG], notes[_ACROSS] = along, across
    if world is not None:
        close = False
        for j in range(world.shape[0]):
            if world[j, LANE] >= ZERO:
                dx, dy = wrapped(world[j, X] - car[X], road.width), wrapped(world[j, Y] - car[Y], road.height)
                cosine, sine = car[COS], car[SIN]
                gap = separation(constants, dx, dy, cosine, sine, world[j, COS], world[j, SIN])
                notes[_GAP] = min(notes[_GAP], max(gap, ZERO))
                ahead, aside = dx * cosine + dy * sine, abs(dy * cosine - dx * sine)
                beyond = ahead - F(2.0) * constants.half_length
                close |= ahead > ZERO and aside < F(2.0) * constants.half_width and beyond < car[SPEED]
        notes[_CLOSE] += ONE if close else ZERO


@leaf
def finish(constants, steps, notes, result):
    """Write an episode's notes to its RESULT."""
    result["lateral"], result["lateral_peak"] = notes[_LATERAL] / F(max(steps, 1)), notes[_PEAK]
    result["jerk"] = notes[_JERK] / F(max(steps - 1, 1))
    result["gap"], result["close"] = notes[_GAP], notes[_CLOSE] * constants.dt
