"""What real sensors and actuators do: noise, rays that miss what is there, and readings and commands that come late.

A ray's noise and dropouts depend only on where the car is and on its control step, so they are the same for any number
of workers. Where nothing is imperfect, kernels get None in place of Imperfections and Delays, and Numba leaves their
code out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gridsim.config import SimConfig
from gridsim.counter import GOLDEN, mix
from gridsim.jit import ZERO, F, I, U, leaf
from gridsim.state import STEPS, X, Y

_SIDES = F(math.sqrt(3.0) / 1024.0)  # scales the sum of four whole numbers below 1,024 to a variance of 1


class Imperfections(NamedTuple):
    """Imperfections of the range sensor, as kernels read them."""

    noise: np.float32  # m, standard deviation
    noise_share: np.float32  # share of the range, added to `noise`
    dropout: np.uint64  # of 2 ** 24 readings, how many (on average) are the full range, whatever is there


class Delays(NamedTuple):
    """Control steps by which readings and commands are late."""

    readings: int
    commands: int


class History(NamedTuple):
    """The latest readings and commands of a car, or of n cars, which take effect late.

    Ring buffers of as many steps as `Delays` (perhaps 0), indexed by the control step modulo their length.
    """

    readings: np.ndarray  # float32 [steps, 2, rays] or [n, ...], ranges and closing speeds
    commands: np.ndarray  # float32 [steps, 2] or [n, ...], action and 0, or pedal and wheel


def imperfections_of(config: SimConfig, own: SimConfig) -> tuple[Imperfections, Delays] | tuple[None, None]:
    """Imperfections and delays of an episode; None and None if no episode of the configuration has any.

    Neither is None alone, or kernels would be compiled for each kind of imperfect car. Args: `own`, the configuration
    with the episode's vehicle (`SimConfig.drawn`).
    """
    sensors, period = config.sensors, config.episode.control_period
    noise = Imperfections(F(sensors.noise), F(sensors.noise_share), U(round(sensors.dropout * (1 << 24))))
    delays = Delays(round(sensors.latency / period), round(own.vehicle.latency / period))
    if any(noise) or any(delays) or any(name == "latency" for name, *_ in config.randomise):
        return noise, delays
    return None, None


@leaf
def degrade(imperfections, reach, car, ranges, closing):
    """Add noise to ranges (m), clip them to [0, `reach`], and have readings drop out.

    The reading of a ray that drops out is `reach`, and 0 of its closing speed unless `closing` is empty.
    """
    if imperfections is None:
        return
    if imperfections.noise + imperfections.noise_share == ZERO and imperfections.dropout == 0:
        return
    place = U(I(car[X] * F(4096.0))) << U(32) ^ U(I(car[Y] * F(4096.0)))  # to a quarter of a millimetre
    key = mix(mix(place) + U(I(car[STEPS])))
    for r in range(ranges.shape[0]):
        bits = mix(key + U(r + 1) * GOLDEN)
        # Nearly normal: the sum of four uniform numbers (Irwin-Hall).
        total = (bits & U(1023)) + (bits >> U(10) & U(1023)) + (bits >> U(20) & U(1023)) + (bits >> U(30) & U(1023))
        normal = (F(total) - F(2046.0)) * _SIDES
        noisy = ranges[r] + (imperfections.noise + imperfections.noise_share * ranges[r]) * normal
        ranges[r] = min(max(noisy, ZERO), reach)
        if bits >> U(40) < imperfections.dropout:
            ranges[r] = reach
            if closing.shape[0] > 0:
                closing[r] = ZERO


def new_history(delays: Delays | None, rays: int, cars: tuple[int, ...] = ()) -> History | None:
    """The History of one car, or of n cars if `cars` is (n,); None without delays."""
    if delays is None:
        return None
    shapes = (*cars, delays.readings, 2, rays), (*cars, delays.commands, 2)
    return History(*(np.zeros(shape, dtype=np.float32) for shape in shapes))


@leaf
def late_readings(history, car, ranges, closing):
    """Store the latest readings, and replace them by those of `Delays.readings` steps ago.

    In the first steps, those are the episode's first readings.
    """
    if history is None or history.readings.shape[0] == 0:
        return
    steps = I(history.readings.shape[0])
    if car[STEPS] == ZERO:
        for k in range(steps):
            for r in range(ranges.shape[0]):
                history.readings[k, 0, r] = ranges[r]
            for r in range(closing.shape[0]):
                history.readings[k, 1, r] = closing[r]
    kept = history.readings[I(car[STEPS]) % steps]
    for r in range(ranges.shape[0]):
        ranges[r], kept[0, r] = kept[0, r], ranges[r]
    for r in range(closing.shape[0]):
        closing[r], kept[1, r] = kept[1, r], closing[r]


@leaf
def late_command(history, car, first, second, neutral):
    """Store this step's command (`first`, `second`), and return the one of `Delays.commands` steps ago.

    In the first steps, that is (`neutral`, 0).
    """
    if history is None or history.commands.shape[0] == 0:
        return first, second
    slot = I(car[STEPS]) % I(history.commands.shape[0])
    late = neutral, ZERO
    if I(car[STEPS]) >= I(history.commands.shape[0]):
        late = history.commands[slot, 0], history.commands[slot, 1]
    history.commands[slot, 0], history.commands[slot, 1] = first, second
    return late
