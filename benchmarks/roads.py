"""Real roads from files: how they load, and whether traffic drives on them.

    python benchmarks/roads.py FILE... [--minutes 10] [--cars 20] [--json]

On each file so many cars drive for so many minutes, without an ego car. One row per file:

    km, lanes   of lanes, and their number
    first       s to load it without its cache, and
    again       s with it
    cars        that found room to start
    overlaps    pairs of cars that overlap, counted in every control step: must be 0
    off road    control steps of cars in which a part of the car was off the road: must be 0
    speed       m/s, mean of all cars
    together    s, the longest time for which all cars stood at once: must be below 60

Exits with 1 where one of these is not met, or a file does not load.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from gridsim.collision import boxes_touch, collides
from gridsim.config import SimConfig, constants
from gridsim.errors import GridSimError
from gridsim.jit import njit
from gridsim.maps.network import wrapped
from gridsim.maps.real import load
from gridsim.maps.scenarios import build
from gridsim.state import CAR_FIELDS, CLOCK, COS, LANE, SIN, SPEED, X, Y
from gridsim.traffic.behaviour import drivers, step_traffic
from gridsim.traffic.world import spawn

STANDS = 0.1  # m/s


@njit(nogil=True)
def drive(road, network, drivers, constants, world, steps) -> tuple[int, int, float, int]:
    """(Overlaps, control steps off the road, sum of speeds, most steps for which all cars stood at once)."""
    nobody = np.zeros(CAR_FIELDS, dtype=np.float32)
    nobody[X] = np.inf  # no ego car is near
    overlaps, off, total, stood, longest = 0, 0, 0.0, 0, 0
    for _ in range(steps):
        step_traffic(network, drivers, world, nobody)
        nobody[CLOCK] += 1.0
        moving = False
        for i in range(world.shape[0]):
            car = world[i]
            if car[LANE] < 0.0:
                continue
            total += car[SPEED]
            moving |= car[SPEED] >= STANDS
            off += collides(road, constants, car[X], car[Y], car[COS], car[SIN])
            for j in range(i):
                dx, dy = wrapped(world[j, X] - car[X], network.width), wrapped(world[j, Y] - car[Y], network.height)
                if (
                    world[j, LANE] >= 0.0
                    and dx * dx + dy * dy < constants.contact * constants.contact
                    and boxes_touch(constants, dx, dy, car[COS], car[SIN], world[j, COS], world[j, SIN])
                ):
                    overlaps += 1
        stood = 0 if moving else stood + 1
        longest = max(longest, stood)
    return overlaps, off, total, longest


def measure(name: str, cars: int, minutes: float) -> dict[str, float]:
    """One row of the table. Raises: GridSimError if the file does not load."""
    sim = SimConfig()
    load.cached(name, load.file_digest(name), load.gap_of(sim)).unlink(missing_ok=True)
    times = []
    for _ in range(2):
        started = time.perf_counter()
        here = build(name, 0, sim)
        times.append(time.perf_counter() - started)
        load.load.cache_clear()
    network, period = here.network, sim.episode.control_period
    world = spawn(network, np.full((1, 5), 1e6, np.float32), cars, np.zeros(1, np.uint64), sim)[0]
    present, steps = int((world[:, LANE] >= 0).sum()), round(minutes * 60 / period)
    overlaps, off, total, stood = drive(here.road, network, drivers(sim), constants(sim), world, steps)
    return {
        "km": float(here.mileage[-1]) / 1000,
        "lanes": len(network.steps),
        "first": times[0],
        "again": times[1],
        "cars": present,
        "overlaps": overlaps,
        "off road": off,
        "speed": total / steps / max(present, 1),
        "together": stood * period,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--cars", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    flags = parser.parse_args()
    rows, failed = {}, False
    for name in flags.files:
        try:
            row = rows[name] = measure(name, flags.cars, flags.minutes)
        except GridSimError as error:
            print(error, file=sys.stderr)
            failed = True
            continue
        failed |= bool(row["overlaps"] or row["off road"] or row["together"] >= 60.0)
        if not flags.json:
            if len(rows) == 1:
                print(f"{'':34}" + "".join(f"{key:>10}" for key in row))
            values = (f"{value:10d}" if isinstance(value, int) else f"{value:10.1f}" for value in row.values())
            print(f"{Path(name).name[:34]:34}" + "".join(values), flush=True)
    if flags.json:
        print(
            json.dumps({f"{Path(name).name} {key}": value for name, row in rows.items() for key, value in row.items()})
        )
    sys.exit(failed)


if __name__ == "__main__":
    main()
