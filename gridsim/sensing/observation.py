"""What a car sees: the features of an observation. Only this file encodes them.

The environment returns features as shares of what the sensor and the car can do (`Feature.full`); policies, exported
networks and the DQN turn these shares into the inputs of networks. To add a feature, add a row to `features` and a line
to `observe`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gridsim.config import Constants, SimConfig, constants
from gridsim.jit import ONE, ZERO, F, U, exact, freeze
from gridsim.sensing import mirrors, route
from gridsim.sensing.route import AHEAD
from gridsim.state import ROUTE_KEY, SPEED, STEERING

# m/s, the speed that networks read as 0, and the closing speed that they read as 1. Networks on rays, but not those on
# grids, multiply it by `SimConfig.pace`.
SPEED_SCALE = F(10.0)


class Feature(NamedTuple):
    """A part of an observation. Its values are in SI units, or shares (`route`), before they are encoded."""

    name: str
    values: int  # how many numbers it has
    full: np.float32  # the value that the environment returns as 1
    unit: np.float32  # the value that networks read as 1 before the shift, or if `near` as 0
    near: bool = False  # networks read a value v as 2 v / (v + unit) - 1, which resolves small values best
    least: np.float32 = -ONE  # the smallest number that the environment returns
    shift: float = 0.0  # networks read value / `Feature.unit` + shift, unless `near`
    mirror: float = 1.0  # factor of the values in a mirrored world
    reversed: bool = True  # whether the values have the opposite order in a mirrored world
    sees: str = ""  # words for help; only networks that name the feature (`mlp:64+steering`) see it; "": all on rays do


def features(k: Constants) -> tuple[Feature, ...]:
    """All features, in the order of an observation."""
    speed, slowest = (k.speed_limit, SPEED_SCALE * k.pace), -k.reverse_limit / k.speed_limit
    return (
        Feature("ranges", int(k.rays), k.ray_range, F(8.0) * k.unit, near=True, least=F(0.0)),
        Feature("motion", int(k.rays), *speed, sees="how fast the cars that rays hit approach"),
        Feature("speed", 1, *speed, least=slowest, shift=-1.0),
        Feature("steering", 1, k.steering_limit, F(0.5), mirror=-1.0, sees="its own steering angle"),
        Feature("route", len(AHEAD), ONE, ONE, shift=-1.0, reversed=False, sees="a route to follow"),
        Feature("route", len(AHEAD), ONE, ONE, mirror=-1.0, reversed=False, sees="a route to follow"),
        Feature("limit", 1, *speed, shift=-1.0, sees="the road's speed limit"),
        Feature("mirrors", 2, mirrors.REACH, F(4.0), near=True, least=F(0.0), sees="cars beside and behind"),
    )


USUAL = constants(SimConfig())
FEATURES = features(USUAL)
OPTIONAL = tuple(dict.fromkeys(feature.name for feature in FEATURES if feature.sees))
_NAMES = [feature.name for feature in FEATURES]
OWN_SPEED, ROUTE, MIRRORS = _NAMES.index("speed"), _NAMES.index("route"), _NAMES.index("mirrors")


class Encoding(NamedTuple):
    """How an observation is encoded, as kernels read it; arrays [features]."""

    # int64 [features + 1], index of each feature's first value, then the end; an unseen feature's equals the next one's
    first: np.ndarray
    near: np.ndarray  # bool
    full: np.ndarray  # float32, as the arrays below
    least: np.ndarray
    scale: np.ndarray  # for networks: full / unit, or where `near` the unit
    shift: np.ndarray

    def each(self, numbers: Iterable[float]) -> np.ndarray:
        """Numbers [features], repeated for each value of a feature: float32 [values]."""
        return np.repeat(np.array([*numbers], dtype=np.float32), np.diff(self.first))


@lru_cache
def encoding(names: tuple[str, ...], k: Constants = USUAL) -> Encoding:
    """The encoding of observations that have the features of these names and those that all networks see."""
    values = [each.values if each.name in names or not each.sees else 0 for each in features(k)]
    rows = [
        (each.near, each.full, each.least, each.unit if each.near else each.full / each.unit, each.shift)
        for each in features(k)
    ]
    near, *others = np.array(rows, dtype=np.float32).T
    return Encoding(freeze(np.cumsum([0, *values])), freeze(near > 0.0), *map(freeze, others))


def mirrored(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """How to mirror an observation: value k of the mirrored one is `factors[k] * observation[indices[k]]`.

    Returns: indices int64 [values] and factors float32 [values].
    """
    first = encoding(names).first
    order = [
        np.arange(*ends)[:: -1 if feature.reversed else 1]
        for feature, *ends in zip(FEATURES, first, first[1:], strict=False)
    ]
    return np.concatenate(order), encoding(names).each(feature.mirror for feature in FEATURES)


@exact
def sees(encoding, feature):
    """Whether observations have a feature, given by its row in `features`."""
    return encoding.first[feature] < encoding.first[feature + 1]


@exact
def _put(encoding, feature, values, observation):
    """If observations have this feature (a row of `features`), write its values / `full`, clipped to [`least`, 1]."""
    first, full, least = U(encoding.first[feature]), encoding.full[feature], encoding.least[feature]
    for i in range(U(encoding.first[feature + 1]) - first):  # unsigned, or it would not be vector code
        observation[first + i] = min(max(values[i] / full, least), ONE)


@exact
def observe(simulation, car, world, ranges, closing, observation):
    """Write the observation float32 [values] of a car, whose rays have these ranges (m) and closing speeds (m/s)."""
    encoding = simulation.encoding
    _put(encoding, 0, ranges, observation)
    _put(encoding, 1, closing, observation)
    _put(encoding, 2, (car[SPEED],), observation)
    _put(encoding, 3, (car[STEERING],), observation)
    if sees(encoding, ROUTE) and car[ROUTE_KEY] > ZERO:
        values = observation[encoding.first[ROUTE] :]
        route.read(simulation, car, values)
        _put(encoding, ROUTE, values, observation)
        _put(encoding, ROUTE + 1, values[len(AHEAD) :], observation)
    _put(encoding, 6, (simulation.road.speed_high,), observation)
    if sees(encoding, MIRRORS):
        values = observation[encoding.first[MIRRORS] :]
        mirrors.read(simulation, car, world, values)
        _put(encoding, MIRRORS, values, observation)


@exact
def normalise(encoding, observation, inputs):
    """Write the inputs float32 [values] of a network on rays (not on grids), given its observation."""
    for feature in range(encoding.full.shape[0]):
        full, scale, shift = encoding.full[feature], encoding.scale[feature], encoding.shift[feature]
        first, last = U(encoding.first[feature]), U(encoding.first[feature + 1])
        if encoding.near[feature]:
            for i in range(first, last):
                reach = observation[i] * full
                inputs[i] = F(2.0) * reach / (reach + scale) - ONE
        else:
            for i in range(first, last):
                inputs[i] = observation[i] * scale + shift
