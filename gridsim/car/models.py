"""The vehicle models: what moves a car within a control period. A further model is a file like `single_track.py`.

A model's parameters are a type of their own, None for the kinematic one, so that kernels are compiled for one model.
"""

from __future__ import annotations

import math

from gridsim.car import vehicle as kinematic
from gridsim.car.single_track import SingleTrack, advance_single_track, single_track
from gridsim.config import VehicleConfig
from gridsim.errors import GridSimError
from gridsim.jit import leaf
from gridsim.state import SLIP, SPEED, STEERING, YAW_RATE

Model = SingleTrack | None
MODELS = {"kinematic": lambda vehicle: None, "single_track": single_track}


def model_of(vehicle: VehicleConfig) -> Model:
    """The parameters of a vehicle's model. Raises: GridSimError for an unknown one."""
    if vehicle.model not in MODELS:
        raise GridSimError(f"vehicle.model must be {' or '.join(MODELS)}, not {vehicle.model!r}")
    return MODELS[vehicle.model](vehicle)


@leaf
def move(model, constants, car, x, y, cosine, sine, speed, acceleration, curvature, dt):
    """Move for dt seconds, with the car's steering angle. Arguments and result as those of `vehicle.advance`."""
    if model is None:
        return kinematic.advance(constants, x, y, cosine, sine, speed, acceleration, curvature, dt)
    after = min(max(speed + acceleration * dt, -constants.reverse_limit), constants.speed_limit)
    x, y, cosine, sine, speed, car[YAW_RATE], car[SLIP], length = advance_single_track(
        model, x, y, cosine, sine, speed, car[YAW_RATE], car[SLIP], car[STEERING], (after - speed) / dt, dt
    )
    return x, y, cosine, sine, speed, length


@leaf
def front_velocity(model, constants, car):
    """Velocity (m/s) of the middle of the front axle, where the sensor is: (along the heading, to the left)."""
    if model is None:
        return kinematic.front_velocity(constants, car[SPEED], car[STEERING])
    along, aside = car[SPEED] * math.cos(car[SLIP]), car[SPEED] * math.sin(car[SLIP])
    return along, aside + constants.front_axle * car[YAW_RATE]
