"""Every constant of the simulated world, once, with its unit and its source. Change a number here, nowhere else."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

FILE_SPEEDS = (5.0, 12.0)  # m/s, the speed interval of a map from a file that names none


@dataclass(frozen=True)
class VehicleConfig:
    """The car and what its engine, brakes and tyres can do."""

    length: float = 4.0  # m
    width: float = 2.0  # m
    wheelbase: float = 2.5  # m
    rear_axle: float = 1.25  # m, centre of mass to rear axle (l_r of Kong et al. 2015)
    steering_limit: float = 27.0  # degrees either side
    steering_rate: float = 60.0  # degrees/s, towards the commanded angle and back to the centre
    speed_limit: float = 30.0  # m/s forward
    reverse_limit: float = 3.0  # m/s backward
    acceleration: float = 3.0  # m/s2 forward, and of the reverse action
    braking: float = 8.0  # m/s2
    lateral_grip: float = 4.9  # m/s2, half of g (Polack et al. 2017); math.inf is the paper's pure kinematic model


@dataclass(frozen=True)
class SensorConfig:
    """The simulated range sensor at the middle of the front axle."""

    rays: int = 31
    field_of_view: float = 120.0  # degrees, centred on the heading
    range: float = 50.0  # m; readings are ranges / range, in [0, 1]


@dataclass(frozen=True)
class EpisodeConfig:
    """When an episode ends and what counts as distance."""

    control_period: float = 0.1  # s
    target: float = 2000.0  # m of new ground: success
    time_limit: float = 400.0  # s
    patience: int = 15  # control steps without progress (the paper's sanity check)
    progress: float = 0.05  # m of new ground a step below which a step is without progress
    revisit: float = 200.0  # m of driving within which a stretch driven again counts nothing


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
    threshold: float = 0.2  # m/s2 to be gained by a change of lanes
    safe_braking: float = 3.0  # m/s2 that a change of lanes may ask of who is behind
    lane_change_speed: float = 1.25  # m/s sideways: three seconds for a lane
    kerb: float = 1.3  # m that the middle of a car which moves over keeps from the road's edge
    give_way: float = 0.9  # m to the right that it moves over for who comes the other way, at most
    taper: float = 0.15  # m a m of way that it moves over
    apart: float = 2.35  # m between the middles of two lanes below which cars on them may touch
    spawn_gap: float = 14.0  # m between two cars at the start of an episode, at least
    spawn_gap_ego: float = 22.0  # m between a car and the ego car then
    courtesy: float = 10.0  # m: standing with a standing car so near ahead is not idleness


@dataclass(frozen=True)
class SimConfig:
    """All that the simulator needs to know beside the scenario."""

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)


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
    ray_range: np.float32  # m
    ray_first: np.float32  # rad, of the rightmost ray from the heading
    ray_step: np.float32  # rad
    progress: np.float32  # m
    revisit: np.float32  # m
    patience: np.int32  # steps
    courtesy: np.float32  # m


def constants(config: SimConfig) -> Constants:
    """Convert and check a configuration.

    Raises: ValueError with one line if a number makes no sense.
    """
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
    if not 0.0 < vehicle.rear_axle < vehicle.wheelbase:
        raise ValueError("the centre of mass must lie between the axles")
    view = math.radians(sensors.field_of_view)
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
        ray_range=f(sensors.range),
        ray_first=f(-view / 2),
        ray_step=f(view / (sensors.rays - 1)),
        progress=f(episode.progress),
        revisit=f(episode.revisit),
        patience=np.int32(episode.patience),
        courtesy=f(config.traffic.courtesy),
    )
