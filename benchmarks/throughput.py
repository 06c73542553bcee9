"""Car-steps per second on one pinned core, and what surrounds them.

    python benchmarks/throughput.py [--json] [--peers]

Ego cars only, resets included, a trained policy at the wheel over several maps, medians of several runs:

    rollout_rays         car-steps/s of the fused rollout: 31 rays of 50 m, network, act, advance, collide
    vector_env_rays      car-steps/s of `env.step` of the Gymnasium vector environment with 1,024 cars
    breed_512x1000_ms    512 children of about 1,000 genes, half of them of two parents, 3 % of the genes mutated
    map_ms               a new map from its seed

`--json` prints these and the speeds driven as one flat object of numbers. `--peers` adds the steps per second of other
environments on the same core under random actions, where they are installed beside this project
(`pip install highway-env "gymnasium[box2d]"`); they are no dependencies.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import gridsim.env
from cluster.champion import Champion, load_champion
from cluster.checkpoint import CheckpointError
from evolution.breeding import RECIPE, Mutation, breed
from evolution.episodes import lane_starts
from evolution.policy import BLOCK, PolicySpec, decide, encode, pack, packed_size
from evolution.rollout import Limits, evaluate
from gridsim.jit import njit
from gridsim.scenarios import HELD_OUT_SEED, Scenario, build
from gridsim.simulator import DISTANCE

MAPS = 8
EPISODES = 16  # of the rollout, over all maps
CARS = 1024  # of the vector environment
SPEED = 6.0  # m/s, that the policy must drive at: crashing and parked cars are cheap
# What a peer is called here: the module it needs, its id and its arguments.
PEERS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "highway_env_grid": ("highway_env", "highway-v0", {"config": {"observation": {"type": "OccupancyGrid"}}}),
    "highway_env_lidar": ("highway_env", "highway-v0", {"config": {"observation": {"type": "LidarObservation"}}}),
    "car_racing": ("Box2D", "CarRacing-v3", {"continuous": False}),
}


def median_s(run: Callable[[], object], runs: int) -> float:
    """Median wall time (s) of a function that is warm."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def rollout_rays(champion: Champion, maps: list[Scenario], runs: int) -> tuple[float, float]:
    """(car-steps/s, m/s driven) of the fused rollout of whole episodes."""
    spec, episode = PolicySpec.parse(champion.policy), champion.sim.episode
    episodes, _ = lane_starts(maps, np.arange(EPISODES) % len(maps), np.random.default_rng(0))
    limits = Limits(episode.target, round(episode.time_limit / episode.control_period))

    def run() -> np.ndarray:
        return evaluate(spec, champion.genome[None], maps, episodes, limits, champion.sim)[0]

    results = run()
    steps = int(results["steps"].sum())
    speed = float(results["distance"].sum()) / (steps * episode.control_period)
    return steps / median_s(run, runs), speed


@njit
def _actions(packed, layers, ranges, speeds, actions):
    """What one network does in many cars."""
    scratch = np.zeros(2 * (layers.max() + BLOCK), dtype=np.float32)
    for i in range(len(actions)):
        encode(ranges[i], None, speeds[i], scratch)
        actions[i] = decide(packed, layers, scratch)


def vector_env_rays(champion: Champion, maps: list[Scenario], runs: int, steps: int = 200) -> tuple[float, float]:
    """(car-steps/s, m/s driven) of `env.step`: without the network's own time; a step that only resets is none."""
    env = gridsim.env.GridSimVectorEnv(CARS, maps=maps, config=champion.sim)
    layers = PolicySpec.parse(champion.policy).layers
    packed = np.empty(packed_size(layers), dtype=np.float32)
    pack(champion.genome, layers, packed)
    actions = np.zeros(CARS, dtype=np.int64)
    _, info = env.reset(seed=0)
    # As in a long run, the cars are spread over the length of their episodes, so that resets come evenly.
    spread = np.random.default_rng(0).uniform(0.0, champion.sim.episode.target, CARS)
    env.simulator.state.cars[:, DISTANCE] = spread
    rates, speeds = [], []
    over = np.zeros(CARS, dtype=bool)
    for run in range(runs + 1):
        spent, driven = 0.0, 0
        for _ in range(steps):
            _actions(packed, layers, env.ranges, info["speed_mps"], actions)
            driven += CARS - int(over.sum())
            start = time.perf_counter()
            _, _, terminations, truncations, info = env.step(actions)
            spent += time.perf_counter() - start
            over = terminations | truncations
            speeds.append(float(info["speed_mps"].mean()))
        if run > 0:  # the first warms up
            rates.append(driven / spent)
    return statistics.median(rates), statistics.mean(speeds)


def breed_ms(runs: int) -> float:
    """Milliseconds to breed 512 children of 1,011 genes from a mating pool of 64 parents."""
    spec = PolicySpec.parse("mlp:17,17")
    rng = np.random.default_rng(0)
    parents = rng.normal(size=(64, spec.size)).astype(np.float32)
    recipes = np.zeros(512, dtype=RECIPE)
    recipes["seed"] = np.arange(1, 513)
    recipes["a"] = rng.integers(64, size=512)
    recipes["b"] = np.where(np.arange(512) % 2, recipes["a"], (recipes["a"] + 1) % 64)
    mutation = Mutation(rate=0.03)
    breed(parents, recipes, 1, spec, mutation)
    return 1e3 * median_s(lambda: breed(parents, recipes, 1, spec, mutation), 4 * runs)


def map_ms(scenario: str, runs: int) -> float:
    """Milliseconds to build a map nobody has seen."""
    build(scenario, 0)
    seeds = iter(range(HELD_OUT_SEED + 1000, HELD_OUT_SEED + 1000 + runs))
    return 1e3 * median_s(lambda: build(scenario, next(seeds)), runs)


def peer_steps(name: str, seconds: float = 3.0) -> float | None:
    """Steps per second of another environment under random actions, resets included; None where it is not installed."""
    module, env_id, arguments = PEERS[name]
    if importlib.util.find_spec(module) is None:
        print(f"throughput: {name}: skipped, {module} is not installed", file=sys.stderr)
        return None
    importlib.import_module(module)
    env = gymnasium.make(env_id, **arguments)
    env.action_space.seed(0)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    steps, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < seconds:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        steps += 1
        if terminated or truncated:
            env.reset()
    env.close()
    return steps / spent


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object of numbers, nothing else")
    parser.add_argument("--peers", action="store_true", help="also measure other environments that are installed")
    parser.add_argument("--champion", type=Path, default=Path(__file__).with_name("champion.npz"), help="who drives")
    parser.add_argument("--runs", type=int, default=7, help="of which each figure is the median (7)")
    options = parser.parse_args()
    if options.runs < 1:
        parser.error("--runs must be 1 or more")
    try:
        champion = load_champion(options.champion)
    except CheckpointError as error:
        parser.error(f"{error}")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

    maps = [build(champion.scenario, HELD_OUT_SEED + k, champion.sim) for k in range(MAPS)]
    figures: dict[str, float] = {}
    for name, measure in (("rollout_rays", rollout_rays), ("vector_env_rays", vector_env_rays)):
        figures[name], figures[f"{name}_speed_mps"] = measure(champion, maps, options.runs)
        if figures[f"{name}_speed_mps"] < SPEED:
            slow = figures[f"{name}_speed_mps"]
            print(f"throughput: {name}: the champion drives at {slow:.1f} m/s, not {SPEED:g}", file=sys.stderr)
    figures["breed_512x1000_ms"] = breed_ms(options.runs)
    figures["map_ms"] = map_ms(champion.scenario, options.runs)
    peers = {name: peer_steps(name) for name in PEERS} if options.peers else {}
    found = {name: steps for name, steps in peers.items() if steps is not None}

    if options.json:
        print(json.dumps({**figures, **{f"peer_{name}": steps for name, steps in found.items()}}))
        return 0
    for name in ("rollout_rays", "vector_env_rays"):
        print(f"{name:<20}{figures[name]:>12,.0f} car-steps/s   at {figures[f'{name}_speed_mps']:.1f} m/s")
    for name in ("breed_512x1000_ms", "map_ms"):
        print(f"{name:<20}{figures[name]:>12.2f} ms")
    for name, steps in found.items():
        ratio = figures["vector_env_rays"] / steps
        print(f"{name:<20}{steps:>12,.0f} steps/s; vector_env_rays is {ratio:,.0f} times that")
    return 0


if __name__ == "__main__":
    sys.exit(main())
