"""GridSim's Python API, without run folders or MLflow: train, also with your own fitness, load, drive, evaluate.

`import gridsim` offers all of it: `gridsim.evolve(scenario="city", workers=2)`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cluster.learn.evolution import Evolution
from cluster.learn.learning import finish
from cluster.learn.maps import Maps
from cluster.run import new_learning
from cluster.settings import DqnSettings, EvolveSettings, RunSettings, check_workers
from cluster.store.champion import Champion, evaluate, load_champion
from cluster.workers.open import open_pool
from cluster.workers.pool import WorkerPool
from gridsim.config import SimConfig

__all__ = ["Champion", "DqnSettings", "EvolveSettings", "compare", "evaluate", "evolve", "load_champion", "train_dqn"]

Fitness = Callable[[np.ndarray, np.ndarray | float], np.ndarray]
OnStep = Callable[[int, dict[str, float]], None]
Trained = tuple[Champion, list[dict[str, float]]]


def evolve(
    settings: EvolveSettings | None = None,
    fitness: Fitness | None = None,
    workers: int = 0,
    on_generation: OnStep | None = None,
    **flags: Any,
) -> Trained:
    """Evolve a driver in memory.

    >>> import gridsim
    >>> champion, history = gridsim.evolve(scenario="curved", population=32, generations=2)
    >>> len(history)
    2

    Args:
        settings: what the command's flags set; alternatively give these by name, such as scenario="city".
        fitness: returns scores float64 [n], higher is better, given the episodes' results (structured, [n, episodes],
            with fields distance (m), paced (m at a speed within the interval), steps and end (`gridsim.state.End`))
            and targets (m). It runs in this process only. Default: `evolution.episodes.fitness.scalar`.
        workers: Ray workers on this machine; 0 evaluates in this process, on all its cores.
        on_generation: called with the number of generations done and the latest one's figures.

    Returns: the champion, and the history: a row of figures for each generation, named as in a run's history.csv.
    `.../mean` is over all members on training episodes, `.../best` of the best genome so far on its own episodes.
    Raises: GridSimError; the message is one line.
    """
    return _train(settings or EvolveSettings(**flags), workers, on_generation, fitness)


def train_dqn(
    settings: DqnSettings | None = None, workers: int = 0, on_evaluation: OnStep | None = None, **flags: Any
) -> Trained:
    """Train a driver by deep Q-learning, in memory, like `evolve`; the history has a row for each evaluation.

    >>> import gridsim
    >>> champion, history = gridsim.train_dqn(scenario="curved", car_steps=1000)
    """
    return _train(settings or DqnSettings(**flags), workers, on_evaluation)


def compare(*runs: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Compare finished runs, as `gridsim-compare RUNS` does: each one's figures, and errors against the reference.

    Args:
        runs: their folders; a comparison's folder stands for all of its finished runs.

    Returns: a row for each run: folder, scenario, learner, seed, traffic, and the figures as table.csv names them; an
    error that could not be measured is nan.
    Raises: GridSimError, with a one-line message, for a folder that is not a finished run.
    """
    from cluster.compare.plan import read_runs
    from cluster.compare.results import measured

    names = ("scenario", "learner", "seed", "traffic")
    return [
        {"run": str(run.folder), **{name: getattr(run.settings, name) for name in names}, **run.figures}
        for run in map(measured, read_runs(map(Path, runs)))
    ]


def _train(settings: RunSettings, workers: int, on_step: OnStep | None, fitness: Fitness | None = None) -> Trained:
    settings.check()
    check_workers(workers, 0.0)
    maps = Maps(settings.scenario, SimConfig())
    pool: WorkerPool | None = None
    try:
        pool = open_pool(workers, None, 0.0, maps.build)
        learning = new_learning(settings, pool, maps)
        if fitness is not None and isinstance(learning, Evolution):
            learning.score = fitness
        while not learning.done():
            finish(learning.step())
            learning.elites.clear()  # needed only for a run's folder
            if on_step:
                on_step(learning.steps, learning.history[-1])
        finish(learning.choose_champion())
        assert learning.champion is not None
        genome = learning.champion.genome
        champion = Champion(genome, settings.policy, settings.scenario, learning.sim, settings.traffic)
        return champion, learning.history
    finally:
        if pool:
            pool.close()
        maps.close()
