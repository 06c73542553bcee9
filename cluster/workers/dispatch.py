"""Which parcel of chunks goes to which worker, and what happens when a worker dies. Bookkeeping only: no Ray, no clock.

* The parcels of a worker that died are sent again, one at a time, so that a second death shows which one caused it.
* A parcel that killed twice is split into its members (of a batch of experience: its episodes, of which all that is
  said of members is true). A member that kills three workers by itself is lost, with everything that it was asked for.
  So the same members are lost however many workers there are and however the work was cut.
* A parcel without chunks, for which a worker takes others from a queue, is sent again once, and never lost.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence

from cluster.workers.pool import Chunk, Parcel

QUEUE = 2  # parcels that a worker holds: the one that it works on, and one so that it does not wait for the coordinator
MAX_KILLS = 3  # workers that a member kills before it is lost


class Dispatch:
    """The parcels of one call, on their way to workers and back. Workers have numbers."""

    def __init__(self, parcels: Sequence[Parcel]):
        self.parcels = list(parcels)  # where one is split, its pieces are added at the end
        self.retries = 0  # parcels that were sent again because their worker died; one that is split then counts once
        self.deaths = 0  # workers that died in a row, without an answer in between
        self._open = set(range(len(self.parcels)))  # neither answered nor lost
        self._todo = deque(range(len(self.parcels)))  # of these, the ones that no worker holds
        self._held: dict[int, deque[int]] = {}  # by worker, the one that it works on first
        self._kills: Counter[int] = Counter()
        self._suspects: set[int] = set()  # held by a worker that died

    def finished(self) -> bool:
        """Whether every parcel is answered, or lost."""
        return not self._open

    def at(self, worker: int) -> int:
        """The parcel that a worker works on."""
        return self._held[worker][0]

    def give(self, idle: Sequence[int]) -> Iterator[tuple[int, int]]:
        """Yield (worker, parcel) of all that is to be sent now.

        Parcels come largest first, so the last worker will be the first to need a second one. The last parcels only go
        to idle workers. So do suspects, and nothing is queued behind them.

        Args:
            idle: workers that hold nothing, not even from an earlier call.
        """
        for worker in idle[: len(self._todo)]:
            yield self._send(worker)
        busy = sum(1 for held in self._held.values() if held)
        for worker, held in reversed(self._held.items()):
            if len(self._todo) > busy and 0 < len(held) < QUEUE and self._suspects.isdisjoint((held[0], self._todo[0])):
                yield self._send(worker)

    def answered(self, worker: int) -> int | None:
        """Record that a worker has answered. Returns its parcel, or None if that is lost."""
        parcel = self._held[worker].popleft()
        self.deaths = 0
        if parcel not in self._open:
            return None
        self._open.remove(parcel)
        return parcel

    def died(self, worker: int, blamed: bool = True) -> list[int]:
        """Record that a worker is gone; what it held is sent again. Returns the lost parcels, the killer first.

        Args:
            blamed: whether the parcel that it worked on may be the reason; not if its host is gone.
        """
        held = self._held.pop(worker, deque())
        if blamed:
            self.deaths += 1
            self._kills.update(list(held)[:1])
        lost: list[int] = []
        for parcel in reversed(held):
            if parcel not in self._open:
                continue
            self._suspects.add(parcel)
            alone = len(self._units(parcel)) == 1
            if alone and self._kills[parcel] >= MAX_KILLS:
                lost = self._lose(parcel)
                continue
            self.retries += 1
            if not alone and self._kills[parcel] >= MAX_KILLS - 1:
                self._split(parcel)
            else:
                self._todo.appendleft(parcel)
        return lost

    def _send(self, worker: int) -> tuple[int, int]:
        parcel = self._todo.popleft()
        self._held.setdefault(worker, deque()).append(parcel)
        return worker, parcel

    def _units(self, parcel: int) -> list[Parcel]:
        """The members of a parcel, each as a parcel of its own."""
        return [
            (Chunk(slice(k, k + 1), columns),)
            for rows, columns in self.parcels[parcel]
            for k in range(rows.start, rows.stop)
        ]

    def _split(self, parcel: int) -> None:
        """Replace a parcel by one for each of its members."""
        self._open.remove(parcel)
        for unit in self._units(parcel):
            piece = len(self.parcels)
            self.parcels.append(unit)
            self._todo.append(piece)
            self._open.add(piece)
            self._suspects.add(piece)

    def _lose(self, parcel: int) -> list[int]:
        """Give up a parcel of one member, with everything else asked of that member."""
        rows = self.parcels[parcel][0].rows
        also = [k for k, (one, *more) in enumerate(self.parcels) if one.rows == rows and not more and k != parcel]
        lost = [k for k in (parcel, *also) if k in self._open]
        self._open.difference_update(lost)
        self._todo = deque(k for k in self._todo if k in self._open)
        return lost
