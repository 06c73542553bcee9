"""Several maps in one set of arrays, so that one kernel call can step cars on different maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gridsim.jit import njit
from gridsim.maps.network import Network
from gridsim.maps.roads import Road, freeze


class Atlas(NamedTuple):
    """Concatenated maps; all arrays read-only and C-contiguous."""

    field: np.ndarray  # `Road.field` of all maps
    bounds: np.ndarray  # int64 [maps + 1, 1], where each map begins in it
    sides: np.ndarray  # uint32 [maps, 2], columns and rows
    sizes: np.ndarray  # float32 [maps, 5], width and height (m), lower and upper speed (m/s), thinnest wall (m)
    lanes: Network  # the arrays of all maps' networks
    lane_bounds: np.ndarray  # int64 [maps + 1, 3], where each map's points, lanes and crossings begin


def make_atlas(roads: Sequence[Road], networks: Sequence[Network]) -> Atlas:
    """Concatenate maps. A single field, which may be large, is not copied."""
    names = [name for name in Network._fields if name not in ("width", "height")]
    lanes = {name: freeze(np.concatenate([getattr(network, name) for network in networks])) for name in names}
    fields = [road.field for road in roads]
    return Atlas(
        field=fields[0] if len(fields) == 1 else freeze(np.concatenate(fields)),
        bounds=_bounds([(field,) for field in fields]),
        sides=freeze(np.array([[r.columns, r.rows] for r in roads], dtype=np.uint32)),
        sizes=freeze(
            np.array([[r.width, r.height, r.speed_low, r.speed_high, r.thinnest] for r in roads], dtype=np.float32)
        ),
        lanes=Network(**lanes, width=networks[0].width, height=networks[0].height),
        lane_bounds=_bounds([(network.points, network.steps, network.crossings) for network in networks]),
    )


def _bounds(parts: Sequence[tuple[np.ndarray, ...]]) -> np.ndarray:
    """Where each map's arrays begin when they are concatenated: int64 [maps + 1, arrays]."""
    lengths = [[len(array) for array in part] for part in parts]
    return freeze(np.cumsum([[0] * len(parts[0]), *lengths], axis=0, dtype=np.int64))


@njit
def road_of(atlas: Atlas, m: int) -> Road:
    """Map m of an atlas."""
    here, there = atlas.bounds[m], atlas.bounds[m + 1]
    return Road(
        atlas.field[here[0] : there[0]],
        atlas.sides[m, 0],
        atlas.sides[m, 1],
        atlas.sizes[m, 0],
        atlas.sizes[m, 1],
        atlas.sizes[m, 2],
        atlas.sizes[m, 3],
        atlas.sizes[m, 4],
    )


@njit
def network_of(atlas: Atlas, m: int) -> Network:
    """The lanes of map m of an atlas."""
    here, there = atlas.lane_bounds[m], atlas.lane_bounds[m + 1]
    lanes = atlas.lanes
    return Network(
        lanes.points[here[0] : there[0]],
        lanes.speeds[here[0] : there[0]],
        lanes.offsets[here[1] + m : there[1] + m + 1],
        lanes.steps[here[1] : there[1]],
        lanes.successors[here[1] : there[1]],
        lanes.left[here[1] : there[1]],
        lanes.right[here[1] : there[1]],
        lanes.crossing_offsets[here[1] + m : there[1] + m + 1],
        lanes.crossings[here[2] : there[2]],
        lanes.clear[here[2] : there[2]],
        lanes.room[here[0] : there[0]],
        lanes.boxes[here[1] : there[1]],
        atlas.sizes[m, 0],
        atlas.sizes[m, 1],
    )
