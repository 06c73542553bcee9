"""The oracle: road, rays, car and episode once more, in float64 NumPy and in textbook form.

Written from the design and the docstrings, not from the kernels, and used by tests alone. Where a kernel marches, looks
up a table or approximates, the oracle intersects lines with circles, or integrates in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from gridsim.config import SimConfig
from gridsim.maps.roads import Strips

SQUARE = 4.0  # m, side of the squares in which new ground is counted
SAME_VISIT = 12.0  # m of driving: back in a square so soon is the same visit
CHECK_EVERY = 1.0  # m that a car moves between two looks at its outline, at most
GROUP = 32.0  # m, side of the squares whose points are looked at together


# --- The road --------------------------------------------------------------------------------------------------------


class ExactRoad:
    """Capsules (lines) and round-ended annular sectors (arcs), united, without rectangles (blocks), on a torus."""

    def __init__(self, strips: Strips, width: float, height: float):
        self.width, self.height = width, height
        pieces = []  # arcs cut into pieces of a quarter turn at most: within one, two half planes bound the sector
        for cx, cy, radius, first, sweep, half_width in strips.arcs:
            n = max(1, math.ceil(abs(sweep) / (math.pi / 2) - 1e-9))
            low = min(first, first + sweep)
            pieces += [(cx, cy, radius, low + abs(sweep) * k / n, abs(sweep) / n, half_width) for k in range(n)]
        self.lines = np.array(strips.lines, dtype=np.float64).reshape(-1, 5)
        self.arcs = np.array(pieces, dtype=np.float64).reshape(-1, 6)
        self.blocks = np.array(strips.blocks, dtype=np.float64).reshape(-1, 5)

    @cached_property
    def _circles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A circle that holds each of lines, arcs and blocks, [3, n]: x, y, radius."""
        lines, arcs, blocks = self.lines.T, self.arcs.T, self.blocks.T
        length = np.hypot(lines[2] - lines[0], lines[3] - lines[1])
        return (
            np.stack([(lines[0] + lines[2]) / 2, (lines[1] + lines[3]) / 2, length / 2 + lines[4]]),
            np.stack([arcs[0], arcs[1], arcs[2] + arcs[5]]),
            np.stack([blocks[0], blocks[1], np.hypot(blocks[3], blocks[4])]),
        )

    def _near(self, x: float, y: float, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lines, arcs and blocks, with their repetitions over the torus, that may come within `radius` of a point."""
        found: tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]] = ([], [], [])
        for dx in self._shifts(x, radius, self.width):
            for dy in self._shifts(y, radius, self.height):
                moved = ([dx, dy, dx, dy, 0.0], [dx, dy, 0.0, 0.0, 0.0, 0.0], [dx, dy, 0.0, 0.0, 0.0])
                kinds = (self.lines, self.arcs, self.blocks)
                for items, circle, shift, near in zip(kinds, self._circles, moved, found, strict=True):
                    away = np.hypot(circle[0] + dx - x, circle[1] + dy - y) - circle[2]
                    near.append(items[away <= radius] + shift)
        lines, arcs, blocks = map(np.concatenate, found)
        return lines, arcs, blocks

    def _shifts(self, at: float, radius: float, side: float) -> list[float]:
        # A strip may reach a side's length beyond the map itself.
        return [k * side for k in range(math.floor((at - radius) / side) - 1, math.floor((at + radius) / side) + 2)]

    def _groups(self, points: np.ndarray) -> Iterator[tuple[np.ndarray, float, float]]:
        """Yield indices of points that lie together, and the middle of their square."""
        squares, of = np.unique(np.floor(points / GROUP), axis=0, return_inverse=True)
        for k, (x, y) in enumerate((squares + 0.5) * GROUP):
            yield np.flatnonzero(of == k), float(x), float(y)

    def clearance(self, points: np.ndarray, deepest: float = 3.0) -> np.ndarray:
        """Greatest (half width - distance to the centre line) at points [n, 2], in m, or the distance to the nearest
        block (negative inside) where that is less; below -deepest it is -deepest."""
        points = np.asarray(points, dtype=np.float64)
        result = np.full(len(points), -deepest)
        for chosen, x, y in self._groups(points):
            # No block further off than the widest strip is can be nearer than the strip's edge.
            far = max(deepest, self.lines[:, 4].max(initial=0.0), self.arcs[:, 5].max(initial=0.0))
            lines, arcs, blocks = self._near(x, y, far + GROUP * math.sqrt(0.5))
            p = points[chosen, None, :]
            a, b, w = lines[:, 0:2], lines[:, 2:4], lines[:, 4]
            along = np.vecdot(p - a, b - a) / np.maximum(((b - a) ** 2).sum(axis=1), 1e-300)
            nearest = a + np.clip(along, 0.0, 1.0)[..., None] * (b - a)
            to_lines = w - np.linalg.norm(p - nearest, axis=2)
            centre, radius, first, sweep, w = arcs[:, 0:2], arcs[:, 2], arcs[:, 3], arcs[:, 4], arcs[:, 5]
            q = p - centre
            # The nearest point of an arc has the angle of the point, or that of the nearer end.
            beyond = (np.arctan2(q[..., 1], q[..., 0]) - first) % (2 * np.pi)
            after_end = beyond - sweep
            angle = np.where(after_end <= 0, beyond, np.where(after_end < 2 * np.pi - beyond, sweep, 0.0)) + first
            nearest = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            to_arcs = w - np.linalg.norm(q - nearest, axis=2)
            beyond = np.abs(_in_frame(p - blocks[:, 0:2], blocks[:, 2])) - blocks[:, 3:5]
            to_blocks = np.linalg.norm(np.maximum(beyond, 0.0), axis=2) + np.minimum(beyond.max(axis=2), 0.0)
            on_strips = np.concatenate([to_lines, to_arcs], axis=1).max(axis=1, initial=-deepest)
            result[chosen] = np.maximum(np.minimum(on_strips, to_blocks.min(axis=1, initial=np.inf)), -deepest)
        return result

    def cast(self, origins: np.ndarray, angles: np.ndarray, reach: float) -> np.ndarray:
        """How far each ray gets before it leaves the union: [n, r] m for origins [n, 2] and directions rad [n, r]."""
        origins, angles = np.asarray(origins, dtype=np.float64), np.asarray(angles, dtype=np.float64)
        result = np.zeros(angles.shape)
        for chosen, x, y in self._groups(origins):
            lines, arcs, blocks = self._near(x, y, reach + GROUP * math.sqrt(0.5))
            p = origins[chosen].repeat(angles.shape[1], axis=0)[:, None, :]  # each ray by itself
            d = np.stack([np.cos(angles[chosen]), np.sin(angles[chosen])], axis=-1).reshape(-1, 1, 2)
            inside = [_in_capsule(p, d, lines), *_in_annular_sector(p, d, arcs)]
            low, high = (np.concatenate(ends, axis=1) for ends in zip(*inside, strict=True))
            # Within the union as long as some strip that was entered before is not left yet.
            before, t = np.full(len(p), -1.0), np.zeros(len(p))
            while (t > before + 1e-9).any():
                before = t
                t = np.maximum(t, np.where(low <= t[:, None] + 1e-9, high, 0.0).max(axis=1, initial=0.0))
            q, e = _in_frame(p - blocks[:, 0:2], blocks[:, 2]), _in_frame(d, blocks[:, 2])
            half = blocks[:, 3:5]
            enter, leave = _meet(*(_between(q[..., k], e[..., k], -half[:, k], half[:, k]) for k in (0, 1)))
            hit = np.where(leave > 0.0, np.maximum(enter, 0.0), np.inf)
            result[chosen] = np.minimum(t, hit.min(axis=1, initial=reach)).reshape(len(chosen), -1)
        return result

    def outline_on_road(self, poses: np.ndarray, half_length: float, half_width: float) -> np.ndarray:
        """Whether a car's outline is on the road, as rays from corner to corner arrive: bool [n] for poses [n, 3]."""
        poses = np.asarray(poses, dtype=np.float64)
        on, corner = np.ones(len(poses), dtype=bool), corners(poses, half_length, half_width)
        for k in range(4):  # counter-clockwise, from the front right
            side = 2 * (half_width, half_length)[k % 2]
            angle = poses[:, 2] + (k + 1) * math.pi / 2
            on &= self.cast(corner[:, k], angle[:, None], side)[:, 0] >= side - 1e-7
        return on

    def widened(self, margin: float) -> ExactRoad:
        """The road with its edges moved outwards by `margin` (m), inwards if that is negative."""
        wider = ExactRoad(Strips(self.lines, self.arcs, self.blocks), self.width, self.height)
        wider.lines[:, 4] += margin
        wider.arcs[:, 5] += margin
        wider.blocks[:, 3:5] -= margin
        return wider


def _in_frame(vectors: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Vectors [n, k, 2] seen from frames with these headings [k]: along and to the left."""
    c, s = np.cos(heading), np.sin(heading)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([x * c + y * s, y * c - x * s], axis=-1)


def _between(p: np.ndarray, d: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> tuple:
    """Where low <= p + t d <= high: t from, t to; (inf, -inf) where nowhere."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - p) / d, (high - p) / d
    still = d == 0
    within = still & (low <= p) & (p <= high)
    first = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(a, b))
    last = np.where(still, np.where(within, np.inf, -np.inf), np.maximum(a, b))
    return first, last


def _in_disc(p: np.ndarray, d: np.ndarray, radius: np.ndarray) -> tuple:
    """Where |p + t d| <= radius, for unit vectors d."""
    b = np.vecdot(p, d)
    root = b * b - np.vecdot(p, p) + np.where(radius > 0, radius, 0.0) ** 2
    hit = (root >= 0) & (radius > 0)
    root = np.sqrt(np.maximum(root, 0.0))
    return np.where(hit, -b - root, np.inf), np.where(hit, -b + root, -np.inf)


def _meet(*intervals: tuple) -> tuple:
    """Intersection of intervals, empty as (inf, -inf)."""
    low = np.maximum.reduce([i[0] for i in intervals])
    high = np.minimum.reduce([i[1] for i in intervals])
    return np.where(low <= high, low, np.inf), np.where(low <= high, high, -np.inf)


def _in_capsule(p: np.ndarray, d: np.ndarray, lines: np.ndarray) -> tuple:
    """Where rays [n, 1, 2] are within capsules [k]: one interval, because a capsule is convex."""
    a, b, w = lines[:, 0:2], lines[:, 2:4], lines[:, 4]
    length = np.linalg.norm(b - a, axis=1)
    u = np.where(length[:, None] > 0, b - a, [1.0, 0.0]) / np.where(length > 0, length, 1.0)[:, None]
    v = np.stack([-u[:, 1], u[:, 0]], axis=1)
    q = p - a
    along = _between(np.vecdot(q, u), np.vecdot(d, u), 0.0, length)
    box = _meet(along, _between(np.vecdot(q, v), np.vecdot(d, v), -w, w))
    parts = (box, _in_disc(q, d, w), _in_disc(p - b, d, w))
    return np.minimum.reduce([i[0] for i in parts]), np.maximum.reduce([i[1] for i in parts])


def _in_annular_sector(p: np.ndarray, d: np.ndarray, arcs: np.ndarray) -> list[tuple]:
    """Where rays [n, 1, 2] are within round-ended annular sectors [k]: four intervals each."""
    centre, radius, first, last, w = arcs[:, 0:2], arcs[:, 2], arcs[:, 3], arcs[:, 3] + arcs[:, 4], arcs[:, 5]
    q = p - centre
    e0 = np.stack([np.cos(first), np.sin(first)], axis=1)
    e1 = np.stack([np.cos(last), np.sin(last)], axis=1)
    n0, n1 = np.stack([-e0[:, 1], e0[:, 0]], axis=1), np.stack([e1[:, 1], -e1[:, 0]], axis=1)
    sector = _meet(*(_between(np.vecdot(q, n), np.vecdot(d, n), 0.0, np.inf) for n in (n0, n1)))
    outer = _meet(sector, _in_disc(q, d, radius + w))
    hole = _in_disc(q, d, radius - w)
    before = _meet(outer, (np.full_like(hole[0], -np.inf), hole[0]))
    behind = _meet(outer, (hole[1], np.full_like(hole[1], np.inf)))
    ends = [_in_disc(q - radius[:, None] * e, d, w) for e in (e0, e1)]
    return [before, behind, *ends]


# --- The car ---------------------------------------------------------------------------------------------------------


def act(config: SimConfig, action: int, speed: float, steering: float) -> tuple[float, float]:
    """(acceleration m/s2, steering rad after the period) of one of the paper's eight actions, in its order:
    accelerate, left, right, brake, none, accelerate-left, accelerate-right, reverse."""
    vehicle, dt = config.vehicle, config.episode.control_period
    wanted = math.radians(vehicle.steering_limit) * {1: 1, 5: 1, 2: -1, 6: -1}.get(action, 0)
    most = math.radians(vehicle.steering_rate) * dt
    steering += float(np.clip(wanted - steering, -most, most))
    if action in (0, 5, 6):
        return vehicle.acceleration, steering
    if action == 7:
        return -vehicle.acceleration, steering
    if action == 3:
        return -math.copysign(min(vehicle.braking, abs(speed) / dt), speed), steering
    return 0.0, steering


def curvature(config: SimConfig, speed: float, steering: float) -> float:
    """Curvature of the path (1/m): sin(beta) / l_r, held to what the tyres can do at this speed."""
    vehicle = config.vehicle
    beta = math.atan(vehicle.rear_axle / vehicle.wheelbase * math.tan(steering))
    most = vehicle.lateral_grip / speed**2 if speed else math.inf
    return float(np.clip(math.sin(beta) / vehicle.rear_axle, -most, most))


def path_length(config: SimConfig, speed: float, acceleration: float, t: float) -> tuple[float, float]:
    """(m driven, speed in m/s) after t seconds of constant acceleration, up to the speed limits."""
    limit = config.vehicle.speed_limit if acceleration > 0 else -config.vehicle.reverse_limit
    until = (limit - speed) / acceleration if acceleration else math.inf
    if t <= until:
        return speed * t + acceleration * t * t / 2, speed + acceleration * t
    return speed * until + acceleration * until**2 / 2 + limit * (t - until), limit


def on_arc(config: SimConfig, pose: tuple, kappa: float, s: float) -> tuple:
    """Pose (x, y, heading) after s m on a path of constant curvature: the integral of (cos, sin)(psi + beta + kappa s)
    ds."""
    x, y, heading = pose
    course = heading + math.asin(kappa * config.vehicle.rear_axle)
    if abs(kappa) < 1e-9:
        return x + s * math.cos(course), y + s * math.sin(course), heading + kappa * s
    after = course + kappa * s
    dx, dy = (math.sin(after) - math.sin(course)) / kappa, (math.cos(course) - math.cos(after)) / kappa
    return x + dx, y + dy, heading + kappa * s


def advance(config: SimConfig, pose: tuple, speed: float, steering: float, acceleration: float) -> np.ndarray:
    """One control period: the moments at which the car's outline is looked at, [n, 5]: x, y, heading, speed, m driven;
    the last of them is the end of the period."""
    dt = config.episode.control_period
    kappa = curvature(config, speed, steering)
    fastest = max(abs(speed), abs(speed + acceleration * dt))
    n = math.floor(fastest * dt / CHECK_EVERY) + 1
    looks = []
    for k in range(1, n + 1):
        s, after = path_length(config, speed, acceleration, dt * k / n)
        looks.append((*on_arc(config, pose, kappa, s), after, s))
    return np.array(looks)


# --- The episode -----------------------------------------------------------------------------------------------------


class Books:
    """New ground. A square driven again within `revisit` metres of driving counts nothing; metres reversed are owed,
    and paid before anything counts again."""

    def __init__(self, config: SimConfig, road: ExactRoad, interval: tuple[float, float], x: float, y: float):
        """Speed counts within the interval (m/s); the square of the start is new ground."""
        self.episode, self.interval, self.sides = config.episode, interval, (road.width, road.height)
        self.distance = self.paced = self.odometer = self.owed = 0.0
        self.idle, self.fresh, self.square = 0, True, self._square(x, y)
        self.last_seen = {self.square: 0.0}

    def _square(self, x: float, y: float) -> tuple[int, int]:
        return int(x % self.sides[0] // SQUARE), int(y % self.sides[1] // SQUARE)

    def enter(self, x: float, y: float, speed: float, moved: float) -> None:
        """Book one control step that moved the car to (x, y)."""
        self.odometer += abs(moved)
        square = self._square(x, y)
        if square != self.square:
            ago = self.odometer - self.last_seen.get(square, -math.inf)
            if ago > self.episode.revisit:
                self.fresh = True
            elif ago > SAME_VISIT:
                self.fresh = False
            self.square = square
        self.last_seen[square] = self.odometer
        gained = 0.0
        if moved < 0:
            self.owed += -moved
        else:
            paid = min(self.owed, moved)
            self.owed -= paid
            gained = moved - paid if self.fresh else 0.0
        self.distance += gained
        if self.interval[0] <= speed <= self.interval[1]:
            self.paced += gained
        self.idle = self.idle + 1 if gained < self.episode.progress * self.episode.control_period else 0


def drive(config, road, interval, start, actions, target, max_steps):
    """Drive a whole episode from start (x, y, heading, speed, steering) under given actions. Returns a row a control
    step, float64 [n, 7]: x, y (not wrapped over the torus), heading, speed, steering, distance, distance at a speed
    within the interval; and the name of its End, "RUNNING" if the actions ran out."""
    x, y, heading, speed, steering = map(float, start)
    books = Books(config, road, interval, x, y)
    steps, angles = [], []
    for action in actions:
        acceleration, steering = act(config, int(action), speed, steering)
        steps.append(advance(config, (x, y, heading), speed, steering, acceleration))
        x, y, heading, speed = map(float, steps[-1][-1, :4])
        angles.append(steering)
    every = np.concatenate(steps)
    on_road = road.outline_on_road(every[:, :3], config.vehicle.length / 2, config.vehicle.width / 2)
    each_on = np.split(on_road, np.cumsum([len(looks) for looks in steps[:-1]]))
    rows, end = [], "RUNNING"
    for looks, on, angle in zip(steps, each_on, angles, strict=True):
        x, y, heading, speed, driven = looks[-1 if on.all() else on.argmin()]
        books.enter(x, y, speed, driven)
        rows.append((x, y, heading, speed, angle, books.distance, books.paced))
        if not on.all():
            end = "COLLISION"
        elif books.idle * config.episode.control_period >= config.episode.patience - 1e-9:
            end = "IDLE"
        elif books.distance >= target:
            end = "SUCCESS"
        elif len(rows) >= max_steps:
            end = "TIME"
        if end != "RUNNING":
            break
    return np.array(rows), end


# --- Other cars ------------------------------------------------------------------------------------------------------


def corners(poses: np.ndarray, a: float, b: float) -> np.ndarray:
    """Corners [n, 4, 2], counter-clockwise, at poses [n, 3] (x, y, heading); half length a, half width b (m)."""
    own = np.array([[a, -b], [a, b], [-a, b], [-a, -b]])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)
    return poses[:, None, :2] + own @ turn


def rays_to_boxes(config, sides, origin, angles, poses, margin):
    """How far rays [r] (rad) from one origin get before they meet an edge of a car at poses [n, 3], in this world or in
    those beside it, where outlines are wider by `margin`: m [r], inf if not, 0 from within a car."""
    shifts = np.array([[i * sides[0], j * sides[1], 0.0] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    a, b = config.vehicle.length / 2 + margin, config.vehicle.width / 2 + margin
    outlines = corners((poses[:, None] + shifts).reshape(-1, 3), a, b) - origin
    first, edge = outlines, np.roll(outlines, -1, axis=1) - outlines
    if (_cross(edge, -first) > 0.0).all(axis=1).any():  # to the left of all four edges
        return np.zeros(len(angles))
    d = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        way, part = _cross(first, edge) / _cross(d, edge), _cross(first, d) / _cross(d, edge)
    hit = (way >= 0.0) & (part >= 0.0) & (part <= 1.0)
    return np.where(hit, way, np.inf).reshape(len(angles), -1).min(axis=1)


def idm(config: SimConfig, speed: float, desired: float, gap: float, leader: float) -> float:
    """Acceleration (m/s2) by Treiber, Hennecke and Helbing 2000: gap m from bumper to bumper, inf without a leader."""
    t = config.traffic
    approach = speed * (speed - leader) / (2 * math.sqrt(t.acceleration * t.comfort))
    wanted = t.jam + max(0.0, speed * t.headway + approach)
    return max(t.acceleration * (1 - (speed / desired) ** 4 - (wanted / gap) ** 2), -t.braking)


def equilibrium_gap(config: SimConfig, speed: float, desired: float) -> float:
    """Gap (m) at which a follower neither gains nor loses: s_e(v) = (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    t = config.traffic
    return (t.jam + speed * t.headway) / math.sqrt(1 - (speed / desired) ** 4)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
