"""Several maps in one set of arrays, so that one kernel call can step cars on different maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gridsim.jit import freeze, njit
from gridsim.maps.network import Network
from gridsim.maps.roads import Road


class Atlas(NamedTuple):
    """Concatenated maps; all arrays read-only and C-contiguous."""

    field: np.ndarray  # `Road.field` of all maps
    lanes: Network  # the arrays of all maps' networks, concatenated; width, height and hand are those of map 0
    # int64 [maps + 1, 8], where each map's part begins of the field, points, lanes, crossings, stop lines, programs,
    # seconds of programs, and `yields`: a column for each
    bounds: np.ndarray
    sides: np.ndarray  # uint32 [maps, 2], columns and rows
    sizes: np.ndarray  # float32 [maps, 9], the fields of `Road` from `width` on, and `Network.hand`


def make_atlas(roads: Sequence[Road], networks: Sequence[Network]) -> Atlas:
    """Concatenate maps. The field of a single map, which may be large, is not copied."""
    most = max(network.successors.shape[1] for network in networks)
    networks = [
        n._replace(successors=np.pad(n.successors, ((0, 0), (0, most - n.successors.shape[1])), constant_values=-1))
        for n in networks
    ]
    *columns, width, height, hand = zip(*networks, strict=True)
    lanes = Network._make([*(freeze(np.concatenate(column)) for column in columns), width[0], height[0], hand[0]])
    fields = [road.field for road in roads]
    lengths = [
        (
            len(r.field), len(n.points), len(n.steps), len(n.crossings), len(n.lines), len(n.program_offsets) - 1,
            len(n.programs), len(n.yields),
        )
        for r, n in zip(roads, networks, strict=True)
    ]  # fmt: skip
    sizes = [(*tuple(r)[3:], n.hand) for r, n in zip(roads, networks, strict=True)]
    return Atlas(
        field=fields[0] if len(fields) == 1 else freeze(np.concatenate(fields)),
        lanes=lanes,
        bounds=freeze(np.cumsum([(0,) * 8, *lengths], axis=0, dtype=np.int64)),
        sides=freeze(np.array([(r.columns, r.rows) for r in roads], dtype=np.uint32)),
        sizes=freeze(np.array(sizes, dtype=np.float32)),
    )


@njit
def road_of(atlas: Atlas, m: int) -> Road:
    """The road of map m of an atlas."""
    field, sides, s = atlas.field[atlas.bounds[m, 0] : atlas.bounds[m + 1, 0]], atlas.sides[m], atlas.sizes[m]
    return Road(field, sides[0], sides[1], s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7])


@njit
def network_of(atlas: Atlas, m: int) -> Network:
    """The lanes of map m of an atlas."""
    here, there = atlas.bounds[m], atlas.bounds[m + 1]
    lanes = atlas.lanes
    return Network(
        lanes.points[here[1] : there[1]],
        lanes.speeds[here[1] : there[1]],
        lanes.offsets[here[2] + m : there[2] + m + 1],
        lanes.steps[here[2] : there[2]],
        lanes.successors[here[2] : there[2]],
        lanes.left[here[2] : there[2]],
        lanes.right[here[2] : there[2]],
        lanes.crossing_offsets[here[2] + m : there[2] + m + 1],
        lanes.crossings[here[3] : there[3]],
        lanes.clear[here[3] : there[3]],
        lanes.yields[here[7] : there[7]],
        lanes.room[here[1] : there[1]],
        lanes.boxes[here[2] : there[2]],
        lanes.lines[here[4] : there[4]],
        lanes.signals[here[2] : there[2]],
        lanes.program_offsets[here[5] + m : there[5] + m + 1],
        lanes.programs[here[6] : there[6]],
        atlas.sizes[m, 0],
        atlas.sizes[m, 1],
        atlas.sizes[m, 8],
    )
