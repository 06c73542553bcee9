"""Networks: what a policy's text means, how a flat genome is laid out, and the forward pass.

This is the one file that knows layer shapes. A genome is a flat float32 vector: for each layer the weights, input-major
[inputs, outputs], then the biases [outputs].
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from gridsim.jit import leaf, njit

INPUTS = 32  # 31 rays and the speed
ACTIONS = 8
MAX_GENES = 1_000_000
_F, _U = np.float32, np.uint64
RAY_HALF = _F(8.0)  # m, the range whose input is 0
SPEED_SCALE = _F(10.0)  # m/s, the speed whose input is 0


@dataclass(frozen=True)
class PolicySpec:
    """A multi-layer perceptron: tanh hidden layers, a linear output, the greatest output acts."""

    hidden: tuple[int, ...] = (6, 7)
    inputs: int = INPUTS
    outputs: int = ACTIONS

    @classmethod
    def parse(cls, text: str) -> PolicySpec:
        """Read `mlp:6,7`. Raises ValueError with one line for anything else."""
        match = re.fullmatch(r"mlp:(\d{1,5}(?:,\d{1,5})*)", text)
        if not match:
            raise ValueError(f"unknown policy {text!r}; write mlp: and the hidden layers' sizes, as in mlp:6,7")
        spec = cls(tuple(int(n) for n in match[1].split(",")))
        if min(spec.hidden) < 1 or spec.size > MAX_GENES:
            raise ValueError(
                f"policy {text!r}: hidden layers need 1 unit or more, and {MAX_GENES:,} genes at most in all"
            )
        return spec

    def __str__(self) -> str:
        return "mlp:" + ",".join(map(str, self.hidden))

    @property
    def layers(self) -> np.ndarray:
        """Units of each layer, inputs and outputs included: int32 [layers + 1]."""
        layers = np.array([self.inputs, *self.hidden, self.outputs], dtype=np.int32)
        layers.setflags(write=False)
        return layers

    @property
    def size(self) -> int:
        """Genes of a genome."""
        layers = self.layers.astype(int)
        return int(((layers[:-1] + 1) * layers[1:]).sum())


@leaf
def encode(ranges, speed, inputs):
    """What the network sees: float32 [rays + 1]. Ranges r (m) as 2 r / (r + 8) - 1, so that near edges stand out."""
    rays = ranges.shape[0]
    for i in range(rays):
        inputs[i] = _F(2.0) * ranges[i] / (ranges[i] + RAY_HALF) - _F(1.0)
    inputs[rays] = speed / SPEED_SCALE - _F(1.0)


@leaf
def squash(x):
    """Hyperbolic tangent by a rational function (Lambert's continued fraction), within 2e-4 everywhere."""
    x = _F(4.97) if x > _F(4.97) else x  # so written, not a number stays one
    x = _F(-4.97) if x < _F(-4.97) else x
    s = x * x
    return (
        x
        * (_F(135135.0) + s * (_F(17325.0) + s * (_F(378.0) + s)))
        / (_F(135135.0) + s * (_F(62370.0) + s * (_F(3150.0) + s * _F(28.0))))
    )


BLOCK = 8  # units computed at once: a layer's outputs are padded to whole blocks


@njit
def packed_size(layers):
    """Length of a genome laid out by `pack`."""
    size = 0
    for k in range(layers.shape[0] - 1):
        size += (layers[k] + 1) * ((layers[k + 1] + BLOCK - 1) // BLOCK * BLOCK)
    return size


@njit
def pack(genome, layers, packed):
    """Lay a genome out for `forward`.

    A layer's outputs stand in blocks of 8; in each block come first the biases, then a row for each input. Missing
    units have weight 0.
    """
    packed[:] = _F(0.0)
    at, to = 0, 0
    for k in range(layers.shape[0] - 1):
        n, m = layers[k], layers[k + 1]
        for block in range(0, m, BLOCK):
            for j in range(min(BLOCK, m - block)):
                packed[to + j] = genome[at + n * m + block + j]
                for i in range(n):
                    packed[to + (i + 1) * BLOCK + j] = genome[at + i * m + block + j]
            to += (n + 1) * BLOCK
        at += (n + 1) * m


@leaf
def forward(packed, layers, scratch):
    """Outputs of the network in scratch[return value: + outputs].

    Args: genome laid out by `pack`; scratch float32 [2 * (widest layer + 8)], the inputs at its beginning.
    Any not-a-number stays one and reaches the outputs.
    """
    # Unsigned indices: a signed one might count from the end, and that check would keep this from being vector code.
    half = _U(scratch.shape[0] // 2)
    source, at = _U(0), _U(0)
    last = layers.shape[0] - 2
    for k in range(last + 1):
        n, m = layers[k], layers[k + 1]
        target = half - source
        for block in range(0, m, BLOCK):
            a0, a1, a2, a3 = packed[at], packed[at + _U(1)], packed[at + _U(2)], packed[at + _U(3)]
            a4, a5, a6, a7 = packed[at + _U(4)], packed[at + _U(5)], packed[at + _U(6)], packed[at + _U(7)]
            for i in range(n):
                at += _U(BLOCK)
                value = scratch[source + _U(i)]
                a0 += value * packed[at]
                a1 += value * packed[at + _U(1)]
                a2 += value * packed[at + _U(2)]
                a3 += value * packed[at + _U(3)]
                a4 += value * packed[at + _U(4)]
                a5 += value * packed[at + _U(5)]
                a6 += value * packed[at + _U(6)]
                a7 += value * packed[at + _U(7)]
            at += _U(BLOCK)
            to = target + _U(block)
            scratch[to], scratch[to + _U(1)], scratch[to + _U(2)], scratch[to + _U(3)] = a0, a1, a2, a3
            scratch[to + _U(4)], scratch[to + _U(5)], scratch[to + _U(6)], scratch[to + _U(7)] = a4, a5, a6, a7
            if k < last:
                for j in range(BLOCK):
                    scratch[to + _U(j)] = squash(scratch[to + _U(j)])
        source = target
    return source


@leaf
def decide(packed, layers, scratch):
    """Index of the greatest output, the first of equals; -1 where an output is not a number."""
    at = forward(packed, layers, scratch)
    best, action = scratch[at], 0
    number = best == best
    for k in range(1, layers[layers.shape[0] - 1]):
        value = scratch[at + k]
        number &= value == value
        if value > best:
            best, action = value, k
    return action if number else -1


@njit
def _act_on(packed, layers, observations, reach, speed_limit, actions):
    scratch = np.zeros(2 * (layers.max() + BLOCK), dtype=np.float32)
    ranges = np.empty(layers[0] - 1, dtype=np.float32)
    for n in range(observations.shape[0]):
        for i in range(ranges.shape[0]):
            ranges[i] = observations[n, i] * reach
        encode(ranges, observations[n, ranges.shape[0]] * speed_limit, scratch)
        actions[n] = decide(packed, layers, scratch)


def act_on(
    spec: PolicySpec, genome: np.ndarray, observation: np.ndarray, reach: float, speed_limit: float
) -> int | np.ndarray:
    """Actions of a genome for the environment's observations.

    Args: observation float32 [32] or [n, 32]: ranges / reach, then speed / speed_limit; reach m; speed limit m/s.
    Returns: an action, or int64 [n]; -1 where the network gives no number.
    """
    many = np.atleast_2d(np.asarray(observation, dtype=np.float32))
    if many.ndim != 2 or many.shape[1] != spec.inputs:
        raise ValueError(f"observations of {spec} are [n, {spec.inputs}], not {many.shape}")
    packed = np.empty(packed_size(spec.layers), dtype=np.float32)
    pack(np.ascontiguousarray(genome), spec.layers, packed)
    actions = np.empty(len(many), dtype=np.int64)
    _act_on(packed, spec.layers, np.ascontiguousarray(many), _F(reach), _F(speed_limit), actions)
    return int(actions[0]) if np.ndim(observation) == 1 else actions
