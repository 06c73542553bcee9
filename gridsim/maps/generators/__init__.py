"""The scenarios: each file of this folder is one, named like it. Its `SCENARIO` lays out maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridsim.maps.lanes import Plan
from gridsim.maps.roads import THICK_WALL


@dataclass(frozen=True)
class Scenario:
    """A kind of road: its layout and its driving limitations (the paper's term)."""

    layout: Callable[[np.random.Generator], Plan]
    speed_interval: tuple[float, float]  # m/s, within which speed counts
    traffic: int = 0  # default number of other cars
    thinnest: float = THICK_WALL  # m, of its walls and parked cars
