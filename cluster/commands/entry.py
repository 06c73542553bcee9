"""Entry points of the console scripts: --version, and what Ctrl-C and SIGTERM do, also while libraries load."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
import time
from functools import partial
from importlib import import_module
from importlib.metadata import version
from types import FrameType

STARTED = time.perf_counter()  # of the process, but for Python's own start of some 30 ms


def interrupt(number: int, frame: FrameType | None) -> None:
    """Signal handler: KeyboardInterrupt, but once the import system is left.

    Raised there, it can be lost, or leave the import lock held, for which other threads then wait forever.
    """
    if frame and frame.f_code.co_filename.startswith("<frozen importlib"):
        threading.Timer(0.01, os.kill, (os.getpid(), number)).start()
    else:
        raise KeyboardInterrupt


def _enter(module: str, name: str) -> None:
    # MLflow and PyTorch create a million objects that are never freed. With Python's default thresholds, garbage
    # collection takes a sixth of their import time.
    gc.set_threshold(200_000, 20, 20)
    if "--version" in sys.argv[1:]:
        print(f"gridsim {version('gridsim')}")
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else the shell has it ignored
        signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        getattr(import_module(f"cluster.commands.{module}"), name)()
    except KeyboardInterrupt:
        sys.exit(130)
    except SystemExit as ended:
        # At once: the last garbage collection takes seconds with PyTorch, threads may still be compiling, and while
        # C++ destructors run, threads that Ray leaves behind abort the process once in some thousands of times.
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(int(ended.code or 0))


evolve_main = partial(_enter, "cli", "evolve_main")
dqn_main = partial(_enter, "cli", "dqn_main")
evaluate_main = partial(_enter, "cli", "evaluate_main")
watch_main = partial(_enter, "watch", "watch_main")
drive_main = partial(_enter, "watch", "drive_main")
compare_main = partial(_enter, "compare", "compare_main")
