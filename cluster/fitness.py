"""Fitness functions of the user's own: found by name, called, and their faults said in one line.

A function is named `MODULE:FUNCTION` or `FILE.py:FUNCTION`, or is passed to the Python API as an object. Its code runs
in the run's own process, never in Ray's workers, and only if the user names or passes it: when a run is resumed or
repeated, it is not enough that its config.json names the function.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gridsim.errors import GridSimError

Fitness = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From results [n, episodes] and targets float64 [episodes] (m): scores [n], higher is better."""

_given: dict[str, Fitness] = {}  # functions that were given as objects, by their names


def give(function: Fitness) -> str:
    """Keep a function that is passed as an object. Returns: the name by which `load` finds it in this process."""
    name = f"{getattr(function, '__module__', '?')}:{getattr(function, '__qualname__', type(function).__name__)}"
    _given[name] = function
    return name


def forget() -> None:
    """Forget the functions found by name, so that a changed FILE.py is run again; a module stays as it was imported."""
    load.cache_clear()
    _find.cache_clear()


@cache
def load(name: str) -> Callable[[np.ndarray, np.ndarray | float], np.ndarray]:
    """The fitness function of a name. Raises: GridSimError if it cannot be found or imported.

    The function that is returned also takes one target for all episodes. It checks itself: it raises GridSimError if
    the user's code fails, or if its scores are not one number for each member or hold a nan. Infinite ones are allowed.
    """
    function = _given.get(name) or _find(name)

    def score(results: np.ndarray, targets: np.ndarray | float) -> np.ndarray:
        try:
            goals = np.full(results.shape[1], targets, dtype=np.float64)
            scores = np.asarray(function(results, goals), dtype=np.float64)
        except Exception as error:
            raise GridSimError(f"--fitness {name}: {_fault(error)}") from error
        if scores.shape != (len(results),):
            shape = f"returned an array of shape {list(scores.shape)}, not one number per member, [{len(results)}]"
            raise GridSimError(f"--fitness {name}: {_place(function)} {shape}")
        if np.isnan(scores).any():
            raise GridSimError(
                f"--fitness {name}: {_place(function)} returned nan for member {np.isnan(scores).argmax()}"
            )
        return scores

    return score


def digest(name: str) -> str:
    """Digest of a named function's whole file, or of the source of one that was passed as an object.

    None of it is run. The digest is "" if there is no such source.
    """
    try:
        source = inspect.getsource(_given[name]).encode() if name in _given else _file(name).read_bytes()
    except (OSError, TypeError, ValueError):
        return ""
    return hashlib.sha256(source).hexdigest()


def _file(name: str) -> Path:
    """The file of a function's module. Raises: ValueError, OSError."""
    source = name.rpartition(":")[0]
    if source.endswith(".py"):
        return Path(source)
    first, *others = source.split(".")
    with _working_folder():
        found = importlib.util.find_spec(first)  # only `a` of a name `a.b`: to find `a.b`, Python would run `a`
    if not found or not found.origin:
        raise ValueError
    path = Path(found.origin).parent.joinpath(*others) if others else Path(found.origin)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def absolute(name: str) -> str:
    """A function's name in which a file's path, if there is one, is absolute: it means the same in every folder."""
    file, mark, function = name.rpartition(":")
    return f"{os.path.abspath(file)}{mark}{function}" if file.endswith(".py") else name


@cache
def _find(name: str) -> Fitness:
    source, _, attribute = name.rpartition(":")
    if not source or not attribute:
        raise GridSimError(f"--fitness {name}: give MODULE:FUNCTION or FILE.py:FUNCTION")
    try:
        with _working_folder():
            function: Any = _module_of_file(source) if source.endswith(".py") else importlib.import_module(source)
        for part in attribute.split("."):
            function = getattr(function, part)
    except AttributeError:
        raise GridSimError(f"--fitness {name}: there is no {attribute} in {source}") from None
    except Exception as error:
        raise GridSimError(f"--fitness {name} cannot be imported: {_fault(error)}") from error
    if not callable(function):
        raise GridSimError(f"--fitness {name}: {attribute} is not a function")
    return function


def _module_of_file(path: str) -> Any:
    name = f"fitness_{hashlib.sha256(path.encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec
    assert spec.loader
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextlib.contextmanager
def _working_folder() -> Iterator[None]:
    """Let modules be found in the working folder, too."""
    folder = os.getcwd()
    sys.path.append(folder)
    try:
        yield
    finally:
        sys.path.remove(folder)


def _place(function: Any) -> str:
    """File and line where a function begins."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else str(function)


def _fault(error: Exception) -> str:
    """An error in one line: file and line where it was raised (also in a library), its type and message."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{Path(error.filename).name}:{error.lineno}: SyntaxError: {error.msg}"
    others = (__file__, importlib.__file__)
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename not in others]
    own = [frame for frame in own if not frame.filename.startswith("<frozen")]
    said = traceback.format_exception_only(error)[-1].strip()
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}: {said}" if own else said
