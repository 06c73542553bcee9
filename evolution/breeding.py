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
MAX_PARENTS = 65_535

_F, _U = np.float32, np.uint64
_UNIT24 = _F(1.0 / (1 << 24))
NOISE = _F(0.5)  # of a new convolutional network's weights: its standard deviation's share


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
def _fresh_views(genome, views, scales, stream, scale):
    """A new genome of a convolutional network: as large as genes are by nature, and mostly smooth in the plane.

    A unit's weights for one plane and channel are (a + b u)(c + d v) with normal products and u, v in (-1, 1) over the
    columns and rows, so that a new unit tells left from right and near from far, and some noise.
    """
    for i in range(genome.shape[0]):
        genome[i] = scale * scales[i] * normal(mix(stream + _U(i + 1) * GOLDEN))
    draw = mix(stream + GOLDEN)
    at = 0
    for k in range(views.shape[0]):
        planes, rows, columns, channels = views[k, 0], views[k, 1], views[k, 2], views[k, 3]
        units = views[k, 5]
        # The mean of (1 + u^2) (1 + v^2), so that the whole has the variance that it should.
        mean = (_F(4.0) - _F(1.0) / _F(rows * rows)) * (_F(4.0) - _F(1.0) / _F(columns * columns)) / _F(9.0)
        spread = scale * scales[at] * _F(math.sqrt((_F(1.0) - NOISE * NOISE) / mean))
        if rows > 1:
            for plane in range(planes):
                for channel in range(channels):
                    for unit in range(units):
                        draw += GOLDEN * _U(4)
                        level, across = normal(mix(draw)), normal(mix(draw + GOLDEN))
                        along, both = normal(mix(draw + GOLDEN * _U(2))), normal(mix(draw + GOLDEN * _U(3)))
                        for row in range(rows):
                            v = _F(2 * row + 1) / _F(rows) - _F(1.0)
                            for column in range(columns):
                                u = _F(2 * column + 1) / _F(columns) - _F(1.0)
                                i = at + (((plane * rows + row) * columns + column) * channels + channel) * units + unit
                                genome[i] = NOISE * genome[i] + spread * (level + across * u + (along + both * u) * v)
        at += (planes * rows * columns * channels + views[k, 4] + 1) * units


@njit
def _bump_view(genome, views, scales, bits, sigma):
    """Change one unit's view: a Gaussian bump somewhere in the plane, of its own height in each plane and channel."""
    k = int((mix(bits) >> _U(33)) % _U(views.shape[0] - 1))
    at = 0
    for before in range(k):
        inputs = views[before, 0] * views[before, 1] * views[before, 2] * views[before, 3] + views[before, 4]
        at += (inputs + 1) * views[before, 5]
    planes, rows, columns, channels, units = views[k, 0], views[k, 1], views[k, 2], views[k, 3], views[k, 5]
    unit = int((mix(bits + _U(1)) >> _U(33)) % _U(units))
    centre_row = uniform(mix(bits + _U(2))) * _F(rows - 1)
    centre_column = uniform(mix(bits + _U(3))) * _F(columns - 1)
    width = _F(0.7) + (_F(0.5) * _F(rows) - _F(0.7)) * uniform(mix(bits + _U(4)))
    slope = _F(-0.5) / (width * width)
    for plane in range(planes):
        for channel in range(channels):
            height = sigma * scales[at] * normal(mix(bits + GOLDEN * _U(plane * channels + channel + 5)))
            for row in range(rows):
                y = _F(row) - centre_row
                for column in range(columns):
                    x = _F(column) - centre_column
                    i = at + (((plane * rows + row) * columns + column) * channels + channel) * units + unit
                    genome[i] += height * math.exp((x * x + y * y) * slope)


@njit
def _cross(a, b, stream, threshold, child, marked):
    """Uniform crossover, and which genes are to mutate: no branches, so that it becomes vector code."""
    for i in range(child.shape[0]):
        bits = mix(stream + _U(i + 1) * GOLDEN)
        x, y = a[i], b[i]
        child[i] = y if bits & _U(1) else x
        marked[i] = (bits >> _U(40)) < threshold


@njit(nogil=True)
def _breed(parents, recipes, key, layers, scales, views, rate, sigma, bump_rate, bump_width, scale, children):
    """Children of recipes; scales [genes] are `policy.gene_scales`, views [layers, 6] `PolicySpec.views`."""
    rays = views.shape[0] == 0
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
                _fresh_views(child, views, scales, stream, scale)
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
        if uniform(bits) >= bump_rate:
            continue
        if rays:
            unit = int((mix(bits) >> _U(33)) % _U(layers[1]))
            centre = uniform(mix(bits + _U(1))) * _F(layers[0] - 1)
            width = _F(0.7) + (bump_width - _F(0.7)) * uniform(mix(bits + _U(2)))
            _bump(child, layers[0], layers[1], unit, centre, width, sigma * normal(mix(bits + _U(3))))
        else:
            _bump_view(child, views, scales, mix(bits + GOLDEN), sigma)


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
        spec.views,
        _F(mutation.rate),
        _F(mutation.sigma),
        _F(mutation.bump_rate),
        _F(mutation.bump_width),
        _F(mutation.first_scale),
        children,
    )
    return children
