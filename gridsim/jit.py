"""Numba's options, and the cache of compiled kernels.

Numba's own on-disk cache does not notice when a function in *another* file changes. So the cache folder is named after
a digest of all sources and library versions: any edit leads to a new folder.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import UserProvidedCacheLocator

# Packages that may contain kernels. All their files enter the digest, so that no list of files has to be maintained.
KERNEL_PACKAGES = ("gridsim", "evolution")


def kernel_digest() -> str:
    """Digest (16 hex digits) of everything that compiled kernels depend on: sources and versions."""
    digest = hashlib.sha256()
    for name in ("numba", "llvmlite", "numpy"):
        digest.update(f"{name}=={version(name)}\n".encode())
    digest.update(platform.python_version().encode())
    for package in KERNEL_PACKAGES:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for path in sorted(Path(folder).rglob("*.py")):
                digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Folder of the compiled kernels: in the user's cache folder, or a temporary one if that is not writable."""
    base = os.environ.get("GRIDSIM_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "gridsim" / f"kernels-{kernel_digest()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    folder = Path(tempfile.gettempdir()) / f"gridsim-{os.getuid()}" / folder.name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


CONFIG: Any = numba.config  # Any, because its attributes are set at import time, unknown to type checkers
CACHE_FOLDER = cache_folder()
FAST_MATH = {"contract", "arcp", "nsz", "reassoc"}


class CacheLocator(UserProvidedCacheLocator):
    """Finds cached kernels by their path within the package, not by the absolute path as Numba does.

    So a copy of the same sources elsewhere finds them: Ray unpacks code into a new folder each time a cluster starts.
    """

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        folder = Path(py_file).resolve().parent
        package = next((above for above in (folder, *folder.parents) if above.name in KERNEL_PACKAGES), folder)
        return folder.relative_to(package.parent).as_posix()


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Callable[..., Any]:
    """`numba.njit` with this project's options: cached in `CACHE_FOLDER`, divisions without a zero check.

    `fastmath` allows contraction and reordering. Results are still the same in all processes on one type of machine,
    because they run the same compiled code.
    """
    if function is None:
        return lambda f: njit(f, **options)
    before = CONFIG.CACHE_DIR, CONFIG.CACHE_LOCATOR_CLASSES
    CONFIG.CACHE_DIR, CONFIG.CACHE_LOCATOR_CLASSES = str(CACHE_FOLDER), f"{__name__}.{CacheLocator.__name__}"
    try:
        return numba.njit(**{"cache": True, "error_model": "numpy", "fastmath": FAST_MATH, **options})(function)
    finally:
        CONFIG.CACHE_DIR, CONFIG.CACHE_LOCATOR_CLASSES = before


def leaf(function: Callable[..., Any]) -> Callable[..., Any]:
    """`njit` for small kernels that return only numbers: inlined into their callers, without reference counting.

    Otherwise, passing a road and its constants (some 60 arguments, with reference counts of the arrays) would take a
    third of a step's time. Do not use it for a kernel that returns or stores an array.
    """
    return njit(function, forceinline=True, _nrt=False)
