"""What cars see, as arrays of Gymnasium's spaces."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box, Dict

from gridsim.jit import F, njit
from gridsim.sensing.grid import CELLS, grid_table, grids
from gridsim.simulator import Simulator
from gridsim.state import SPEED, STEERING

_ALL = slice(None)
Seen = np.ndarray | dict[str, np.ndarray]


@njit
def _observe(ranges, closing, speeds, reach, slowest, limit, observations):
    """Observations [n, rays + 1], with closing speeds [n, rays] in between if they are not None."""
    rays = ranges.shape[1]
    for i in range(ranges.shape[0]):
        for r in range(rays):
            observations[i, r] = min(ranges[i, r] / reach, F(1.0))
        if closing is not None:
            for r in range(rays):
                observations[i, rays + r] = min(max(closing[i, r] / limit, F(-1.0)), F(1.0))
        last = rays if closing is None else 2 * rays
        observations[i, last] = min(max(speeds[i] / limit, slowest), F(1.0))


def row(observations: Seen, i: int) -> Seen:
    """Car i's part of all cars' observations."""
    return {name: part[i] for name, part in observations.items()} if isinstance(observations, dict) else observations[i]


class Observer:
    """Turns what a simulator's cars sense into observations.

    Attributes: space, the observation space of one car.
    """

    def __init__(self, simulator: Simulator, observation: str, frames: int, motion: bool, steering: bool):
        self._simulator, self.config = simulator, simulator.config
        self._motion, self._steering = motion, steering
        rays, vehicle = self.config.sensors.rays, self.config.vehicle
        self._width = (2 if motion else 1) * rays + 1 + steering
        self._slowest = F(-vehicle.reverse_limit / vehicle.speed_limit)
        self._observation = observation
        shape = 0 if observation == "rays" else (len(simulator), frames, CELLS, CELLS)
        self._stack = np.zeros(shape, dtype=np.uint8)
        image = Box(0, 255, (frames, CELLS, CELLS), dtype=np.uint8)
        low = np.zeros(self._width, dtype=np.float32)
        low[rays:] = -1.0
        low[self._width - 1 - steering] = self._slowest
        self.space: Box | Dict = Box(low, np.ones_like(low))
        if observation == "image":
            self.space = image
        elif observation == "grid":
            self.space = Dict({"grid": image, "speed": Box(self._slowest, 1.0, (1,), dtype=np.float32)})

    def take(self, begun: np.ndarray, which: np.ndarray | slice) -> None:
        """Add the newest frames of cars `which` [k], as all frames of those that have `begun` [k]."""
        if self._observation == "rays" or self._stack.shape[1] == 1:
            return
        stack, newest = self._stack[which], self._grids(which)
        for k in range(stack.shape[1] - 1):
            stack[:, k] = stack[:, k + 1]
        stack[:, -1] = newest
        stack[begun] = newest[begun, None]
        if not isinstance(which, slice):  # then it is a copy
            self._stack[which] = stack

    def look(self, which: np.ndarray | slice = _ALL) -> Seen:
        """Observations of cars `which`, after `take`; the caller owns them."""
        speeds = np.ascontiguousarray(self._simulator.cars[which, SPEED])
        if self._observation == "rays":
            return self._rays(speeds, which)
        one = self._stack.shape[1] == 1
        image = self._grids(which)[:, None] if one else self._stack[which].copy()
        if self._observation == "image":
            return image
        share = np.clip(speeds / F(self.config.vehicle.speed_limit), self._slowest, F(1.0))
        return {"grid": image, "speed": share[:, None]}

    def _grids(self, which: np.ndarray | slice) -> np.ndarray:
        # The table is not stored: copies of it would be writable, and kernels would be compiled again for them.
        return grids(grid_table(self.config), self._simulator.ranges[which])

    def _rays(self, speeds: np.ndarray, which: np.ndarray | slice) -> np.ndarray:
        vehicle, ranges = self.config.vehicle, self._simulator.ranges[which]
        observations = np.empty((len(ranges), self._width), dtype=np.float32)
        closing = self._simulator.closing[which] if self._motion else None
        reach, limit = F(self.config.sensors.range), F(vehicle.speed_limit)
        _observe(ranges, closing, speeds, reach, self._slowest, limit, observations)
        if self._steering:
            angles = self._simulator.cars[which, STEERING]
            observations[:, -1] = np.clip(angles / np.radians(vehicle.steering_limit), -1.0, 1.0)
        return observations
