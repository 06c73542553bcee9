"""Entry points of the console scripts: the environment, --version, and what signals do, also while libraries load."""

from __future__ import annotations

import contextlib
import gc
import getpass
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from functools import partial
from importlib import import_module
from pathlib import Path
from types import FrameType

STARTED = time.perf_counter()  # when the process started, but for Python's own startup of some 30 ms
#: MLflow and PyTorch create a million objects that are never freed. With Python's default thresholds, garbage
#: collection takes a sixth of their import time.
GC_THRESHOLDS = (200_000, 20, 20)
#: How a notebook or a user's own settings change what matplotlib draws, and whether it can be imported at all.
PLOTTING = ("MPLBACKEND", "MATPLOTLIBRC")
#: File descriptors that were a terminal as the command began.
TERMINALS = [descriptor for descriptor in (0, 1, 2) if os.isatty(descriptor)]


def settle_environment() -> None:
    """Change the environment where libraries would fail with it; to be called before there are threads.

    A process may have no HOME and a user id without a name (OpenShift, HTCondor, systemd). HOME is then a folder that
    does not exist, as Debian's services have it, so that nothing is written there.
    """
    for name in PLOTTING:
        os.environ.pop(name, None)
    try:
        Path.home()
    except RuntimeError:
        os.environ["HOME"] = "/nonexistent"
    try:
        getpass.getuser()
    except (KeyError, OSError):
        os.environ["USER"] = str(os.getuid())


def interrupt(number: int, frame: FrameType | None) -> None:
    """Signal handler: raise KeyboardInterrupt, but never during an import or below LLVM.

    Raised in the former, it can be lost, become another exception, or leave the import lock held, so that other threads
    wait for it forever. Raised in a function that LLVM calls while it loads a kernel, it ends the process with a
    segmentation fault. In a hook that runs after a fork, Python would only print it.
    """
    if number == signal.SIGHUP:
        _leave_terminal()
    callers = [caller.f_code for caller, _ in traceback.walk_stack(frame)]
    files = [caller.co_filename for caller in callers]
    if any(caller.co_name == "_after_fork" for caller in callers):
        return
    if any(file.startswith("<frozen importlib") or "llvmlite" in file for file in files):
        threading.Timer(0.01, os.kill, (os.getpid(), number)).start()
    else:
        raise KeyboardInterrupt


def _leave_terminal() -> None:
    """If the terminal is gone, write to nowhere: an error of writing would keep the run from being saved and closed."""
    for descriptor in TERMINALS:
        if not os.isatty(descriptor):
            os.dup2(os.open(os.devnull, os.O_RDWR), descriptor)


def _enter(module: str, name: str) -> None:
    gc.set_threshold(*GC_THRESHOLDS)
    if "--version" in sys.argv[1:]:
        from importlib.metadata import version  # which takes longer than all else until Ctrl-C is handled

        print(f"gridsim {version('gridsim')}")
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else the shell had it ignored
        signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # else by nohup
        signal.signal(signal.SIGHUP, interrupt)
    settle_environment()
    prog = Path(sys.argv[0]).name
    warnings.formatwarning = lambda message, *_: f"{prog}: warning: {message}\n"  # as `common.main`, also of imports
    try:
        _check_import(prog)
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


def _check_import(prog: str) -> None:
    """Exit with one line if a user's file hides our packages, or no folder can keep compiled kernels."""
    from gridsim.errors import GridSimError
    from gridsim.packages import check_packages

    try:
        check_packages()
        import gridsim.jit  # noqa: F401
    except GridSimError as error:
        print(f"{prog}: error: {error}", file=sys.stderr)
        sys.exit(2)


evolve_main = partial(_enter, "cli", "evolve_main")
dqn_main = partial(_enter, "cli", "dqn_main")
evaluate_main = partial(_enter, "cli", "evaluate_main")
watch_main = partial(_enter, "watch", "watch_main")
drive_main = partial(_enter, "watch", "drive_main")
compare_main = partial(_enter, "compare", "compare_main")
