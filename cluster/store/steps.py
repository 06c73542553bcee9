"""The row of the history and the elite of each step of a run, in a file that grows with the run.

The checkpoint holds only the number of these records and their digest. Records are on the disk before the checkpoint
that counts them: any that a kill leaves uncounted are cut off when the run is resumed, and made again. When a run ends,
its history moves into the checkpoint and its elites into elites.npz, and the file is deleted.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from cluster.redaction import one_line
from cluster.store import checkpoint
from cluster.store.checkpoint import CHECKPOINT, STEPS, CheckpointError, WriteError
from cluster.store.folder import ELITES
from evolution.networks.policy import PolicySpec


def records(rows: np.ndarray, elites: np.ndarray | Sequence[np.ndarray]) -> np.ndarray:
    """Records [n] of the file: rows float64 [n, columns] and elites float32 [n, genes]."""
    made = np.zeros(len(rows), _record(rows.shape[1], len(elites[0])))
    made["row"], made["elite"] = rows, elites
    return made


def append(path: Path, first: int, new: np.ndarray) -> None:
    """Write records from number `first` on and cut off what follows them; they are on the disk when this returns.

    Raises: WriteError; the records before are kept.
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
        raise WriteError(f"{path}: cannot be written: {one_line(error)}") from error


def resume(folder: Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any], genes: int) -> np.ndarray:
    """The records that a run's checkpoint counts; if the run had ended, their file is written again.

    Raises: CheckpointError, and KeyError or ValueError if another version wrote the checkpoint.
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
    """The elites float32 [steps, genes], of that policy, of a run that is going on, was stopped or has ended.

    Raises: CheckpointError.
    """
    genes, path = PolicySpec.parse(policy).size, folder / STEPS
    try:
        with open(path, "rb") as file:  # opened before the checkpoint is read: a run that ends deletes it
            return np.array(_read(file, checkpoint.load(folder / CHECKPOINT)[1], genes)["elite"])
    except FileNotFoundError:
        path = folder / ELITES
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {one_line(error)}") from error
    genomes = checkpoint.load(path)[0].get("genomes")
    if genomes is None or genomes.dtype != np.float32 or genomes.shape[1:] != (genes,) or not len(genomes):
        raise CheckpointError(f"{path}: its elites do not fit {policy}")
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
