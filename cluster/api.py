"""GridSim's Python API: train drivers, also with your own fitness or search; load, drive and evaluate them.

`import gridsim` offers all of it: `gridsim.evolve(scenario="city", workers=2)`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

from cluster.evaluator import Evaluator
from cluster.fitness import Fitness, forget, give
from cluster.learn.learning import Event, finish
from cluster.learn.maps import Maps
from cluster.run import Place, new_learning, send, train
from cluster.settings import DqnSettings, EvolveSettings, RunSettings, check_workers
from cluster.store.champion import Champion, evaluate, load_champion
from cluster.store.checkpoint import CHECKPOINT
from cluster.store.folder import is_finished, new_run, open_run
from cluster.store.steps import read_history
from cluster.tracking.address import check_uri
from cluster.tracking.tracking import saved_uri
from cluster.workers.address import cluster_address
from cluster.workers.open import open_pool
from cluster.workers.pool import WorkerPool
from gridsim.errors import GridSimError

__all__ = [
    "Champion",
    "DqnSettings",
    "Evaluator",
    "EvolveSettings",
    "compare",
    "evaluate",
    "evolve",
    "load_champion",
    "train_dqn",
]

Settings = TypeVar("Settings", bound=RunSettings)
OnStep = Callable[[int, dict[str, float]], None]
Trained = tuple[Champion, list[dict[str, float]]]


def evolve(
    settings: EvolveSettings | None = None,
    fitness: Fitness | str | None = None,
    workers: int = 0,
    on_generation: OnStep | None = None,
    *,
    folder: str | os.PathLike[str] | None = None,
    resume: bool = False,
    address: str | None = None,
    tracking_uri: str | None = None,
    **flags: Any,
) -> Trained:
    """Evolve a driver.

    >>> import gridsim
    >>> champion, history = gridsim.evolve(scenario="curved", population=32, generations=2)
    >>> len(history)
    2

    Args:
        settings: what gridsim-evolve's flags for learning set. Give these here, or by name, such as scenario="city".
        fitness: returns scores float64 [n], higher is better, given the episodes' results (structured, [n, episodes],
            with fields distance (m), paced (m at a speed within the road's interval), steps, end (`gridsim.state.End`),
            and figures of comfort, see docs/own.md) and targets (m, float64 [episodes]). It runs in this process only.
            Default: `evolution.episodes.fitness.scalar`. A string is a name as for --fitness.
        workers: number of Ray workers; 0 without `address`: this process evaluates, on all its cores.
        on_generation: called after each generation with the number of those done and the latest one's figures.
        folder: a new folder in which the run is kept, as gridsim-evolve does in runs/NAME; None keeps nothing.
        resume: go on with the run in `folder` if there is one; its settings must be these, but limits may be raised.
        address: a Ray cluster, host:port or "auto", to run the workers on instead of this machine; with it, 0 workers
            mean one for each free CPU. None is this machine, whatever RAY_ADDRESS says.
        tracking_uri: MLflow's address, to which a run with a folder is sent; None sends nothing.

    Returns: the champion, and the history: a row of figures for each generation, named as in a run's history.csv.
    `.../mean` is over all members on training episodes, `.../best` of the leader (the best genome known before the
    generation) on longer episodes of its own, or of the best member in a generation without a leader, the first.
    Raises: GridSimError; the message is one line.
    """
    settings = _settings(EvolveSettings, settings, flags)
    if fitness:
        settings = replace(settings, fitness=fitness if isinstance(fitness, str) else give(fitness))
    return _train(settings, workers, on_generation, folder, resume, address, tracking_uri)


def train_dqn(
    settings: DqnSettings | None = None,
    workers: int = 0,
    on_evaluation: OnStep | None = None,
    *,
    folder: str | os.PathLike[str] | None = None,
    resume: bool = False,
    address: str | None = None,
    tracking_uri: str | None = None,
    **flags: Any,
) -> Trained:
    """Train a driver by deep Q-learning.

    >>> import gridsim
    >>> champion, history = gridsim.train_dqn(scenario="curved", car_steps=1000)

    Arguments and result are as for `evolve`, with an evaluation in place of a generation, and without `fitness`. In the
    history, `distance_m/mean` and `speed_mps/mean` are over the training episodes since the evaluation before,
    `.../best` is the network's in validation.
    Raises: GridSimError, with a one-line message; FloatingPointError if the network diverged.
    """
    settings = _settings(DqnSettings, settings, flags)
    return _train(settings, workers, on_evaluation, folder, resume, address, tracking_uri)


def compare(*runs: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Compare finished runs, as `gridsim-compare RUNS` does: their figures, and errors against a reference driver.

    Args:
        runs: their folders; a comparison's folder stands for all of its finished runs.

    Returns: a row for each run: run (its folder), scenario, learner, seed, traffic, and the figures as table.csv names
    them; an error that could not be measured is nan.
    Raises: GridSimError, with a one-line message, if a run is not finished or is damaged, or if two folders hold the
    same one.
    """
    from cluster.compare.plan import read_runs
    from cluster.compare.results import measured

    names = ("scenario", "learner", "seed", "traffic")
    return [
        {"run": str(run.folder), **{name: getattr(run.settings, name) for name in names}, **run.figures}
        for run in map(measured, read_runs(map(Path, runs)))
    ]


def _settings(kind: Callable[..., Settings], settings: Settings | None, flags: dict[str, Any]) -> Settings:
    """The settings that were given, as an object or by name. Raises GridSimError if both are given."""
    if settings and flags:
        raise GridSimError(f"give either settings or {', '.join(flags)} by name; dataclasses.replace changes settings")
    return settings or kind(**flags)


def _train(
    settings: RunSettings, workers: int, on_step: OnStep | None, folder: str | os.PathLike[str] | None, resume: bool,
    address: str | None, tracking_uri: str | None,
) -> Trained:  # fmt: skip
    forget()
    settings.check()
    check_workers(workers, 0.0)
    if folder is None and (resume or tracking_uri):
        raise GridSimError("resume and tracking_uri are for a run that is kept: give a folder, too")
    cluster = cluster_address(address) if address else None
    on_row = on_step or (lambda steps, row: None)
    if folder is not None:
        return _train_in(Path(folder), settings, Place(workers, cluster), on_row, resume, tracking_uri)
    maps = Maps(settings.scenario, settings.simulator())
    pool: WorkerPool | None = None
    try:
        pool = open_pool(workers, cluster, 0.0, maps.build)
        learning, begun = new_learning(settings, pool, maps), perf_counter()
        while not learning.done():
            finish(learning.step())
            learning.add_wall_clock(perf_counter() - begun)
            learning.elites.clear()  # needed only for a run's folder
            on_row(learning.steps, learning.history[-1])
        finish(learning.choose_champion())
        assert learning.champion is not None
        genome = learning.champion.genome
        champion = Champion(genome, settings.policy, settings.scenario, learning.sim, settings.traffic)
        return champion, learning.history
    finally:
        if pool:
            pool.close()
        maps.close()


def _train_in(
    folder: Path, settings: RunSettings, place: Place, on_row: OnStep, resume: bool, tracking_uri: str | None
) -> Trained:
    """Train a new run in a folder, or resume the run in it. If that is finished, it is only read and sent to MLflow."""
    if resume and (folder / CHECKPOINT).is_file():
        run = open_run(folder)
        if type(run.settings) is not type(settings):
            raise GridSimError(f"{folder} is a run of another learner, {run.settings.command}")
        settings = settings.extending(run.settings)
        if replace(settings, **{name: getattr(run.settings, name) for name in settings.extendable}) != run.settings:
            raise GridSimError(f"{folder} is a run with other settings; give those, or another folder")
        run.settings = settings
    else:
        run = new_run(folder.absolute().parent, folder.name, settings, may_exist=resume)
    if tracking_uri is not None:
        place = replace(place, uri=check_uri(tracking_uri, saved_uri(run.path)))

    def warn(event: Event) -> None:
        if event.warning:
            warnings.warn(event.text, stacklevel=2)

    if not is_finished(run):
        history = train(run, place, warn, on_row).learning.history
    else:
        history = read_history(run.path)
        if tracking_uri is not None and (unsent := send(run, place.uri)[1]):
            warnings.warn(unsent, stacklevel=2)
    return load_champion(run.path), history
