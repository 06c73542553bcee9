"""What cars see, as arrays of Gymnasium's spaces."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box, Dict

from gridsim.config import constants
from gridsim.sensing.grid import CELLS, grid_table, grids
from gridsim.sensing.observation import encoding
from gridsim.simulator import Simulator

_ALL = slice(None)
Seen = np.ndarray | dict[str, np.ndarray]


def row(observations: Seen, i: int) -> Seen:
    """Car i's part of all cars' observations: views of their arrays."""
    return {name: part[i] for name, part in observations.items()} if isinstance(observations, dict) else observations[i]


class Observer:
    """Turns what a simulator's cars sense into observations.

    Attributes: space, the observation space of one car.
    """

    def __init__(self, simulator: Simulator, observation: str, frames: int):
        self._simulator, self.config = simulator, simulator.config
        self._observation = observation
        shape = 0 if observation == "rays" else (len(simulator), frames, CELLS, CELLS)
        self._stack = np.zeros(shape, dtype=np.uint8)
        image = Box(0, 255, (frames, CELLS, CELLS), dtype=np.uint8)
        encoded = encoding(simulator.features, constants(self.config))
        low = encoded.each(encoded.least)
        self.space: Box | Dict = Box(low, np.ones_like(low))
        if observation == "image":
            self.space = image
        elif observation == "grid":
            self.space = Dict({"grid": image, "speed": Box(low[-1:], np.ones(1, dtype=np.float32))})

    def take(self, begun: np.ndarray, which: np.ndarray | slice) -> None:
        """Add the newest grid to the frames of cars `which` [k]; it fills all frames if an episode has `begun` [k].

        Without grids, or with one frame, do nothing: no frames are kept.
        """
        if self._observation == "rays" or self._stack.shape[1] == 1:
            return
        stack, newest = self._stack[which], self._grids(which)
        for k in range(stack.shape[1] - 1):
            stack[:, k] = stack[:, k + 1]
        stack[:, -1] = newest
        stack[begun] = newest[begun, None]
        if not isinstance(which, slice):  # indexing with an array has made a copy
            self._stack[which] = stack

    def look(self, which: np.ndarray | slice = _ALL) -> Seen:
        """Observations of cars `which`, as new arrays; call `take` first."""
        numbers = self._simulator.observations[which]
        if self._observation == "rays":
            return numbers.copy() if isinstance(which, slice) else numbers
        one = self._stack.shape[1] == 1
        image = self._grids(which)[:, None] if one else self._stack[which].copy()
        return image if self._observation == "image" else {"grid": image, "speed": numbers[:, -1:].copy()}

    def _grids(self, which: np.ndarray | slice) -> np.ndarray:
        # The table is no attribute: in a copy of this object it would be writable, and kernels would be compiled again.
        return grids(grid_table(self.config), self._simulator.ranges[which])
