"""A comparison's runs, one after the other in this process, on one pool of workers."""

from __future__ import annotations

import math
import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from cluster.commands.progress import way
from cluster.comparison.plan import COMPARISON, Cell, CellError
from cluster.runs.checkpoint import CheckpointError
from cluster.runs.run import CHECKPOINT, CONFIG, RunError, RunFolder, Session, lock, make_tracker, new_run, open_run
from cluster.runs.settings import MAX_STEPS, DqnSettings, EvolveSettings, RunSettings, SettingsError
from cluster.tracking.mlflow_run import Status
from cluster.training.trainer import Maps
from cluster.workers import kernels
from cluster.workers.pool import PoolError, SerialPool, WorkerPool
from gridsim.config import SimConfig
from gridsim.maps.map import Map

UNBOUND = MAX_STEPS  # generations or car-steps, where a budget is what ends a run
EVALUATIONS = 10  # of the DQN at least


@dataclass
class Cells:
    """Executes cells: an `plan.Execute`.

    Attributes:
        workers, address, tracking_uri, experiment: as the command has them.
        parent_id: MLflow's run that the cells belong to, or "".
        note: told how far a run is, and perhaps more of it.
        patience: as the command has it.
    """

    workers: int
    address: str
    tracking_uri: str
    experiment: str
    parent_id: str = ""
    note: Callable[..., None] = lambda text, more="": None
    patience: float = 0.0
    _pool: WorkerPool | None = None
    _maps: Maps | None = field(default=None, init=False)

    def __call__(self, cell: Cell) -> dict[str, Any]:
        try:
            run = self._folder(cell)
            run.settings.check()
            return self._train(cell, run)
        except PoolError as error:
            self.close()  # the next run has workers of its own
            raise CellError(str(error)) from error
        except (CheckpointError, RunError, SettingsError, FloatingPointError) as error:
            raise CellError(str(error)) from error

    def close(self) -> None:
        """Stop the workers."""
        if self._pool:
            self._pool.close()
            self._pool = None

    def _folder(self, cell: Cell) -> RunFolder:
        """A new run's folder, or that of one that goes on."""
        if (cell.folder / CHECKPOINT).is_file():
            run = open_run(cell.folder)
            if run.settings != settings_of(cell):
                raise CellError(
                    f"{cell.folder}: its {CONFIG} is not what {COMPARISON} asks for; one of them was edited"
                )
            return run
        if cell.folder.exists():  # it was killed before its first step; `Cell.check` has looked at what is in it
            shutil.rmtree(cell.folder)
        return new_run(cell.folder.parent, cell.name, settings_of(cell))

    def _train(self, cell: Cell, run: RunFolder) -> dict[str, Any]:
        settings = run.settings
        self._maps = maps = Maps(settings.scenario, SimConfig())
        warming = kernels.begin(settings)
        tracker = make_tracker(run, self.tracking_uri, self.experiment, self.parent_id)
        status: Status = "KILLED"
        try:
            pool = self._workers(run.path.parent.name)
            session = Session(
                run, pool, maps, tracker, time.perf_counter(), film=False,
                wall_limit_s=cell.plan.budget.wall_s or math.inf,
                on_row=lambda _, row: self.note(
                    f"{way(session.learning, bound=False)}  success {row['validation/success_rate']:.0%}",
                    session.learning.describe(row),
                ),
            )  # fmt: skip
            session.learning.warn = lambda text: print(f"{cell.name}: warning: {text}", file=sys.stderr, flush=True)
            maps.ahead(session.learning.curriculum.map_seeds[:3])
            if warming.processes:
                self.note("compiling the simulator for this machine, once")
            warming.wait()
            kernels.compile_kernels(settings.policy, settings.traffic, settings.command)
            lock(run.path)
            run.write_config()
            session.process_started = time.perf_counter()  # a budget is of learning, not of what is loaded for it
            session.learn()
            summary = session.complete(self.workers, self.note)
            status = "FINISHED"
            return summary
        except Exception:
            status = "FAILED"
            raise
        finally:
            warming.stop()
            maps.close()
            tracker.close(status, timeout_s=60.0 if status == "FINISHED" else 15.0)

    def _workers(self, comparison: str) -> WorkerPool:
        """The pool of all runs."""
        if self._pool is None and self.workers:
            from cluster.workers.ray_pool import RayPool

            address = self.address or os.environ.get("RAY_ADDRESS") or None
            self._pool = RayPool(self.workers, self._build, address, patience_s=self.patience)
        elif self._pool is None:
            self._pool = SerialPool(self._build)
        return self._pool

    def _build(self, scenario: str, seed: int) -> Map:
        assert self._maps is not None
        return self._maps.build(scenario, seed)


def settings_of(cell: Cell) -> RunSettings:
    """What a cell's run is asked to do."""
    plan = cell.plan
    common: dict[str, Any] = {"scenario": cell.scenario, "traffic": cell.traffic, "seed": cell.seed}
    if cell.learner == "dqn":
        steps = plan.budget.car_steps or UNBOUND
        usual = DqnSettings.suited[plan.observation]["evaluate_every"]
        every = min(usual, max(steps // EVALUATIONS, 1))
        return DqnSettings(**common, observation=plan.observation, car_steps=steps, evaluate_every=every)
    if plan.population:
        common["population"] = plan.population
    return EvolveSettings(
        **common,
        observation=plan.observation,
        search="random" if cell.learner == "random" else "evolution",
        recombination="two" if cell.learner == "two-parents" else "all",
        car_steps=plan.budget.car_steps,
        generations=plan.generations or UNBOUND,
    )
