"""Left-right symmetry: which genes are drawn, and which follow from them.

Cars and roads look the same in a mirror, so a network should do in a mirrored world what it does in ours, with left and
right exchanged. Random numbers of a genome are therefore drawn for half of its genes; the others get the same ones in
their mirrored place. A symmetric genome stays so, there is half as much to search for, and what is learned in a bend to
the left serves in one to the right.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from evolution.policy import INPUTS, KERNEL_1, KERNEL_2, SIDE_2, CnnSpec, MlpSpec, PolicySpec
from gridsim.roads import freeze
from gridsim.vehicle import Action

RAYS = INPUTS - 1

#: Of each action its mirror image.
MIRRORED_ACTIONS = np.array(
    [
        {
            Action.LEFT: Action.RIGHT,
            Action.RIGHT: Action.LEFT,
            Action.ACCELERATE_LEFT: Action.ACCELERATE_RIGHT,
            Action.ACCELERATE_RIGHT: Action.ACCELERATE_LEFT,
        }.get(action, action)
        for action in Action
    ]
)


class Symmetry(NamedTuple):
    """How the genes of a symmetric network depend on each other: gene[bound] = factor * gene[source]."""

    free: np.ndarray  # int32 [f], genes that are drawn
    bound: np.ndarray  # int32 [genes - f], all others
    source: np.ndarray  # int32 [genes - f], free genes, but where the factor is 0
    factor: np.ndarray  # float32 [genes - f]: 1; -1 of the steering angle's weights, 0 of its weight at a middle unit


@cache
def symmetry(spec: PolicySpec) -> Symmetry:
    """Of a network whose hidden units mirror each other from first to last.

    The middle one of an odd number mirrors itself; with a layer of that one alone a network could not tell left from
    right, so that all of its genes are free. A `cnn` is symmetric only about: its second convolution does not see the
    last of 19 columns.
    """
    images, signs, at = [], [], 0
    shapes = spec.shapes()
    for k, (inputs, (n, m)) in enumerate(zip(_inputs(spec), shapes, strict=True)):
        units = np.arange(m)[::-1] if k < len(shapes) - 1 else MIRRORED_ACTIONS
        sign = np.ones((n + 1, m))
        if k == 0 and isinstance(spec, MlpSpec) and spec.steering:
            sign[n - 1] = -1.0
        images += [(at + inputs[:, None] * m + units).ravel(), at + n * m + units]
        signs.append(sign.ravel())
        at += (n + 1) * m
    image, factor = np.concatenate(images), np.concatenate(signs)
    gene = np.arange(spec.size)
    if 1 in spec.hidden:
        image, factor = gene, np.ones(spec.size)
    opposite = (image == gene) & (factor < 0)
    is_free = (gene <= image) & ~opposite
    bound = np.flatnonzero(~is_free)
    return Symmetry(
        freeze(np.flatnonzero(is_free).astype(np.int32)),
        freeze(bound.astype(np.int32)),
        freeze(image[bound].astype(np.int32)),
        freeze(np.where(opposite, 0.0, factor)[bound].astype(np.float32)),
    )


def _inputs(spec: PolicySpec) -> list[np.ndarray]:
    """Of each layer the mirror images of its units' inputs, by their places."""
    if isinstance(spec, CnnSpec):
        first, second, dense = spec.hidden
        return [
            _columns_reversed(spec.frames * KERNEL_1, KERNEL_1, 1),
            _columns_reversed(KERNEL_2, KERNEL_2, first),
            np.append(_columns_reversed(SIDE_2, SIDE_2, second), SIDE_2 * SIDE_2 * second),  # the speed is last
            np.arange(dense)[::-1],
        ]
    assert isinstance(spec, MlpSpec)
    rays = np.arange(RAYS)[::-1]
    seen = [rays, rays + RAYS] if spec.motion else [rays]
    others = np.arange(len(seen) * RAYS, spec.inputs)
    return [np.concatenate([*seen, others]), *(np.arange(m)[::-1] for m in spec.hidden)]


def _columns_reversed(rows: int, columns: int, channels: int) -> np.ndarray:
    """Places of the mirror image's values (row, column, channel) among those of an image."""
    places = np.arange(rows * columns * channels).reshape(rows, columns, channels)
    return places[:, ::-1, ::-1].ravel()
