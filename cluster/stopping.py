"""Stopping is by a flag: a signal sets it, and code that takes long checks it where stopping is safe.

Ctrl-C, SIGTERM and a closed terminal (SIGHUP) all mean the same: save, and end in seconds. Another signal, more
than `ONE_SIGNAL_S` after the first, ends the process at once.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130  # exit code of a command that was stopped
ONE_SIGNAL_S = 0.5  # signals within this time count as one: `make` and `uv run` repeat what the terminal sends
_asked_at: float | None = None  # when the first signal came; `time.monotonic`
_terminals: list[int] = []  # standard file descriptors that were a terminal when `listen` was called


class Stopped(KeyboardInterrupt):
    """Raised where stopping is safe, after a signal."""


def listen() -> None:
    """From now on signals set the flag. A signal that a shell or nohup has set to be ignored stays ignored."""
    _terminals[:] = [descriptor for descriptor in (0, 1, 2) if os.isatty(descriptor)]
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def requested() -> bool:
    """Whether a signal has come."""
    return _asked_at is not None


def check() -> None:
    """Raise Stopped if a signal has come."""
    if requested():
        raise Stopped


def _stop(number: int, frame: FrameType | None) -> None:
    global _asked_at
    now = time.monotonic()
    if number == signal.SIGHUP:
        _leave_terminal()
    if _asked_at is None:
        _asked_at = now
    elif now - _asked_at > ONE_SIGNAL_S:
        end_at_once()


def end_at_once() -> NoReturn:
    """End the process without saving; a cursor that a progress display has hidden is shown again."""
    if sys.stdout.isatty():
        os.write(sys.stdout.fileno(), b"\x1b[?25h")
    os._exit(INTERRUPTED)


def _leave_terminal() -> None:
    """If the terminal is gone, send output to /dev/null: an error of writing would keep the run from being saved."""
    for descriptor in _terminals:
        if not os.isatty(descriptor):
            os.dup2(os.open(os.devnull, os.O_RDWR), descriptor)
