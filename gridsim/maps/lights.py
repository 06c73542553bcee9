"""Traffic lights: programs that repeat, and the stop lines that they close. A network without stop lines has no lights.

While its light is not green, a stop line is a wall for the sensors of an ego car that drives towards it; while the
light is red, that car must not cross it. The line reaches across the road, so that nobody passes beside it. Other cars
stop by `Network.signals`. All lights around an ego car share one clock, the car's `state.CLOCK`. Its first value
follows from the episode's start: the same start has the same lights, whoever drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gridsim.counter import mix
from gridsim.jit import ZERO, F, I, U, freeze, leaf
from gridsim.maps.network import Network, wrapped, wrapped_any
from gridsim.state import CLOCK, COS, POSE, SIN, X, Y

GO, CLEARING, STOP = 0, 1, 2  # green; yellow: those who cannot stop any more may go; red
NO_LINE = F(1e9)  # m, stands for the way to a stop line if there is none


def lights_of(signals: ArrayLike, lines: ArrayLike, programs: Sequence[Sequence[int]]) -> dict[str, Any]:
    """The fields of a Network that hold its lights.

    Args: `signals` [lanes] and `lines` [lines, 5] as in `Network`; `programs`, what each program shows in each second.
    Program k is that of line k; programs that only `signals` name come after those of the lines.
    """
    return {
        "lines": freeze(np.array(lines, dtype=np.float32).reshape(-1, 5)),
        "signals": freeze(np.array(signals, dtype=np.int32)),
        "program_offsets": freeze(np.cumsum([0, *map(len, programs)]).astype(np.int32)),
        "programs": freeze(np.array([shows for program in programs for shows in program], dtype=np.uint8)),
    }


def no_lights(lanes: int) -> dict[str, Any]:
    """`lights_of` for a network of `lanes` lanes without lights."""
    return lights_of(np.full(lanes, -1), [], [])


def programs_of_lines(network: Network) -> list[np.ndarray]:
    """The program of each stop line: what it shows in each second."""
    return [network.programs[slice(*network.program_offsets[k : k + 2])] for k in range(len(network.lines))]


@leaf
def light(network, program, seconds):
    """What a program shows at `seconds` on the lights' clock: GO, CLEARING or STOP."""
    program = U(program)
    first = network.program_offsets[program]
    cycle = network.program_offsets[program + U(1)] - first
    return I(network.programs[U(first + I(seconds) % cycle)])


@leaf
def set_clock(network, start, car):
    """Set a car's clock of the lights: to that of `start` if it continues a drive, else to a hash of the car's place.

    On a map without stop lines, the clock is left as it is.
    """
    if network.lines.shape[0] > 0:
        goes_on = start.shape[0] > POSE + 2 and start[POSE + 2] > ZERO
        drawn = mix(mix(U(I(car[X] * F(4096.0))) << U(32) ^ U(I(car[Y] * F(4096.0)))))
        car[CLOCK] = start[POSE + 2] if goes_on else F(drawn >> U(48)) + F(1.0)


@leaf
def way_to_line(network, seconds, least, x, y, cosine, sine):
    """Way (m) from (x, y) straight ahead to the first stop line whose light shows `least` or a stricter colour.

    Lines for traffic of the opposite direction do not count. NO_LINE if there is none.
    """
    best = NO_LINE
    for k in range(network.lines.shape[0]):
        line = network.lines[k]
        dx, dy = wrapped(line[0] - x, network.width), wrapped(line[1] - y, network.height)
        ahead, along = dx * line[2] + dy * line[3], cosine * line[2] + sine * line[3]
        if ahead > ZERO and along > ZERO and ahead < best * along:
            way = ahead / along
            aside = way * (sine * line[2] - cosine * line[3]) - (dy * line[2] - dx * line[3])
            if abs(aside) <= line[4] and light(network, k, seconds) >= least:
                best = way
    return best


@leaf
def crosses_line(network, seconds, car, front, x, y, cosine, sine):
    """Whether a car's front, `front` m ahead of its middle, crosses a red light's stop line in that line's direction.

    The car moves from the pose in its state to the given pose near by, whose x, y may be outside the torus's sides.
    """
    from_x, from_y = car[X] + front * car[COS], car[Y] + front * car[SIN]
    to_x, to_y = x + front * cosine, y + front * sine
    for k in range(network.lines.shape[0]):
        line = network.lines[k]
        ax, ay = wrapped_any(from_x - line[0], network.width), wrapped_any(from_y - line[1], network.height)
        bx, by = ax + (to_x - from_x), ay + (to_y - from_y)
        before, after = ax * line[2] + ay * line[3], bx * line[2] + by * line[3]
        if before < ZERO and after >= ZERO:
            share = before / (before - after)
            x_there, y_there = ax + share * (bx - ax), ay + share * (by - ay)
            if abs(y_there * line[2] - x_there * line[3]) <= line[4] and light(network, k, seconds) == STOP:
                return True
    return False
