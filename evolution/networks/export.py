"""Policies in PyTorch: their outputs, and a module of standard operations, which can be exported without GridSim.

The input of the module is the environment's observation, float32 [n, inputs]:

* rays: the observation unchanged (`policy.act_on`);
* grid: the cells of all frames, 0 to 255, the newest frame last, each row by row; then the speed in m/s.

It returns the outputs, float32 [n, 8]; the action is the largest one, the first of ties. They equal the kernels'
outputs up to float32 rounding.

PyTorch, which takes seconds to import, is imported inside functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
from gridsim.sensing.grid import CELLS, FREE

if TYPE_CHECKING:
    import torch

    Layers = list[tuple[torch.Tensor, torch.Tensor]]


def layers_of(spec: PolicySpec, genome: torch.Tensor) -> Layers:
    """Weights [inputs, units] and biases [units] of each layer, as views of a genome [genes]."""
    layers, at = [], 0
    for n, m in spec.shapes():
        layers.append((genome[at : at + n * m].view(n, m), genome[at + n * m : at + (n + 1) * m]))
        at += (n + 1) * m
    return layers


def outputs(
    spec: PolicySpec, layers: Layers, x: torch.Tensor, squash: Callable[[torch.Tensor], torch.Tensor]
) -> torch.Tensor:
    """Outputs float32 [n, outputs] for a network's inputs [n, inputs]; squash: a perceptron's tanh."""
    import torch

    if isinstance(spec, CnnSpec):
        one, two, _ = spec.hidden
        (w1, b1), (w2, b2), (w3, b3), (w4, b4) = layers
        speed = x[:, -1:]
        x = x[:, :-1].reshape(-1, spec.frames, CELLS, CELLS)
        # A genome orders a unit's inputs (frame, row, column), then (row, column, channel).
        w1 = w1.view(spec.frames, KERNEL_1, KERNEL_1, one).permute(3, 0, 1, 2)
        x = torch.relu(torch.nn.functional.conv2d(x, w1, b1, stride=STRIDE_1))
        w2 = w2.view(KERNEL_2, KERNEL_2, one, two).permute(3, 2, 0, 1)
        x = torch.relu(torch.nn.functional.conv2d(x, w2, b2, stride=STRIDE_2))
        x = torch.cat([x.permute(0, 2, 3, 1).flatten(1), speed], dim=1)
        return torch.addmm(b4, torch.relu(torch.addmm(b3, x, w3)), w4)
    for weights, biases in layers[:-1]:
        x = squash(torch.addmm(biases, x, weights))
    weights, biases = layers[-1]
    return torch.addmm(biases, x, weights)


def to_torch(spec: PolicySpec, genome: np.ndarray, config: SimConfig) -> torch.nn.Module:
    """A genome float32 [genes] as a module in evaluation mode, on the CPU, without gradients.

    `config` gives the scales of the environment's observations.
    Raises: ValueError with one line if the genome does not fit the policy.
    """
    import torch

    if genome.shape != (spec.size,) or genome.dtype != np.float32:
        raise ValueError(f"a genome of {spec} is float32 [{spec.size}], not {genome.dtype} {genome.shape}")

    class Driver(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.genome = torch.nn.Parameter(torch.from_numpy(genome.copy()), requires_grad=False)

        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            encoded = encode_grids if isinstance(spec, CnnSpec) else encode_rays
            return outputs(spec, layers_of(spec, self.genome), encoded(observation), _squash)

    def encode_grids(observation: torch.Tensor) -> torch.Tensor:
        return torch.cat([observation[:, :-1] * (1.0 / 255.0), observation[:, -1:] / float(SPEED_SCALE) - 1.0], dim=1)

    def encode_rays(observation: torch.Tensor) -> torch.Tensor:
        """As `policy.encode`."""
        assert isinstance(spec, MlpSpec)
        ranges = observation[:, :RAYS] * config.sensors.range
        inputs = [2.0 * ranges / (ranges + float(RAY_HALF)) - 1.0]
        at = RAYS
        if spec.motion:
            inputs.append(observation[:, at : at + RAYS] * config.vehicle.speed_limit / float(SPEED_SCALE))
            at += RAYS
        inputs.append(observation[:, at : at + 1] * config.vehicle.speed_limit / float(SPEED_SCALE) - 1.0)
        if spec.steering:
            angle = observation[:, at + 1 :] * math.radians(config.vehicle.steering_limit)
            inputs.append(angle / float(STEERING_SCALE))
        return torch.cat(inputs, dim=1)

    return Driver().eval()


def _squash(x: torch.Tensor) -> torch.Tensor:
    """The policies' hyperbolic tangent (`policy.squash`)."""
    x = x.clamp(-4.97, 4.97)
    s = x * x
    return x * (135135.0 + s * (17325.0 + s * (378.0 + s))) / (135135.0 + s * (62370.0 + s * (3150.0 + s * 28.0)))


def example(spec: PolicySpec, config: SimConfig) -> np.ndarray:
    """Example inputs of `to_torch`'s module, float32 [2, inputs]: nothing in sight, at standstill and at 10 m/s."""
    speeds = np.array([0.0, 10.0], dtype=np.float32)
    observations = np.zeros((2, spec.inputs), dtype=np.float32)  # wheels straight ahead
    if isinstance(spec, CnnSpec):
        observations[:, :-1], observations[:, -1] = FREE, speeds
        return observations
    assert isinstance(spec, MlpSpec)
    observations[:, :RAYS] = 1.0
    observations[:, 2 * RAYS if spec.motion else RAYS] = speeds / config.vehicle.speed_limit
    return observations
