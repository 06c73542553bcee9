"""A generation on 1 to 10,000 workers, as a discrete-event simulation fed by what `coordinator.py` measured.

The coordinator is one thread, as in `cluster.workers.ray_pool`: it sends chunks to free workers, looks at all busy
ones, and takes in their answers. The chunks are those of `cluster.workers.pool.cut`. Simulated are its time, the
network's latency and the bandwidth of its own link, the search's few rows on their way to the nodes, and the evaluation
of the members and of the leader, whose long episodes go out first. All members count as one group. Not simulated:
trials of candidates for champion, maps, deaths of workers, and other users' load.

Efficiency is the time of evaluation over the time of all workers: 1 means that none ever waited.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cluster.workers.pool import Chunk, Parcel, cut, metres
from cluster.workers.pool import size as episodes_in
from cluster.workers.worker import Task
from evolution.episodes.rollout import EPISODE, RESULT
from evolution.search.breeding import RECIPE, Mutation
from gridsim.config import SimConfig
from gridsim.state import TRAFFIC_FIELDS as FIELDS

WORKERS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
POPULATION = 10_000
QUEUE = 2  # chunks that a worker holds, as in the pool
TASK_BYTES = 4_000  # of a broadcast, besides genomes: episodes, settings, and how they are pickled
ROWS = 4  # genomes in a broadcast: centre, step sizes, champion, leader
CHUNK_BYTES = 300  # around what is sent, either way: Ray's own description of a call


@dataclass(frozen=True)
class Costs:
    """What things cost, in seconds; the last three are assumed and not measured."""

    child_s: float  # of the coordinator, for a member: its recipe, its score, its weight
    recombine_s: float  # plus this for each of its genes
    chunk_s: float  # of the coordinator, for a chunk: to send it and to take in its results
    look_s: float  # of the coordinator, for a look for answers
    look_worker_s: float  # plus this for each busy worker
    byte_s: float  # of the coordinator, for a byte that is sent
    gene_s: float  # to breed a gene
    latency_s: float = 0.3e-3  # from one machine to another
    bandwidth: float = 1.25e9  # bytes/s of a machine's link: 10 Gbit/s
    node_workers: int = 16  # workers of a machine


@dataclass(frozen=True)
class Load:
    """What a generation asks for.

    Attributes:
        targets: m, of each of a member's episodes [e].
        drives: s, of each member's episodes [n, e]; members are drawn from these.
        leader_targets, leader_drives: the same of the leader's episodes [k], which are driven as they are.
        genes: of a network.
        recipes: whether children are sent as recipes; else as genomes, which the coordinator breeds.
    """

    targets: np.ndarray
    drives: np.ndarray
    leader_targets: np.ndarray
    leader_drives: np.ndarray
    genes: int
    recipes: bool = True


@dataclass
class Call:
    """One call of a pool: what is asked for, and how long it takes."""

    costs: Costs
    workers: int
    drives: np.ndarray  # s [n, e]; 0 where nothing is asked for
    targets: np.ndarray  # m [e]
    broadcast: int = 0  # bytes
    asked: Sequence[Chunk] = ()  # the longest first; all if empty
    member_bytes: float = RECIPE.itemsize  # sent for each member, in each chunk that it is in
    member_s: float = 0.0  # of the coordinator, for the same

    def parcels(self) -> list[Parcel]:
        """What is asked for as the pool cuts it, knowing from the last generation how long a metre takes."""
        n, e = self.drives.shape
        episodes, worlds = np.zeros(e, dtype=EPISODE), np.zeros((e, 0, FIELDS), dtype=np.float32)
        episodes["target"] = self.targets
        task = Task(
            "mlp:6,7", episodes, worlds, (), SimConfig(), np.zeros((1, 1), np.float32), 0,
            Mutation(),
        )  # fmt: skip
        asked = self.asked or [Chunk(slice(0, n), slice(0, e))]
        whole = sum(metres(task, part) for part in asked)
        return cut(task, asked, self.workers, [max(self.drives.sum() / whole, 1e-12)] * len(asked))

    def run(self) -> float:
        """Seconds from start to end."""
        k, parcels = self.costs, self.parcels()
        size = np.concatenate([np.zeros((len(self.drives), 1)), np.cumsum(self.drives, axis=1)], axis=1)
        todo = deque(parcels)
        idle = deque(range(self.workers))
        single: deque[int] = deque()  # workers that hold one chunk, in the order in which they got it
        held = [0] * self.workers
        free_at = [0.0] * self.workers
        broadcast_at: dict[int, float] = {}  # by node
        coming: list[tuple[float, int, float]] = []  # (when an answer arrives, whose it is, its bytes)
        link_s = 0.0  # until when the coordinator's link is busy
        now = self.broadcast * k.byte_s

        def send(worker: int) -> None:
            nonlocal now, link_s
            parcel = todo.popleft()
            members = sum(rows.stop - rows.start for rows, _ in parcel)
            down = CHUNK_BYTES + members * self.member_bytes
            now += k.chunk_s / 2 + down * k.byte_s + members * self.member_s
            link_s = max(link_s, now) + down / k.bandwidth
            node = worker // k.node_workers
            if node not in broadcast_at:
                # Every node that has the broadcast passes it on, so that their number doubles in each round.
                rounds = math.ceil(math.log2(node + 2))
                broadcast_at[node] = link_s + rounds * (2 * k.latency_s + self.broadcast / k.bandwidth)
            begin = max(link_s + k.latency_s, free_at[worker], broadcast_at[node])
            took = sum(float((size[rows, columns.stop] - size[rows, columns.start]).sum()) for rows, columns in parcel)
            free_at[worker] = begin + took
            up = CHUNK_BYTES + sum(map(episodes_in, parcel)) * RESULT.itemsize
            heapq.heappush(coming, (free_at[worker] + k.latency_s + up / k.bandwidth, worker, up))
            held[worker] += 1
            if held[worker] == 1:
                single.append(worker)

        left = len(parcels)
        while left:
            while todo and idle:
                send(idle.popleft())
            for _ in range(len(single)):
                if len(todo) <= self.workers:
                    break
                worker = single.popleft()
                if 0 < held[worker] < QUEUE:
                    send(worker)
            looked = now = max(now + k.look_s + k.look_worker_s * (self.workers - len(idle)), coming[0][0])
            while coming and coming[0][0] <= looked:
                _, worker, up = heapq.heappop(coming)
                now += k.chunk_s / 2 + up * k.byte_s
                left -= 1
                held[worker] -= 1
                (single if held[worker] else idle).append(worker)
        return now


def generation(costs: Costs, load: Load, workers: int, drives: np.ndarray) -> float:
    """Seconds of a generation of members [n, e] and the leader, which comes after them in rows and columns."""
    n, e = drives.shape
    k = len(load.leader_drives)
    both = np.zeros((n + 1, e + k))
    both[:n, :e], both[n, e:] = drives, load.leader_drives
    call = Call(
        costs, workers, both, np.concatenate([load.targets, load.leader_targets]), TASK_BYTES,
        [Chunk(slice(n, n + 1), slice(e, e + k)), Chunk(slice(0, n), slice(0, e))],
    )  # fmt: skip
    if load.recipes:
        call.broadcast += 4 * load.genes * ROWS
    else:
        call.member_bytes, call.member_s = 4 * load.genes, costs.gene_s * load.genes
    return n * (costs.child_s + costs.recombine_s * load.genes) + call.run()


def efficiency(costs: Costs, load: Load, workers: int, population: int = POPULATION) -> float:
    """Time of evaluation over the time of all workers."""
    drives = load.drives[np.random.default_rng(0).integers(len(load.drives), size=population)]
    return (drives.sum() + load.leader_drives.sum()) / (workers * generation(costs, load, workers, drives))


def at(load: Load, member_s: float, genes: int, recipes: bool = True) -> Load:
    """A load with a network of so many genes, where evaluating a member takes `member_s` on average."""
    factor = member_s / load.drives.sum(axis=1).mean()
    return replace(
        load, drives=load.drives * factor, leader_drives=load.leader_drives * factor, genes=genes, recipes=recipes
    )


def table(costs: Costs, cases: dict[str, Load], workers: Sequence[int] = WORKERS) -> dict[str, list[float]]:
    """Efficiency of each case at each number of workers."""
    return {name: [efficiency(costs, load, w) for w in workers] for name, load in cases.items()}


def draw(figures: dict[str, list[float]], path: Path, workers: Sequence[int] = WORKERS) -> None:
    """Draw the figures of `table` to a picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for k, (name, values) in enumerate(figures.items()):
        axes.plot(workers, values, "--" if "genomes" in name else "-", color=f"C{k // 2}", marker=".", label=name)
    axes.set(
        xscale="log", ylim=(0, 1.02), xlabel="workers", ylabel="efficiency",
        title=f"Simulated efficiency of a generation of {POPULATION:,} members",
    )  # fmt: skip
    axes.axhline(0.9, color="0.7", linewidth=0.8, zorder=0)
    axes.grid(alpha=0.25)
    axes.legend(loc="lower left", frameon=False)
    figure.savefig(path, dpi=100)
    plt.close(figure)
