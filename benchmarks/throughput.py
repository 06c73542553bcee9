"""Car-steps per second on one pinned core, and related figures.

    python benchmarks/throughput.py [--json] [--peers [PYTHON]]

On `seamless`, resets included, driven by a trained policy on several maps, medians of several runs; only ego cars are
counted:

    rollout_rays             car-steps/s of the fused rollout: 31 rays of 50 m, network, act, advance, collide
    vector_env_rays          car-steps/s of `env.step` of the Gymnasium vector environment with 1,024 cars
    vector_env_grid          the same with `observation="grid"`
    ..._traffic              the same with 8 other cars in each car's world, by a policy that learned in traffic
    breed_512x1000_ms        512 children of about 1,000 genes, half of them of two parents, 3 % of the genes mutated
    breed_step_512x1000_ms   the same around a centre in mirrored pairs, as the default search breeds
    map_<scenario>_ms, _mib  a new map from its seed: time to build it, and its memory

`--json` prints these and the speeds driven as one flat object of numbers. `--peers` adds the steps per second of other
environments on the same core under random actions, and how many times as fast ours is; they are not dependencies, and
`--peers /path/to/python` finds them in a virtual environment of their own (`benchmarks/peers.py`).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from peers import NOT_INSTALLED, PEERS  # beside this file

import gridsim.envs.env
from cluster.store.champion import Champion, load_champion
from cluster.store.checkpoint import CheckpointError
from evolution.episodes.rollout import evaluate
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec, decide, pack, scratch_size
from evolution.networks.symmetry import space
from evolution.search.base import recipes as some_recipes
from evolution.search.breeding import Kind, Mutation, breed
from gridsim.config import constants
from gridsim.jit import njit
from gridsim.maps.map import Map
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import REGISTRY, build
from gridsim.sensing.observation import encoding, normalise
from gridsim.state import DISTANCE

MAPS = 8
EPISODES = 16  # of the rollout, over all maps
CARS = 1024  # of the vector environment
SPEED = 6.0  # m/s at which the policy must drive at least: crashing and parked cars are cheap
TRAFFIC = 8  # cars in a world


def median_s(run: Callable[[], object], runs: int) -> float:
    """Median wall time (s) of a function that is warm."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def rollout_rays(champion: Champion, maps: list[Map], runs: int, traffic: int = 0) -> tuple[float, float]:
    """(car-steps/s, m/s driven) of the fused rollout of whole episodes."""
    spec, episode = PolicySpec.parse(champion.policy), champion.sim.episode
    rng = np.random.default_rng(0)
    episodes, worlds = lane_starts(maps, np.arange(EPISODES) % len(maps), rng, traffic, champion.sim)

    def run() -> np.ndarray:
        return evaluate(spec, champion.genome[None], maps, episodes, champion.sim, worlds)[0]

    results = run()
    steps = int(results["steps"].sum())
    speed = float(results["distance"].sum()) / (steps * episode.control_period)
    return steps / median_s(run, runs), speed


@njit
def _actions(packed, layers, encoding, observations, actions):
    """The actions of one network in many cars."""
    scratch = np.zeros(scratch_size(layers), dtype=np.float32)
    for i in range(len(actions)):
        normalise(encoding, observations[i], scratch)
        actions[i] = decide(packed, layers, scratch, None)


def vector_env(
    champion: Champion,
    maps: list[Map],
    runs: int,
    traffic: int = 0,
    observation: Literal["rays", "grid"] = "rays",
    steps: int = 200,
) -> tuple[float, float]:
    """(car-steps/s, m/s driven) of `env.step`, without the network's own time; steps that only reset do not count."""
    env = gridsim.envs.env.GridSimVectorEnv(
        CARS, maps=maps, config=champion.sim, traffic=traffic, observation=observation, scenario=champion.scenario
    )
    layers = PolicySpec.parse(champion.policy).layers
    packed, encoded = pack(champion.genome, layers), encoding((), constants(champion.sim))
    actions = np.zeros(CARS, dtype=np.int64)
    _, info = env.reset(seed=0)
    # As in a long run, the cars are spread over the length of their episodes, so that resets come evenly.
    spread = np.random.default_rng(0).uniform(0.0, champion.sim.episode.target, CARS)
    env.simulator.cars[:, DISTANCE] = spread
    rates, speeds = [], []
    over = np.zeros(CARS, dtype=bool)
    for run in range(runs + 1):
        spent, driven = 0.0, 0
        for _ in range(steps):
            _actions(packed, layers, encoded, env.simulator.observations, actions)
            driven += CARS - int(over.sum())
            start = time.perf_counter()
            _, _, terminations, truncations, info = env.step(actions)
            spent += time.perf_counter() - start
            over = terminations | truncations
            speeds.append(float(info["speed_mps"].mean()))
        if run > 0:  # the first warms up
            rates.append(driven / spent)
    return statistics.median(rates), statistics.mean(speeds)


def breed_ms(runs: int, crossed: bool) -> float:
    """Milliseconds to breed 512 children of 1,011 genes by Kind.CROSS, or by Kind.STEP and MIRRORED.

    Rows of a mating pool of 64 are crossed: half of the children have two parents, half have one and are only mutated;
    3 % of all genes mutate. Steps are taken from one row.
    """
    spec = PolicySpec.parse("mlp:17,17")
    rng = np.random.default_rng(0)
    parents = rng.normal(size=(64, spec.size)).astype(np.float32)
    recipes = some_recipes(512)
    if crossed:
        recipes["kind"] = Kind.CROSS
        recipes["a"] = rng.integers(64, size=512)
        recipes["b"] = np.where(np.arange(512) % 2, recipes["a"], (recipes["a"] + 1) % 64)
    else:
        recipes["kind"], recipes["seed"] = [Kind.STEP, Kind.MIRRORED] * 256, np.arange(512) // 2
    mutation = Mutation(rate=0.03)
    breed(parents, recipes, 1, space(spec), mutation)
    return 1e3 * median_s(lambda: breed(parents, recipes, 1, space(spec), mutation), 4 * runs)


def new_map(scenario: str, runs: int) -> tuple[float, float]:
    """(ms to build a new map, MiB of its arrays)."""
    made = build(scenario, 0)
    seeds = iter(range(HELD_OUT_SEED + 1000, HELD_OUT_SEED + 1000 + runs))
    return 1e3 * median_s(lambda: build(scenario, next(seeds)), runs), made.nbytes / 2**20


def peer_steps(name: str, python: str) -> float | str:
    """Steps per second of another environment, measured by a process of that Python; or why there is no figure."""
    file = str(Path(__file__).with_name("peers.py"))
    try:
        run = subprocess.run([python, file, name], capture_output=True, text=True, timeout=120, check=False)
        if run.returncode == 0:
            return float(run.stdout.split()[-1])
    except (OSError, subprocess.TimeoutExpired, ValueError, IndexError) as error:
        return f"could not be run: {error}"
    why = (run.stderr.strip() or f"exit code {run.returncode}").splitlines()[-1]
    return why if run.returncode == NOT_INSTALLED else f"could not be run: {why}"


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--json", action="store_true", help="print one flat JSON object of numbers, nothing else")
    parser.add_argument(
        "--peers", nargs="?", const=sys.executable, metavar="PYTHON", help="also measure other environments"
    )
    here = Path(__file__).parent
    parser.add_argument("--champion", type=Path, default=here / "champion.npz", help="drives alone")
    parser.add_argument("--champion-traffic", type=Path, default=here / "champion_traffic.npz", help="... in traffic")
    parser.add_argument("--runs", type=int, default=7, help="each figure is their median (7)")
    options = parser.parse_args()
    if options.runs < 1:
        parser.error("--runs must be 1 or more")
    try:
        alone, among = load_champion(options.champion), load_champion(options.champion_traffic)
        for champion in (alone, among):
            if not re.fullmatch(r"mlp:[\d,]+", champion.policy):
                parser.error(f"give a champion of mlp:N,N without more, not of {champion.policy}")
    except CheckpointError as error:
        parser.error(f"{error}")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

    figures: dict[str, float] = {}
    rates = []
    for champion, traffic in ((alone, 0), (among, TRAFFIC)):
        maps = [build(champion.scenario, HELD_OUT_SEED + k, champion.sim) for k in range(MAPS)]
        for name in ("rollout_rays", "vector_env_rays", "vector_env_grid"):
            if name == "rollout_rays":
                rate, speed = rollout_rays(champion, maps, options.runs, traffic)
            else:
                rate, speed = vector_env(
                    champion, maps, options.runs, traffic, "grid" if name.endswith("grid") else "rays"
                )
            name += "_traffic" if traffic else ""
            rates.append(name)
            figures[name], figures[f"{name}_speed_mps"] = rate, speed
            if speed < SPEED:
                print(f"throughput: {name}: the champion drives at {speed:.1f} m/s, not {SPEED:g}", file=sys.stderr)
    bred = {"breed_512x1000_ms": True, "breed_step_512x1000_ms": False}
    figures |= {name: breed_ms(options.runs, crossed) for name, crossed in bred.items()}
    for name in REGISTRY:
        figures[f"map_{name}_ms"], figures[f"map_{name}_mib"] = new_map(name, options.runs)
    peers = {name: peer_steps(name, options.peers) for name in PEERS} if options.peers else {}
    found = {name: steps for name, steps in peers.items() if not isinstance(steps, str)}

    if options.json:
        print(json.dumps({**figures, **{f"peer_{name}": steps for name, steps in found.items()}}))
        return 0
    for name in rates:
        print(f"{name:<24}{figures[name]:>12,.0f} car-steps/s   at {figures[f'{name}_speed_mps']:.1f} m/s")
    for name in bred:
        print(f"{name:<24}{figures[name]:>12.2f} ms")
    for name in REGISTRY:
        print(f"{f'map_{name}':<24}{figures[f'map_{name}_ms']:>12.1f} ms   {figures[f'map_{name}_mib']:.1f} MiB")
    for name, steps in peers.items():
        if isinstance(steps, str):
            print(f"{name:<24}{steps}")
        else:
            ours = PEERS[name].ours
            print(f"{name:<24}{steps:>12,.0f} steps/s; {ours} is {figures[ours] / steps:,.0f} times that")
    return 0


if __name__ == "__main__":
    sys.exit(main())
