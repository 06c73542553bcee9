"""How the service scales: python benchmarks/scaling.py [--json] [--quick] [--picture FILE] [--generations N] [--seed N]

On this machine: runs the default job to its end with 2 workers and keeps the state ten generations before it; then
evolves those ten generations again, with 1 worker and with 2, saving and logging as always. Medians over them:

    speedup_2_workers               wall clock of a generation with 1 worker over that with 2
    overhead_ms_per_generation      wall clock less the busiest worker's evaluation, 2 workers, population 512
    bytes_per_child                 sent per member and generation, both ways, validation beside it included
    broadcast_bytes_per_generation  put into the object store per generation: parents, racers, episodes

The coordinator's ceilings, with workers that answer at once (`ceilings.py`):

    children_per_s                  selection, recipes, dispatch and collection
    coordinator_mib_100k            peak memory of its process at population 100,000, everything in it
    broadcast_bytes_100k            as above, at that population
    chunk_us, look_us, ...          what the simulation is fed with: the coordinator's own time

On more machines: a simulation (`simulation.py`) of a generation of 10,000 members on 1 to 10,000 workers, as a table
and, with --picture, a picture; and what it says of 1 to 8 workers beside real Ray actors. Those share this machine's
cores, so that they sleep in place of evaluating: what is checked is the dispatch, not the cores.

    efficiency_1000_workers         1 s of evaluation a member, mlp:6,7; evaluation over what the workers had
    real_efficiency_<n>, simulated_efficiency_<n>

--json prints one flat object of numbers and nothing else. --quick takes a minute, with figures that mean little.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import sys
import tempfile
import time
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ceilings import (  # beside this file
    CHILDREN,
    CHUNKS,
    EPISODES,
    InstantWorker,
    children_per_s,
    chunk_costs,
    gene_s,
    learn,
    memory,
    naps,
    ray_costs,
    session,
    sleeping_efficiency,
    step_s,
)
from simulation import WORKERS, Call, Costs, Load, at, draw, episodes_of, table

from cluster.learning import Maps
from cluster.ray_pool import RayPool
from cluster.settings import EvolveSettings
from cluster.warm import compile_kernels
from evolution.policy import PolicySpec
from evolution.rollout import targets
from gridsim.config import SimConfig

LAST = 10  # generations that are measured
MLP, CNN = "mlp:6,7", "cnn:8,16,32@1"
ACTORS = (1, 2, 4, 8)  # real ones, that the simulation is checked with
NAPPING = 40  # members for each of them
MEMBER_S = 1.0  # of evaluation, in the simulation


class Last(NamedTuple):
    """The last generations of the default run: figures of each, and how the last one's episodes went."""

    figures: dict[str, list[float]]
    load: Load


def default_run(folder: Path, settings: EvolveSettings, maps: Maps) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The state of the default run LAST generations before its end."""
    pool = RayPool(2, maps.build)
    states: deque[tuple[dict[str, np.ndarray], dict[str, Any]]] = deque(maxlen=LAST + 1)
    this = session(folder, "whole", settings, pool, maps)
    compile_kernels(settings.policy, settings.traffic, settings.command)

    def keep(generation: int, row: dict[str, float]) -> None:
        arrays, meta = this.learning.state()
        states.append(({k: v.copy() for k, v in arrays.items()}, meta))
        if sys.stderr.isatty():
            print(f"\rdefault run: generation {generation} ", end="", file=sys.stderr, flush=True)

    this.on_row = keep
    learn(this)
    return states[0]


def last_generations(
    folder: Path,
    settings: EvolveSettings,
    maps: Maps,
    state: tuple[dict[str, np.ndarray], dict[str, Any]],
    workers: int,
) -> Last:
    """Evolve LAST generations from a state."""
    pool = RayPool(workers, maps.build)
    this = session(folder, f"last-{workers}", settings, pool, maps)
    this.learning.restore({k: v.copy() for k, v in state[0].items()}, {**state[1], "solved": False})
    compile_kernels(settings.policy, settings.traffic, settings.command)
    figures: dict[str, list[float]] = {"wall": [], "overhead": [], "bytes": [], "broadcast": []}
    begun = 0.0

    def measure(generation: int, row: dict[str, float]) -> None:
        nonlocal begun
        end = time.perf_counter()
        outcomes = this.learning.outcomes
        busiest = sum(max(o.busy_s.values()) for o in outcomes)
        main = outcomes[0]
        figures["wall"].append(end - begun)
        figures["overhead"].append(end - begun - busiest)
        figures["bytes"].append((main.bytes_down + main.bytes_up) / settings.population)
        figures["broadcast"].append(sum(o.broadcast_bytes for o in outcomes))
        this.learning.solved = len(figures["wall"]) > LAST
        begun = time.perf_counter()

    this.on_row = measure
    begun = time.perf_counter()
    learn(this)
    curriculum = this.learning.curriculum
    generation = this.learning.steps - 1
    main, race = this.learning.outcomes[0].results, this.learning.outcomes[1].results
    rows = curriculum.episodes(generation).rows
    step = curriculum.period  # in the unit of the car's clock; `at` makes it seconds of evaluation
    load = Load(
        targets(rows, curriculum.limits()),
        main["steps"][: settings.population, : len(rows)] * step,
        np.full(race.shape[1], curriculum.race_limits().target),
        race["steps"] * step,
        PolicySpec.parse(settings.policy).size,
    )
    return Last({name: values[1:] for name, values in figures.items()}, load)  # the first one waits for Ray


def measured_costs(maps: Maps, quick: bool) -> tuple[Costs, dict[str, float]]:
    """What the simulation is fed with, and the figures of it."""
    pool = RayPool(2, maps.build, worker_factory=InstantWorker)
    try:
        children, child = children_per_s(pool, CHILDREN // 10 if quick else CHILDREN)
        chunk, look = chunk_costs(pool, CHUNKS // 10 if quick else CHUNKS)
        busy, byte = ray_costs()
    finally:
        pool.close()
    costs = Costs(child, chunk, look, busy, byte, gene_s(MLP))
    figures = {
        "children_per_s": children,
        "child_us": 1e6 * child,
        "chunk_us": 1e6 * chunk,
        "look_us": 1e6 * look,
        "look_us_per_worker": 1e6 * busy,
        "sent_mib_per_s": 1.0 / max(byte, 1e-12) / 2**20,
        "gene_ns": 1e9 * costs.gene_s,
    }
    return costs, figures


def cases(load: Load) -> dict[str, Load]:
    """What is simulated, by name."""
    cnn = PolicySpec.parse(CNN).size
    steps = load.drives.sum(axis=1).mean() / SimConfig().episode.control_period
    own_s = {policy: float(steps * step_s(policy)) for policy in (MLP, CNN)}
    second = f"{MEMBER_S:g} s a member"
    return {
        f"{MLP}, {second}": at(load, MEMBER_S),
        f"{MLP}, {second}, genomes": at(load, MEMBER_S, recipes=False),
        f"{CNN}, {second}": at(load, MEMBER_S, genes=cnn),
        f"{CNN}, {second}, genomes": at(load, MEMBER_S, genes=cnn, recipes=False),
        f"{MLP}, {1e3 * own_s[MLP]:.1f} ms": at(load, own_s[MLP]),
        f"{MLP}, {1e3 * own_s[MLP]:.1f} ms, genomes": at(load, own_s[MLP], recipes=False),
        f"{CNN}, {1e3 * own_s[CNN]:.0f} ms": at(load, own_s[CNN], genes=cnn),
        f"{CNN}, {1e3 * own_s[CNN]:.0f} ms, genomes": at(load, own_s[CNN], genes=cnn, recipes=False),
    }


def checked(costs: Costs, actors: tuple[int, ...]) -> dict[str, float]:
    """Efficiency of real actors that sleep, and what the simulation says of them."""
    figures = {}
    for workers in actors:
        members = NAPPING * workers
        figures[f"real_efficiency_{workers}"] = sleeping_efficiency(workers, members)
        drives = naps()[:members]
        local = dataclasses.replace(costs, latency_s=0.0)
        goals = np.full(EPISODES, 150.0)
        call = Call(local, workers, drives, episodes_of(goals), 6.0, 0.0, 72 * 1244 + 4_000)
        figures[f"simulated_efficiency_{workers}"] = float(drives.sum() / (workers * call.run()))
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one flat JSON object and nothing else")
    parser.add_argument("--quick", action="store_true", help="all of it, on a small scale")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the simulated efficiency")
    parser.add_argument(
        "--generations", type=int, default=EvolveSettings().generations, help="of the default run, at most"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the default run")
    options = parser.parse_args()
    if options.generations < 1:
        parser.error("--generations must be 1 or more")
    count, population = options.generations, EvolveSettings().population
    if options.quick:
        count, population = min(count, 3), 64
    settings = EvolveSettings(generations=count, seed=options.seed, population=population)
    longer = EvolveSettings(generations=count + LAST + 2, seed=options.seed, population=population, until=2.0)
    with tempfile.TemporaryDirectory() as folder:
        maps = Maps(settings.scenario, SimConfig())
        state = default_run(Path(folder), settings, maps)
        one = last_generations(Path(folder), longer, maps, state, 1)
        two = last_generations(Path(folder), longer, maps, state, 2)
        costs, ceilings = measured_costs(maps, options.quick)
        maps.close()
    large = memory(2_000 if options.quick else 100_000)
    loads = cases(two.load)
    workers = (1, 10, 1_000) if options.quick else WORKERS
    efficiencies = table(costs, loads, workers)
    median = statistics.median
    figures = {
        "speedup_2_workers": sum(one.figures["wall"]) / sum(two.figures["wall"]),
        "overhead_ms_per_generation": 1e3 * median(two.figures["overhead"]),
        "bytes_per_child": median(two.figures["bytes"]),
        "broadcast_bytes_per_generation": median(two.figures["broadcast"]),
        "generation_ms_1_worker": 1e3 * median(one.figures["wall"]),
        "generation_ms_2_workers": 1e3 * median(two.figures["wall"]),
        **ceilings,
        "coordinator_mib_100k": large["coordinator_mib"],
        "broadcast_bytes_100k": large["broadcast_bytes"],
        "generation_s_100k": large["generation_s"],
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
