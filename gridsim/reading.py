"""Reading users' files: bytes, YAML and numbers, with errors in one line."""

from __future__ import annotations

import dataclasses
import math
import reprlib
from pathlib import Path
from typing import Any

import yaml

from gridsim.errors import GridSimError

MAX_BYTES = 1 << 27


def shown(value: object) -> str:
    """A value's repr, shortened to one line of at most 80 characters."""
    text = " ".join(reprlib.repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def read_bytes(path: Path) -> bytes:
    """A file's bytes.

    Raises: GridSimError if it cannot be read, has more than MAX_BYTES, or is a pipe or a device, which may have no end.
    """
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise GridSimError(f"{path} is not a regular file")
        if path.is_file() and path.stat().st_size > MAX_BYTES:
            raise GridSimError(f"{path}: more than {MAX_BYTES >> 20} MiB; make it smaller")
        return path.read_bytes()
    except OSError as error:
        raise GridSimError(f"{path}: {error.strerror or error}") from None
    except ValueError:
        raise GridSimError(f"{shown(str(path))} is not a valid path") from None


def read_yaml(path: Path) -> Any:
    """The contents of a YAML file. Raises: GridSimError."""
    text = read_bytes(path)
    try:
        return yaml.safe_load(text)
    except Exception as error:  # PyYAML raises many types of error on invalid input
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or shown(error)
        raise GridSimError(f"{path}: not valid YAML{where}: {problem}") from None


def number(value: Any, what: str, low: float, high: float, unit: str = "") -> float:
    """A value as a float, also if it is text: YAML 1.1 reads 5e-2 as a string, but ROS reads it as a number.

    Raises: GridSimError if it is a bool, no number, or not within the limits; `what` names it in the message.
    """
    try:
        found = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not low <= found <= high:
        raise GridSimError(f"{what} must be a number from {low:g} to {high:g}{unit and ' '}{unit}, not {shown(value)}")
    return found


def quantity(default: float, low: float, high: float, unit: str = "") -> Any:
    """A dataclass's field for a number from `low` to `high`; if `default` and these are int, for a whole number.

    The dataclass itself does not check this: `SimConfig.check` does.
    """
    return dataclasses.field(default=default, metadata={"limits": (low, high, unit)})


def limits_of(part: Any) -> dict[str, tuple[float, float, str]]:
    """Least and greatest value and unit of each quantity of a dataclass."""
    return {field.name: field.metadata["limits"] for field in dataclasses.fields(part) if field.metadata}
