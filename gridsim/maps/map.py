"""A map as arrays: its road, its lanes, and start poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from gridsim.jit import F, freeze, njit
from gridsim.maps.lanes import lay_lanes
from gridsim.maps.network import Network
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR, THICK_WALL, Road, Strips, make_road


@dataclass(frozen=True, eq=False)
class Map:
    """One map. Maps are compared by identity."""

    name: str  # the road's name in the registry, or the absolute path of the map's file, with its crop if any
    seed: int  # the smallest seed of its part that gives this map, if the scenario is only its road (`parts.road_of`)
    road: Road
    strips: Strips  # the exact drivable area of a generated road, for pictures and tests; empty for a file
    network: Network  # its lanes, if it has any
    torus: bool = True  # whether leaving on one side means entering on the other
    # float32 [n, 5], of a map without lanes (from a picture): where episodes begin, see `starts_at`; else empty.
    starts: np.ndarray = field(default_factory=lambda: freeze(np.zeros((0, 5), dtype=np.float32)))
    # bool [n], if the road is a single file, not a folder of them: whether episodes of the seed's part (`maps.parts`)
    # may begin on each step between the network's points; without lanes, which of the file's starts are in `starts`.
    # Empty: episodes may begin everywhere.
    begins: np.ndarray = field(default_factory=lambda: freeze(np.zeros(0, dtype=bool)))

    @property
    def size(self) -> np.ndarray:
        """Width and height (m): float64 [2]."""
        return np.array([self.road.width, self.road.height], dtype=np.float64)

    def shortest(self, offsets: np.ndarray) -> np.ndarray:
        """Differences [..., 2] of points (m), on a torus the short way round."""
        return offsets - np.round(offsets / self.size) * self.size if self.torus else offsets

    @cached_property
    def mileage(self) -> np.ndarray:
        """Cumulative length (m) at each point of the network, with all lanes laid end to end: float64 [points]."""
        step = np.diff(self.network.points.astype(np.float64), axis=0)
        length = np.hypot(step[:, 0], step[:, 1])
        length[self.network.offsets[1:-1] - 1] = 0.0  # a step from one lane to the next is no road
        return freeze(np.concatenate([[0.0], np.cumsum(length)]))

    @cached_property
    def starts_mileage(self) -> np.ndarray:
        """As `mileage`, but steps on which no episode begins have length 0."""
        if not len(self.begins):
            return self.mileage
        return freeze(np.concatenate([[0.0], np.cumsum(np.diff(self.mileage) * self.begins)]))

    def magnified(self) -> Map:
        """The map enlarged so that its unit (`SimConfig.unit`) is 1 m: pictures look alike for cars of any size.

        Only lengths that pictures need are multiplied: `starts`, speeds and stop lines are kept.
        """
        if self.road.unit == 1.0:
            return self
        road, per_m = self.road, float(self.road.per_m)
        width, height = road.width * road.per_m, road.height * road.per_m
        road = road._replace(width=width, height=height, unit=F(1.0), per_m=F(1.0))
        return replace(self, road=road, strips=self.strips.scaled(per_m), network=self.network.scaled(per_m))

    @property
    def nbytes(self) -> int:
        """Memory that the map's arrays take, in bytes."""
        return sum(part.nbytes for part in (*self.road, *self.strips, *self.network, self.starts, self.begins))

    def __getstate__(self) -> dict[str, Any]:
        """State without the cached arc lengths."""
        return {name: part for name, part in vars(self).items() if "mileage" not in name}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Unpickle with read-only arrays: for writable ones, Numba would compile the kernels again."""
        vars(self).update({name: _frozen(part) for name, part in state.items()})

    def __deepcopy__(self, memo: dict[int, Any]) -> Map:
        """Copies share the map, because it cannot be changed."""
        return self


def _frozen(part: Any) -> Any:
    """A field of a map with each array in it frozen (`jit.freeze`); numbers and text as they are."""
    if isinstance(part, tuple):
        return type(part)(*map(_frozen, part))
    return freeze(part) if isinstance(part, np.ndarray) else part


def without_lanes(
    name: str,
    nodes: np.ndarray,
    speed_interval: tuple[float, float],
    thinnest: float,
    starts: np.ndarray,
    unit: float = 1.0,
) -> Map:
    """A map without lanes, not a torus, on which episodes begin at starts float32 [n, 5], in m.

    Args: `nodes`, the clearance field [rows, columns], in units of `unit` m, as `thinnest` is; speeds in m/s.
    """
    road = make_road(nodes, speed_interval, thinnest, unit)
    network = lay_lanes([], float(road.width), float(road.height))
    return Map(name, 0, road, Strips.of(), network, torus=False, starts=freeze(starts))


def blank() -> Map:
    """A map of 8 m x 8 m without any road, used to compile kernels before the first map is built."""
    nodes = np.full((8 * CELLS_PER_UNIT, 8 * CELLS_PER_UNIT), FIELD_FLOOR, dtype=np.float32)
    return without_lanes("blank", nodes, (0.0, 1.0), THICK_WALL, np.zeros((0, 5), dtype=np.float32))


@njit
def _starts_at(points, mileage, shares, starts):
    for k in range(shares.shape[0]):
        metres = shares[k] * mileage[-1]
        i = min(np.searchsorted(mileage, metres, side="right"), len(mileage) - 1) - 1
        part = (metres - mileage[i]) / max(mileage[i + 1] - mileage[i], 1e-9)
        x, y = points[i, 0], points[i, 1]
        dx, dy = points[i + 1, 0] - x, points[i + 1, 1] - y
        starts[k, 0], starts[k, 1] = x + part * dx, y + part * dy
        starts[k, 2], starts[k, 3], starts[k, 4] = math.atan2(dy, dx), 0.0, 0.0


def starts_at(road_map: Map, shares: np.ndarray) -> np.ndarray:
    """Starts float32 [n, 5], at rest, at `shares` of the way over all lanes on which episodes begin.

    A start is x, y (m), heading (rad), speed (m/s), steering (rad), on the lane's centre line and along it. On a map
    without lanes, share s gives number s * n, rounded down, of the n starts in `Map.starts`.
    Args: `shares`, float64 [n] in [0, 1), of the length of these lanes laid end to end.
    """
    if not len(road_map.network.steps):
        return road_map.starts[(np.asarray(shares) * len(road_map.starts)).astype(np.intp)]
    starts = np.empty((len(shares), 5), dtype=np.float32)
    _starts_at(road_map.network.points, road_map.starts_mileage, shares, starts)
    return starts


def sample_starts(road_map: Map, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random starts float32 [count, 5]: those of `starts_at` for uniform shares."""
    return starts_at(road_map, rng.random(count))
