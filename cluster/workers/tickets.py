"""A queue between processes of one machine: a named pipe with a ticket for each parcel, which one process reads."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator

TICKET = struct.Struct("<HH")  # a task's serial number and a parcel's index; a pipe gives each to one reader, whole
EMPTY = 1 << 20  # more bytes than a pipe holds


class Tickets:
    """One process's end of the queue, the pipe at `path`; it is created if `new`."""

    def __init__(self, path: str, new: bool = False):
        self.path = path
        if new:
            os.mkfifo(path)
        self._pipe = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def put(self, serial: int, parcels: int) -> None:
        """Put tickets for the parcels of a task in place of all that are left; as many as there is room for."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._pipe, EMPTY)
        os.write(self._pipe, b"".join(TICKET.pack(serial & 0xFFFF, index) for index in range(parcels)))

    def take(self, serial: int) -> Iterator[int]:
        """Parcels of a task that are not taken yet, until there are none."""
        with contextlib.suppress(BlockingIOError):
            while True:
                owner, index = TICKET.unpack(os.read(self._pipe, TICKET.size))
                if owner != serial & 0xFFFF:  # of a later task: this one was interrupted
                    return
                yield index

    def close(self) -> None:
        """Close this process's end; the pipe stays where it is."""
        os.close(self._pipe)
