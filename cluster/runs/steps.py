"""What each step of a run leaves for good, its row of the history and its elite, in a file that grows with the run.

The checkpoint counts them and has their digest, and so is as small after thousands of steps as after the first. They
are on the disk before it is: what a kill leaves behind the last step that is counted is cut off when the run goes on,
and comes again. When a run ends, its history goes into the checkpoint, its elites into elites.npz, and the file goes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from cluster.runs import checkpoint
from cluster.runs.checkpoint import CHECKPOINT, STEPS, CheckpointError, one_line
from cluster.runs.run import ELITES
from evolution.networks.policy import PolicySpec


def records(rows: np.ndarray, elites: np.ndarray | Sequence[np.ndarray]) -> np.ndarray:
    """Records [n] of the file: rows float64 [n, columns] and elites float32 [n, genes]."""
    made = np.zeros(len(rows), _record(rows.shape[1], len(elites[0])))
    made["row"], made["elite"] = rows, elites
    return made


def append(path: Path, first: int, new: np.ndarray) -> None:
    """Write records from number `first` on and cut off what is behind them; they are on the disk when this returns.

    Raises: CheckpointError with one line; the records before are kept.
    """
    try:
        path.touch()
        with open(path, "r+b") as file:
            file.seek(first * new.itemsize)
            file.write(new.tobytes())
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written: {one_line(error)}") from error


def resume(folder: Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any], genes: int) -> np.ndarray:
    """The records that a run's checkpoint counts; of a run that had ended they are written again.

    Raises: CheckpointError with one line, and KeyError or ValueError where another version wrote the checkpoint.
    """
    path = folder / STEPS
    if "history" not in arrays:
        try:
            with open(path, "rb") as file:
                return _read(file, meta, genes)
        except OSError as error:
            raise CheckpointError(f"{path}: cannot be read: {one_line(error)}") from error
    digest = meta["steps_sha256"]
    made = records(arrays["history"], checkpoint.load(folder / ELITES)[0]["genomes"])
    if hashlib.sha256(made.tobytes()).hexdigest() != digest:
        raise CheckpointError(f"{folder}: {ELITES} and {CHECKPOINT} do not belong together: one of them was edited")
    checkpoint.write_atomic(path, made.tobytes())
    return made


def read_elites(folder: Path, policy: str) -> np.ndarray:
    """The elites float32 [steps, genes] of a run that is going on, was stopped or has ended, of that policy.

    Raises: CheckpointError with one line.
    """
    genes, path = PolicySpec.parse(policy).size, folder / STEPS
    try:
        with open(path, "rb") as file:  # opened before the checkpoint is read: it goes when the run ends
            return np.array(_read(file, checkpoint.load(folder / CHECKPOINT)[1], genes)["elite"])
    except FileNotFoundError:
        path = folder / ELITES
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {one_line(error)}") from error
    genomes = checkpoint.load(path)[0].get("genomes")
    if genomes is None or genomes.dtype != np.float32 or genomes.shape[1:] != (genes,) or not len(genomes):
        raise CheckpointError(f"{path}: its elites are no {policy}")
    return genomes


def _record(columns: int, genes: int) -> np.dtype:
    return np.dtype([("row", "<f8", (columns,)), ("elite", "<f4", (genes,))])


def _read(file: BinaryIO, meta: Mapping[str, Any], genes: int) -> np.ndarray:
    """The records that a checkpoint with this `meta` counts. Raises: CheckpointError if they are not in the file."""
    kind = _record(len(meta.get("columns", ())), genes)
    content = file.read(kind.itemsize * meta.get("steps", 0))
    if hashlib.sha256(content).hexdigest() != meta.get("steps_sha256"):
        raise CheckpointError(f"{file.name}: damaged or edited: it lacks steps that {CHECKPOINT} counts")
    return np.frombuffer(content, kind)
