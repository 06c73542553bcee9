"""The vehicle models: what moves a car within a control period. Each is a file like `single_track.py`, with

* `Parameters` and `parameters(vehicle)`: a vehicle's numbers as kernels read them. Each model has a type of its own for
  them, so that kernels are compiled for one model;
* `move(model, constants, car, curvature, x, y, cosine, sine, speed, acceleration, dt)`: moves for dt seconds with the
  car's steering angle. Args: pose (m, m, heading as cosine and sine), speed m/s, acceleration m/s2; curvature (1/m) of
  the kinematic model. Returns: (x, y, cosine, sine, speed, signed path length in m);
* `front_velocity(model, constants, car)`: velocity (m/s) of the middle of the front axle, where the sensor is, along
  the heading and to the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numba.core.extending import overload

from gridsim.car import kinematic, single_track

MODELS: dict[str, Any] = {"kinematic": kinematic, "single_track": single_track}


@dataclass(frozen=True)
class Numbers(single_track.Numbers):
    """The numbers of a vehicle that only some models read."""


def _by_model(name: str) -> Any:
    """A function for kernels: it calls the function `name` of the model whose `Parameters` its first argument is."""
    functions = {model.Parameters: getattr(model, name) for model in MODELS.values()}

    def function(model, *rest):
        raise NotImplementedError

    @overload(function)
    def of_model(model, *rest):
        chosen = functions[getattr(model, "instance_class", type(None))]
        return lambda model, *rest: chosen(model, *rest)

    return function


move, front_velocity = _by_model("move"), _by_model("front_velocity")
