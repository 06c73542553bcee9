"""Numba's options, and the cache of compiled kernels.

Numba's own on-disk cache does not notice when a function in *another* file changes. So the cache folder is named after
a digest of sources and versions (`kernel_digest`): any edit of them leads to a new folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import operator
import platform
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
from numba.core import types
from numba.core.caching import FunctionCache, UserProvidedCacheLocator
from numba.core.extending import intrinsic
from numba.core.registry import CPUDispatcher

from gridsim.cache import cache_folder
from gridsim.errors import GridSimError
from gridsim.packages import package_folder

# Packages that may contain kernels. All their Python files enter the digest: no list of files has to be maintained.
KERNEL_PACKAGES = ("gridsim", "evolution")


def _sources() -> list[Path]:
    """Folders of KERNEL_PACKAGES. Ray unpacks each package into a folder of its own."""
    own = Path(__file__).parent
    try:
        return [own, package_folder("evolution")]
    except GridSimError:  # `evolution` is missing, or a user's file hides it: the simulator still works.
        return [own, own.parent / "evolution"]


def kernel_digest() -> str:
    """Digest (16 hex digits) of the sources of KERNEL_PACKAGES and versions of Python, Numba, llvmlite and NumPy."""
    digest = hashlib.sha256()
    for name in ("numba", "llvmlite", "numpy"):
        digest.update(f"{name}=={version(name)}\n".encode())
    digest.update(platform.python_version().encode())
    for folder in _sources():
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


CONFIG: Any = numba.config  # Any, because its attributes are set at import time, unknown to type checkers
CACHE_FOLDER = cache_folder(f"kernels-{kernel_digest()}")
FAST_MATH = {"contract", "arcp", "nsz", "reassoc"}

# Kernels compute in float32, which a plain number would turn into float64.
F, I, U = np.float32, np.int32, np.uint64  # noqa: E741
ZERO, HALF, ONE = F(0.0), F(0.5), F(1.0)


class CacheLocator(UserProvidedCacheLocator):
    """Finds cached kernels by their path within the package, not by the absolute path as Numba does.

    Ray unpacks code into a new folder each time a cluster starts.
    """

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        folder = Path(py_file).resolve().parent
        package = next((above for above in (folder, *folder.parents) if above.name in KERNEL_PACKAGES), folder)
        return folder.relative_to(package.parent).as_posix()

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> CacheLocator:
        """Numba's method also tries to write to the folder. `KernelCache` does without a cache if writing fails."""
        return cls(py_func, py_file)


class KernelCache(FunctionCache):
    """Numba's cache of a kernel. Where it cannot be read or written, kernels are compiled anew, and a run goes on."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling a damaged file raises: compile and save the kernel anew
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except Exception as error:  # an OSError, or a damaged index that could not be emptied
            reason = getattr(error, "strerror", None) or str(error)
            _warn(f"compiled kernels cannot be kept in {CACHE_FOLDER} and are compiled anew each time: {reason}")


@functools.cache
def _warn(text: str) -> None:
    """Warn, once for each text. Numba resets what Python itself knows about earlier warnings."""
    warnings.warn(text, stacklevel=3)


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Callable[..., Any]:
    """`numba.njit` with this project's options: cached in `CACHE_FOLDER`, divisions without a zero check.

    Unless `options` say otherwise, `fastmath` is FAST_MATH: sums may be reordered, for example, but NaN and infinity
    are respected. Results are still the same in all processes on one type of machine, because they run the same
    compiled code.
    """
    if function is None:
        return lambda f: njit(f, **options)
    before = CONFIG.CACHE_DIR, CONFIG.CACHE_LOCATOR_CLASSES
    CONFIG.CACHE_DIR, CONFIG.CACHE_LOCATOR_CLASSES = str(CACHE_FOLDER), f"{__name__}.{CacheLocator.__name__}"
    try:
        given = {"error_model": "numpy", "fastmath": FAST_MATH, "no_cfunc_wrapper": True, **options}
        kernel = numba.njit(**given)(function)
        kernel._cache = KernelCache(function)  # `cache=True` would set Numba's own cache here
        return kernel
    finally:
        CONFIG.CACHE_DIR, CONFIG.CACHE_LOCATOR_CLASSES = before


class Leaf(CPUDispatcher):
    """A kernel that other kernels inline.

    It is compiled without the code that reads its arguments from Python objects (some two hundred numbers for a road).
    That code would take a third of the time in which a run compiles its kernels. The first call from Python compiles a
    second kernel, which has it.
    """

    def __call__(self, *arguments: Any) -> Any:
        return self.for_python(*arguments)

    @functools.cached_property
    def for_python(self) -> Callable[..., Any]:
        """The second kernel, which Python can call."""
        f = self.py_func
        copy = FunctionType(f.__code__, f.__globals__, argdefs=f.__defaults__, closure=f.__closure__)
        copy.__qualname__ += " for Python"  # Numba names the files of its cache by this
        return njit(copy, fastmath=self.targetoptions["fastmath"])


def leaf(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`njit` for small kernels that return only numbers: inlined into their callers, without reference counting.

    Otherwise, passing a road and its constants (some two hundred arguments) would take a third of a step's time. Do not
    use it for a kernel that returns or stores an array.
    """
    kernel = njit(function, forceinline=True, _nrt=False, no_cpython_wrapper=True, **options)
    if isinstance(kernel, CPUDispatcher):  # under NUMBA_DISABLE_JIT, it is the plain function instead
        kernel.__class__ = Leaf
    return kernel


def exact(function: Callable[..., Any]) -> Callable[..., Any]:
    """A `leaf` without `fastmath`: it rounds the same in every kernel that inlines it, and as NumPy does."""
    return leaf(function, fastmath=False)


def _row_of(typingctx, arrays, i):
    """For kernels: `arrays[i]`; the same of each array in a named tuple; None of None.

    Numba knows which of these when it compiles. Of `None if arrays is None else arrays[i]` it would make an optional
    array, for which all kernels that take it would be compiled once more, and which they would test in each step.
    """
    if isinstance(arrays, types.NoneType):
        return arrays(arrays, i), lambda context, builder, signature, values: context.get_dummy_value()
    several = isinstance(arrays, types.BaseTuple)
    getitem = typingctx.resolve_value_type(operator.getitem)
    kinds = [getitem.get_call_type(typingctx, (part, i), {}) for part in (arrays if several else [arrays])]
    rows = [kind.return_type for kind in kinds]
    result = types.BaseTuple.from_types(rows, arrays.instance_class) if several else rows[0]

    def codegen(context, builder, signature, values):
        whole, index = values
        parts = [builder.extract_value(whole, k) for k in range(len(kinds))] if several else [whole]
        each = [
            context.get_function(operator.getitem, kind)(builder, (part, index))
            for kind, part in zip(kinds, parts, strict=True)
        ]
        return context.make_tuple(builder, result, each) if several else each[0]

    return result(arrays, i), codegen


row_of: Any = intrinsic(_row_of)


def freeze(array: np.ndarray) -> np.ndarray:
    """The array C-contiguous and read-only: a view, or a copy if it is not contiguous.

    Kernels take what they only read in this form; for any other, Numba would compile them once more.
    """
    view = np.ascontiguousarray(array).view()
    view.setflags(write=False)
    return view
