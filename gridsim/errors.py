"""The base of all errors that are meant for the user."""

from __future__ import annotations


class GridSimError(ValueError):
    """Something that the user can mend; the message is one line that says what. Commands print it and end."""
