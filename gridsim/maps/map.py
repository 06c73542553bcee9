"""A map as arrays: its road, its lanes, the lane network for traffic, and start poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from gridsim.config import START_SPEED, SimConfig
from gridsim.jit import njit
from gridsim.maps.network import Network, make_network, network_of_lanes
from gridsim.maps.roads import (
    CELLS_PER_M,
    HEADING_BINS,
    HEADING_WRAP,
    START_CELLS_PER_M,
    Lanes,
    Road,
    Strips,
    freeze,
)

ROAD_FIELDS = ("columns", "rows", "width", "height", "speed_low", "speed_high", "thin")


@dataclass(frozen=True)
class Map:
    """One map.

    Attributes:
        name: its scenario's name, or a file's path.
        seed: the seed it was built from.
        road: the drivable area as kernels read it.
        lanes: directed polylines, for starts, traffic and drivers.
        strips: the exact drivable area, for pictures and tests.
        network: the lanes as traffic's kernels read them.
        torus: whether leaving on one side means entering on the other.
        starts: float32 [n, 5], start poses of a map from a file, which has no lanes; else empty.
    """

    name: str
    seed: int
    road: Road
    lanes: Lanes
    strips: Strips
    network: Network
    torus: bool = True
    starts: np.ndarray = field(default_factory=lambda: freeze(np.zeros((0, 5), dtype=np.float32)))

    @cached_property
    def mileage(self) -> np.ndarray:
        """Cumulated length (m) at each point of `lanes`, with all lanes laid end to end: float64 [points]."""
        step = np.diff(self.lanes.points.astype(np.float64), axis=0)
        length = np.hypot(step[:, 0], step[:, 1])
        length[self.lanes.offsets[1:-1] - 1] = 0.0  # between lanes there is no road
        return freeze(np.concatenate([[0.0], np.cumsum(length)]))

    def arrays(self) -> dict[str, np.ndarray]:
        """The map as plain arrays, which processes can share without copying."""
        scalars = np.array([float(getattr(self.road, name)) for name in ROAD_FIELDS] + [self.seed, self.torus])
        return {
            "name": np.frombuffer(self.name.encode(), dtype=np.uint8),
            "scalars": scalars,
            "field": self.road.field,
            "start_row": self.road.start_row,
            "start": self.road.start,
            **vars(self.lanes),
            **vars(self.strips),
            "speeds": self.network.speeds,
            "clear": self.network.clear,
            "room": self.network.room,
            "starts": self.starts,
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Map:
        """The inverse of `arrays`. The arrays are not copied, and become read-only."""
        frozen = {key: freeze(value) for key, value in arrays.items()}
        columns, rows, width, height, low, high, thin, seed, torus = frozen["scalars"]
        f = np.float32
        lanes = Lanes(**{f.name: frozen[f.name] for f in fields(Lanes)})
        return cls(
            name=frozen["name"].tobytes().decode(),
            seed=int(seed),
            road=Road(
                frozen["field"],
                frozen["start_row"],
                frozen["start"],
                np.uint32(columns),
                np.uint32(rows),
                f(width),
                f(height),
                f(low),
                f(high),
                np.uint32(thin),
            ),
            lanes=lanes,
            strips=Strips(**{f.name: frozen[f.name] for f in fields(Strips)}),
            network=network_of_lanes(lanes, frozen["speeds"], frozen["clear"], frozen["room"], width, height),
            torus=bool(torus),
            starts=frozen["starts"],
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Unpickle with read-only arrays: for writable ones, Numba would compile the kernels again."""
        return Map.from_arrays, (self.arrays(),)

    def __deepcopy__(self, memo: dict[int, Any]) -> Map:
        """It cannot be changed, so that copies share it."""
        return self


def blank(config: SimConfig) -> Map:
    """A map of 8 m x 8 m without any road, used to compile kernels before the first map is built."""
    side = 8
    lanes, f = Lanes.none(), np.float32
    return Map(
        name="blank",
        seed=0,
        road=Road(
            field=freeze(np.zeros((side * CELLS_PER_M) ** 2, dtype=np.uint32)),
            start_row=freeze(np.full((side * START_CELLS_PER_M) ** 2, -1, dtype=np.int32)),
            start=freeze(np.zeros(HEADING_BINS + HEADING_WRAP, dtype=np.uint8)),
            columns=np.uint32(side * CELLS_PER_M),
            rows=np.uint32(side * CELLS_PER_M),
            width=f(side),
            height=f(side),
            speed_low=f(0.0),
            speed_high=f(1.0),
            thin=np.uint32(1),
        ),
        lanes=lanes,
        strips=Strips(np.zeros((0, 5)), np.zeros((0, 6)), np.zeros((0, 5))),
        network=make_network(lanes, side, side, 1.0, config.traffic),
    )


@njit
def _starts_at(points, mileage, shares, speed, starts):
    for k in range(shares.shape[0]):
        metres = shares[k] * mileage[-1]
        i = min(np.searchsorted(mileage, metres, side="right"), len(mileage) - 1) - 1
        part = (metres - mileage[i]) / max(mileage[i + 1] - mileage[i], 1e-9)
        x, y = points[i, 0], points[i, 1]
        dx, dy = points[i + 1, 0] - x, points[i + 1, 1] - y
        starts[k, 0], starts[k, 1] = x + part * dx, y + part * dy
        starts[k, 2], starts[k, 3], starts[k, 4] = math.atan2(dy, dx), speed, 0.0


def starts_at(road_map: Map, shares: np.ndarray) -> np.ndarray:
    """Starts float32 [n, 5], at rest, at these shares float64 [n] in [0, 1) of the total length of the lanes.

    A start is x, y (m), heading (rad), speed (m/s), steering (rad), on the lane's centre line and along it. On a map
    without lanes, shares index `Map.starts`.
    """
    if not len(road_map.lanes):
        return road_map.starts[(np.asarray(shares) * len(road_map.starts)).astype(np.intp)]
    starts = np.empty((len(shares), 5), dtype=np.float32)
    _starts_at(freeze(road_map.lanes.points), road_map.mileage, shares, np.float32(START_SPEED), starts)
    return starts


def sample_starts(road_map: Map, count: int, rng: np.random.Generator) -> np.ndarray:
    """Starts float32 [count, 5] uniformly over the lanes; see `starts_at`."""
    return starts_at(road_map, rng.random(count))
