"""Whether there is a display to open a window on."""

from __future__ import annotations

import os
import sys

# What SDL looks at on Linux: a driver given by name, Wayland or X11.
_VARIABLES = ("SDL_VIDEODRIVER", "WAYLAND_DISPLAY", "DISPLAY")


def has_display() -> bool:
    """Whether a window may be opened, by environment variables; always true on systems other than Linux."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in _VARIABLES)
