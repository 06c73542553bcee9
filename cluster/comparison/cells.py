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
from cluster.comparison.plan import Cell
from cluster.runs.run import CHECKPOINT, RunFolder, new_run, open_run
from cluster.runs.train import Reporter, Session, Workers, train
from cluster.training.trainer import Learning
from cluster.workers.pool import PoolError


@dataclass
class Cells:
    """Trains runs, each to its end, from its checkpoint if it has one.

    Attributes:
        workers, address, tracking_uri, experiment: as the command has them.
        wall_s: s of wall time that a run may take, or 0.
        parent_id: MLflow's run that they belong to, or "".
        note: called with how far a run is, and perhaps more of it.
        patience: as the command has it.
    """

    workers: int
    address: str
    tracking_uri: str
    experiment: str
    wall_s: float = 0.0
    parent_id: str = ""
    note: Callable[..., None] = lambda text, more="": None
    patience: float = 0.0
    _workers: Workers | None = None

    def __call__(self, cell: Cell) -> dict[str, Any]:
        """Returns the run's summary. Raises GridSimError, FloatingPointError."""
        try:
            return self._train(cell, self._folder(cell))
        except PoolError:
            self.close()  # the next run has workers of its own
            raise

    def close(self) -> None:
        """Stop the workers."""
        if self._workers:
            self._workers.close()

    def _folder(self, cell: Cell) -> RunFolder:
        """A new run's folder, or that of one that goes on; `Cell.check` has looked at what is in it."""
        if (cell.folder / CHECKPOINT).is_file():
            return open_run(cell.folder)
        if cell.folder.exists():  # it was killed before its first step
            shutil.rmtree(cell.folder)
        return new_run(cell.folder.parent, cell.name, cell.settings)

    def _train(self, cell: Cell, run: RunFolder) -> dict[str, Any]:
        if self._workers is None:
            address = self.address or os.environ.get("RAY_ADDRESS") or None
            self._workers = Workers(self.workers, address, self.patience)
        reporter = CellReporter(cell, self.note)
        return train(
            run, self._workers, self.tracking_uri, self.experiment, reporter, parent_id=self.parent_id,
            wall_limit_s=self.wall_s or math.inf,
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
        again = f"{self.cell.settings.command} --resume {self.cell.folder}"
        self.warn(f"{text}; send it later with: {again}" if finished else text)
