"""Breeding: genomes from recipes, by kernels with counter-based random numbers.

A recipe is a few bytes. Together with the space and the generation's parents, key and mutation, it determines the
child, bit for bit, in every process.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from statistics import NormalDist

import numpy as np

from evolution.search.space import Space
from gridsim.counter import GOLDEN, mix
from gridsim.jit import F, U, freeze, njit


class Kind(IntEnum):
    """How a child is made; its recipe's `a` and `b` are rows of `parents`."""

    COPY = 0  # parents[a], unmodified
    NEW = 1  # a random genome, symmetric (`space.Symmetry`), like the noise of STEP and MIRRORED
    STEP = 2  # parents[a] plus noise in each gene
    MIRRORED = 3  # parents[a] minus the noise of a STEP with the same seed
    CROSS = 4  # uniform crossover of parents[a] and parents[b], then mutation of some genes; symmetric if both are


RECIPE = np.dtype([("kind", "u1"), ("a", "<u2"), ("b", "<u2"), ("seed", "<u4")])

_COPY, _NEW, _STEP, _MIRRORED = int(Kind.COPY), int(Kind.NEW), int(Kind.STEP), int(Kind.MIRRORED)
_LEVELS = 1 << 12


# The standard library gives the same bits as scipy.special, whose import would cost each worker 0.2 s.
_UNSCALED = np.array([NormalDist().inv_cdf((k + 0.5) / _LEVELS) for k in range(_LEVELS)])
QUANTILES = freeze((_UNSCALED / _UNSCALED.std()).astype(np.float32))
"""Quantiles of N(0, 1) at the middles of _LEVELS equal shares, scaled to variance 1. Normal numbers are looked up by 12
random bits, ten times as fast as the Box-Muller transform."""


@dataclass(frozen=True)
class Mutation:
    """Gaussian mutation."""

    rate: float = 0.03  # share of genes that get noise, in a child of two parents
    sigma: float = 0.5  # standard deviation of the noise, in units of the space's scales


@njit
def _stream(key, seed):
    """The random stream of a recipe's seed."""
    return mix(key ^ mix(U(seed) + GOLDEN))


@njit
def _normals(quantiles, stream, scale, symmetry, out):
    """Fill out [genes] with symmetric noise, out[i] = scale[i] * N(0, 1); 64 random bits give four numbers."""
    n = out.shape[0]
    for block in range(n // 4):
        bits = mix(stream + U(block + 1) * GOLDEN)
        i = 4 * block
        out[i] = scale[i] * quantiles[bits & U(0xFFF)]
        out[i + 1] = scale[i + 1] * quantiles[(bits >> U(16)) & U(0xFFF)]
        out[i + 2] = scale[i + 2] * quantiles[(bits >> U(32)) & U(0xFFF)]
        out[i + 3] = scale[i + 3] * quantiles[(bits >> U(48)) & U(0xFFF)]
    bits = mix(stream + U(n // 4 + 1) * GOLDEN)
    for i in range(4 * (n // 4), n):
        out[i] = scale[i] * quantiles[(bits >> U(16 * (i & 3))) & U(0xFFF)]
    for k in range(symmetry.bound.shape[0]):
        out[symmetry.bound[k]] = symmetry.factor[k] * out[symmetry.source[k]]


@njit
def _cross(a, b, stream, threshold, source, child, marked):
    """Uniform crossover; marks the genes to mutate. Bound genes are chosen like their sources (`space.Symmetry`).

    The loop has no branches, so that it is vectorised.
    """
    for i in range(child.shape[0]):
        bits = mix(stream + (source[i] + U(1)) * GOLDEN)
        x, y = a[i], b[i]
        child[i] = y if bits & U(1) else x
        marked[i] = (bits >> U(40)) < threshold


@njit(nogil=True)
def _breed(parents, recipes, key, scales, symmetry, quantiles, rate, sigma, children):
    """Fill `children` by recipes; scales [genes] and symmetry are the space's."""
    genes = children.shape[1]
    threshold = U(rate * F(1 << 24))
    marked = np.empty(genes, dtype=np.uint8)
    source, factor = np.arange(genes).astype(np.uint64), np.ones(genes, dtype=np.float32)
    for k in range(symmetry.bound.shape[0]):
        source[symmetry.bound[k]], factor[symmetry.bound[k]] = symmetry.source[k], symmetry.factor[k]
    for n in range(recipes.shape[0]):
        recipe = recipes[n]
        kind, child = recipe["kind"], children[n]
        a, b = parents[recipe["a"]], parents[recipe["b"]]
        stream = _stream(key, recipe["seed"])
        if kind == _COPY:
            for i in range(genes):
                child[i] = a[i]
        elif kind == _NEW:
            _normals(quantiles, stream, scales, symmetry, child)
        elif kind in (_STEP, _MIRRORED):
            _normals(quantiles, stream, scales, symmetry, child)
            size = sigma if kind == _STEP else -sigma
            for i in range(genes):
                child[i] = a[i] + size * child[i]
        else:
            _cross(a, b, stream, threshold, source, child, marked)
            for i in range(genes):
                if marked[i]:
                    bits = mix(mix(stream + (source[i] + U(1)) * GOLDEN))
                    child[i] += factor[i] * sigma * scales[i] * quantiles[bits & U(0xFFF)]


def breed(parents: np.ndarray, recipes: np.ndarray, key: int, space: Space, mutation: Mutation) -> np.ndarray:
    """Make the children float32 [n, genes] that recipes RECIPE [n] give with parents float32 [p, genes]."""
    if not len(parents):  # all are Kind.NEW
        parents = np.zeros((1, space.size), dtype=np.float32)
    children = np.empty((len(recipes), space.size), dtype=np.float32)
    _breed(
        freeze(parents), freeze(recipes), U(key), space.scales, space.symmetry, QUANTILES,
        F(mutation.rate), F(mutation.sigma), children,
    )  # fmt: skip
    return children


@njit
def _noise_sum(seeds, weights, key, quantiles, scales, symmetry, total):
    """Add to total [genes], for all k, weights[k] times the noise of seeds[k]."""
    z = np.empty(total.shape[0], dtype=np.float32)
    for k in range(seeds.shape[0]):
        if weights[k] == 0.0:
            continue
        _normals(quantiles, _stream(key, seeds[k]), scales, symmetry, z)
        w = F(weights[k])
        for i in range(total.shape[0]):
            total[i] += w * z[i]


def noise_sum(seeds: np.ndarray, weights: np.ndarray, key: int, space: Space) -> np.ndarray:
    """Weighted sum float32 [genes] of the noise that Kind.STEP adds, at sigma 1, for each of the seeds [n]."""
    total = np.zeros(space.size, dtype=np.float32)
    _noise_sum(seeds.astype(np.uint32), weights, U(key), QUANTILES, space.scales, space.symmetry, total)
    return total
