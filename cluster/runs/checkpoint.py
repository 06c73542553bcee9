"""Files that survive a kill: saved atomically, loaded only if every byte is as it was written.

The format is NumPy's `.npz` (an uncompressed zip; `np.load` reads it) with two additions: the member `meta`, JSON as
uint8, and a zip comment `sha256:<hex>` that covers every byte before the hex digits. So a truncated or edited file is
told from a whole one before anything in it is parsed. Nothing is ever pickled.
"""

import contextlib
import hashlib
import io
import json
import math
import os
import stat
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from gridsim.errors import GridSimError

CONFIG, CHECKPOINT, CHAMPION = "config.json", "checkpoint.npz", "champion.npz"
"""Files of a run's folder."""

VERSION = 1
MAX_BYTES = 1 << 32
"""The largest file, in bytes, that is written or read."""
MAX_ARRAYS = 1024

_META = "meta"
_MARK = b"sha256:"
_DIGEST = 64  # hex digits of a sha256
_STALE_S = 60.0


class CheckpointError(GridSimError):
    """A file that cannot be saved or that must not be trusted; its text is one line for the user."""


def save(path: str | os.PathLike[str], arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
    """Write `arrays` and `meta` to `path` in one step: afterwards the file is the new one whole, or the old one whole.

    The same content gives the same bytes. `meta` has to be plain JSON (string keys; tuples come back as lists).
    Raises TypeError or ValueError for what the format cannot hold (objects, a name that is no identifier) and
    CheckpointError if the file cannot be written (a full disk, a folder that is gone).
    """
    text = json.dumps({"format": "gridsim", "version": VERSION, "meta": meta})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.comment = _MARK + b"0" * _DIGEST
        _add(archive, _META, np.frombuffer(text.encode(), np.uint8))
        for name, array in arrays.items():
            if not name.isidentifier() or name == _META:
                raise ValueError(f"{name!r} cannot be an array's name")
            _add(archive, name, np.asarray(array, order="C"))
    content = buffer.getbuffer()
    if len(content) > MAX_BYTES or len(arrays) >= MAX_ARRAYS:
        raise CheckpointError(f"{path}: too large to be saved ({len(content):,} bytes, {len(arrays)} arrays)")
    content[-_DIGEST:] = hashlib.sha256(content[:-_DIGEST]).hexdigest().encode()
    write_atomic(path, content)


def load(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `save` wrote: the arrays (owned, aligned, writable, C order) and the meta data.

    Raises CheckpointError, and nothing else, for a file that is missing, truncated, edited, hostile or another's.
    """
    content = _read(path)
    if not content.startswith(b"PK\x03\x04"):
        raise CheckpointError(f"{path}: {'not a GridSim file' if content else 'the file is empty'}")
    if content[-_DIGEST - len(_MARK) : -_DIGEST] != _MARK:
        raise CheckpointError(f"{path}: truncated, or not written by GridSim")
    if content[-_DIGEST:] != hashlib.sha256(memoryview(content)[:-_DIGEST]).hexdigest().encode():
        raise CheckpointError(f"{path}: damaged or edited: its content does not match its checksum")
    # From here on the bytes are as somebody wrote them, who need not have been `save`: a checksum is no signature.
    # zipfile, numpy and json raise a dozen kinds of errors on such input, and each means the same.
    try:
        arrays = _parse(content)
        header = json.loads(arrays.pop(_META).tobytes().decode())
        if header["format"] != "gridsim" or not isinstance(header["meta"], dict):
            raise ValueError("it holds no GridSim data")
        version, meta = header["version"], header["meta"]
    except Exception as error:
        raise CheckpointError(f"{path}: not a GridSim file ({_one_line(error)})") from error
    if version != VERSION:
        raise CheckpointError(f"{path}: written in format {repr(version)[:20]}; this GridSim reads format {VERSION}")
    return arrays, meta


def write_atomic(path: str | os.PathLike[str], content: bytes | memoryview, durable: bool = True) -> None:
    """Replace the file at `path` by `content`, or leave it as it was and raise CheckpointError.

    With `durable` it is on the disk when this returns. Without, a power cut (no mere kill) can lose it; for
    what can be made again.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        reason = error.strerror or _one_line(error)
        kept = "; the one before it is kept" if path.exists() else ""
        raise CheckpointError(f"{path}: cannot be written: {reason}{kept}") from error
    with contextlib.suppress(OSError):  # the file itself is safe: what fails from here on is no reason to stop a run
        if durable:
            _sync_folder(path.parent)
        _remove_stale(path)


def _add(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    """Append one array as `<name>.npy`."""
    if array.dtype.hasobject:
        raise TypeError(f"array {name!r} holds Python objects, which only pickle could store")
    if array.dtype.itemsize == 0:
        raise ValueError(f"array {name!r} holds items of no size")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(array))
    # A fixed time, so that the same content gives the same bytes.
    info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
    info.file_size = len(header.getvalue()) + array.nbytes  # whether its entry must be a large one
    with archive.open(info, "w") as member:
        member.write(header.getvalue())
        if array.size:
            member.write(array.reshape(-1).view(np.uint8).data)  # no copy: a replay has gigabytes


def _read(path: str | os.PathLike[str]) -> bytes:
    """The whole file, if it is one and not larger than MAX_BYTES."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise CheckpointError(f"{path}: not a file")
        if status.st_size > MAX_BYTES:
            raise CheckpointError(f"{path}: too large for a GridSim file ({status.st_size:,} bytes)")
        with open(path, "rb") as file:
            return file.read(status.st_size)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        raise CheckpointError(f"{path}: cannot be read: {_one_line(error)}") from error


def _parse(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of an archive. Allocates no more than the file's own size, whatever its headers claim."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        if len(members) > MAX_ARRAYS or len({member.filename for member in members}) != len(members):
            raise ValueError("too many arrays, or one twice")
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("compressed")
        if sum(member.file_size for member in members) > len(content):
            raise ValueError("its arrays are larger than the file")
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _array(raw: bytes) -> np.ndarray:
    """One `.npy` as an array of its own."""
    stream = io.BytesIO(raw)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("unknown array format")
    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(stream)
    start = stream.tell()
    # Items of no size would let a header of a few bytes claim any number of them.
    if dtype.hasobject or dtype.itemsize == 0 or fortran_order or any(size < 0 for size in shape):
        raise ValueError("an array that GridSim does not write")
    if math.prod(shape) * dtype.itemsize != len(raw) - start:
        raise ValueError("an array's size is not that of its data")
    # A copy: the view would be read-only and might be unaligned, which numba compiles for a second time.
    return np.ndarray(shape, dtype, raw, start).copy()


def _sync_folder(folder: Path) -> None:
    """Make a rename in `folder` durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_stale(path: Path) -> None:
    """Remove what a writer of `path` that was killed left behind; a living one needs milliseconds."""
    with os.scandir(path.parent) as entries:
        for entry in entries:
            if entry.name.startswith(f".{path.name}.") and entry.name.endswith(".tmp"):
                with contextlib.suppress(FileNotFoundError):
                    if time.time() - entry.stat().st_mtime > _STALE_S:
                        os.unlink(entry.path)


def _one_line(error: BaseException) -> str:
    """The error in a few words."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return text.splitlines()[0][:120]
