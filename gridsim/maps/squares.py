"""Networks of roads laid square by square: graphs on a grid that wraps round, and the strips and lanes of a square."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import combinations, permutations

import numpy as np

from gridsim.maps.lanes import Path, Plan, lay_lanes
from gridsim.maps.lights import CLEARING, GO, STOP, lights_of
from gridsim.maps.roads import Strips

# Edges of a square in counter-clockwise order: east, north, west, south.
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))

PHASES = np.repeat([GO, CLEARING, STOP], [12, 3, 9])  # what a light shows in each second of its cycle

Pieces = tuple[tuple[float, float], ...]  # length (m) and curvature (1/m) of each, as in `lanes.Path`


def components(edges: np.ndarray) -> np.ndarray:
    """Which connected part each node of a grid that wraps round belongs to: int [rows * columns].

    Args: edges bool [rows, columns, 4], whether a node's edge in each of DIRECTIONS is open.
    """
    rows, columns, _ = edges.shape
    part, before = np.arange(rows * columns).reshape(rows, columns), None
    while before is None or (part != before).any():  # the least index spreads over open edges
        before = part
        for d, (dx, dy) in enumerate(DIRECTIONS):
            beyond = np.roll(part, (-dy, -dx), axis=(0, 1))
            part = np.where(edges[..., d], np.minimum(part, beyond), part)
    return np.unique(part, return_inverse=True)[1].ravel()


def rotated(x: float, y: float, quarters: int) -> tuple[float, float]:
    """A point rotated counter-clockwise by quarter turns."""
    c, s = DIRECTIONS[quarters % 4]
    return x * c - y * s, x * s + y * c


def through_square(turn: int, half: float, offset: float) -> Pieces:
    """Pieces of a lane through a square of side 2 * half, `offset` m to the right of the road's middle.

    turn: the number of sides, counter-clockwise, from the lane's entry to its exit: 1 right, 2 straight, 3 left.
    """
    if turn == 2:
        return ((2.0 * half, 0.0),)
    radius = half + offset if turn == 3 else half - offset
    return ((math.pi / 2 * radius, (1.0 if turn == 3 else -1.0) / radius),)


class Layout:
    """Strips and lanes of a network of two-lane roads, collected while it is laid.

    Args: half_road m from the centre line to the road's edge; lane_width m.
    """

    def __init__(self, half_road: float, lane_width: float):
        self.half_road, self.offset = half_road, lane_width / 2
        self.lines: list[list[float]] = []
        self.arcs: list[list[float]] = []
        self.blocks: list[list[float]] = []
        self.paths: list[Path] = []
        self.stop_lines: list[list[float]] = []
        self.programs: list[list[int]] = []  # what the light of each stop line shows in each second
        self.signals: dict[int, int] = {}  # for a lane, the number of the stop line at which cars enter it

    def line(self, x: float, y: float, end_x: float, end_y: float) -> None:
        """Add a straight road between two points."""
        self.lines.append([x, y, end_x, end_y, self.half_road])

    def join(self, x: float, y: float, half: float, arms: list[int]) -> None:
        """Add roads that join the middles of the sides `arms` of a square (side 2 * half) centred on (x, y)."""
        if len(arms) == 3:
            # Adds no road, but fills the dip of the clearance where the other three strips meet.
            dx, dy = next(DIRECTIONS[a] for a in arms if (a + 2) % 4 not in arms)
            self.line(dx * half + x, dy * half + y, x, y)
        for a, b in combinations(arms, 2):
            (ax, ay), (bx, by) = DIRECTIONS[a], DIRECTIONS[b]
            if (b - a) % 4 == 2:
                self.line(ax * half + x, ay * half + y, bx * half + x, by * half + y)
            else:
                first = math.atan2(-by, -bx)  # from the corner towards edge a's middle
                sweep = math.remainder(math.atan2(-ay, -ax) - first, 2 * math.pi)
                self.arcs.append([half * (ax + bx) + x, half * (ay + by) + y, half, first, sweep, self.half_road])

    def connect(
        self,
        x: float,
        y: float,
        half: float,
        arms: list[int],
        pieces: Callable[[int, float, float], Pieces] = through_square,
    ) -> None:
        """Add lanes from each of the sides `arms` of a square to each of the others; `pieces`: as `through_square`."""
        for entry, exit in permutations(arms, 2):
            edge_x, edge_y = rotated(half, self.offset, entry)
            way = pieces((exit - entry) % 4, half, self.offset)
            self.paths.append(Path(x + edge_x, y + edge_y, (entry + 2) * math.pi / 2, way))

    def signal(self, first: int, across: float, late: int) -> None:
        """Put traffic lights in the middle of a straight street, and split its two lanes there.

        Args: `first`, the index of the first lane's path; the other lane's is the next one; `across`, half of a stop
        line's length (m); `late`, the time (s) on the lights' clock at which a cycle of PHASES begins.
        """
        for k in (first, first + 1):
            (x, y, heading, ((length, _),)) = self.paths[k]
            dx, dy, way = math.cos(heading), math.sin(heading), ((length / 2, 0.0),)
            x_there, y_there = x + length / 2 * dx, y + length / 2 * dy
            self.paths[k] = Path(x, y, heading, way)
            self.signals[len(self.paths)] = len(self.programs)
            self.paths.append(Path(x_there, y_there, heading, way))
            self.stop_lines.append([x_there - self.offset * dy, y_there + self.offset * dx, dx, dy, across])
            self.programs.append(np.roll(PHASES, late).tolist())

    def finish(self, side: float) -> Plan:
        """The strips, and the lanes with their lights, of a square map."""
        network = lay_lanes(self.paths, side, side)
        signals = [self.signals.get(lane, -1) for lane in range(len(self.paths))]
        lines = np.array(self.stop_lines, dtype=np.float32).reshape(-1, 5)
        lines[:, :2] %= np.float32(side)
        network = network._replace(**lights_of(signals, lines, self.programs))
        return Strips.of(self.lines, self.arcs, self.blocks), network
