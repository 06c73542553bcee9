"""GridSim from Python, without folders or MLflow: train with a fitness of one's own, load, drive, evaluate.

`import gridsim` has all of this: `gridsim.evolve(scenario="city", workers=2)`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cluster.runs.champion import Champion, evaluate, load_champion
from cluster.runs.settings import DqnSettings, EvolveSettings, RunSettings
from cluster.runs.train import Workers, new_learning
from cluster.training.evolution import Evolution
from cluster.training.trainer import Maps
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
        settings: as the command's flags; or give those by name, such as scenario="city".
        fitness: scores float64 [n], greater is better, from the episodes' results (structured, [n, episodes], with
            fields distance (m), paced (m at a speed within the interval), steps and end (`gridsim.car.ego.End`)) and
            the episodes' targets (m). It runs here, never in the workers. Default: `evolution.search.fitness.scalar`.
        workers: Ray workers on this machine; 0 evaluates in this process.
        on_generation: called with the number of generations done and the last one's figures.

    Returns: the champion, and the history, a row of figures for each generation, by the names of a run's history.csv:
    `.../mean` is of all members on training's episodes, `.../best` of the best genome so far on episodes of its own.
    Raises: SettingsError, PoolError with one line.
    """
    return _train(settings or EvolveSettings(**flags), workers, on_generation, fitness)


def train_dqn(
    settings: DqnSettings | None = None, workers: int = 0, on_evaluation: OnStep | None = None, **flags: Any
) -> Trained:
    """Train a driver by deep Q-learning, in memory. As `evolve`; the history has a row for each evaluation.

    >>> import gridsim
    >>> champion, history = gridsim.train_dqn(scenario="curved", car_steps=1000)
    """
    return _train(settings or DqnSettings(**flags), workers, on_evaluation)


def compare(*runs: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Compare finished runs, as `gridsim-compare RUNS` does: figures of each, and its errors against the reference.

    Args:
        runs: their folders; a comparison's folder stands for all of its finished runs.

    Returns: a row for each run: folder, scenario, learner, seed, traffic, and the figures as table.csv names them; nan
    where an error is not known.
    Raises: GridSimError with one line for what is no finished run.
    """
    from cluster.comparison.plan import read_runs
    from cluster.comparison.results import errors_of

    names = ("scenario", "learner", "seed", "traffic")
    return [
        {"run": str(run.folder), **{name: getattr(run.settings, name) for name in names}}
        | {**run.figures, **errors_of(run)}
        for run in read_runs(map(Path, runs))
    ]


def _train(settings: RunSettings, workers: int, on_step: OnStep | None, fitness: Fitness | None = None) -> Trained:
    settings.check()
    maps = Maps(settings.scenario, SimConfig())
    team = Workers(workers, address=None, patience_s=0.0)
    try:
        learning = new_learning(settings, team.open(maps), maps)
        if fitness is not None and isinstance(learning, Evolution):
            learning.score = fitness
        while not learning.done():
            row = learning.step()
            learning.elites.clear()  # nobody asks for them
            if on_step:
                on_step(learning.steps, row)
        learning.validate_last()
        assert learning.champion is not None
        genome = learning.champion.genome
        champion = Champion(genome, settings.policy, settings.scenario, learning.sim, settings.traffic)
        return champion, learning.history
    finally:
        team.close()
        maps.close()
