"""Left-right symmetry: which genes are free, and which are bound to them.

Cars and roads look the same in a mirror. In a mirrored world a network should therefore take the mirrored action. It
does so if each gene equals its mirror image, in some places with the opposite sign. So random numbers are drawn for the
free half of a genome, and the bound half copies them. The search then has half as many dimensions, and what is learned
in a bend to the left also serves in a bend to the right.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from evolution.networks.policy import KERNEL_1, KERNEL_2, SIDE_2, CnnSpec, MlpSpec, PolicySpec, gene_scales
from evolution.search.space import Space, Symmetry
from gridsim.car.vehicle import Action
from gridsim.jit import freeze
from gridsim.sensing.observation import mirrored

#: The mirror image of each action.
MIRRORED_ACTIONS = np.array(
    [
        Action.ACCELERATE, Action.RIGHT, Action.LEFT, Action.BRAKE, Action.NONE, Action.ACCELERATE_RIGHT,
        Action.ACCELERATE_LEFT, Action.REVERSE,
    ]
)  # fmt: skip


@cache
def space(spec: PolicySpec) -> Space:
    """The space of a network's genomes, as searches know it."""
    return Space(spec.size, gene_scales(spec), symmetry(spec))


@cache
def symmetry(spec: PolicySpec) -> Symmetry:
    """The symmetry of a network in which hidden unit k of a layer is the mirror image of unit k from the layer's end.

    With an odd width the middle unit is its own mirror image. A hidden layer of one unit could not tell left from
    right, so all genes of a network with such a layer are free. A `cnn` is only nearly symmetric: its second
    convolution leaves out a column. The factor of a bound gene (`Symmetry.factor`) is 0 if the gene would be its own
    opposite, -1 if it is a gene of the output wheel (continuous actions only), that of the feature (`Feature.mirror`)
    for weights of a perceptron's inputs, else 1.
    """
    images, signs, at = [], [], 0
    shapes = spec.shapes()
    for k, (inputs, (n, m)) in enumerate(zip(_inputs(spec), shapes, strict=True)):
        units, sign = np.arange(m)[::-1], np.ones((n + 1, m))
        if k == len(shapes) - 1:
            units = MIRRORED_ACTIONS if spec.actions == "discrete" else np.arange(2)
            sign[:, 1] = 1.0 if spec.actions == "discrete" else -1.0  # continuous: column 1 is the wheel
        if k == 0 and isinstance(spec, MlpSpec):
            sign[:n] *= mirrored(spec.features)[1][:, None]
        images += [(at + inputs[:, None] * m + units).ravel(), at + n * m + units]
        signs.append(sign.ravel())
        at += (n + 1) * m
    image, factor = np.concatenate(images), np.concatenate(signs)
    gene = np.arange(spec.size)
    opposite = (image == gene) & (factor < 0)
    is_free = (gene <= image) & ~opposite | (1 in spec.hidden)
    bound = np.flatnonzero(~is_free)
    return Symmetry(
        freeze(np.flatnonzero(is_free).astype(np.int32)),
        freeze(bound.astype(np.int32)),
        freeze(image[bound].astype(np.int32)),
        freeze(np.where(opposite, 0.0, factor)[bound].astype(np.float32)),
    )


def _inputs(spec: PolicySpec) -> list[np.ndarray]:
    """For each layer an array of the indices of its inputs' mirror images."""
    if isinstance(spec, CnnSpec):
        first, second, dense = spec.hidden
        return [
            _columns_reversed(spec.frames * KERNEL_1, KERNEL_1, 1),
            _columns_reversed(KERNEL_2, KERNEL_2, first),
            np.append(_columns_reversed(SIDE_2, SIDE_2, second), SIDE_2 * SIDE_2 * second),  # the speed is last
            np.arange(dense)[::-1],
        ]
    assert isinstance(spec, MlpSpec)
    return [mirrored(spec.features)[0], *(np.arange(m)[::-1] for m in spec.hidden)]


def _columns_reversed(rows: int, columns: int, channels: int) -> np.ndarray:
    """Indices [rows * columns * channels] of an image's values with columns and channels in reverse order."""
    index = np.arange(rows * columns * channels).reshape(rows, columns, channels)
    return index[:, ::-1, ::-1].ravel()
