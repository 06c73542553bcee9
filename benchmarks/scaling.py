"""How work scales over threads and Ray workers: python benchmarks/scaling.py [--json] [--quick] [--generations N]

On this machine: generations of `--traffic 6 --population 512` on `seamless`, around a trained driver (beside this
file), by one and by two threads of this process in turns, and then by one and by two Ray workers. All drive the same.

    speedup_2_threads               wall clock of all generations with one thread over that with two
    speedup_2_workers               the same of Ray workers
    threads_over_workers            car-steps a second by two threads over that by two Ray workers
    overhead_ms_per_generation      wall clock less the busiest worker's evaluation, 2 Ray workers; median
    thread_overhead_ms              the same of 2 threads
    start_workers_s                 until a pool of 2 Ray workers is open
    children_per_s                  members that the search asks for, the pool sends and collects, and the search
                                    recombines, with Ray workers that answer at once: the coordinator's ceiling

--json prints one flat object of numbers and nothing else. --quick takes some seconds, with figures that mean little.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import statistics
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from cluster.settings import EvolveSettings
from cluster.store.champion import load_champion
from cluster.workers.kernels import compile_ahead
from cluster.workers.open import open_pool
from cluster.workers.pool import Chunk, Outcome, WorkerPool
from cluster.workers.ray_pool import RayPool
from cluster.workers.threads import ThreadPool
from cluster.workers.worker import Task, Worker
from evolution.episodes import fitness
from evolution.episodes.curriculum import Curriculum
from evolution.episodes.rollout import EPISODE, RESULT
from evolution.networks.policy import PolicySpec
from evolution.networks.symmetry import space
from evolution.search.base import SearchConfig
from evolution.search.recombination import Recombination
from gridsim.config import SimConfig
from gridsim.maps import scenarios
from gridsim.maps.map import Map
from gridsim.state import TRAFFIC_FIELDS as FIELDS
from gridsim.state import End

SIGMA = 0.1  # step size, so that most members drive as well as at the end of a run
WARM = 2  # generations before the measured ones, in which kernels are loaded and maps sent
CHILDREN = 100_000  # members that the coordinator alone is timed with
DRIVER = Path(__file__).with_name("champion_traffic.npz")


build = functools.cache(scenarios.build)


class InstantWorker(Worker):
    """Answers at once: most episodes succeed, the others end in a collision on the way."""

    def evaluate(
        self, task: Task, maps: Sequence[Map], recipes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        results = np.zeros((len(recipes), len(task.episodes)), dtype=RESULT)
        share = (recipes["seed"].astype(np.int64)[:, None] * 7919 + np.arange(len(task.episodes)) * 104_729) % 512 / 160
        results["distance"] = results["paced"] = np.floor(np.minimum(share, 1.0) * task.episodes["target"])
        results["steps"], results["end"] = 100, np.where(share >= 1.0, End.SUCCESS, End.COLLISION)
        return results, np.zeros(0), np.zeros(0)


class Generations:
    """The same generations for every pool that drives them; each pool has one of these."""

    def __init__(self, settings: EvolveSettings, pool: WorkerPool):
        champion = load_champion(DRIVER)
        self._scenario, self._policy, self._pool = settings.scenario, champion.policy, pool
        self._curriculum = Curriculum(
            settings.curriculum(), settings.seed, partial(build, settings.scenario), SimConfig(), settings.crowds
        )
        self._curriculum.target = self._curriculum.config.last_target
        self._search = Recombination(space(PolicySpec.parse(champion.policy)), settings.search_config(), settings.seed)
        self._search.start_from(champion.genome)
        self._search.sigma = SIGMA
        self.driven: list[tuple[Outcome, float]] = []  # and how long each took, s

    def next(self) -> None:
        """Drive one."""
        asked, episodes = self._search.ask(), self._curriculum.episodes(len(self.driven))
        e = len(episodes.rows) // len(asked.groups)
        parts = [Chunk(group, slice(g * e, (g + 1) * e)) for g, group in enumerate(asked.groups)]
        names = tuple((self._scenario, seed) for seed in episodes.maps)
        base = (self._policy, episodes.rows, episodes.worlds, names, SimConfig())
        task, begun = Task(*base, asked.parents, asked.key, asked.mutation), time.perf_counter()
        outcome = self._pool.run(Outcome(task, asked.recipes, parts))
        self.driven.append((outcome, time.perf_counter() - begun))
        results = np.concatenate([outcome.results[part] for part in parts])
        self._search.tell(fitness.scalar(results, episodes.rows["target"][:e].astype(np.float64)))

    def figures(self) -> dict[str, float]:
        """Of all but the first ones."""
        driven = self.driven[WARM:]
        return {
            "wall_s": sum(wall_s for _, wall_s in driven),
            "car_steps": sum(float(call.results["steps"].sum()) for call, _ in driven),
            "overhead_ms": 1e3 * statistics.median(wall_s - max(call.busy_s.values()) for call, wall_s in driven),
        }


def drive(settings: EvolveSettings, pools: list[WorkerPool], generations: int) -> list[dict[str, float]]:
    """Figures of each pool; pools drive each generation in turns."""
    drivers = [Generations(settings, pool) for pool in pools]
    for _ in range(WARM + generations):
        for driver in drivers:
            driver.next()
    return [driver.figures() for driver in drivers]


def children_per_s(children: int) -> float:
    """Members per second with two Ray workers that answer at once."""
    spec, config, groups = PolicySpec.parse("mlp:6,7"), SimConfig(), SearchConfig.groups
    search = Recombination(space(spec), SearchConfig(population=children), 0)
    episodes = np.zeros(2 * groups, EPISODE)
    episodes["target"], episodes["steps"] = 150.0, 245
    worlds, rates = np.zeros((len(episodes), 0, FIELDS), dtype=np.float32), []
    with contextlib.closing(RayPool(2, build, worker_factory=InstantWorker)) as pool:
        pool.open()
        for _ in range(4):
            begun = time.perf_counter()
            asked = search.ask()
            parts = [Chunk(group, slice(2 * g, 2 * g + 2)) for g, group in enumerate(asked.groups)]
            task = Task(str(spec), episodes, worlds, (), config, asked.parents, asked.key, asked.mutation)
            results = pool.run(Outcome(task, asked.recipes, parts)).results
            search.tell(fitness.scalar(np.concatenate([results[part] for part in parts]), 150.0))
            rates.append(children / (time.perf_counter() - begun))
    return statistics.median(rates[1:])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one flat JSON object and nothing else")
    parser.add_argument("--quick", action="store_true", help="all of it, on a small scale")
    parser.add_argument("--generations", type=int, default=10, help="that are measured")
    options = parser.parse_args()
    settings = EvolveSettings(traffic=6, population=64 if options.quick else 512)
    generations = 2 if options.quick else options.generations
    compile_ahead(settings)
    # First Ray, whose variables are to be set before there are threads.
    rate = children_per_s(CHILDREN // 10 if options.quick else CHILDREN)
    of_workers = {}
    for workers in (1, 2):
        begun = time.perf_counter()
        with contextlib.closing(open_pool(workers, None, 0.0, build)) as pool:
            start_s = time.perf_counter() - begun
            (of_workers[workers],) = drive(settings, [pool], generations)
    threads = [ThreadPool(build, 1), ThreadPool(build, 2)]
    one, two = drive(settings, threads, generations)
    for pool in threads:
        pool.close()
    pair = of_workers[2]
    assert pair["car_steps"] == of_workers[1]["car_steps"] == one["car_steps"] == two["car_steps"]
    figures = {
        "speedup_2_workers": of_workers[1]["wall_s"] / pair["wall_s"],
        "speedup_2_threads": one["wall_s"] / two["wall_s"],
        "threads_over_workers": pair["wall_s"] / two["wall_s"],
        "overhead_ms_per_generation": pair["overhead_ms"],
        "thread_overhead_ms": two["overhead_ms"],
        "car_steps_per_s_2_workers": pair["car_steps"] / pair["wall_s"],
        "car_steps_per_s_2_threads": two["car_steps"] / two["wall_s"],
        "start_workers_s": start_s,
        "children_per_s": rate,
    }
    if options.json:
        print(json.dumps({name: round(value, 3) for name, value in figures.items()}))
        return
    for name, value in figures.items():
        print(f"{name:32} {value:14,.2f}")


if __name__ == "__main__":
    main()
