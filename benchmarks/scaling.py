"""How the service scales on this machine: python benchmarks/scaling.py [--json] [--generations N]

Runs the default job to its end with 2 workers and keeps the state ten generations before it; then evolves those ten
generations again, with 1 worker and with 2, saving and logging as always. Figures are medians over the generations.

    speedup_2_workers               wall clock of a generation with 1 worker over that with 2
    overhead_ms_per_generation      wall clock less the busiest worker's evaluation, 2 workers, population 512
    bytes_per_child                 sent per member and generation, both ways
    broadcast_bytes_per_generation  put into the object store per generation: parents, episodes, new maps aside
    children_per_s                  selection, recipes, dispatch and collection alone: workers that answer at once
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from cluster.learning import Maps
from cluster.pool import WorkerPool
from cluster.ray_pool import RayPool
from cluster.run import Session, make_tracker, new_run
from cluster.settings import EvolveSettings
from cluster.tracking_address import check_uri
from cluster.warm import compile_kernels
from cluster.worker import Task, Worker
from evolution.breeding import Mutation
from evolution.genetic import Genetic, GeneticConfig
from evolution.policy import PolicySpec
from evolution.rollout import EPISODE, Limits, no_traffic
from gridsim.config import SimConfig

LAST = 10  # generations that are measured
CHILDREN = 100_000  # members that the coordinator alone is timed with


class InstantWorker(Worker):
    """Answers at once."""

    def evaluate(self, task: Task, maps: Any, recipes: np.ndarray) -> tuple[np.ndarray, float]:
        return np.zeros((len(recipes), len(task.episodes)), dtype=task.row), 0.0


def session(folder: Path, name: str, settings: EvolveSettings, pool: WorkerPool, maps: Maps) -> Session:
    """A run as the command makes it, in a folder of its own."""
    run = new_run(folder, name, settings)
    run.path.mkdir(parents=True)
    tracker = make_tracker(run, check_uri(f"sqlite:///{folder}/mlflow.db"), "scaling")
    return Session(run, pool, maps, tracker, time.perf_counter())


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
    try:
        this.learn()
    finally:
        pool.close()
        this.tracker.close("FINISHED")
    return states[0]


def last_generations(
    folder: Path,
    settings: EvolveSettings,
    maps: Maps,
    state: tuple[dict[str, np.ndarray], dict[str, Any]],
    workers: int,
) -> dict[str, list[float]]:
    """Evolve LAST generations from a state. Returns figures of each."""
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
    try:
        begun = time.perf_counter()
        this.learn()
    finally:
        pool.close()
        this.tracker.close("FINISHED")
    return {name: values[1:] for name, values in figures.items()}  # the first one waits for Ray


def children_per_s(maps: Maps) -> float:
    """Members a second that the coordinator selects, writes recipes for, sends and collects."""
    spec, sim = PolicySpec.parse("mlp:6,7"), SimConfig()
    genetic = Genetic(spec, GeneticConfig(population=CHILDREN), 0)
    pool = RayPool(2, maps.build, worker_factory=InstantWorker)
    rng = np.random.default_rng(0)
    rates = []
    try:
        for _ in range(6):
            begun = time.perf_counter()
            recipes, key = genetic.ask(Mutation())
            task = Task(
                "mlp:6,7",
                genetic.parents,
                key,
                Mutation(),
                np.zeros(4, EPISODE),
                no_traffic(4),
                (),
                Limits(150.0, 100),
                sim,
            )
            results = pool.evaluate(task, recipes).results
            genetic.tell(results["distance"].sum(axis=1) + rng.random(CHILDREN))
            rates.append(CHILDREN / (time.perf_counter() - begun))
    finally:
        pool.close()
    return statistics.median(rates[1:])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one flat JSON object and nothing else")
    parser.add_argument(
        "--generations", type=int, default=EvolveSettings().generations, help="of the default run, at most"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the default run")
    options = parser.parse_args()
    settings = EvolveSettings(generations=options.generations, seed=options.seed)
    longer = EvolveSettings(generations=options.generations + LAST + 2, seed=options.seed, until=2.0)
    with tempfile.TemporaryDirectory() as folder:
        maps = Maps(settings.scenario, SimConfig())
        state = default_run(Path(folder), settings, maps)
        one = last_generations(Path(folder), longer, maps, state, 1)
        two = last_generations(Path(folder), longer, maps, state, 2)
        rate = children_per_s(maps)
        maps.close()
    median = statistics.median
    figures = {
        "speedup_2_workers": sum(one["wall"]) / sum(two["wall"]),
        "overhead_ms_per_generation": 1e3 * median(two["overhead"]),
        "bytes_per_child": median(two["bytes"]),
        "broadcast_bytes_per_generation": median(two["broadcast"]),
        "children_per_s": rate,
        "generation_ms_1_worker": 1e3 * median(one["wall"]),
        "generation_ms_2_workers": 1e3 * median(two["wall"]),
    }
    if options.json:
        print(json.dumps({name: round(value, 3) for name, value in figures.items()}))
    else:
        for name, value in figures.items():
            print(f"{name:32} {value:14,.2f}")


if __name__ == "__main__":
    main()
