"""The constants of the simulated world, each with its unit and its source, and the configuration of a run."""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import combinations_with_replacement, product
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from gridsim.car.models import MODELS, Numbers
from gridsim.errors import GridSimError
from gridsim.reading import limits_of, number, quantity, read_yaml, shown
from gridsim.state import POSE

_F = np.float32

FILE_SPEEDS = (5.0, 12.0)  # m/s, speed interval of a map file that gives none, before `SimConfig.file_speeds` scales it
SUBSTEP = _F(1.0)  # units (`SimConfig.unit`) that a car moves between two collision checks, at most
REENTRY = _F(12.0)  # units driven within which a car that returns to a visit cell is still on the same visit

# Lanes. Own choices, unless a source is named.
CROSSING_GAP = 1.5  # m between two lanes' centre lines below which they cross; lanes side by side are 3 m apart or more

# Traffic, besides `TrafficConfig`; float32 because kernels read them as globals. Own choices, unless a source is named.
TRAFFIC_PACE = 0.5  # traffic's speed on a straight / (lower + upper end of the speed interval); 0.5 is the middle
SLOWEST_DRIVER, DRIVER_SPREAD = _F(0.9), _F(0.3)  # desired speed = lane's speed * (0.9 to 1.2, uniform)
SPAWN_SPEED = _F(0.5)  # share of the desired speed, at the start of an episode
LANE_CHANGE_PERIOD = 1.0  # s between two decisions whether to change lanes
LANE_CHANGE_SIGHT = _F(100.0)  # m within which other cars matter to a lane change
# m sideways per (m ahead)^2: tolerance for bends, as lanes are taken to be straight when the ego car's lane is judged
NEIGHBOUR_WIDENING = _F(0.004)
# A car looks ahead by `jam` + LOOK_AHEAD m + its way in LOOK_AHEAD_TIME s + its braking distance at `comfort` m/s2.
LOOK_AHEAD, LOOK_AHEAD_TIME = _F(8.0), _F(1.5)
CAUTION = _F(0.25)  # m, added on every side of a car that might be in the way
STOP_LINE_GAP = _F(0.25)  # m between a waiting car and the stop line; small, so that its rear clears a junction behind
SWERVE_RADIUS = _F(16.0)  # m, least radius of the arcs by which a car moves sideways, as in the curved road's bends
STEEPEST_SWERVE = _F(0.2)  # m sideways per m driven, at most
LANE_CHANGE_ALONE = _F(20.0)  # m; a car changes lanes only if no car on a third lane is changing lanes this near
KEEP_LANE = _F(30.0)  # m before a junction, or a lane without a neighbour, within which cars stay in their lane
SKEW = _F(0.05)  # m; neighbours' points with the same index count as side by side if neither is farther ahead than this
WALKING_PACE = _F(2.0)  # m/s below which a car at a junction counts as standing, or as about to stop
JUNCTION_MARGIN = _F(0.5)  # m that a car's rear must be beyond a crossing before the other lane is free

# How traffic meets the ego car.
MEETING_DISTANCE = _F(35.0)  # m within which a car keeps to the right for an oncoming or crossing ego car
SAME_WAY_COSINE = _F(0.3)  # cosine of the angle between two headings above which the cars go the same way or merge
FORESIGHT = _F(3.0)  # s for which a car predicts the ego car's motion
FORESIGHT_STEP = _F(0.25)  # s between predicted positions, at least
EMERGENCY_BRAKING = _F(6.0)  # m/s2 with which a car is taken to be able to stop before a predicted collision

# Junctions.
STANDING = _F(0.1)  # m/s below which a car in a junction stands, for GRIDLOCK
GRIDLOCK = _F(60.0)  # s that a car stands in a junction before it is taken away (SUMO's time-to-teleport is 300)
CROSSING_TIME = _F(7.0)  # s to clear a junction from a standstill (critical gaps of drivers are 6 to 7 s)
PRIORITY_TIME = _F(4.0)  # s; a car gives way to cars with priority that would arrive less than this after its entry
EGO_CLEARANCE = _F(7.0)  # m; cars do not enter a junction on a lane this close to the ego car (exceptions: `may_enter`)
EGO_BEHIND = _F(2.5)  # m to the side within which an ego car behind a car is taken to follow it
EGO_INSIDE = _F(0.5)  # m; the ego car blocks a lane if its side is this close to the lane's centre line
EGO_SECTOR_COSINE = _F(0.6)  # cosine of the angle to the ego car's heading within which that car may soon be


@dataclass(frozen=True)
class _Vehicle:
    """The numbers of a vehicle that every vehicle model may read."""

    length: float = quantity(4.0, 0.2, 30.0, "m")
    width: float = quantity(2.0, 0.1, 5.0, "m")
    wheelbase: float = quantity(2.5, 0.1, 25.0, "m")
    rear_axle: float = quantity(1.25, 0.05, 25.0, "m")  # centre of mass to rear axle (l_r of Kong et al. 2015)
    steering_limit: float = quantity(27.0, 1.0, 80.0, "degrees")  # either side
    steering_rate: float = quantity(60.0, 1.0, 1e5, "degrees/s")  # also back to the centre
    speed_limit: float = quantity(30.0, 0.5, 150.0, "m/s")  # forward
    reverse_limit: float = quantity(3.0, 0.0, 50.0, "m/s")  # backward
    acceleration: float = quantity(3.0, 0.1, 50.0, "m/s2")  # forward and in reverse
    braking: float = quantity(8.0, 0.1, 50.0, "m/s2")
    # m/s2, half of g (Polack et al. 2017); math.inf is the paper's pure kinematic model. With full braking, a car has
    # 9.4 m/s2 in all: less than g, and than the 11.5 m/s2 of CommonRoad's friction circle (Althoff et al. 2017).
    lateral_grip: float = quantity(4.9, 0.1, math.inf, "m/s2")
    model: str = "kinematic"  # a key of `car.models.MODELS`
    latency: float = quantity(0.0, 0.0, 2.0, "s")  # by which commands are late


@dataclass(frozen=True)
class VehicleConfig(Numbers, _Vehicle):
    """The car: its size, the limits of engine, brakes, steering and tyres, and what only some models of it read."""


@dataclass(frozen=True)
class SensorConfig:
    """The simulated range sensor at the middle of the front axle."""

    rays: int = quantity(31, 2, 256)
    field_of_view: float = quantity(120.0, 1.0, 240.0, "degrees")  # centred on the heading
    range: float = quantity(50.0, 1.0, 63.0, "m")  # an observation has ranges / `range`, in [0, 1]
    noise: float = quantity(0.0, 0.0, 10.0, "m")  # standard deviation of a reading
    noise_share: float = quantity(0.0, 0.0, 1.0)  # added to `noise`, as a share of the measured distance
    dropout: float = quantity(0.0, 0.0, 1.0)  # share of readings that are the full range, whatever is there
    latency: float = quantity(0.0, 0.0, 2.0, "s")  # by which readings are late


@dataclass(frozen=True)
class EpisodeConfig:
    """When an episode ends, and what counts as distance."""

    control_period: float = quantity(0.1, 0.005, 1.0, "s")
    target: float = quantity(2000.0, 0.1, 1e6, "m")  # of new ground, at which an episode succeeds
    time_limit: float = quantity(400.0, 0.1, 1e5, "s")
    patience: float = quantity(1.5, 0.01, 1e6, "s")  # of idling after which an episode ends (the paper's sanity check)
    progress: float = quantity(0.5, 0.0, 100.0, "m/s")  # new ground per time below which a car idles
    revisit: float = quantity(200.0, 0.0, 1e6, "m")  # driven before the same ground counts again

    @property
    def steps(self) -> int:
        """The time limit in control steps."""
        return round(self.time_limit / self.control_period)


@dataclass(frozen=True)
class TrafficConfig:
    """How other cars drive: IDM (Treiber et al. 2000, city values) and MOBIL (Kesting et al. 2007)."""

    acceleration: float = quantity(2.0, 1e-6, 50.0, "m/s2")  # a of IDM
    comfort: float = quantity(2.0, 0.1, 50.0, "m/s2")  # comfortable deceleration, b of IDM
    braking: float = quantity(8.0, 1e-6, 50.0, "m/s2")  # greatest deceleration
    headway: float = quantity(1.2, 0.0, 100.0, "s")  # T of IDM
    jam: float = quantity(2.0, 0.1, 100.0, "m")  # bumper to bumper at standstill, s0 of IDM
    lateral: float = quantity(3.0, 0.1, 50.0, "m/s2")  # greatest lateral acceleration in bends
    politeness: float = quantity(0.2, 0.0, 10.0)  # p of MOBIL
    threshold: float = quantity(0.2, 0.0, 50.0, "m/s2")  # acceleration that a lane change must gain
    safe_braking: float = quantity(3.0, 0.0, 50.0, "m/s2")  # most that a car or its new follower may brake for a change
    lane_change_speed: float = quantity(1.25, 0.1, 10.0, "m/s")  # sideways, at most
    verge: float = quantity(0.3, 0.0, 10.0, "m")  # from the road's edge to a car that has moved to the right, at least
    give_way: float = quantity(0.9, 0.0, 10.0, "m")  # that a car moves to the right for the ego car, at most
    taper: float = quantity(0.1, 0.001, 1.0)  # m per m of lane, by which the room for giving way changes at most
    beside: float = quantity(0.35, 0.0, 10.0, "m")  # between the sides of cars on crossing lanes, at least
    spawn_gap: float = quantity(14.0, 0.1, 1000.0, "m")  # between two cars' middles at an episode's start, at least
    spawn_gap_ego: float = quantity(22.0, 0.1, 1000.0, "m")  # the same between a car and the ego car
    courtesy: float = quantity(10.0, 0.0, 1000.0, "m")  # waiting behind what stands this close is not idle
    lights: bool = True  # whether there are traffic lights, where a road has them
    city_lights: bool = False  # whether two streets of each `city` have traffic lights, if `lights`


MOST_STEPS = 65_535  # control steps of an episode, at most
LENGTH = 4.0  # m, length of the car for which roads are sized: its unit (`SimConfig.unit`) is 1 m
LEAST_UNIT = 1 / 16  # m, the smallest `SimConfig.unit`


@dataclass(frozen=True)
class SimConfig:
    """The simulator's parameters that do not depend on the scenario."""

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    # Name, least and greatest value of each number of the vehicle that is drawn for each episode, uniformly.
    randomise: tuple[tuple[str, float, float], ...] = ()

    def drawn(self, start: np.ndarray) -> SimConfig:
        """The configuration with one episode's vehicle; the same configuration if `randomise` is empty.

        The seed is the pose in the episode's start, float32 [5 or more].
        """
        if not self.randomise:
            return self
        rng = np.random.default_rng(
            np.random.SeedSequence(np.asarray(start[:POSE], dtype=np.float32).view(np.uint32).tolist())
        )
        values: dict[str, Any] = {name: float(rng.uniform(least, most)) for name, least, most in self.randomise}
        return replace(self, vehicle=replace(self.vehicle, **values), randomise=())

    @classmethod
    def load(cls, source: SimConfig | str | os.PathLike[str]) -> SimConfig:
        """The configuration of a preset, by its name, or of a YAML file, by its path; see docs/own.md.

        Values that a file lacks are those of the preset that it names as its `base`, or else the defaults. A SimConfig
        is returned as it is. Raises: GridSimError.
        """
        if isinstance(source, SimConfig):
            return source
        if not names_file(name := os.fspath(source)):
            return _preset(name)
        path = Path(name)
        try:
            return cls.of(read_yaml(path))
        except GridSimError as error:
            raise GridSimError(str(error) if str(error).startswith(name) else f"{path}: {error}") from None

    @classmethod
    def of(cls, values: Any) -> Self:
        """A checked configuration from a mapping like that of a file; None is an empty one. Raises: GridSimError."""
        values = {} if values is None else values
        if not isinstance(values, Mapping):
            raise GridSimError(f"give some of {', '.join(LIMITS)} as keys with values, not {shown(values)}")
        _check_names("", values, [*LIMITS, "base", "randomise"])
        base = _preset(str(values["base"])) if "base" in values else SimConfig()
        parts = {}
        for part, limits in LIMITS.items():
            given = {} if values.get(part) is None else values[part]
            if not isinstance(given, Mapping):
                raise GridSimError(f"{part}: give some of {', '.join(limits)} as keys with values, not {shown(given)}")
            before = getattr(base, part)
            _check_names(f"{part}.", given, [f.name for f in dataclasses.fields(before)])
            others = {name: n if isinstance(n, bool) else str(n) for name, n in given.items() if name not in limits}
            numbers = {name: number(given[name], f"{part}.{name}", *limits[name]) for name in given if name in limits}
            whole = {name: int(n) for name, n in numbers.items() if isinstance(limits[name][0], int) and n == int(n)}
            parts[part] = dataclasses.replace(before, **others, **numbers | whole)
        config = cls(**parts, randomise=_ranges(values.get("randomise") or {}) or base.randomise)
        config.check()
        return config

    @cached_property
    def unit(self) -> float:
        """The unit in m: 1, or for cars shorter than 2.83 m one of 1/2, 1/4, 1/8 and 1/16.

        Generated roads, walls and the resolution of maps are sized in units. The speed intervals of generated roads,
        and of map files that give none, are multiplied by the square root of the unit (Froude's law); speeds in
        `vehicle` are not.
        """
        return max(2.0 ** min(round(math.log2(self.vehicle.length / LENGTH)), 0), LEAST_UNIT)

    @property
    def pace(self) -> float:
        """Factor of speeds and times on a road that is scaled by `unit`."""
        return math.sqrt(self.unit)

    @property
    def file_speeds(self) -> tuple[float, float]:
        """The speed interval (m/s) of a map file that gives none."""
        return FILE_SPEEDS[0] * self.pace, FILE_SPEEDS[1] * self.pace

    def check(self) -> None:
        """Raises: GridSimError for a value that has a wrong type, is out of its limits, or does not fit the others."""
        for part, limits in LIMITS.items():
            for name, limit in limits.items():
                value = getattr(getattr(self, part), name)
                number(value, f"{part}.{name}", *limit)
                if isinstance(limit[0], int) and not isinstance(value, (int, np.integer)):
                    raise GridSimError(f"{part}.{name} must be a whole number, not {shown(value)}")
        for name, *ends in self.randomise:
            _check_names("randomise.", {name: ends}, list(LIMITS["vehicle"]))
            least, most = (number(end, f"randomise.{name}", *LIMITS["vehicle"][name]) for end in ends)
            if not least <= most < math.inf:
                raise GridSimError(f"randomise.{name} must be least and most, not {least:g} and {most:g}")
            for length in (least, most) if name == "length" else ():
                if replace(self, vehicle=replace(self.vehicle, length=length)).unit != self.unit:
                    text = f"roads are not scaled for cars of {length:g} m, but for one of {self.vehicle.length:g} m"
                    raise GridSimError(f"randomise.length: {text}")
        drawn: dict[str, Any] = {name: least for name, least, _ in self.randomise}
        for (one, *ends), (other, *others) in combinations_with_replacement(self.randomise, 2):
            for end, other_end in product(ends, others):  # two numbers that are drawn may contradict each other
                vehicle = replace(self.vehicle, **drawn | {one: end, other: other_end})
                replace(self, vehicle=vehicle, randomise=()).check()
        vehicle, traffic, episode = self.vehicle, self.traffic, self.episode
        if vehicle.model not in MODELS:
            raise GridSimError(f"vehicle.model must be {' or '.join(MODELS)}, not {shown(vehicle.model)}")
        for name in ("lights", "city_lights"):
            if not isinstance(value := getattr(traffic, name), bool):
                raise GridSimError(f"traffic.{name} must be true or false, not {shown(value)}")
        if not vehicle.rear_axle < vehicle.wheelbase:
            text = f"below vehicle.wheelbase, {vehicle.wheelbase:g} m: the centre of mass lies between the axles"
            raise GridSimError(f"vehicle.rear_axle must be {text}, not {vehicle.rear_axle:g}")
        reach = LIMITS["sensors"]["range"][1] * self.unit  # below half the shortest side of generated maps
        if self.sensors.range > reach:
            text = f"at most {reach:g} m for a car of {vehicle.length:g} m"
            raise GridSimError(f"sensors.range must be {text}, not {self.sensors.range:g}")
        apart = vehicle.length + traffic.jam
        for name in ("spawn_gap", "spawn_gap_ego"):
            if getattr(traffic, name) < apart:
                text = f"at least vehicle.length plus traffic.jam, {apart:g} m"
                raise GridSimError(f"traffic.{name} must be {text}, not {getattr(traffic, name):g}")
        if not 1 <= episode.steps <= MOST_STEPS:
            text = f"1 to {MOST_STEPS:,} times episode.control_period, {episode.control_period:g} s"
            raise GridSimError(f"episode.time_limit must be {text}, not {episode.time_limit:g}")


#: (least value, greatest value, unit such as "m") of each number, by part and name: `LIMITS["vehicle"]["length"]`.
LIMITS = {name: limits_of(part) for name, part in vars(SimConfig()).items() if dataclasses.is_dataclass(part)}


def _ranges(given: Any) -> tuple[tuple[str, float, float], ...]:
    """`SimConfig.randomise` from a mapping of names to [least, most], or from its own rows. Raises: GridSimError."""
    try:
        rows = [(name, *ends) for name, ends in given.items()] if isinstance(given, Mapping) else given
        return tuple((str(name), float(least), float(most)) for name, least, most in rows)
    except (TypeError, ValueError):
        raise GridSimError(f"randomise needs names with [least, most], not {shown(given)}") from None


def names_file(name: str) -> bool:
    """Whether a name, of a scenario or a preset, is meant as a file's path: it has a dot or a slash."""
    return "." in name or os.sep in name


def _check_names(where: str, given: Mapping[Any, Any], known: list[str]) -> None:
    """Raises: GridSimError for a name that is not known; the message names the most similar known name, or all."""
    for name in given:
        if name not in known:
            like = difflib.get_close_matches(str(name), known, 1)
            remedy = f"did you mean {like[0]}?" if like else f"there are: {', '.join(known)}"
            raise GridSimError(f"unknown key {where}{shown(name)[:60]}; {remedy}")


@cache
def _preset(name: str) -> SimConfig:
    """A preset of this package. Raises: GridSimError."""
    folder = Path(__file__).parent / "presets"
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in names:
        like = difflib.get_close_matches(name, names, 1)
        remedy = f"did you mean {like[0]}?" if like else f"there are: {', '.join(names)}, and files (.yaml)"
        raise GridSimError(f"unknown simulator {shown(name)}; {remedy}")
    return SimConfig.of(read_yaml(folder / f"{name}.yaml"))


class Constants(NamedTuple):
    """Numbers of `SimConfig` as kernels read them, in SI units and radians; traffic's are `traffic.behaviour.Drivers`.

    It is not a NumPy record, because kernels that read one run 2 to 4 % slower, though they compile a fifth faster.
    """

    half_length: np.float32  # m
    half_width: np.float32  # m
    front_axle: np.float32  # m ahead of the centre of mass
    rear_axle: np.float32  # m behind the centre of mass
    rear_share: np.float32  # l_r / (l_f + l_r)
    steering_limit: np.float32  # rad
    steering_step: np.float32  # rad per control period
    speed_limit: np.float32  # m/s
    reverse_limit: np.float32  # m/s
    acceleration: np.float32  # m/s2
    braking: np.float32  # m/s2
    grip: np.float32  # m/s2
    dt: np.float32  # s
    rays: np.int32
    ray_range: np.float32  # m
    ray_first: np.float32  # rad, angle from the heading to the rightmost ray, negative
    ray_step: np.float32  # rad, from a ray to the next one to the left
    progress: np.float32  # m of new ground in a control step, below which a car idles
    revisit: np.float32  # m
    patience: np.int32  # control steps of idling after which an episode ends
    courtesy: np.float32  # m
    contact: np.float32  # m between the middles of two cars, below which they may touch
    near: np.float32  # m from the car's middle, within which other cars matter to a control step
    unit: np.float32  # m, `SimConfig.unit`
    pace: np.float32  # `SimConfig.pace`


def constants(config: SimConfig) -> Constants:
    """Check a configuration and convert it for the kernels. Raises: GridSimError if a value is invalid."""
    config.check()
    vehicle, sensors, episode = config.vehicle, config.sensors, config.episode
    view = math.radians(sensors.field_of_view)
    # `near` reaches all cars that a car can touch in a control step, in which two cars approach each other by at most
    # `approach` m, and all those behind which it may wait (`courtesy`).
    approach = 2.0 * vehicle.speed_limit * episode.control_period
    near = math.hypot(vehicle.length + config.traffic.courtesy, vehicle.width) + approach
    f = np.float32
    return Constants(
        half_length=f(vehicle.length / 2),
        half_width=f(vehicle.width / 2),
        front_axle=f(vehicle.wheelbase - vehicle.rear_axle),
        rear_axle=f(vehicle.rear_axle),
        rear_share=f(vehicle.rear_axle / vehicle.wheelbase),
        steering_limit=f(math.radians(vehicle.steering_limit)),
        steering_step=f(math.radians(vehicle.steering_rate) * episode.control_period),
        speed_limit=f(vehicle.speed_limit),
        reverse_limit=f(vehicle.reverse_limit),
        acceleration=f(vehicle.acceleration),
        braking=f(vehicle.braking),
        grip=f(vehicle.lateral_grip),
        dt=f(episode.control_period),
        rays=np.int32(sensors.rays),
        ray_range=f(sensors.range),
        ray_first=f(-view / 2),
        ray_step=f(view / (sensors.rays - 1)),
        progress=f(episode.progress * episode.control_period),
        revisit=f(episode.revisit),
        patience=np.int32(max(round(episode.patience / episode.control_period), 1)),
        courtesy=f(config.traffic.courtesy),
        contact=f(math.hypot(vehicle.length, vehicle.width) * 1.001),  # the factor is for rounding
        near=f(near),
        unit=f(config.unit),
        pace=f(config.pace),
    )
