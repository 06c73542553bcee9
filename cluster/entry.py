"""Entry points of the console scripts: nothing but a guard, so that Ctrl-C is quiet even while libraries load."""

from __future__ import annotations

import sys


def _enter(name: str) -> None:
    try:
        from cluster import cli
    except KeyboardInterrupt:
        sys.exit(130)
    getattr(cli, name)()


def evolve_main() -> None:
    """Run `gridsim-evolve`."""
    _enter("evolve_main")


def evaluate_main() -> None:
    """Run `gridsim-evaluate`."""
    _enter("evaluate_main")
