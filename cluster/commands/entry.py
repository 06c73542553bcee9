"""Entry points of the console scripts: --version, and what Ctrl-C and SIGTERM do, also while libraries load."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
import time
import traceback
from functools import partial
from importlib import import_module
from types import FrameType

STARTED = time.perf_counter()  # when the process started, but for Python's own startup of some 30 ms
#: MLflow and PyTorch create a million objects that are never freed. With Python's default thresholds, garbage
#: collection takes a sixth of their import time.
GC_THRESHOLDS = (200_000, 20, 20)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Signal handler: raise KeyboardInterrupt, but never during an import or below LLVM.

    Raised in the former, it can be lost, become another exception, or leave the import lock held, so that other threads
    wait for it forever. Raised in a function that LLVM calls while it loads a kernel, it ends the process with a
    segmentation fault. In a hook that runs after a fork, Python would only print it.
    """
    callers = [caller.f_code for caller, _ in traceback.walk_stack(frame)]
    files = [caller.co_filename for caller in callers]
    if any(caller.co_name == "_after_fork" for caller in callers):
        return
    if any(file.startswith("<frozen importlib") or "llvmlite" in file for file in files):
        threading.Timer(0.01, os.kill, (os.getpid(), number)).start()
    else:
        raise KeyboardInterrupt


def _enter(module: str, name: str) -> None:
    for variable in ("MPLBACKEND", "MATPLOTLIBRC"):
        os.environ.pop(variable, None)
    gc.set_threshold(*GC_THRESHOLDS)
    if "--version" in sys.argv[1:]:
        from importlib.metadata import version  # which takes longer than all else until Ctrl-C is handled

        print(f"gridsim {version('gridsim')}")
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else the shell had it ignored
        signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        getattr(import_module(f"cluster.commands.{module}"), name)()
    except KeyboardInterrupt:
        sys.exit(130)
    except SystemExit as ended:
        # Exit at once: the last garbage collection takes seconds with PyTorch, threads may still be compiling, and
        # threads that Ray leaves behind abort one process in some thousands while C++ destructors run.
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        if used := sys.modules.get("multiprocessing.util"):
            used._run_finalizers()  # removes the folder of a socket (`jobs`)
        os._exit(int(ended.code or 0))


evolve_main = partial(_enter, "cli", "evolve_main")
dqn_main = partial(_enter, "cli", "dqn_main")
evaluate_main = partial(_enter, "cli", "evaluate_main")
watch_main = partial(_enter, "watch", "watch_main")
drive_main = partial(_enter, "watch", "drive_main")
compare_main = partial(_enter, "compare", "compare_main")
