"""The vehicle models: what moves a car within a control period. Each is a file like `single_track.py`, with

Parameters, parameters   a vehicle's numbers as kernels read them: a type of its own, so that kernels are compiled
for one model
hold(model, constants, car)
a number that holds for a control period, which `move` gets as `held`
move(model, constants, car, held, x, y, cosine, sine, speed, acceleration, dt)
moves for dt seconds with the car's steering angle; pose (m, m, heading as cosine and
sine), speed m/s, acceleration m/s2. Returns: (x, y, cosine, sine, speed, signed path
length in m)
front_velocity(model, constants, car)
velocity (m/s) of the middle of the front axle, where the sensor is: (along the heading,
to the left)
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
    """A function for kernels: that of the model whose parameters its first argument is."""
    functions = {model.Parameters: getattr(model, name) for model in MODELS.values()}

    def function(model, *rest):
        raise NotImplementedError

    @overload(function)
    def of_model(model, *rest):
        chosen = functions[getattr(model, "instance_class", type(None))]
        return lambda model, *rest: chosen(model, *rest)

    return function


hold, move, front_velocity = map(_by_model, ("hold", "move", "front_velocity"))
