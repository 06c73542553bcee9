"""The base class of all errors meant for the user."""

from __future__ import annotations


class GridSimError(ValueError):
    """A problem that the user can fix; the message is one line that says what to fix. Commands print it and exit."""
