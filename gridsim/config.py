"""The constants of the simulated world, each with its unit and its source."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

_F = np.float32

FILE_SPEEDS = (5.0, 12.0)  # m/s, speed interval of a map file that gives none
SUBSTEP = _F(1.0)  # m a car moves between collision checks, at most
REENTRY = _F(12.0)  # m driven; returning to a cell within this distance still counts as the same visit

# The reward of Trasnea et al. (2019).
PROGRESS_SHARE = 0.15  # weight of the distance, and also of the speed
CLEARANCE_SHARE = 0.7  # weight of the shortest ray
CRASH_REWARD = -1.0

# Lanes. Own choices, unless a source is named.
CROSSING_GAP = 1.5  # m between two lanes' centre lines below which they cross; lanes side by side are 3 m apart

# Traffic, besides `TrafficConfig`; float32 because kernels read them as globals. Own choices, unless a source is named.
TRAFFIC_PACE = 0.5  # traffic's speed on a straight, as a share of lower + upper speed: the middle of the interval
SLOWEST_DRIVER, DRIVER_SPREAD = _F(0.9), _F(0.3)  # desired speed as a share of the lane's: least, and range above it
SPAWN_SPEED = _F(0.5)  # share of the desired speed, at the start of an episode
LANE_CHANGE_PERIOD = _F(10.0)  # control steps between two decisions whether to change lanes
LANE_CHANGE_SIGHT = _F(100.0)  # m within which other cars matter to a lane change
NEIGHBOUR_WIDENING = _F(0.004)  # m per m2 of distance: tolerance of the ego car's lane, judged along a straight line
# A car looks ahead the jam distance, LOOK_AHEAD m, the distance driven in LOOK_AHEAD_TIME s, and that of braking.
LOOK_AHEAD, LOOK_AHEAD_TIME = _F(8.0), _F(1.5)
CAUTION = _F(0.25)  # m, added on every side of a car that might be in the way
STOP_LINE_GAP = _F(0.25)  # m between a waiting car and the stop line; small, so that its rear clears a junction behind
SWERVE_RADIUS = _F(16.0)  # m, least radius of the arcs by which a car moves sideways; bends are as tight
STEEPEST_SWERVE = _F(0.2)  # m sideways per m driven, at most
LANE_CHANGE_ALONE = _F(20.0)  # m within which only one car at a time changes to or from a lane
WALKING_PACE = _F(2.0)  # m/s below which a car in a junction may be about to stop
JUNCTION_MARGIN = _F(0.5)  # m that a car's rear must be beyond a conflict before the other lane is free

# How traffic meets the ego car.
MEETING_DISTANCE = _F(35.0)  # m within which a car keeps to the right for the oncoming ego car
SAME_WAY_COSINE = _F(0.3)  # of the angle between headings; above it, both cars go the same way or merge
FORESIGHT = _F(3.0)  # s for which a car predicts the ego car's motion
FORESIGHT_STEP = _F(0.25)  # s between predicted positions, at least
EMERGENCY_BRAKING = _F(6.0)  # m/s2 with which a car would stop before a predicted collision

# Junctions.
CROSSING_TIME = _F(7.0)  # s to clear a junction from a standstill (critical gaps of drivers are 6 to 7 s)
EGO_CLEARANCE = _F(7.0)  # m around the ego car in which no car enters a junction
EGO_BEHIND = _F(2.5)  # m to the side within which the ego car, if it is behind, follows a car
EGO_INSIDE = _F(0.5)  # m; the ego car blocks a lane if its side is this close to the lane's centre line
EGO_SECTOR_COSINE = _F(0.6)  # of the angle from the ego car's heading within which it may soon be


@dataclass(frozen=True)
class VehicleConfig:
    """The car: its size, and the limits of engine, brakes, steering and tyres."""

    length: float = 4.0  # m
    width: float = 2.0  # m
    wheelbase: float = 2.5  # m
    rear_axle: float = 1.25  # m, centre of mass to rear axle (l_r of Kong et al. 2015)
    steering_limit: float = 27.0  # degrees either side
    steering_rate: float = 60.0  # degrees/s, towards the commanded angle and back to the centre
    speed_limit: float = 30.0  # m/s forward
    reverse_limit: float = 3.0  # m/s backward
    acceleration: float = 3.0  # m/s2, forward and in reverse
    braking: float = 8.0  # m/s2
    # m/s2, half of g (Polack et al. 2017); math.inf is the paper's pure kinematic model. With full braking it is 9.4:
    # less than g, and than the 11.5 of CommonRoad's friction circle (Althoff et al. 2017).
    lateral_grip: float = 4.9
    # kinematic, or single_track with what follows: linear tyres, without the limit of `lateral_grip`. The numbers are
    # those of CommonRoad's vehicle 2, a BMW 320i (Althoff et al. 2017).
    model: str = "kinematic"
    mass: float = 1093.3  # kg
    yaw_inertia: float = 1791.6  # kg m2
    mass_height: float = 0.6137  # m, of the centre of mass
    friction: float = 1.0489  # of tyres and road
    cornering_stiffness: float = 20.898  # 1/rad, of an axle, per load
    latency: float = 0.0  # s by which commands are late


@dataclass(frozen=True)
class SensorConfig:
    """The simulated range sensor at the middle of the front axle."""

    rays: int = 31
    field_of_view: float = 120.0  # degrees, centred on the heading
    range: float = 50.0  # m; readings are ranges / range, in [0, 1]
    noise: float = 0.0  # m, standard deviation of a reading
    noise_share: float = 0.0  # the same, as a share of the range
    dropout: float = 0.0  # share of readings that are the full range, whatever is there
    latency: float = 0.0  # s by which readings are late


@dataclass(frozen=True)
class EpisodeConfig:
    """When an episode ends, and what counts as distance."""

    control_period: float = 0.1  # s
    target: float = 2000.0  # m of new ground: success
    time_limit: float = 400.0  # s
    patience: int = 15  # control steps without progress that end an episode (the paper's sanity check)
    progress: float = 0.05  # m of new ground; a step with less is without progress
    revisit: float = 200.0  # m of driving within which the same ground does not count again

    @property
    def steps(self) -> int:
        """The time limit in control steps."""
        return round(self.time_limit / self.control_period)


@dataclass(frozen=True)
class TrafficConfig:
    """How other cars drive: IDM (Treiber et al. 2000, city values) and MOBIL (Kesting et al. 2007)."""

    acceleration: float = 2.0  # m/s2, a of IDM
    comfort: float = 2.0  # m/s2, comfortable deceleration, b of IDM
    braking: float = 8.0  # m/s2, greatest deceleration
    headway: float = 1.2  # s, T of IDM
    jam: float = 2.0  # m, bumper to bumper at standstill, s0 of IDM
    lateral: float = 3.0  # m/s2, lateral acceleration in bends
    politeness: float = 0.2  # p of MOBIL
    threshold: float = 0.2  # m/s2 that a lane change must gain
    safe_braking: float = 3.0  # m/s2 of braking that a lane change may force on the car behind
    lane_change_speed: float = 1.25  # m/s sideways, at most
    verge: float = 0.3  # m, least distance from the road's edge to the side of a car that has moved to the right
    give_way: float = 0.9  # m that a car moves to the right for oncoming cars, at most
    taper: float = 0.1  # m to the right per m driven while giving way
    beside: float = 0.35  # m between the sides of cars on crossing lanes, below which they may touch
    spawn_gap: float = 14.0  # m between two cars at the start of an episode, at least
    spawn_gap_ego: float = 22.0  # m between a car and the ego car at the start, at least
    courtesy: float = 10.0  # m; waiting behind a standing car within this distance is not idleness


@dataclass(frozen=True)
class SimConfig:
    """The simulator's parameters that do not depend on the scenario."""

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    # Numbers of the vehicle that are drawn for each episode, uniformly: name, least and most.
    randomise: tuple[tuple[str, float, float], ...] = ()

    def drawn(self, start: np.ndarray) -> SimConfig:
        """The configuration of the episode with a start float32 [5]: the same start gives the same vehicle."""
        if not self.randomise:
            return self
        rng = np.random.default_rng(
            np.random.SeedSequence(np.asarray(start, dtype=np.float32).view(np.uint32).tolist())
        )
        values: dict[str, Any] = {name: float(rng.uniform(least, most)) for name, least, most in self.randomise}
        return replace(self, vehicle=replace(self.vehicle, **values), randomise=())


class Constants(NamedTuple):
    """`SimConfig` as the kernels read it: SI units and radians."""

    half_length: np.float32  # m
    half_width: np.float32  # m
    front_axle: np.float32  # m ahead of the centre of mass
    rear_axle: np.float32  # m
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
    ray_first: np.float32  # rad, of the rightmost ray from the heading
    ray_step: np.float32  # rad
    progress: np.float32  # m
    revisit: np.float32  # m
    patience: np.int32  # steps
    courtesy: np.float32  # m
    contact: np.float32  # m between the middles of two cars, below which they may touch
    near: np.float32  # m from the car's middle, within which other cars matter to a control step


def constants(config: SimConfig) -> Constants:
    """Check a configuration and convert it for the kernels. Raises: ValueError if a value is invalid."""
    vehicle, sensors, episode = config.vehicle, config.sensors, config.episode
    for name, value in (
        ("length", vehicle.length),
        ("width", vehicle.width),
        ("wheelbase", vehicle.wheelbase),
        ("control_period", episode.control_period),
        ("lateral_grip", vehicle.lateral_grip),
        ("range", sensors.range),
    ):
        if not value > 0.0:
            raise ValueError(f"{name} must be above 0, not {value}")
    if sensors.rays < 2 or not 0.0 < sensors.field_of_view <= 240.0 or sensors.range > 63.0:
        raise ValueError("the sensor needs 2 rays or more, a field of view within 240 degrees and a range within 63 m")
    apart = vehicle.length + config.traffic.jam
    if not min(config.traffic.spawn_gap, config.traffic.spawn_gap_ego) >= apart:
        raise ValueError(f"spawn_gap and spawn_gap_ego must be at least a car's length plus jam, {apart:g} m")
    for name, *ends in config.randomise:
        if not isinstance(getattr(vehicle, name, ""), float):
            raise ValueError(f"randomise: the vehicle has no number {name!r}")
        if not ends[0] <= ends[1]:
            raise ValueError(f"randomise: {name} must be least and most, not {ends[0]:g} and {ends[1]:g}")
        for value in ends:
            changed: dict[str, Any] = {name: value}
            constants(replace(config, vehicle=replace(vehicle, **changed), randomise=()))
    if not 0.0 < vehicle.rear_axle < vehicle.wheelbase:
        raise ValueError("the centre of mass must lie between the axles")
    view = math.radians(sensors.field_of_view)
    # Two cars approach each other by at most `approach` in a control step; within courtesy, waiting is not idleness.
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
        progress=f(episode.progress),
        revisit=f(episode.revisit),
        patience=np.int32(episode.patience),
        courtesy=f(config.traffic.courtesy),
        contact=f(math.hypot(vehicle.length, vehicle.width) * 1.001),  # the factor is for rounding
        near=f(near),
    )
