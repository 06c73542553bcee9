"""Traffic alone: whether its cars run into each other or come to a stop, hour after hour.

    python benchmarks/traffic.py [--hours 1 | --ego [200]] [--seeds 20] [--cars N] [--scenario NAME] [--json]

Each scenario's default number of cars (6 where that is 0) drives on so many maps for so many simulated hours, with no
ego car. One row per scenario:

    cars        on a map, of those that found room to start
    overlaps    pairs of cars that overlap, counted in every control step: must be 0
    speed       m/s, mean of all cars over all the time
    worst map   m/s, the same of the slowest map
    at the end  m/s, the same of the slowest map in the last tenth of the time, which gridlock would lower
    open road   m/s, mean speed of a car that drives everywhere as fast as the lanes allow
    stood       s, the longest that any car stood still

Exits with 1 if there is an overlap, or a map where cars are at the end less than half as fast as on an open road.

With --ego, 24 cars drive for two minutes around an ego car that stands, at so many starts. One row per scenario, and
exit code 1 if one of these is not 0:

    egos hit    starts at which a car of the traffic touched the ego car
    off road    control steps of cars in which a part of the car was off the road
"""

from __future__ import annotations

import argparse
import json
import sys
import time

import numpy as np

from gridsim.collision import boxes_touch, collides
from gridsim.config import SimConfig, constants
from gridsim.jit import njit
from gridsim.maps.map import sample_starts
from gridsim.maps.network import Network, wrapped
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import REGISTRY, build
from gridsim.state import CAR_FIELDS as FIELDS
from gridsim.state import COS, LANE, SIN, SPEED, X, Y
from gridsim.traffic.behaviour import drivers
from gridsim.traffic.behaviour import step_traffic as flow
from gridsim.traffic.encounters import touches_ego
from gridsim.traffic.world import spawn

CARS = 6  # where the scenario's default is none
CARS_AROUND, SECONDS_AROUND = 24, 120.0  # an ego car that stands


@njit(nogil=True)
def soak(network, drivers, constants, world, steps, stood) -> tuple[int, float, float]:
    """Let traffic flow for so many control steps.

    Args: world [cars, FIELDS], changed; stood int64 [cars], steps for which each car has stood by now, changed.
    Returns: (overlaps, sum of all cars' speeds over all steps in m/s, most steps for which any car stood).
    """
    nobody = np.zeros(5, dtype=np.float32)
    nobody[X] = np.inf  # no ego car is near
    overlaps, total, longest = 0, 0.0, 0
    for _ in range(steps):
        flow(network, drivers, world, nobody)
        for i in range(world.shape[0]):
            car = world[i]
            if car[LANE] < 0.0:
                continue
            total += car[SPEED]
            stood[i] = stood[i] + 1 if car[SPEED] < 0.1 else 0
            longest = max(longest, stood[i])
            for j in range(i):
                if world[j, LANE] >= 0.0:
                    dx = wrapped(world[j, X] - car[X], network.width)
                    dy = wrapped(world[j, Y] - car[Y], network.height)
                    if dx * dx + dy * dy < constants.contact * constants.contact and boxes_touch(
                        constants, dx, dy, car[COS], car[SIN], world[j, COS], world[j, SIN]
                    ):
                        overlaps += 1
    return overlaps, total, longest


def open_road(network: Network) -> float:
    """Mean speed (m/s), over all lanes, of a car that drives everywhere as fast as they allow."""
    metres = np.repeat(network.steps.astype(np.float64), np.diff(network.offsets))
    return float(metres.sum() / (metres / network.speeds).sum())


def measure(scenario: str, cars: int, seeds: int, hours: float) -> dict[str, float]:
    """One row of the table."""
    sim = SimConfig()
    k, others, period = constants(sim), drivers(sim), sim.episode.control_period
    steps = round(hours * 3600 / period)
    parts = [steps - steps // 10, steps // 10]
    totals, ends, frees, present, overlaps, longest = [], [], [], [], 0, 0
    for seed in range(seeds):
        network = build(scenario, HELD_OUT_SEED + seed, sim).network
        start = np.full((1, 5), 1e6, dtype=np.float32)
        world = spawn(network, start, cars, np.array([seed], dtype=np.uint64), sim)[0]
        there = max(int((world[:, LANE] >= 0).sum()), 1)
        stood = np.zeros(cars, dtype=np.int64)
        means = []
        for part in parts:
            touched, total, most = soak(network, others, k, world, part, stood)
            overlaps, longest = overlaps + touched, max(longest, most)
            means.append(total / there / max(part, 1))
        totals.append((means[0] * parts[0] + means[1] * parts[1]) / steps)
        ends.append(means[1])
        frees.append(open_road(network))
        present.append(there)
    return {
        "cars": float(np.mean(present)),
        "overlaps": overlaps,
        "speed": float(np.mean(totals)),
        "worst map": min(totals),
        "at the end": min(ends),
        "open road": float(np.mean(frees)),
        "gridlocks": int(sum(end < free / 2 for end, free in zip(ends, frees, strict=True))),
        "stood": longest * period,
    }


@njit(nogil=True)
def stand(road, network, drivers, constants, world, ego, steps) -> tuple[bool, int]:
    """Let traffic flow around an ego car that stands, for so many control steps.

    Returns: (whether a car touched it, control steps of cars in which a part of the car was off the road).
    """
    hit, off = False, 0
    for _ in range(steps):
        flow(network, drivers, world, ego)
        for i in range(world.shape[0]):
            car = world[i]
            if car[LANE] >= 0.0:
                hit |= touches_ego(network, drivers, car, ego)
                off += collides(road, constants, car[X], car[Y], car[COS], car[SIN])
    return hit, off


def measure_ego(scenario: str, cars: int, maps: int, starts: int) -> dict[str, int]:
    """One row of the table with --ego."""
    sim = SimConfig()
    built = [build(scenario, HELD_OUT_SEED + seed, sim) for seed in range(min(maps, starts))]
    hits = off = 0
    for seed in range(starts):
        here = built[seed % len(built)]
        start = sample_starts(here, 1, np.random.default_rng(seed))
        world = spawn(here.network, start, cars, np.array([seed], dtype=np.uint64), sim)[0]
        ego = np.zeros(FIELDS, dtype=np.float32)
        ego[[X, Y]] = start[0, :2] % [here.network.width, here.network.height]
        ego[[COS, SIN]] = np.cos(start[0, 2]), np.sin(start[0, 2])
        steps = round(SECONDS_AROUND / sim.episode.control_period)
        hit, outside = stand(here.road, here.network, drivers(sim), constants(sim), world, ego, steps)
        hits, off = hits + hit, off + outside
    return {"egos hit": hits, "off road": off}


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--hours", type=float, default=1.0, help="simulated, on each map (1)")
    parser.add_argument(
        "--ego", type=int, nargs="?", const=200, default=0, metavar="STARTS", help="around an ego car that stands (200)"
    )
    parser.add_argument("--seeds", type=int, default=20, help="maps of each scenario (20)")
    parser.add_argument("--cars", type=int, default=0, help="on each map, in place of the scenario's default")
    parser.add_argument("--scenario", choices=sorted(REGISTRY), help="this one alone")
    parser.add_argument("--json", action="store_true", help="print one flat JSON object of numbers, nothing else")
    options = parser.parse_args()
    if options.seeds < 1 or not 0.0 < options.hours <= 1000.0 or min(options.cars, options.ego) < 0:
        parser.error("--seeds must be 1 or more, --hours above 0, --cars and --ego 0 or more")
    columns = ("cars", "overlaps", "speed", "worst map", "at the end", "open road", "gridlocks", "stood")
    if options.ego:
        columns = ("egos hit", "off road")
    if not options.json:
        print(f"{'':<12}" + "".join(f"{name:>11}" for name in columns) + f"{'took, s':>10}")
    failed, flat = False, {}
    for name in [options.scenario] if options.scenario else REGISTRY:
        began = time.perf_counter()
        if options.ego:
            row = measure_ego(name, options.cars or CARS_AROUND, options.seeds, options.ego)
        else:
            row = measure(name, options.cars or REGISTRY[name].traffic or CARS, options.seeds, options.hours)
        failed |= any(row.get(key) for key in ("overlaps", "gridlocks", "egos hit", "off road"))
        flat.update({f"{name}_{key.replace(' ', '_')}": value for key, value in row.items()})
        if not options.json:
            figures = "".join(
                f"{row[key]:>11.0f}" if row[key] == int(row[key]) else f"{row[key]:>11.2f}" for key in columns
            )
            print(f"{name:<12}{figures}{time.perf_counter() - began:>10.1f}", flush=True)
    if options.json:
        print(json.dumps(flat))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
