"""How the service scales: python benchmarks/scaling.py [--json] [--quick] [--picture FILE] [--generations N] [--seed N]

On this machine: runs the default job to its end with 2 workers and keeps the state ten generations before the end; then
evolves the last ten generations again, with 1 worker, with 2, and with 2 at population 512, saving and logging as
always. Medians over them:

    speedup_2_workers               wall clock of all ten with 1 worker over that with 2
    overhead_ms_per_generation      wall clock less the busiest worker's evaluation, 2 workers, population 512
    bytes_per_child                 sent per member and generation, both ways, leader and validation included
    broadcast_bytes_per_generation  put into the object store per generation: a few genomes, episodes

The coordinator's ceilings, with workers that answer at once (`coordinator.py`):

    children_per_s                  recipes, dispatch, collection and recombination, mlp:6,7
    coordinator_mib_100k            peak memory of its process at population 100,000, everything included
    broadcast_bytes_100k            as above, at that population
    chunk_us, look_us, ...          input of the simulation: the coordinator's own time

On more machines: a simulation (`simulated_workers.py`) of a generation of 10,000 members on 1 to 10,000 workers, as a
table and, with --picture, a picture; and its figures for 1 to 8 workers beside those of real Ray actors. These share
this machine's cores, so they sleep instead of evaluating: this checks the dispatch, not the cores.

    efficiency_1000_workers         1 s of evaluation a member, mlp:6,7; evaluation over what the workers had
    real_efficiency_<n>, simulated_efficiency_<n>

--json prints one flat object of numbers and nothing else. --quick takes a minute, with figures that mean little.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from coordinator import (  # beside this file
    CHILDREN,
    CHUNKS,
    EPISODES,
    InstantWorker,
    Watched,
    children_per_s,
    chunk_costs,
    gene_costs,
    learn,
    memory,
    naps,
    ray_costs,
    session,
    sleeping_efficiency,
    step_s,
)
from coordinator import POLICY as MLP
from simulated_workers import ROWS, TASK_BYTES, WORKERS, Call, Costs, Load, at, draw, table

from cluster.learn.learning import Maps
from cluster.settings import MAX_STEPS, EvolveSettings
from cluster.workers.kernels import compile_kernels
from cluster.workers.ray_pool import RayPool
from evolution.episodes.curriculum import HELD_OUT_SEEDS, VALIDATION_SEEDS
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig

LAST = 10  # generations that are measured
OVERHEAD = 512  # population that the coordinator's time is measured at
CNN = "cnn:8,16,32@1"
ACTORS = (1, 2, 4, 8)  # real ones, with which the simulation is checked
NAPPING = 40  # members for each of them
MEMBER_S = 1.0  # of evaluation, in the simulation


State = tuple[dict[str, np.ndarray], dict[str, Any]]


def default_run(folder: Path, settings: EvolveSettings, maps: Maps) -> State:
    """The state of the default run LAST generations before its end."""
    pool = RayPool(2, maps.build)
    states: deque[State] = deque(maxlen=LAST + 1)
    this = session(folder, "whole", settings, pool, maps)
    compile_kernels(settings.policy, settings.traffic, settings.command)

    def keep(generation: int, row: dict[str, float]) -> None:
        arrays, meta = this.learning.state()
        states.append(({k: v.copy() for k, v in arrays.items()}, meta))
        if sys.stderr.isatty():
            print(f"\rdefault run: generation {generation} ", end="", file=sys.stderr, flush=True)

    this.reporter.row = keep
    learn(this)
    for seed in (*this.learning.curriculum.map_seeds, *VALIDATION_SEEDS, *HELD_OUT_SEEDS):
        maps.get(seed)  # a short run ends before all are built, and none is to be built during a measurement
    return states[0]


def last_generations(
    folder: Path, settings: EvolveSettings, maps: Maps, state: State, workers: int
) -> tuple[dict[str, list[float]], Load]:
    """Evolve LAST generations from a state. Returns: figures of each, and how the last one's episodes went."""
    # Generations are counted here: neither a limit of the run nor its champion ends it.
    settings = replace(settings, generations=0, car_steps=MAX_STEPS, until=2.0)
    pool = Watched(workers, maps.build)
    this = session(folder, f"last-{workers}-{settings.population}", settings, pool, maps)
    learning, curriculum = this.learning, this.learning.curriculum
    compile_kernels(settings.policy, settings.traffic, settings.command)
    nobody = np.zeros((1, learning.spec.size), dtype=np.float32)

    def restore() -> None:
        learning.restore({k: v.copy() for k, v in state[0].items()}, {**state[1], "solved": False})

    # Before the measurement MLflow's run is opened, and all workers are put to work and sent nearly all maps.
    this.tracker.wait_ready()
    restore()
    coming = [curriculum.episodes(learning.steps + k) for k in range(LAST + 1)]
    for episodes in (curriculum.validation(), *coming):
        while len(learning.drive("warm", nobody, episodes).busy_s) < workers:
            pass
    restore()
    figures: dict[str, list[float]] = {"wall": [], "overhead": [], "bytes": [], "broadcast": []}
    begun = 0.0

    def measure(generation: int, row: dict[str, float]) -> None:
        nonlocal begun
        end = time.perf_counter()
        outcome = pool.outcome
        figures["wall"].append(end - begun)
        figures["overhead"].append(end - begun - max(outcome.busy_s.values()))
        figures["bytes"].append((outcome.bytes_down + outcome.bytes_up) / settings.population)
        figures["broadcast"].append(outcome.broadcast_bytes)
        learning.solved = len(figures["wall"]) > LAST
        begun = time.perf_counter()

    this.reporter.row = measure
    begun = time.perf_counter()
    learn(this)
    n, goals = settings.population, pool.outcome.task.episodes["target"].astype(np.float64)
    seconds = pool.outcome.results["steps"] * curriculum.period  # driven; `at` scales them to evaluation
    groups = [part for part in pool.outcome.asked if part.rows.stop <= n]
    leader = next(part for part in pool.outcome.asked if part.rows.start == n)
    load = Load(
        goals[groups[0].columns], np.concatenate([seconds[part] for part in groups]),
        goals[leader.columns], seconds[leader][0], learning.spec.size,
    )  # fmt: skip
    return {name: values[1:] for name, values in figures.items()}, load  # the first one only times metres


def measured_costs(maps: Maps, quick: bool) -> tuple[Costs, dict[str, float]]:
    """The input of the simulation, and the same as figures to print."""
    pool = RayPool(2, maps.build, worker_factory=InstantWorker)
    try:
        children, child = children_per_s(pool, CHILDREN // 10 if quick else CHILDREN)
        chunk, look = chunk_costs(pool, CHUNKS // 10 if quick else CHUNKS)
        busy, byte = ray_costs()
    finally:
        pool.close()
    breed_s, recombine_s = gene_costs()
    of_genes = recombine_s * PolicySpec.parse(MLP).size
    costs = Costs(max(child - of_genes, 0.0), recombine_s, chunk, look, busy, byte, breed_s)
    figures = {
        "children_per_s": children,
        "child_us": 1e6 * child,
        "chunk_us": 1e6 * chunk,
        "look_us": 1e6 * look,
        "look_us_per_worker": 1e6 * busy,
        "sent_mib_per_s": 1.0 / max(byte, 1e-12) / 2**20,
        "gene_ns": 1e9 * breed_s,
        "recombined_gene_ns": 1e9 * recombine_s,
    }
    return costs, figures


def cases(load: Load) -> dict[str, Load]:
    """What is simulated, by name."""
    steps = load.drives.sum(axis=1).mean() / SimConfig().episode.control_period
    own_s = {policy: float(steps * step_s(policy)) for policy in (MLP, CNN)}
    found = {}
    for policy, seconds, member in (
        (MLP, MEMBER_S, f"{MEMBER_S:g} s a member"),
        (CNN, MEMBER_S, f"{MEMBER_S:g} s a member"),
        (MLP, own_s[MLP], f"{1e3 * own_s[MLP]:.1f} ms"),
        (CNN, own_s[CNN], f"{1e3 * own_s[CNN]:.0f} ms"),
    ):
        genes = PolicySpec.parse(policy).size
        found[f"{policy}, {member}"] = at(load, seconds, genes)
        found[f"{policy}, {member}, genomes"] = at(load, seconds, genes, recipes=False)
    return found


def checked(costs: Costs, actors: tuple[int, ...]) -> dict[str, float]:
    """Efficiency of real actors that sleep, and what the simulation says of them."""
    figures = {}
    for workers in actors:
        members = NAPPING * workers
        figures[f"real_efficiency_{workers}"] = sleeping_efficiency(workers, members)
        drives = naps()[:members]
        local = replace(costs, latency_s=0.0)
        broadcast = TASK_BYTES + 4 * PolicySpec.parse(MLP).size * ROWS
        call = Call(local, workers, drives, np.full(EPISODES, 150.0), broadcast)
        figures[f"simulated_efficiency_{workers}"] = float(drives.sum() / (workers * call.run()))
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one flat JSON object and nothing else")
    parser.add_argument("--quick", action="store_true", help="all of it, on a small scale")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the simulated efficiency")
    parser.add_argument("--generations", type=int, default=0, help="of the default run, at most; 0: its own end")
    parser.add_argument("--seed", type=int, default=0, help="of the default run")
    options = parser.parse_args()
    if options.generations < 0:
        parser.error("--generations must be 0 or more")
    settings = EvolveSettings(generations=options.generations, seed=options.seed)
    if options.quick:
        settings = replace(settings, generations=3, population=64)
    with tempfile.TemporaryDirectory() as folder:
        maps = Maps(settings.scenario, SimConfig())
        state = default_run(Path(folder), settings, maps)
        one, _ = last_generations(Path(folder), settings, maps, state, 1)
        two, load = last_generations(Path(folder), settings, maps, state, 2)
        large, _ = last_generations(Path(folder), replace(settings, population=OVERHEAD), maps, state, 2)
        costs, ceilings = measured_costs(maps, options.quick)
        maps.close()
    largest = memory(2_000 if options.quick else 100_000)
    loads = cases(load)
    workers = (1, 10, 1_000) if options.quick else WORKERS
    efficiencies = table(costs, loads, workers)
    median = statistics.median
    figures = {
        "speedup_2_workers": sum(one["wall"]) / sum(two["wall"]),
        "overhead_ms_per_generation": 1e3 * median(large["overhead"]),
        "bytes_per_child": median(two["bytes"]),
        "broadcast_bytes_per_generation": median(two["broadcast"]),
        "generation_ms_1_worker": 1e3 * median(one["wall"]),
        "generation_ms_2_workers": 1e3 * median(two["wall"]),
        "generation_ms_512": 1e3 * median(large["wall"]),
        **ceilings,
        "coordinator_mib_100k": largest["coordinator_mib"],
        "broadcast_bytes_100k": largest["broadcast_bytes"],
        "generation_s_100k": largest["generation_s"],
        "efficiency_1000_workers": next(iter(efficiencies.values()))[workers.index(1_000)],
        **checked(costs, ACTORS[:2] if options.quick else ACTORS),
    }
    if options.picture:
        draw(efficiencies, options.picture, workers)
    if options.json:
        print(json.dumps({name: round(value, 3) for name, value in figures.items()}))
        return
    for name, value in figures.items():
        print(f"{name:32} {value:14,.2f}")
    print("\nSimulated efficiency of a generation of 10,000 members\n")
    print(f"{'workers':34}" + "".join(f"{w:>7}" for w in workers))
    for name, values in efficiencies.items():
        print(f"{name:34}" + "".join(f"{value:7.2f}" for value in values))


if __name__ == "__main__":
    main()
