"""A route to follow: which way to go where a road forks, for drivers who have somewhere to go.

A route is a random walk over the lanes. A place on it is a lane, the metres along that lane, and a key, from which
SplitMix64 draws the next lane and the next key. So a route has no end and takes three numbers of a car's state; what
lies ahead is found by walking on. An episode's first key follows from its start: the same start has the same route,
whoever drives.

The car's place on its route is the route's point nearest to the car, found by moving from the previous step's place,
forwards or back.
"""

from __future__ import annotations

import numpy as np

from gridsim.counter import mix, uniform
from gridsim.errors import GridSimError
from gridsim.jit import ONE, ZERO, F, I, U, exact, njit
from gridsim.maps.map import Map
from gridsim.maps.network import lane_length, successor, wrapped_any
from gridsim.state import COS, POSE, ROUTE_ALONG, ROUTE_KEY, ROUTE_LANE, SIN, X, Y

AHEAD = (F(5.0), F(10.0), F(20.0), F(40.0))  # points that a car sees, in units (`SimConfig.unit`) along its route
ASTRAY = F(6.0)  # units (`SimConfig.unit`) from the route beyond which an episode ends
_OPPOSITE = F(1e8)  # m2, added for lanes that lead the other way; more than any squared distance on a map
_KEYS = U((1 << 24) - 1)  # float32 holds all whole numbers up to here


def check_lanes(road_map: Map, features: tuple[str, ...]) -> None:
    """Raises: GridSimError if a route is to be followed on a map without lanes."""
    if "route" in features and len(road_map.starts):
        raise GridSimError(f"{road_map.name} has no lanes to follow: use a policy without +route")


@exact
def _following(network, lane, key):
    """The lane that follows a lane on a route, and its key, which decides the lane after it."""
    bits = mix(key)
    return successor(network, lane, uniform(bits)), bits & _KEYS | U(1)


@exact
def _walk(network, place, metres):
    """The place (lane, metres along it, key) some metres further along a route."""
    lane, along, key = place
    along += metres
    while along > lane_length(network, lane):
        along -= lane_length(network, lane)
        lane, key = _following(network, lane, key)
    return lane, along, key


@exact
def _point(network, place):
    """x, y (m) of a place on a route."""
    lane, along, _ = place
    first, step = U(network.offsets[U(lane)]), network.steps[U(lane)]
    k = min(U(I(along / step)), U(network.offsets[U(lane) + U(1)]) - first - U(2))
    part, k = along / step - F(I(k)), first + k
    x, y = network.points[k, 0], network.points[k, 1]
    return x + part * (network.points[k + U(1), 0] - x), y + part * (network.points[k + U(1), 1] - y)


@exact
def _place(car):
    """The place of a car on its route."""
    return I(car[ROUTE_LANE]), car[ROUTE_ALONG], U(I(car[ROUTE_KEY]))


@exact
def _beside(network, car, k):
    """Where a car is relative to the segment that begins at point k of the network.

    Returns: the car's projection on the segment, as a share of the segment's length; the squared distance (m2) to the
    segment; and the segment's component along the car's heading (m), below 0 if it leads the other way.
    """
    x, y = network.points[k, 0], network.points[k, 1]
    ux, uy = network.points[k + U(1), 0] - x, network.points[k + U(1), 1] - y
    dx, dy = wrapped_any(car[X] - x, network.width), wrapped_any(car[Y] - y, network.height)
    share = (dx * ux + dy * uy) / max(ux * ux + uy * uy, F(1e-12))
    part = min(max(share, ZERO), ONE)
    dx, dy = dx - part * ux, dy - part * uy
    return share, dx * dx + dy * dy, ux * car[COS] + uy * car[SIN]


@njit(_nrt=False, fastmath=False)
def begin_route(network, start, car):
    """Begin the route of a car that has been put at `start`, or continue the route that the start names.

    A new route begins on the nearest lane that leads in the car's direction, or if none does, on the nearest lane.
    """
    goes_on = start.shape[0] > POSE and start[POSE + 1] > ZERO
    best = F(np.inf)
    for lane in range(network.steps.shape[0]):
        box = network.boxes[lane]
        beside_x = max(abs(wrapped_any(car[X] - box[0], network.width)) - box[2], ZERO)
        beside_y = max(abs(wrapped_any(car[Y] - box[1], network.height)) - box[3], ZERO)
        if (goes_on and F(lane) != start[POSE]) or beside_x * beside_x + beside_y * beside_y > best:
            continue
        first = network.offsets[lane]
        for k in range(first, network.offsets[lane + 1] - 1):
            share, away, leads = _beside(network, car, U(k))
            if leads <= ZERO:
                away += _OPPOSITE
            if away < best:
                best, part = away, min(max(share, ZERO), ONE)
                car[ROUTE_LANE], car[ROUTE_ALONG] = F(lane), (F(k - first) + part) * network.steps[lane]
    if network.steps.shape[0] > 0:
        drawn = mix(U(I(car[X] * F(4096.0))) << U(32) ^ U(I(car[Y] * F(4096.0))))
        car[ROUTE_KEY] = start[POSE + 1] if goes_on else F(drawn & _KEYS | U(1))


@njit(_nrt=False, fastmath=False)
def follow_route(network, car, most):
    """Move a car's place on its route to the route's point nearest to the car, but not back to an earlier lane.

    It moves by at most `most` m plus one step between a lane's points. Returns: how far it moved (m, negative
    backwards), and the car's squared distance (m2) from the new place.
    """
    lane, before, key = _place(car)
    progress, way = ZERO, 0
    at = min(I(before / network.steps[lane]), network.offsets[lane + 1] - network.offsets[lane] - 2)
    while True:
        first, step = network.offsets[lane], network.steps[lane]
        share, away, _ = _beside(network, car, U(first + at))
        along = (F(at) + min(max(share, ZERO), ONE)) * step
        progress += along - before
        before = along
        if share > ONE and way >= 0 and progress < most:
            way, at = 1, at + 1
            if first + at + 1 == network.offsets[lane + 1]:
                lane, key = _following(network, lane, key)
                at, before = 0, ZERO
        elif share < ZERO and way <= 0 and at > 0 and progress > -most:
            way, at = -1, at - 1
        else:
            car[ROUTE_LANE], car[ROUTE_ALONG], car[ROUTE_KEY] = F(lane), along, F(key)
            return progress, away


@exact
def read(simulation, car, values):
    """Write to `values` float32 [8] where the four points of AHEAD are, relative to the car and its heading.

    First how far ahead each point is, then how far to the left, both as shares of its distance along the route.
    """
    network, place, metres = simulation.network, _place(car), ZERO
    for k in range(len(AHEAD)):
        further = AHEAD[k] * simulation.constants.unit
        place, metres = _walk(network, place, further - metres), further
        x, y = _point(network, place)
        dx, dy = wrapped_any(x - car[X], network.width), wrapped_any(y - car[Y], network.height)
        values[k] = (dx * car[COS] + dy * car[SIN]) / metres
        values[len(AHEAD) + k] = (dy * car[COS] - dx * car[SIN]) / metres


@njit(nogil=True)
def _points_ahead(network, unit, cars, points):
    for n in range(len(cars)):
        place, metres = _place(cars[n]), ZERO
        for k in range(len(AHEAD)):
            place, metres = _walk(network, place, AHEAD[k] * unit - metres), AHEAD[k] * unit
            points[n, k, 0], points[n, k, 1] = _point(network, place)


def points_ahead(road_map: Map, cars: np.ndarray) -> np.ndarray:
    """Points at the distances AHEAD on the routes of cars in states [n, CAR_FIELDS], for pictures.

    Returns: float32 [n, points, 2], x, y (m, not wrapped over the torus); empty [n, 0, 2] if the cars have no route.
    """
    points = np.empty((len(cars), len(AHEAD) if cars[0, ROUTE_KEY] else 0, 2), dtype=np.float32)
    if points.size:
        _points_ahead(road_map.network, road_map.road.unit, cars, points)
    return points
