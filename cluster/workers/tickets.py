"""A queue between processes of one machine: a named pipe with a ticket for each parcel. Who reads a ticket does it."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator

TICKET = struct.Struct("<IH")  # a task's serial number and a parcel's index; a pipe gives each to one reader, whole


class Tickets:
    """One process's end of the queue. The first one creates it.

    Args:
        path: of the pipe.
    """

    def __init__(self, path: str):
        with contextlib.suppress(FileExistsError):
            os.mkfifo(path)
        self.path = path
        self._pipe = os.open(path, os.O_RDWR | os.O_NONBLOCK)

    def put(self, serial: int, parcels: int) -> None:
        """Put tickets for the parcels of a task, fewer than 10,000, in place of all that are left."""
        for _ in self.take(serial):
            pass
        os.write(self._pipe, b"".join(TICKET.pack(serial, index) for index in range(parcels)))

    def take(self, serial: int) -> Iterator[int]:
        """Parcels of a task that nobody has taken, until there are none."""
        with contextlib.suppress(BlockingIOError):
            while True:
                owner, index = TICKET.unpack(os.read(self._pipe, TICKET.size))
                if owner == serial:  # else the call that it is of was interrupted
                    yield index

    def close(self) -> None:
        os.close(self._pipe)
