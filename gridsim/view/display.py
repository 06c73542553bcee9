"""Whether there is a display to open a window on."""

from __future__ import annotations

import os
import sys


def has_display() -> bool:
    """Whether a window may be opened: on Linux, if a variable is set that tells SDL of a display; elsewhere always."""
    variables = ("SDL_VIDEODRIVER", "WAYLAND_DISPLAY", "DISPLAY")  # a driver given by name, Wayland or X11
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in variables)
