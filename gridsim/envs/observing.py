"""What cars see, as arrays of Gymnasium's spaces, and their rewards."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from gridsim.car.ego import STEERING
from gridsim.car.reward import reward
from gridsim.envs.simulator import Simulator
from gridsim.jit import njit
from gridsim.sensing.grid import CELLS, grid_table, grids, push_frames

_F = np.float32


@njit
def _observe(ranges, closing, speeds, progress, ends, fastest, begun, reach, slowest, limit, dt, observations, rewards):
    """Observations [n, rays + 1], if not None, and rewards [n]; `fastest` m/s: upper speed of each car's scenario."""
    rays = ranges.shape[1]
    for i in range(ranges.shape[0]):
        speed = speeds[i]
        if observations is not None:
            for r in range(rays):
                observations[i, r] = min(ranges[i, r] / reach, _F(1.0))
            if closing is not None:
                for r in range(rays):
                    observations[i, rays + r] = min(max(closing[i, r] / limit, _F(-1.0)), _F(1.0))
            last = rays if closing is None else 2 * rays
            observations[i, last] = min(max(speed / limit, slowest), _F(1.0))
        if begun[i]:
            rewards[i] = _F(0.0)
        else:
            rewards[i] = reward(ranges[i], reach, speed, progress[i], ends[i], fastest[i], dt)


class Observer:
    """Turns what a simulator's cars sense into observations.

    Attributes:
        space: of one car.
        table: the grid's, or None where rays are seen.
    """

    def __init__(
        self, simulator: Simulator, observation: str, frames: int = 1, motion: bool = False, steering: bool = False
    ):
        self._simulator, self.config = simulator, simulator.config
        self._motion, self._steering = motion, steering
        rays, vehicle = self.config.sensors.rays, self.config.vehicle
        self._width = (2 if motion else 1) * rays + 1 + steering
        self._slowest = _F(-vehicle.reverse_limit / vehicle.speed_limit)
        grid = observation == "grid"
        self.table = grid_table(self.config) if grid else None
        self._stack = np.zeros((len(simulator), frames, CELLS, CELLS), dtype=np.uint8) if grid else None
        if grid:
            shape = (CELLS, CELLS) if frames == 1 else (frames, CELLS, CELLS)
            self.space = Box(0, 255, shape, dtype=np.uint8)
        else:
            low = np.zeros(self._width, dtype=np.float32)
            low[rays:] = -1.0
            low[self._width - 1 - steering] = self._slowest
            self.space = Box(low, np.ones_like(low))

    def look(
        self,
        ranges: np.ndarray,
        speeds: np.ndarray,
        progress: np.ndarray,
        ends: np.ndarray,
        begun: np.ndarray,
        fastest: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Observations and rewards [n] of a step, the caller's own; where an episode has `begun` the reward is 0."""
        rewards = np.empty(len(ranges), dtype=np.float32)
        observations = np.empty((len(ranges), self._width), dtype=np.float32) if self.table is None else None
        _observe(
            ranges,
            self._simulator.closing if self._motion else None,
            speeds,
            progress,
            ends,
            fastest,
            begun,
            _F(self.config.sensors.range),
            self._slowest,
            _F(self.config.vehicle.speed_limit),
            _F(self.config.episode.control_period),
            observations,
            rewards,
        )
        if observations is None:
            return self._grids(ranges, begun), rewards
        if self._steering:
            limit = np.radians(self.config.vehicle.steering_limit)
            observations[:, -1] = np.clip(self._simulator.state.cars[:, STEERING] / limit, -1.0, 1.0)
        return observations, rewards

    def _grids(self, ranges: np.ndarray, begun: np.ndarray) -> np.ndarray:
        """Occupancy grids, stacked if so asked."""
        assert self.table is not None
        assert self._stack is not None
        now = grids(self.table, ranges)
        if self._stack.shape[1] == 1:
            return now
        push_frames(self._stack, now, begun)
        return self._stack.copy()
