"""A policy as a PyTorch module of standard operations, which runs and can be exported without GridSim.

Its input is the environment's observation, float32 [n, inputs]:

* rays: the observation unchanged (`policy.act_on`);
* grid: the cells of all frames, 0 to 255, the newest frame last, each row by row; then the speed in m/s,
  `info["speed_mps"]`.

It returns the outputs, float32 [n, 8]; the action is the largest one, the first of ties. They equal the kernels'
outputs up to float32 rounding, so the action is the same unless two outputs almost tie.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from evolution.networks.policy import (
    KERNEL_1,
    KERNEL_2,
    RAY_HALF,
    RAYS,
    SPEED_SCALE,
    STEERING_SCALE,
    STRIDE_1,
    STRIDE_2,
    CnnSpec,
    MlpSpec,
    PolicySpec,
)
from gridsim.config import SimConfig
from gridsim.sensing.grid import CELLS, FREE, OCCUPIED, UNKNOWN, centres

if TYPE_CHECKING:
    import torch

_ROAD = 8.0  # m, width of the straight road of `example`


def to_torch(spec: PolicySpec, genome: np.ndarray, config: SimConfig) -> torch.nn.Module:
    """A genome float32 [genes] as a module in evaluation mode, on the CPU, without gradients.

    `config` has the scales of the environment's observations. Imports torch, which takes seconds.
    Raises: ValueError with one line if the genome does not fit the policy.
    """
    import torch

    if genome.shape != (spec.size,) or genome.dtype != np.float32:
        raise ValueError(f"a genome of {spec} is float32 [{spec.size}], not {genome.dtype} {genome.shape}")
    genes = torch.from_numpy(genome.copy())
    parts = []  # weights [inputs, units] and biases [units] of each layer
    at = 0
    for n, m in spec.shapes():
        parts.append((genes[at : at + n * m].view(n, m), genes[at + n * m : at + (n + 1) * m]))
        at += (n + 1) * m

    def loaded(layer: torch.nn.Module, weights: torch.Tensor, biases: torch.Tensor) -> torch.nn.Module:
        layer.load_state_dict({"weight": weights.contiguous(), "bias": biases.contiguous()})
        return layer.requires_grad_(False)

    def dense(weights: torch.Tensor, biases: torch.Tensor) -> torch.nn.Module:
        return loaded(torch.nn.Linear(*weights.shape), weights.T, biases)

    class Perceptron(torch.nn.Module):
        """Encodes the inputs as `policy.encode` does; then dense layers."""

        def __init__(self, motion: bool, steering: bool):
            super().__init__()
            self.motion, self.steering = motion, steering
            self.layers = torch.nn.ModuleList(dense(*part) for part in parts)

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            ranges = observation[:, :RAYS] * config.sensors.range
            inputs = [2.0 * ranges / (ranges + float(RAY_HALF)) - 1.0]
            at = RAYS
            if self.motion:
                inputs.append(observation[:, at : at + RAYS] * config.vehicle.speed_limit / float(SPEED_SCALE))
                at += RAYS
            speed = observation[:, at : at + 1] * config.vehicle.speed_limit
            inputs.append(speed / float(SPEED_SCALE) - 1.0)
            if self.steering:
                angle = observation[:, at + 1 :] * math.radians(config.vehicle.steering_limit)
                inputs.append(angle / float(STEERING_SCALE))
            x = torch.cat(inputs, dim=1)
            for layer in self.layers[:-1]:
                x = _squash(layer(x))
            return self.layers[-1](x)

    class Convolutional(torch.nn.Module):
        """Two convolutions on the frames, a dense layer with the speed as a further input, and the outputs."""

        def __init__(self, frames: int, first: int, second: int):
            super().__init__()
            self.frames = frames
            # Order of a unit's inputs in a genome: (frame, row, column), in the second layer (row, column, channel).
            weights = parts[0][0].view(frames, KERNEL_1, KERNEL_1, first).permute(3, 0, 1, 2)
            self.first = loaded(torch.nn.Conv2d(frames, first, KERNEL_1, STRIDE_1), weights, parts[0][1])
            weights = parts[1][0].view(KERNEL_2, KERNEL_2, first, second).permute(3, 2, 0, 1)
            self.second = loaded(torch.nn.Conv2d(first, second, KERNEL_2, STRIDE_2), weights, parts[1][1])
            self.dense, self.outputs = dense(*parts[2]), dense(*parts[3])

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            cells, speed = observation[:, :-1] * (1.0 / 255.0), observation[:, -1:] / float(SPEED_SCALE) - 1.0
            x = torch.relu(self.first(cells.unflatten(1, (self.frames, CELLS, CELLS))))
            x = torch.relu(self.second(x))
            x = torch.cat([x.permute(0, 2, 3, 1).flatten(1), speed], dim=1)
            return self.outputs(torch.relu(self.dense(x)))

    module: torch.nn.Module
    if isinstance(spec, CnnSpec):
        module = Convolutional(spec.frames, *spec.hidden[:2])
    else:
        assert isinstance(spec, MlpSpec)
        module = Perceptron(spec.motion, spec.steering)
    return module.eval()


def _squash(x: torch.Tensor) -> torch.Tensor:
    """The policies' hyperbolic tangent (`policy.squash`)."""
    x = x.clamp(-4.97, 4.97)
    s = x * x
    return x * (135135.0 + s * (17325.0 + s * (378.0 + s))) / (135135.0 + s * (62370.0 + s * (3150.0 + s * 28.0)))


def example(spec: PolicySpec, config: SimConfig) -> np.ndarray:
    """Example inputs of `to_torch`'s module, float32 [2, inputs]: a straight road, at standstill and at 10 m/s."""
    speeds = np.array([0.0, 10.0], dtype=np.float32)
    if isinstance(spec, CnnSpec):
        ahead, left = centres()
        grid = np.where(np.abs(left) < _ROAD / 2, FREE, OCCUPIED)
        grid[np.abs(left) > _ROAD / 2 + 1.0] = UNKNOWN
        grid[np.abs(np.arctan2(left, ahead)) > math.radians(config.sensors.field_of_view / 2)] = UNKNOWN
        cells = np.tile(grid.ravel().astype(np.float32), spec.frames)
        return np.stack([np.append(cells, speed) for speed in speeds])
    assert isinstance(spec, MlpSpec)
    half = math.radians(config.sensors.field_of_view / 2)
    across = np.abs(np.sin(np.linspace(-half, half, RAYS)))
    reach = config.sensors.range
    ranges = np.minimum(_ROAD / 2 / np.maximum(across, 1e-6), reach) / reach
    still = np.zeros(RAYS if spec.motion else 0)
    wheels = np.zeros(1 if spec.steering else 0)
    rows = [np.concatenate([ranges, still, [speed / config.vehicle.speed_limit], wheels]) for speed in speeds]
    return np.array(rows, dtype=np.float32)
