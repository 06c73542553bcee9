"""Numba, configured once: where compiled kernels are cached and how they are compiled.

Numba's own on-disk cache does not notice that a function in *another* file changed. So the cache lives in a folder
whose name is a digest of every kernel source, of the constants and of the versions: an edit anywhere, a new folder.
`NUMBA_DISABLE_JIT=1` runs every kernel as plain Python.
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

# Packages whose files may hold kernels; all their sources count, so that nobody has to keep a list in step.
KERNEL_PACKAGES = ("gridsim", "evolution")


def kernel_digest() -> str:
    """Digest (16 hex digits) of all that decides what the kernels compile to: sources, constants, versions."""
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
    """Folder of the compiled kernels; the user's cache folder, or a temporary one where that cannot be written."""
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


CONFIG: Any = numba.config  # its attributes are made when it is imported
CACHE_FOLDER = cache_folder()
FAST_MATH = {"contract", "arcp", "nsz", "reassoc"}


class CacheLocator(UserProvidedCacheLocator):
    """Finds kernels by the name of their package and not, as Numba does, by the path that it lies at.

    `CACHE_FOLDER` is that of these very sources, so that a copy of them has the same kernels: Ray unpacks what is
    shipped to a cluster's node into a folder that is new with each start of the cluster.
    """

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        folder = Path(py_file).resolve().parent
        package = next((above for above in (folder, *folder.parents) if above.name in KERNEL_PACKAGES), folder)
        return folder.relative_to(package.parent).as_posix()


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Callable[..., Any]:
    """`numba.njit` with this project's options: cached in `CACHE_FOLDER`, divisions without a zero check.

    `fastmath` allows contraction and reordering; results are still the same in every process of one machine type,
    because all of them run the same compiled code.
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
    """`njit` for small kernels that return numbers only: inlined into their callers, without reference counting.

    Passing a road and its constants costs some 60 arguments and the counting of its arrays: a third of a step's time.
    Not for a kernel that returns or stores an array.
    """
    return njit(function, forceinline=True, _nrt=False)
