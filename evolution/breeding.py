"""Breeding: genomes from recipes, by kernels with a counter-based generator.

A recipe is a few bytes; together with the parents and the generation's key it *is* the child: whoever breeds it,
wherever and how often, gets the same bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evolution.policy import PolicySpec, gene_scales
from gridsim.counter import GOLDEN, mix, uniform
from gridsim.jit import njit
from gridsim.roads import freeze

#: Parents' rows and the child's seed. Seed 0 with a == b is an unmodified copy; a == FRESH is a new random genome.
RECIPE = np.dtype([("a", "<u2"), ("b", "<u2"), ("seed", "<u4")])
FRESH = 65_535
MAX_PARENTS = 65_500  # some rows are left for copies of others

_F, _U = np.float32, np.uint64
_UNIT24 = _F(1.0 / (1 << 24))


@dataclass(frozen=True)
class Mutation:
    """How a child differs from its parents."""

    rate: float = 0.03  # share of genes that get Gaussian noise
    sigma: float = 0.5  # its standard deviation, in units of `policy.gene_scales`
    bump_rate: float = (
        0.3  # children of which one first-layer unit gets a smooth bump across neighbouring rays; not cnn
    )
    bump_width: float = 4.0  # rays, the bump's greatest standard deviation
    first_scale: float = 1.0  # scale of a new genome's weights


@njit
def normal(bits):
    """Standard normal float32 from 64 bits (Box and Muller 1958)."""
    u = (_F(bits >> _U(40)) + _F(0.5)) * _UNIT24
    v = _F(bits & _U(0xFFFFFF)) * _UNIT24
    return _F(math.sqrt(_F(-2.0) * math.log(u)) * math.cos(_F(2.0 * math.pi) * v))


@njit
def _bump(genome, inputs, units, unit, centre, width, height):
    """Add a Gaussian bump across the rays (all inputs but the last) to one first-layer unit's weights."""
    scale = _F(-0.5) / (width * width)
    for i in range(inputs - 1):
        d = _F(i) - centre
        genome[i * units + unit] += height * math.exp(d * d * scale)


@njit
def _fresh(genome, layers, stream, scale):
    """A new genome: first-layer weights smooth across rays, the others normal with variance 1 / inputs."""
    inputs, units = layers[0], layers[1]
    at = 0
    for k in range(layers.shape[0] - 1):
        n, m = layers[k], layers[k + 1]
        spread = scale / _F(math.sqrt(_F(n))) if k > 0 else scale
        for i in range(n * m + m):
            if k == 0 and i < (n - 1) * m:
                genome[at + i] = _F(0.0)
            else:
                genome[at + i] = spread * normal(mix(stream + _U(at + i + 1) * GOLDEN))
        at += n * m + m
    for unit in range(units):
        for b in range(3):
            h = mix(stream + _U(at + 2 * (3 * unit + b) + 1) * GOLDEN)
            width = _F(1.0) + _F(5.0) * uniform(mix(h + GOLDEN))
            height = scale * _F(0.6) * normal(mix(stream + _U(at + 2 * (3 * unit + b) + 2) * GOLDEN))
            _bump(genome, inputs, units, unit, uniform(h) * _F(inputs - 1), width, height)


@njit
def _fresh_scaled(genome, scales, stream, scale):
    """A new genome of a convolutional network: normal, and as large as its genes are by nature."""
    for i in range(genome.shape[0]):
        genome[i] = scale * scales[i] * normal(mix(stream + _U(i + 1) * GOLDEN))


@njit
def _cross(a, b, stream, threshold, child, marked):
    """Uniform crossover, and which genes are to mutate: no branches, so that it becomes vector code."""
    for i in range(child.shape[0]):
        bits = mix(stream + _U(i + 1) * GOLDEN)
        x, y = a[i], b[i]
        child[i] = y if bits & _U(1) else x
        marked[i] = (bits >> _U(40)) < threshold


@njit(nogil=True)
def _breed(parents, recipes, key, layers, scales, rays, rate, sigma, bump_rate, bump_width, scale, children):
    """Children of recipes; scales [genes] are `policy.gene_scales`, `rays` is whether the first layer sees rays."""
    genes = children.shape[1]
    threshold = _U(rate * _F(1 << 24))
    marked = np.empty(genes, dtype=np.uint8)
    chosen = np.empty(genes, dtype=np.int64)
    for n in range(recipes.shape[0]):
        recipe = recipes[n]
        child = children[n]
        stream = mix(key ^ mix(_U(recipe["seed"]) + GOLDEN))
        if recipe["a"] == FRESH:
            if rays:
                _fresh(child, layers, stream, scale)
            else:
                _fresh_scaled(child, scales, stream, scale)
            continue
        a, b = parents[recipe["a"]], parents[recipe["b"]]
        if recipe["seed"] == 0:
            for i in range(genes):
                child[i] = a[i]
            continue
        _cross(a, b, stream, threshold, child, marked)
        count = 0
        for i in range(genes):
            chosen[count] = i
            count += marked[i]
        # A loop of their own: under an `if` LLVM would compute a logarithm and a cosine for every gene (tenfold time).
        for k in range(count):
            i = chosen[k]
            child[i] += sigma * scales[i] * normal(mix(mix(stream + _U(i + 1) * GOLDEN)))
        bits = mix(stream + _U(genes + 1) * GOLDEN)
        if rays and uniform(bits) < bump_rate:
            unit = int((mix(bits) >> _U(33)) % _U(layers[1]))
            centre = uniform(mix(bits + _U(1))) * _F(layers[0] - 1)
            width = _F(0.7) + (bump_width - _F(0.7)) * uniform(mix(bits + _U(2)))
            _bump(child, layers[0], layers[1], unit, centre, width, sigma * normal(mix(bits + _U(3))))


def breed(parents: np.ndarray, recipes: np.ndarray, key: int, spec: PolicySpec, mutation: Mutation) -> np.ndarray:
    """Children float32 [n, genes] of recipes RECIPE [n] over parents float32 [p, genes].

    Uniform crossover where a recipe has two parents, then mutation. With sigma 0 a child of one parent is that parent.
    Raises: ValueError where shapes or parents' rows do not fit.
    """
    if parents.ndim != 2 or parents.shape[1] != spec.size:
        raise ValueError(f"parents of {spec} are [n, {spec.size}], not {parents.shape}")
    own = recipes[recipes["a"] != FRESH]
    if own.size and max(own["a"].max(), own["b"].max()) >= len(parents):
        raise ValueError(f"a recipe names a parent beyond the {len(parents)} there are")
    children = np.empty((len(recipes), spec.size), dtype=np.float32)
    _breed(
        freeze(parents),
        freeze(recipes),
        _U(key),
        spec.layers,
        gene_scales(spec),
        spec.observation == "rays",
        _F(mutation.rate),
        _F(mutation.sigma),
        _F(mutation.bump_rate),
        _F(mutation.bump_width),
        _F(mutation.first_scale),
        children,
    )
    return children
