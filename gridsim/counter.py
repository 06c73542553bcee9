"""Counter-based random numbers for kernels: a draw depends only on its key and its index, not on earlier draws.

SplitMix64 (Steele et al. 2014): `mix(key + index * GOLDEN)` is draw number `index` of a key.
"""

from __future__ import annotations

import numpy as np

from gridsim.jit import F, U, njit

GOLDEN = U(0x9E3779B97F4A7C15)
_UNIT24 = F(1.0 / (1 << 24))


@njit
def mix(x: np.uint64) -> np.uint64:
    """SplitMix64's finaliser: 64 random bits from a counter."""
    x = (x ^ (x >> U(30))) * U(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> U(27))) * U(0x94D049BB133111EB)
    return x ^ (x >> U(31))


@njit
def uniform(bits: np.uint64) -> np.float32:
    """Uniform float32 in [0, 1) from the upper 24 bits."""
    return F(bits >> U(40)) * _UNIT24


@njit
def uniform64(bits: np.uint64) -> np.float64:
    """Uniform float64 in [0, 1) from the upper 53 bits."""
    return np.float64(bits >> U(11)) * (1.0 / (1 << 53))
