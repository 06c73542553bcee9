"""What the coordinator can do at most, measured with workers that answer at once or sleep; `scaling.py` calls it.

    python benchmarks/coordinator.py POPULATION

prints as JSON the peak memory of a process that coordinates a complete run of so many members, and what it broadcasts.
It is a process of its own, so that nothing else is counted.
"""

from __future__ import annotations

import dataclasses
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from simulated_workers import ROWS  # beside this file

from cluster.learn.learning import Maps
from cluster.run import Session
from cluster.settings import EvolveSettings
from cluster.store.folder import new_run
from cluster.tracking.address import check_uri
from cluster.workers import ray_pool
from cluster.workers.pool import Chunk, Outcome, WorkerPool
from cluster.workers.ray_pool import RayPool
from cluster.workers.worker import Task, Worker
from evolution.episodes.rollout import EPISODE, RESULT, evaluate
from evolution.networks.policy import PolicySpec
from evolution.search import fitness
from evolution.search.base import recipes as some_recipes
from evolution.search.breeding import Kind, Mutation, breed, noise_sum
from evolution.search.recombination import Recombination
from gridsim.config import SimConfig
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.state import TRAFFIC_FIELDS as FIELDS
from gridsim.state import End

POLICY = "mlp:6,7"  # 311 genes
CHILDREN = 100_000  # members that the coordinator alone is timed with
EPISODES = 2  # of a member, as in the default run
CHUNKS = 2_000  # that are sent to measure the cost of one
WAITING = 1_000  # busy workers that are looked at to measure the cost of one
SEED = 7  # of the sleeping workers' naps


class InstantWorker(Worker):
    """Answers at once: most episodes succeed, the others end on the way; those that crash do so where they started."""

    def evaluate(self, task: Task, maps: Any, recipes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        results = np.zeros((len(recipes), len(task.episodes)), dtype=RESULT)
        goals = task.episodes["target"].astype(np.float64)
        mark = 2 * recipes["seed"].astype(np.int64) + (recipes["kind"] == Kind.MIRRORED)
        share = (mark[:, None] * 7919 + np.arange(len(goals)) * 104_729) % 512 / 160
        results["distance"] = np.floor(np.minimum(share, 1.0) * goals)
        results["paced"] = np.floor(results["distance"] / 2)
        results["steps"] = results["distance"]
        results["end"] = np.where(share >= 1.0, End.SUCCESS, End.COLLISION)
        back = task.episodes["rewind"] > 0
        rewound, worlds = (
            np.repeat(states[back][None], len(recipes), axis=0) for states in (task.episodes["start"], task.worlds)
        )
        return results, rewound, worlds


class SleepingWorker(InstantWorker):
    """Sleeps instead of evaluating, for as long as `naps` gives for a member's seed and an episode's mark."""

    def evaluate(self, task: Task, maps: Any, recipes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        columns = task.episodes["start"][:, 4].astype(int)
        time.sleep(float(naps()[np.ix_(recipes["seed"], columns)].sum()))
        return super().evaluate(task, maps, recipes)


class Watched(RayPool):
    """A pool that remembers what it was last asked for, and what came of it."""

    outcome: Outcome

    def evaluate(self, *arguments: Any) -> Outcome:
        self.outcome = super().evaluate(*arguments)
        return self.outcome


def naps(members: int = 400, mean_s: float = 0.02) -> np.ndarray:
    """Seconds [members, EPISODES]: as uneven as real episodes, most of which are driven to their end."""
    rng = np.random.default_rng(SEED)
    shape = (members, EPISODES)
    shares = np.where(rng.random(shape) < 0.6, 1.0, rng.random(shape))
    return shares * (mean_s / shares.mean() / EPISODES)


def make_task(parents: np.ndarray, key: int = 1, count: int = EPISODES) -> Task:
    """A generation's task without maps; each episode is marked by its number."""
    episodes = np.zeros(count, EPISODE)
    episodes["start"][:, 4] = np.arange(count)
    episodes["target"], episodes["steps"] = 150.0, 245
    worlds = np.zeros((count, 0, FIELDS), dtype=np.float32)
    return Task(POLICY, episodes, worlds, (), SimConfig(), parents, key, Mutation())


def rows(count: int) -> np.ndarray:
    """Genomes float32 [count, genes] as they are broadcast."""
    return np.zeros((count, PolicySpec.parse(POLICY).size), dtype=np.float32)


def session(
    folder: Path, name: str, settings: EvolveSettings, pool: WorkerPool, maps: Maps, initial: np.ndarray | None = None
) -> Session:
    """A run as the command makes it, in a folder of its own; `initial` is a genome to start from."""
    run = new_run(folder, name, settings)
    run.path.mkdir(parents=True)
    return Session(run, pool, maps, check_uri(f"sqlite:///{folder}/mlflow.db"), "scaling", initial=initial)


def learn(this: Session) -> None:
    """Learn to the end, and leave neither workers nor an open run behind."""
    try:
        this.learn()
    finally:
        this.pool.close()
        this.tracker.close("FINISHED")


def children_per_s(pool: WorkerPool, children: int = CHILDREN) -> tuple[float, float]:
    """Members per second that the default search asks for, the pool sends and collects, and the search recombines.

    With InstantWorkers, whose results come in groups as in a run. Also the coordinator thread's CPU seconds for a
    member, in which waiting for the workers does not count.
    """
    search = Recombination(PolicySpec.parse(POLICY), EvolveSettings(population=children).search_config(), 0)
    rng = np.random.default_rng(0)
    rates, times = [], []
    for _ in range(6):
        begun, before = time.perf_counter(), time.thread_time()
        asked = search.ask()
        parts = [Chunk(group, slice(g * EPISODES, (g + 1) * EPISODES)) for g, group in enumerate(asked.groups)]
        task = make_task(asked.parents, asked.key, EPISODES * len(parts))
        results = pool.evaluate(task, asked.recipes, asked=parts).results
        driven = np.concatenate([results[part] for part in parts])
        search.tell(fitness.scalar(driven, float(task.episodes["target"][0])) + 1e-6 * rng.random(children))
        rates.append(children / (time.perf_counter() - begun))
        times.append((time.thread_time() - before) / children)
    return statistics.median(rates[1:]), statistics.median(times[1:])


def chunk_costs(pool: WorkerPool, chunks: int = CHUNKS) -> tuple[float, float]:
    """CPU seconds that the coordinator's thread takes for a chunk of one member, and for each look for answers.

    CPU time and not wall time, as the InstantWorkers share its cores. With few workers nearly every chunk takes a look
    of its own, with many one look finds many answers; so looks are measured separately.
    """
    import ray

    wait, looks = ray.wait, [0.0]

    def timed(*arguments: Any, **options: Any) -> Any:
        begun = time.thread_time()
        try:
            return wait(*arguments, **options)
        finally:
            looks.append(time.thread_time() - begun)

    recipes, task = some_recipes(chunks), make_task(rows(1))
    asked = [Chunk(slice(k, k + 1), slice(0, EPISODES)) for k in range(chunks)]
    times = []
    cut, ray_pool.cut = ray_pool.cut, lambda _, asked, *more: [(chunk,) for chunk in asked]  # each on its own
    ray.wait = timed
    try:
        for _ in range(3):
            begun, before = time.thread_time(), sum(looks)
            pool.evaluate(task, recipes, asked=asked)
            times.append((time.thread_time() - begun - sum(looks) + before) / chunks)
    finally:
        ray.wait, ray_pool.cut = wait, cut
    return statistics.median(times), statistics.median(looks)


def ray_costs(waiting: int = WAITING) -> tuple[float, float]:
    """Seconds to look at one busy worker, and to send a byte. A pool must have started Ray."""
    import ray

    class Helper:
        def nap(self, seconds: float) -> None:
            time.sleep(seconds)

        def length(self, payload: bytes) -> int:
            return len(payload)

    make: Any = ray.remote(num_cpus=0)(Helper)
    one = make.remote()
    small, large = b"0" * 1_000, b"0" * 2_000_000
    times: dict[bytes, list[float]] = {small: [], large: []}
    for payload in [small, large] * 10:
        begun = time.perf_counter()
        ray.get(one.length.remote(payload))
        times[payload].append(time.perf_counter() - begun)
    byte_s = (statistics.median(times[large]) - statistics.median(times[small])) / (len(large) - len(small))
    busy = [one.nap.remote(3600.0) for _ in range(waiting)]
    looks = []
    for _ in range(11):
        begun = time.thread_time()
        ray.wait(busy, num_returns=len(busy), timeout=0.0)
        looks.append(time.thread_time() - begun)
    ray.kill(one)
    return statistics.median(looks) / waiting, max(byte_s, 0.0)


def gene_costs() -> tuple[float, float]:
    """Seconds to breed a gene of a member, and to recombine it: members come in pairs that share their noise."""
    spec, pairs = PolicySpec.parse(POLICY), 1_000
    recipes = some_recipes(2 * pairs)
    recipes["kind"], recipes["seed"] = [Kind.STEP, Kind.MIRRORED] * pairs, np.arange(2 * pairs) // 2
    weights = np.random.default_rng(0).normal(size=pairs)
    bred, recombined = [], []
    for _ in range(6):
        times = [time.perf_counter()]
        breed(rows(1), recipes, 1, spec, Mutation())
        times.append(time.perf_counter())
        noise_sum(np.arange(pairs), weights, 1, spec)
        times.append(time.perf_counter())
        bred.append(times[1] - times[0])
        recombined.append(times[2] - times[1])
    genes = 2 * pairs * spec.size
    return statistics.median(bred[1:]) / genes, statistics.median(recombined[1:]) / genes


def step_s(policy: str, members: int = 64) -> float:
    """Seconds of a car-step with that network, by untrained drivers on `seamless`."""
    spec, scenario = PolicySpec.parse(policy), build("seamless", 0)
    rng = np.random.default_rng(0)
    genomes = (rng.normal(size=(members, spec.size)) * 0.3).astype(np.float32)
    episodes = np.zeros(4, EPISODE)
    episodes["start"] = sample_starts(scenario, 4, rng)
    episodes["target"], episodes["steps"] = 150.0, 245
    worlds = np.zeros((4, 0, FIELDS), dtype=np.float32)
    times = []
    for _ in range(4):
        begun = time.perf_counter()
        results, _, _ = evaluate(spec, genomes, [scenario], episodes, SimConfig(), worlds)
        times.append((time.perf_counter() - begun) / results["steps"].sum())
    return statistics.median(times[1:])


def sleeping_efficiency(workers: int, members: int, generations: int = 3) -> float:
    """Efficiency of so many real Ray actors, on however many cores there are: they only sleep."""
    maps = Maps("seamless", SimConfig())
    pool = RayPool(workers, maps.build, worker_factory=SleepingWorker)
    recipes, task = some_recipes(members), make_task(rows(ROWS))
    try:
        while len(pool.pids()) < workers:  # until all are up, and the time for a metre is known
            pool.evaluate(task, recipes)
        walls = [pool.evaluate(task, recipes).wall_s for _ in range(generations)]
    finally:
        pool.close()
        maps.close()
    return float(naps()[:members].sum()) / (workers * statistics.median(walls))


def memory(population: int) -> dict[str, float]:
    """Figures of a process that coordinates so many members, by `python benchmarks/coordinator.py POPULATION`."""
    done = subprocess.run(
        [sys.executable, __file__, str(population)], stdout=subprocess.PIPE, text=True, check=True, timeout=600
    )
    return json.loads(done.stdout.splitlines()[-1])


def coordinate(population: int, generations: int = 16) -> dict[str, float]:
    """Run some generations with InstantWorkers on the longest episodes, saved and logged as always.

    The broadcast is that of a generation with neither new maps nor a candidate for champion.
    """
    settings = EvolveSettings(population=population, generations=generations, until=2.0)
    with tempfile.TemporaryDirectory() as folder:
        maps = Maps(settings.scenario, SimConfig())
        pool = Watched(2, maps.build, worker_factory=InstantWorker)
        this = session(Path(folder), "large", settings, pool, maps)
        curriculum = this.learning.curriculum
        curriculum.config = dataclasses.replace(curriculum.config, first_target=curriculum.config.last_target)
        curriculum.target = curriculum.config.last_target
        broadcast: list[int] = []
        this.reporter.row = lambda step, row: broadcast.append(pool.outcome.broadcast_bytes)
        begun = time.perf_counter()
        learn(this)
        maps.close()
        seconds = time.perf_counter() - begun
    scale = 1 if sys.platform == "darwin" else 1024
    return {
        "coordinator_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 2**20,
        "broadcast_bytes": min(broadcast),
        "generation_s": seconds / generations,
    }


if __name__ == "__main__":
    print(json.dumps(coordinate(int(sys.argv[1]))))
