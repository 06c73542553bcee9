"""Files that survive a kill: saved atomically, loaded only if every byte is as it was written.

The format is NumPy's `.npz` (an uncompressed zip; `np.load` reads it) with two additions: the member `meta`, JSON as
uint8, and a zip comment `sha256:<hex>` that covers every byte before the hex digits. So a truncated or edited file is
detected before anything in it is parsed. Nothing is ever pickled.
"""

import contextlib
import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from cluster.redaction import one_line
from gridsim.errors import GridSimError

CONFIG, CHECKPOINT, STEPS, HISTORY = "config.json", "checkpoint.npz", "steps.bin", "history.csv"
"""Files of a run's folder: config.json from the start, the others from the first saved step on."""
MLFLOW = "mlflow.json"
"""File that says where MLflow has the run; only `cluster.tracking` reads and writes this file."""
CHAMPION, ELITES, SUMMARY = "champion.npz", "elites.npz", "summary.json"
"""Files that a finished run has. If it is extended, summary.json is deleted until it is finished again."""

VERSION = 1
_MARK = b"sha256:"
_DIGEST = 64  # hex digits of a sha256


class CheckpointError(GridSimError):
    """A file that cannot be saved or must not be trusted; the message is one line for the user."""


class WriteError(CheckpointError):
    """A file that cannot be written; the message is one line for the user."""


def save(path: str | os.PathLike[str], arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
    """Replace the file at `path` with `arrays` and `meta`, or leave it as it was and raise WriteError.

    The same content gives the same bytes. `meta` has to be plain JSON (string keys; tuples come back as lists).
    """
    text = json.dumps({"format": "gridsim", "version": VERSION, "meta": meta})
    buffer = io.BytesIO()
    ordered = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    np.savez(buffer, allow_pickle=False, meta=np.frombuffer(text.encode(), np.uint8), **ordered)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = _MARK + b"0" * _DIGEST
    content = buffer.getbuffer()
    content[-_DIGEST:] = hashlib.sha256(content[:-_DIGEST]).hexdigest().encode()
    write_atomic(path, content)


def load(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `save` wrote: the arrays (in memory of their own, aligned, writable, C order) and the meta data.

    Raises CheckpointError, and nothing else, for a file that is missing, truncated, edited or not GridSim's.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:  # the latter for a name with a null byte
        raise CheckpointError(f"{path}: cannot be read: {one_line(error)}") from error
    if content[-_DIGEST - len(_MARK) : -_DIGEST] != _MARK:
        raise CheckpointError(f"{path}: truncated, or not a GridSim file")
    if content[-_DIGEST:] != hashlib.sha256(memoryview(content)[:-_DIGEST]).hexdigest().encode():
        raise CheckpointError(f"{path}: damaged or edited: its content does not match its checksum")
    # A checksum is not a signature: another program may have written these bytes. zipfile, numpy and json raise a dozen
    # kinds of errors for such content, which all mean the same.
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop("meta").tobytes().decode())
        if (header["format"], header["version"]) != ("gridsim", VERSION):
            raise ValueError(f"its format is not {VERSION}, which this GridSim reads")
        return arrays, dict(header["meta"])
    except Exception as error:
        raise CheckpointError(f"{path}: not a GridSim file ({one_line(error):.120})") from error


def write_atomic(path: str | os.PathLike[str], content: bytes | memoryview) -> None:
    """Replace the file at `path` with `content`, flushed to the disk, or leave it as it was and raise WriteError."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.tmp")  # left behind by a killed process, until the next write
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {one_line(error)}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_json(path: Path, content: dict[str, Any]) -> None:
    """`write_atomic` for a JSON file."""
    write_atomic(path, (json.dumps(content, indent=2) + "\n").encode())
