"""Entry points of the console scripts: --version, and a guard, so that Ctrl-C is quiet even while libraries load."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from functools import partial
from importlib import import_module
from importlib.metadata import version

STARTED = time.perf_counter()  # of the process, but for Python's own start of some 30 ms


def _enter(module: str, name: str) -> None:
    if "--version" in sys.argv[1:]:
        print(f"gridsim {version('gridsim')}")
        return
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
