"""A comparison's runs, one after the other in this process, on one pool of workers."""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

from cluster.commands.progress import way
from cluster.comparison.plan import COMPARISON, Cell, CellError
from cluster.runs.checkpoint import CheckpointError
from cluster.runs.run import CHECKPOINT, CONFIG, RunError, RunFolder, new_run, open_run
from cluster.runs.settings import MAX_STEPS, DqnSettings, EvolveSettings, RunSettings, SettingsError
from cluster.runs.train import Reporter, Session, Workers, train
from cluster.training.trainer import Learning
from cluster.workers.pool import PoolError

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
    _workers: Workers | None = None

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
        if self._workers:
            self._workers.close()

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
        if self._workers is None:
            address = self.address or os.environ.get("RAY_ADDRESS") or None
            self._workers = Workers(self.workers, address, self.patience)
        reporter = CellReporter(cell, self.note)
        wall_limit_s = cell.plan.budget.wall_s or math.inf
        return train(
            run, self._workers, self.tracking_uri, self.experiment, reporter, parent_id=self.parent_id, film=False,
            wall_limit_s=wall_limit_s,
        ).summary  # fmt: skip


@dataclass
class CellReporter(Reporter):
    """Shows how far a cell is; `tell` shows a text, and perhaps more of it."""

    cell: Cell
    tell: Callable[..., None]
    _learning: Learning | None = None

    def warn(self, text: str) -> None:
        print(f"{self.cell.name}: warning: {text}", file=sys.stderr, flush=True)

    def compiling(self) -> AbstractContextManager[object]:
        self.tell("compiling the simulator for this machine, once")
        return nullcontext()

    def learning(self, session: Session) -> AbstractContextManager[object]:
        self._learning = session.learning
        return nullcontext()

    def row(self, steps: int, row: dict[str, float]) -> None:
        assert self._learning is not None
        success = f"success {row['validation/success_rate']:.0%}"
        self.tell(f"{way(self._learning, bound=False)}  {success}", self._learning.describe(row))

    def note(self, text: str) -> None:
        self.tell(text)

    def unsent(self, text: str, finished: bool) -> None:
        command = "gridsim-dqn" if self.cell.learner == "dqn" else "gridsim-evolve"
        self.warn(f"{text}; send it later with: {command} --resume {self.cell.folder}" if finished else text)


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
