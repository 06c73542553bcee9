"""Which chunk goes to which worker, and what happens when a worker dies. Bookkeeping only: no Ray, no clock.

* The chunks of a worker that died are sent again, one at a time, so that a second death shows which one caused it.
* A chunk that killed twice is split into its members (of a batch of experience: its episodes). A member that kills
  three workers by itself is lost, with everything that it was asked for. So the same members are lost however many
  workers there are and however the work was cut.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence

from cluster.workers.pool import Chunk

QUEUE = 2  # chunks that a worker holds: the one that it works on, and one so that it does not wait for the coordinator
MAX_KILLS = 3  # workers that one member may cost


class Dispatch:
    """The chunks of one call, on their way to workers and back. Workers are numbers.

    Args:
        parts: the chunks; where one is split, its pieces are added at the end.
        by_episode: whether single episodes are lost, instead of whole members.

    Attributes:
        retries: chunks that were sent again because their worker died; one that is split then counts once.
        deaths: workers that died in a row, without an answer in between.
    """

    def __init__(self, parts: Sequence[Chunk], by_episode: bool):
        self.parts = list(parts)
        self.retries = self.deaths = 0
        self._by_episode = by_episode
        self._open = set(range(len(self.parts)))  # neither answered nor lost
        self._todo = deque(range(len(self.parts)))  # of these, the ones that no worker holds
        self._held: dict[int, deque[int]] = {}  # by worker, the one that it works on first
        self._kills: Counter[int] = Counter()
        self._suspects: set[int] = set()  # held by a worker that died

    def finished(self) -> bool:
        """Whether every chunk is answered, or lost."""
        return not self._open

    def at(self, worker: int) -> int:
        """The chunk that a worker works on."""
        return self._held[worker][0]

    def give(self, idle: Sequence[int]) -> Iterator[tuple[int, int]]:
        """Yield (worker, chunk) of all that is to be sent now.

        The last chunks only go to idle workers. So do suspects, and nothing is queued behind them.

        Args:
            idle: workers that hold nothing, of no earlier call either.
        """
        for worker in idle[: len(self._todo)]:
            yield self._send(worker)
        busy = sum(1 for held in self._held.values() if held)
        for worker, held in self._held.items():
            if len(self._todo) > busy and 0 < len(held) < QUEUE and self._suspects.isdisjoint((held[0], self._todo[0])):
                yield self._send(worker)

    def answered(self, worker: int) -> int | None:
        """A worker has answered: the chunk, or None if that is lost."""
        chunk = self._held[worker].popleft()
        self.deaths = 0
        if chunk not in self._open:
            return None
        self._open.remove(chunk)
        return chunk

    def died(self, worker: int, blamed: bool = True) -> list[int]:
        """A worker is gone, and what it held is sent again. Returns the chunks that are lost, the killer first.

        Args:
            blamed: whether the chunk that it worked on may be the reason; not if its host is gone.
        """
        held = self._held.pop(worker, deque())
        if blamed:
            self.deaths += 1
            self._kills.update(list(held)[:1])
        lost: list[int] = []
        for chunk in reversed(held):
            if chunk not in self._open:
                continue
            self._suspects.add(chunk)
            alone = len(self._units(chunk)) == 1
            if alone and self._kills[chunk] >= MAX_KILLS:
                lost = self._lose(chunk)
                continue
            self.retries += 1
            if not alone and self._kills[chunk] >= MAX_KILLS - 1:
                self._split(chunk)
            else:
                self._todo.appendleft(chunk)
        return lost

    def _send(self, worker: int) -> tuple[int, int]:
        chunk = self._todo.popleft()
        self._held.setdefault(worker, deque()).append(chunk)
        return worker, chunk

    def _units(self, chunk: int) -> range:
        """The members of a chunk, or its episodes if `by_episode`."""
        rows, columns = self.parts[chunk]
        span = columns if self._by_episode else rows
        return range(span.start, span.stop)

    def _split(self, chunk: int) -> None:
        """Put a chunk of each of its members in a chunk's place, or of each of its episodes."""
        self._open.remove(chunk)
        rows, columns = self.parts[chunk]
        for unit in self._units(chunk):
            one = slice(unit, unit + 1)
            piece = len(self.parts)
            self.parts.append(Chunk(rows, one) if self._by_episode else Chunk(one, columns))
            self._todo.append(piece)
            self._open.add(piece)
            self._suspects.add(piece)

    def _lose(self, chunk: int) -> list[int]:
        """Give up a chunk of one member, with everything else asked of that member; or a chunk of one episode."""
        rows = self.parts[chunk].rows
        also = [] if self._by_episode else [k for k, part in enumerate(self.parts) if part.rows == rows and k != chunk]
        lost = [k for k in (chunk, *also) if k in self._open]
        self._open.difference_update(lost)
        self._todo = deque(k for k in self._todo if k in self._open)
        return lost
