"""Policies: their specification as text, the layout of a flat genome, and the perceptron's forward pass.

Layer shapes are defined here. A genome is a flat float32 vector: for each layer the weights, input-major [inputs,
outputs], then the biases [outputs]. The forward pass of `cnn` policies is in `convnet`.
"""

from __future__ import annotations

import itertools
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cache
from typing import ClassVar, Literal

import numpy as np

from evolution.networks.dense import tile
from gridsim.config import SensorConfig, SimConfig, constants
from gridsim.errors import GridSimError
from gridsim.jit import F, U, freeze, leaf, njit
from gridsim.sensing.grid import CELLS, MAX_FRAMES
from gridsim.sensing.observation import OPTIONAL, encoding, normalise

RAYS = SensorConfig.rays
ACTIONS = 8
MAX_GENES = 1_000_000
COMMAND_SCALE = 0.5  # scale of a perceptron's genes for pedal and wheel; with 1 both are mostly at their limits

_FEATURES = "".join(rf"(?:\+{name})?" for name in OPTIONAL)  # matches any optional features, in OPTIONAL's order

Observation = Literal["rays", "grid"]
Actions = Literal["discrete", "continuous"]
CONTINUOUS = "+continuous"  # ends the text of a policy whose outputs are pedal and wheel


@dataclass(frozen=True)
class PolicySpec(ABC):
    """A network's shape. Two kinds: `MlpSpec` on the rays, `CnnSpec` on the occupancy grid."""

    observation: ClassVar[Observation]

    hidden: tuple[int, ...]  # units, or channels, of the hidden layers
    actions: Actions = field(default="discrete", kw_only=True)
    features: tuple[str, ...] = field(default=(), kw_only=True)  # optional inputs of the network, ordered as OPTIONAL

    @staticmethod
    def parse(text: str) -> PolicySpec:
        """Read `mlp:6,7`, perhaps with features (`+motion+steering`), or `cnn`, perhaps with sizes (`:16,32,256@4`).

        Features come in the order of OPTIONAL; either may end with `+continuous`. Raises: GridSimError if a text has
        another form or its sizes are not allowed.
        """
        network = text.removesuffix(CONTINUOUS)
        actions: Actions = "discrete" if network == text else "continuous"
        if match := re.fullmatch(r"mlp:(\d{1,5}(?:,\d{1,5})*)" + _FEATURES, network):
            sizes = tuple(int(n) for n in match[1].split(","))
            spec: PolicySpec = MlpSpec(sizes, features=tuple(network.split("+")[1:]), actions=actions)
            if min(sizes) < 1:
                raise GridSimError(f"policy {text!r}: hidden layers need 1 unit or more")
        elif match := re.fullmatch(r"cnn(?::(\d{1,5}),(\d{1,5}),(\d{1,5})(?:@(\d{1,2}))?)?", network):
            hidden = tuple(int(n) for n in match.groups()[:3]) if match[1] else CnnSpec.hidden
            spec = CnnSpec(hidden, frames=int(match[4] or CnnSpec.frames), actions=actions)
            if any(n < UNIT_MULTIPLE or n % UNIT_MULTIPLE for n in hidden) or not 1 <= spec.frames <= MAX_FRAMES:
                raise GridSimError(
                    f"policy {text!r}: layers of a cnn need a positive multiple of {UNIT_MULTIPLE} units, "
                    f"and it sees 1 to {MAX_FRAMES} frames"
                )
        else:
            raise GridSimError(
                f"unknown policy {text!r}; write mlp: and the hidden layers' sizes, as in mlp:6,7, and then, in this "
                f"order, what else it sees (+{', +'.join(OPTIONAL)}), or cnn for the grid, as in cnn:8,16,32@1"
            )
        if spec.size > MAX_GENES:
            raise GridSimError(f"policy {text!r} has {spec.size:,} genes; the maximum is {MAX_GENES:,}")
        return spec

    @property
    def outputs(self) -> int:
        """Number of outputs: 8 for discrete actions, of which the largest is chosen, or 2, pedal and wheel."""
        return ACTIONS if self.actions == "discrete" else 2

    @property
    def suffix(self) -> str:
        """What the specification's text ends with: CONTINUOUS, or nothing."""
        return "" if self.actions == "discrete" else CONTINUOUS

    @property
    @abstractmethod
    def inputs(self) -> int:
        """Number of the network's inputs."""

    @property
    @abstractmethod
    def layers(self) -> np.ndarray:
        """The layers' sizes as kernels read them, int32."""

    @abstractmethod
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """(inputs of a unit, units) of each hidden layer and of the output layer."""

    @property
    def size(self) -> int:
        """Number of genes of a genome."""
        return sum((n + 1) * m for n, m in self.shapes())


@dataclass(frozen=True)
class MlpSpec(PolicySpec):
    """A multi-layer perceptron on rays, the speed, and optional features: tanh hidden layers, linear outputs.

    Optional features (`features`) show what a network without memory cannot infer, such as the car's own steering
    angle: its wheels take half a second to turn.
    """

    observation = "rays"

    def __str__(self) -> str:
        return "+".join(["mlp:" + ",".join(map(str, self.hidden)), *self.features]) + self.suffix

    @property
    def inputs(self) -> int:
        return int(encoding(self.features).first[-1])

    @property
    def layers(self) -> np.ndarray:
        """Sizes from the inputs through the hidden layers to the outputs: int32 [hidden layers + 2]."""
        return freeze(np.array([self.inputs, *self.hidden, self.outputs], dtype=np.int32))

    def shapes(self) -> tuple[tuple[int, int], ...]:
        return tuple(itertools.pairwise(self.layers.tolist()))


# Kernels and strides of the first two convolutions of Mnih et al. (2015), which the paper's authors use for their grid.
KERNEL_1, STRIDE_1 = 8, 4
KERNEL_2, STRIDE_2 = 4, 2
SIDE_1 = (CELLS - KERNEL_1) // STRIDE_1 + 1  # 19, side of the first convolution's output
SIDE_2 = (SIDE_1 - KERNEL_2) // STRIDE_2 + 1  # 8, side of the second convolution's output
UNIT_MULTIPLE = 8  # a `cnn`'s channels and hidden units are multiples of this, so that layers are whole vectors


@dataclass(frozen=True)
class CnnSpec(PolicySpec):
    """A convolutional network on the occupancy grid and the speed: ReLU hidden layers, linear outputs.

    Two convolutions (8 x 8 with stride 4, 4 x 4 with stride 2), a dense layer with the speed as a further input, and
    the outputs. `cnn:16,32,256@4` gives the channels of both convolutions, the units of the dense layer, and the number
    of frames. Frames are the grids of consecutive control steps, the newest last. `cnn` alone means this network, which
    is that of the paper's authors plus the speed; without `@` there are 4 frames.

    A unit's inputs are ordered (frame, row, column) in the first convolution, and (row, column, channel) in the second
    convolution and the dense layer. The last input of the dense layer is the speed.
    """

    observation = "grid"

    hidden: tuple[int, ...] = (16, 32, 256)
    frames: int = 4

    def __str__(self) -> str:
        return f"cnn:{','.join(map(str, self.hidden))}@{self.frames}{self.suffix}"

    @property
    def inputs(self) -> int:
        return self.frames * CELLS * CELLS + 1

    @property
    def layers(self) -> np.ndarray:
        """Frames, channels of both convolutions, units of the dense layer, outputs: int32 [5]."""
        return freeze(np.array([self.frames, *self.hidden, self.outputs], dtype=np.int32))

    def shapes(self) -> tuple[tuple[int, int], ...]:
        first, second, dense = self.hidden
        return (
            (self.frames * KERNEL_1 * KERNEL_1, first),
            (KERNEL_2 * KERNEL_2 * first, second),
            (SIDE_2 * SIDE_2 * second + 1, dense),
            (dense, self.outputs),
        )


@cache
def gene_scales(spec: PolicySpec) -> np.ndarray:
    """The scale of each gene, float32 [genes]: the spread of new genomes and of mutations is proportional to it.

    In a perceptron, whose few inputs are alike, it is 1, but COMMAND_SCALE in the output layer of pedal and wheel. In a
    convolutional network, it is the standard deviation of He et al. (2015), sqrt(2 / inputs of the unit), so that a
    step has the same effect in a layer of 64 inputs as in one of 2,000; the linear output layer has half that variance.
    Weights of the speed have scale 1: it is one input among a thousand and would have no effect otherwise.
    """
    shapes = spec.shapes()
    if spec.observation == "rays":
        scales = np.ones(spec.size, dtype=np.float32)
        if spec.actions == "continuous":
            units, outputs = shapes[-1]
            scales[-(units + 1) * outputs :] = COMMAND_SCALE
        return freeze(scales)
    parts = []
    for k, (n, m) in enumerate(shapes):
        beside = 1 if k == len(shapes) - 2 else 0  # the speed, an input of the dense layer
        size = np.sqrt((2.0 if k < len(shapes) - 1 else 1.0) / (n - beside))
        parts += [np.full((n - beside) * m, size), np.ones(beside * m), np.full(m, size)]
    return freeze(np.concatenate(parts).astype(np.float32))


@leaf
def squash(x):
    """Hyperbolic tangent by a rational function (Lambert's continued fraction), within 2e-4 everywhere."""
    x = F(4.97) if x > F(4.97) else x  # this form keeps NaN
    x = F(-4.97) if x < F(-4.97) else x
    s = x * x
    return (
        x
        * (F(135135.0) + s * (F(17325.0) + s * (F(378.0) + s)))
        / (F(135135.0) + s * (F(62370.0) + s * (F(3150.0) + s * F(28.0))))
    )


BLOCK = 8  # a layer's outputs are padded to whole blocks
_dense_64, _dense_16, _dense_8 = tile(1, 64, False), tile(1, 16, False, 2), tile(1, 8, False, 4)


@leaf
def _padded(units):
    """`units`, rounded up to a multiple of BLOCK."""
    return (units + BLOCK - 1) // BLOCK * BLOCK


@njit
def scratch_size(layers):
    """Length of `forward`'s scratch: room for two layers, each as wide as the widest one plus BLOCK."""
    widest = 0
    for k in range(layers.shape[0]):
        widest = max(widest, layers[k])
    return 2 * (widest + BLOCK)


@njit
def pack(genome, layers):
    """A genome as `forward` reads it: float32, for each layer the biases, then a row of weights for each input.

    Rows are padded with zeros to whole blocks.
    """
    size = 0
    for k in range(layers.shape[0] - 1):
        size += (layers[k] + 1) * _padded(layers[k + 1])
    packed = np.zeros(size, dtype=np.float32)
    at, to = 0, 0
    for k in range(layers.shape[0] - 1):
        n, m = layers[k], layers[k + 1]
        width = _padded(m)
        for j in range(m):
            packed[to + j] = genome[at + n * m + j]
        for i in range(n):
            for j in range(m):
                packed[to + (i + 1) * width + j] = genome[at + i * m + j]
        at += (n + 1) * m
        to += (n + 1) * width
    return packed


@leaf
def forward(packed, layers, scratch):
    """Compute the network's outputs in `scratch`. Returns: the index at which they begin.

    Args: genome packed by `pack`; scratch float32 [2 * (widest layer + 8)], which begins with the inputs and is
    overwritten. A NaN anywhere reaches the outputs.
    """
    half = scratch.shape[0] // 2
    source, at = 0, 0
    last = layers.shape[0] - 2
    for k in range(last + 1):
        n, m = layers[k], layers[k + 1]
        width = _padded(m)
        target = half - source
        unit = 0
        while width - unit >= 64:
            bias = at + unit
            _dense_64(scratch, source, 0, 1, 0, 1, 0, n, packed, bias + width, width, bias, scratch, target + unit, 0)
            unit += 64
        while width - unit >= 16:
            bias = at + unit
            _dense_16(scratch, source, 0, 1, 0, 1, 0, n, packed, bias + width, width, bias, scratch, target + unit, 0)
            unit += 16
        if width - unit >= 8:
            bias = at + unit
            _dense_8(scratch, source, 0, 1, 0, 1, 0, n, packed, bias + width, width, bias, scratch, target + unit, 0)
        if k < last:
            first = U(target)  # unsigned: a check whether an index is negative would prevent vectorisation
            for j in range(U(width)):
                scratch[first + j] = squash(scratch[first + j])
        at += (n + 1) * width
        source = target
    return source


@leaf
def greatest(values, first, n):
    """Index, 0 for `first`, of the greatest of `values[first:first + n]`; the first of ties; -1 if any is NaN."""
    best, index = values[first], 0
    number = best == best
    for k in range(1, n):
        value = values[first + k]
        number &= value == value
        if value > best:
            best, index = value, k
    return index if number else -1


@leaf
def choose(outputs, first, n, command):
    """Choose an action from n outputs, `outputs[first:first + n]`.

    Discrete (`command` is None): returns the index of the largest output, or -1 if one is NaN.
    Continuous: writes pedal and wheel to `command`, float32 [2], each within [-1, 1]; returns 0, or -1 if one is NaN.
    """
    if command is None:
        return greatest(outputs, first, n)
    command[0], command[1] = squash(outputs[first]), squash(outputs[first + 1])
    return 0 if command[0] == command[0] and command[1] == command[1] else -1


@leaf
def decide(packed, layers, scratch, command):
    """Choose a perceptron's action for the inputs in `scratch` (overwritten); `command` and result as in `choose`."""
    return choose(scratch, forward(packed, layers, scratch), layers[layers.shape[0] - 1], command)


@njit
def _outputs(packed, layers, encoding, observations, outputs):
    scratch = np.zeros(scratch_size(layers), dtype=np.float32)
    for n in range(observations.shape[0]):
        normalise(encoding, observations[n], scratch)
        first = forward(packed, layers, scratch)
        if outputs.shape[1] == ACTIONS:
            outputs[n] = scratch[first : first + ACTIONS]
        else:
            choose(scratch, first, 2, outputs[n])


def outputs_of(spec: MlpSpec, genome: np.ndarray, observations: np.ndarray, config: SimConfig) -> np.ndarray:
    """Outputs of a perceptron for observations float32 [n, inputs].

    Returns: float32 [n, 8], one for each action, or [n, 2], pedal and wheel.
    """
    outputs = np.empty((len(observations), spec.outputs), dtype=np.float32)
    packed, encoded = pack(np.ascontiguousarray(genome), spec.layers), encoding(spec.features, constants(config))
    _outputs(packed, spec.layers, encoded, np.ascontiguousarray(observations), outputs)
    return outputs


def act_on(spec: PolicySpec, genome: np.ndarray, observation: np.ndarray, config: SimConfig) -> int | np.ndarray:
    """Actions of a perceptron for the environment's observations, float32 [inputs] or [n, inputs] (`gridsim.envs.env`).

    Returns: for one observation an int or for n int64 [n], -1 where an output is NaN; if actions are continuous, pedal
    and wheel, float32 [2] or [n, 2]. Raises: ValueError for a wrong shape, or a policy that is not a perceptron.
    """
    many = np.atleast_2d(np.asarray(observation, dtype=np.float32))
    if not isinstance(spec, MlpSpec) or many.ndim != 2 or many.shape[1] != spec.inputs:
        raise ValueError(f"observations of {spec} are [n, {spec.inputs}], not {many.shape}")
    actions = outputs_of(spec, genome, many, config)
    if spec.actions == "discrete":
        actions = np.where(np.isnan(actions).any(axis=1), -1, actions.argmax(axis=1))
    return actions if np.ndim(observation) == 2 else actions[0] if spec.actions == "continuous" else int(actions[0])
