"""GridSim from Python, without folders or MLflow: evolve with a fitness of one's own, load, drive, evaluate.

>>> from cluster.api import evaluate, evolve, load_champion
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cluster.runs.champion import Champion, evaluate, load_champion
from cluster.runs.settings import EvolveSettings
from cluster.training.evolution import Evolution
from cluster.training.trainer import Maps
from cluster.workers.pool import SerialPool, WorkerPool
from gridsim.config import SimConfig

__all__ = ["Champion", "EvolveSettings", "evaluate", "evolve", "load_champion"]

Fitness = Callable[[np.ndarray, np.ndarray | float], np.ndarray]


def evolve(
    settings: EvolveSettings | None = None,
    fitness: Fitness | None = None,
    workers: int = 0,
    on_generation: Callable[[int, dict[str, float]], None] | None = None,
) -> tuple[Champion, list[dict[str, float]]]:
    """Evolve a driver in memory.

    Args:
        settings: as the command's flags; default all of theirs.
        fitness: scores float64 [n], greater is better, from the episodes' results (structured, [n, episodes], with
            fields distance (m), paced (m at a speed within the interval), steps and end (`gridsim.car.ego.End`)) and
            the episodes' targets (m). It runs here, never in the workers. Default: `evolution.search.fitness.scalar`.
        workers: Ray workers on this machine; 0 evaluates in this process.
        on_generation: told the number of generations done and the last one's figures.

    Returns: the champion, and the history, a row of figures for each generation, by the names of a run's history.csv:
    `.../mean` is of all members on training's episodes, `.../best` of the best genome so far on episodes of its own.
    Raises: SettingsError, PoolError with one line.
    """
    settings = settings or EvolveSettings()
    settings.check()
    maps = Maps(settings.scenario, SimConfig())
    pool: WorkerPool
    if workers:
        from cluster.workers.ray_pool import RayPool

        pool = RayPool(workers, maps.build)
    else:
        pool = SerialPool(maps.build)
    try:
        evolution = Evolution(settings, pool, maps)
        if fitness is not None:
            evolution.score = fitness
        while not evolution.done():
            row = evolution.step()
            if on_generation:
                on_generation(evolution.generation, row)
        evolution.conclude()
        assert evolution.champion is not None
        champion = Champion(
            evolution.champion.genome, settings.policy, settings.scenario, evolution.sim, settings.traffic
        )
        return champion, evolution.history
    finally:
        pool.close()
        maps.close()
