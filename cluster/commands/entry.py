"""Entry points of the console scripts: --version, and a guard, so that Ctrl-C is quiet even while libraries load."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.metadata import version


def _enter(name: str, module: str = "cluster.commands.cli") -> None:
    if "--version" in sys.argv[1:]:
        print(f"gridsim {version('gridsim')}")
        return
    try:
        commands = import_module(module)
    except KeyboardInterrupt:
        sys.exit(130)
    getattr(commands, name)()


def evolve_main() -> None:
    """Run `gridsim-evolve`."""
    _enter("evolve_main")


def dqn_main() -> None:
    """Run `gridsim-dqn`."""
    _enter("dqn_main")


def evaluate_main() -> None:
    """Run `gridsim-evaluate`."""
    _enter("evaluate_main")


def watch_main() -> None:
    """Run `gridsim-watch`."""
    _enter("watch_main", "cluster.commands.watch")


def drive_main() -> None:
    """Run `gridsim-drive`."""
    _enter("drive_main", "cluster.commands.watch")


def compare_main() -> None:
    """Run `gridsim-compare`."""
    _enter("compare_main", "cluster.commands.compare")
