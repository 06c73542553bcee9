"""The row of the history and the network of each step of a run, as records of one file, steps.bin.

A record is on the disk before the checkpoint that counts it. If the run is killed in between, records that are not
counted are overwritten when it goes on. history.csv and elites.npz are written from the records.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cluster.redaction import one_line
from cluster.store import checkpoint
from cluster.store.checkpoint import CHECKPOINT, ELITES, HISTORY, STEPS, CheckpointError, WriteError
from evolution.networks.policy import PolicySpec


class Steps:
    """The saved steps of a run, to which this process adds.

    Args: the run's `folder`; `step_name`, what a step is called; the history's `columns`; `genes`, a genome's size.
    """

    def __init__(self, folder: Path, step_name: str, columns: Sequence[str], genes: int):
        self.number = 0  # steps that are saved; after a kill, steps.bin may hold further records, which do not count
        self._folder, self._record = folder, _record(len(columns), genes)
        self._history = [",".join([step_name, *columns])]  # lines of history.csv

    def resume(self, meta: Mapping[str, Any]) -> np.ndarray:
        """Go on from the `steps` that a checkpoint's meta data counts. Returns: their rows, float64 [n, columns].

        Raises: CheckpointError.
        """
        records = _read(self._folder, meta, self._record)
        self.number = len(records)
        return records["row"]

    def append(self, rows: np.ndarray, elites: Sequence[np.ndarray]) -> None:
        """Add n steps: rows float64 [n, columns] and n elites, each float32 [genes]. Returns once they are on the disk.

        Raises: WriteError; the steps before are kept.
        """
        new = np.zeros(len(rows), self._record)
        new["row"], new["elite"] = rows, elites
        path = self._folder / STEPS
        try:
            with open(path, "ab") as file:
                file.truncate(self.number * new.itemsize)
                file.write(new.tobytes())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise WriteError(f"{path}: cannot be written: {one_line(error)}") from error
        self.number += len(new)

    def write_history(self, rows: np.ndarray) -> None:
        """Write history.csv anew: the rows of earlier calls, then `rows`, float64 [n, columns]. Raises: WriteError."""
        for row in rows.tolist():
            self._history.append(",".join([str(len(self._history) - 1), *map(repr, row)]))
        checkpoint.write_atomic(self._folder / HISTORY, "\n".join([*self._history, ""]).encode())


def read_history(folder: Path) -> list[dict[str, float]]:
    """The rows of history.csv, each as figures by column, without the step's number. Raises: OSError."""
    with open(folder / HISTORY, newline="") as file:
        (_, *columns), *rows = csv.reader(file)
    return [dict(zip(columns, map(float, row[1:]), strict=True)) for row in rows]


def read_elites(folder: Path, policy: str) -> np.ndarray:
    """The network of each saved step of a run, which may still be going on: float32 [steps, genes].

    Args: `policy`, the run's. Raises: CheckpointError.
    """
    meta = checkpoint.load(folder / CHECKPOINT)[1]
    return _read(folder, meta, _record(len(meta.get("columns", ())), PolicySpec.parse(policy).size))["elite"]


def write_elites(folder: Path, policy: str) -> np.ndarray:
    """Write elites.npz, which holds `genomes` float32 [steps, genes]. Returns: `genomes`. Raises: CheckpointError."""
    genomes = np.ascontiguousarray(read_elites(folder, policy))
    checkpoint.save(folder / ELITES, {"genomes": genomes}, {"policy": policy})
    return genomes


def _record(columns: int, genes: int) -> np.dtype:
    return np.dtype([("row", "<f8", (columns,)), ("elite", "<f4", (genes,))])


def _read(folder: Path, meta: Mapping[str, Any], record: np.dtype) -> np.ndarray:
    """The records that a checkpoint with this `meta` counts. Raises: CheckpointError if steps.bin has fewer."""
    path, number = folder / STEPS, meta.get("steps", 0)
    try:
        with open(path, "rb") as file:
            return np.frombuffer(file.read(number * record.itemsize), record, number)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {one_line(error)}") from error
    except ValueError as error:
        raise CheckpointError(f"{path}: damaged or edited: it lacks steps that {CHECKPOINT} counts") from error
