"""Entry points of the console scripts: the environment, --version, and what signals do while libraries load."""

from __future__ import annotations

import contextlib
import gc
import getpass
import os
import signal
import sys
import time
import warnings
from functools import partial
from importlib import import_module
from pathlib import Path

from cluster import stopping

STARTED = time.perf_counter()  # s; some 30 ms after the process started, which Python's own startup takes


def _enter(module: str, name: str) -> None:
    # MLflow and PyTorch create a million objects that are never freed. With Python's default thresholds, garbage
    # collection takes a sixth of their import time.
    gc.set_threshold(200_000, 20, 20)
    if "--version" in sys.argv[1:]:
        from importlib.metadata import version  # only here: it takes longer than all else before signals are handled

        from gridsim.packages import DISTRIBUTION

        print(f"gridsim {version(DISTRIBUTION)}")
        return
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # one that the shell or nohup ignores stays ignored
            # A signal ends the process at once, until a command with something to save calls `stopping.listen`.
            signal.signal(number, lambda *_: stopping.end_at_once())
    _settle_environment()
    prog = Path(sys.argv[0]).name
    warnings.formatwarning = lambda message, *_: f"{prog}: warning: {message}\n"
    from gridsim.errors import GridSimError
    from gridsim.packages import check_packages

    try:
        check_packages()
        getattr(import_module(f"cluster.commands.{module}"), name)()
    except GridSimError as error:  # a package is hidden, an extra is missing, or no folder can keep compiled kernels
        print(f"{prog}: error: {error}", file=sys.stderr)
        sys.exit(2)
    except SystemExit as ended:
        # Exit at once: the last garbage collection takes seconds with PyTorch, and threads may still be at work.
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        if used := sys.modules.get("multiprocessing.util"):
            used._run_finalizers()  # removes a private folder of kernels (`gridsim.cache`)
        os._exit(int(ended.code or 0))


def _settle_environment() -> None:
    """Change environment variables with which libraries would fail. To be called before there are threads.

    Settings of Matplotlib by a notebook or the user are removed, as they may keep it from being imported. A user id may
    have no name (OpenShift, HTCondor, systemd). USER is then set to the id if no variable names the user, and HOME, if
    it is missing, to a folder that does not exist, as Debian's services have it, so that nothing is written there.
    """
    for name in ("MPLBACKEND", "MATPLOTLIBRC"):
        os.environ.pop(name, None)
    try:
        Path.home()
    except RuntimeError:
        os.environ["HOME"] = "/nonexistent"
    try:
        getpass.getuser()
    except (KeyError, OSError):
        os.environ["USER"] = str(os.getuid())


evolve_main = partial(_enter, "cli", "evolve_main")
dqn_main = partial(_enter, "cli", "dqn_main")
evaluate_main = partial(_enter, "cli", "evaluate_main")
watch_main = partial(_enter, "watch", "watch_main")
drive_main = partial(_enter, "watch", "drive_main")
map_main = partial(_enter, "roads", "map_main")
compare_main = partial(_enter, "compare", "compare_main")
