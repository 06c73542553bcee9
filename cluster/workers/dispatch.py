"""Which chunk goes to which worker, and what follows from a death: bookkeeping alone. It knows no Ray and no clock.

* What was sent to a worker that died is sent again, alone, so that the next time it is clear which chunk it was; the
  first time at once, then after a pause that doubles.
* A chunk that killed twice is split, and so are its pieces that go on killing, down to one member (of a batch of
  experience: one episode), and then to some of its episodes: the shorter a chunk, the less likely do workers that die
  for another reason die of it. Whoever costs three workers by itself is lost, with all that it was asked for, and the
  call goes on without it. So it is the same members that are lost, however many workers there are and however it was
  cut.
* Stragglers: who has nothing left to do takes a second copy of a chunk that is late. The first answer counts.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from cluster.workers.pool import Chunk

QUEUE = 2  # chunks that a worker holds: one that it works on, one so that it need not wait for us
MAX_KILLS = 3  # workers that one member may cost
BACKOFF_S = 0.5  # before a chunk is sent for the third time; twice as long the next time
MAX_BACKOFF_S = 8.0
LATE_S = 2.0  # a chunk is late when it takes longer than this ...
LATE = 5.0  # ... and so many times what was expected


@dataclass
class _Held:
    chunk: int
    since: float  # when it was sent, or the one before it answered


class Dispatch:
    """The chunks of one call, on their way to workers and back. Workers are numbers, times are seconds of any clock.

    Args:
        parts: the chunks; where one is split, its pieces are added at the end.
        by_episode: whether an episode is lost alone, and not a member.
        expected_s: how long a chunk is expected to take, in seconds.

    Attributes:
        retries: chunks that were sent again because their worker died; one that is split then counts once.
        deaths: workers that died in a row, without an answer in between.
    """

    def __init__(self, parts: Sequence[Chunk], by_episode: bool, expected_s: Callable[[Chunk], float]):
        self.parts = list(parts)
        self.retries = self.deaths = 0
        self._by_episode, self._expected_s = by_episode, expected_s
        self._todo = deque(range(len(self.parts)))
        self._held: dict[int, deque[_Held]] = {}
        self._settled = [False] * len(self.parts)
        self._open = len(self.parts)
        self._kills: Counter[int] = Counter()
        self._returns: Counter[int] = Counter()  # how often a chunk came back
        self._not_before: dict[int, float] = {}
        self._suspects: set[int] = set()  # lost with a worker
        self._narrowest: set[int] = set()  # pieces of one member
        self._copied: set[int] = set()  # late, and sent to a second worker

    def finished(self) -> bool:
        """Whether every chunk is answered, or lost."""
        return not self._open

    def waiting(self) -> int:
        """Chunks that nobody holds."""
        return len(self._todo)

    def pause_s(self, now: float) -> float:
        """Seconds until something that waits may be sent; infinite where nothing has to wait."""
        if not self._not_before:
            return math.inf
        times = [self._not_before[chunk] - now for chunk in self._todo if chunk in self._not_before]
        return min((time for time in times if time > 0.0), default=math.inf)

    def at(self, worker: int) -> int:
        """The chunk that a worker is at."""
        return self._held[worker][0].chunk

    def expected_s(self, worker: int) -> float:
        """Seconds that what a worker is at is expected to take; 0 where it holds nothing of this call."""
        return self._expected_s(self.parts[self.at(worker)]) if self._held.get(worker) else 0.0

    def give(self, idle: Sequence[int], now: float) -> Iterator[tuple[int, int]]:
        """Yield (worker, chunk) of all that is to be sent now.

        The last ones only go to who has nothing to do. So do suspects, and nothing is queued behind them. All answers
        that have come are to be taken before, so that it is known what is late.

        Args:
            idle: workers that have nothing at all to do; who holds something of this call is known.
        """
        left = deque(idle)
        while left and (chunk := self._next(now)) is not None:
            yield self._send(left.popleft(), chunk, now)
        up = len(left) + sum(1 for held in self._held.values() if held)
        for worker, held in self._held.items():
            if len(self._todo) > up and 0 < len(held) < QUEUE:
                first = self._todo[0]
                if self._suspects.isdisjoint((first, held[0].chunk)):
                    yield self._send(worker, self._todo.popleft(), now)
        if left and not self._todo:
            for worker, chunk in zip(left, self._late(now), strict=False):
                self._copied.add(chunk)
                yield self._send(worker, chunk, now)

    def answered(self, worker: int, now: float) -> int | None:
        """A worker has answered: the chunk, or None where that was settled before."""
        held = self._held[worker]
        chunk = held.popleft().chunk
        if held:
            held[0].since = now
        self.deaths = 0
        return chunk if self._settle(chunk) else None

    def died(self, worker: int, now: float, blamed: bool = True) -> list[int]:
        """A worker is gone, and what it held is sent again. Returns the chunks that are lost, the killer first.

        Args:
            blamed: whether what it was at may be why; not where its host is gone.
        """
        held = self._held.pop(worker, deque())
        if blamed:
            self.deaths += 1
            if held:
                self._kills[held[0].chunk] += 1
        lost: list[int] = []
        for chunk in [h.chunk for h in reversed(held)]:
            if self._settled[chunk]:
                continue
            self._suspects.add(chunk)
            if chunk in self._copied:
                self._copied.remove(chunk)
                continue  # the other copy goes on
            if (whole := self._is_whole(chunk)) and self._kills[chunk] >= MAX_KILLS:
                lost = self._lose(chunk)
                continue
            self.retries += 1
            if not whole and self._kills[chunk] >= MAX_KILLS - 1:
                self._split(chunk)
                continue
            self._returns[chunk] += 1
            if self._returns[chunk] > 1:
                pause = BACKOFF_S * 2.0 ** (self._returns[chunk] - 2)
                self._not_before[chunk] = now + min(pause, MAX_BACKOFF_S)
            self._todo.appendleft(chunk)
        return lost

    def _next(self, now: float) -> int | None:
        """Take the next chunk that may be sent."""
        for place, chunk in enumerate(self._todo):
            if self._not_before.get(chunk, now) <= now:
                del self._todo[place]
                return chunk
        return None

    def _send(self, worker: int, chunk: int, now: float) -> tuple[int, int]:
        self._held.setdefault(worker, deque()).append(_Held(chunk, now))
        return worker, chunk

    def _settle(self, chunk: int) -> bool:
        """Whether a chunk was open until now."""
        if self._settled[chunk]:
            return False
        self._settled[chunk] = True
        self._open -= 1
        return True

    def _units(self, part: Chunk) -> range:
        """The members of a chunk, or its episodes where these are lost alone."""
        span = part.columns if self._by_episode else part.rows
        return range(span.start, span.stop)

    def _is_whole(self, chunk: int) -> bool:
        """Whether a chunk is not to be split."""
        rows, columns = self.parts[chunk]
        return chunk in self._narrowest or (rows.stop - rows.start == 1 and columns.stop - columns.start == 1)

    def _split(self, chunk: int) -> None:
        """Put pieces in a chunk's place, about as many as each has members, or one member's episodes."""
        self._settle(chunk)
        rows, columns = self.parts[chunk]
        units = self._units(self.parts[chunk])
        narrow = len(units) == 1
        by_columns = narrow or self._by_episode
        if narrow:
            units = range(columns.start, columns.stop)
        size = math.isqrt(len(units))
        for first in range(units.start, units.stop, size):
            piece = slice(first, min(first + size, units.stop))
            self._todo.append(len(self.parts))
            self._suspects.add(len(self.parts))
            if narrow:
                self._narrowest.add(len(self.parts))
            # One more death, and it is split again; who is alone has three chances.
            self._kills[len(self.parts)] = 0 if narrow or piece.stop - piece.start == 1 else MAX_KILLS - 2
            self.parts.append(Chunk(rows, piece) if by_columns else Chunk(piece, columns))
            self._settled.append(False)
            self._open += 1

    def _lose(self, chunk: int) -> list[int]:
        """Give up a chunk of one member, and with it what else that was asked for; of an episode, it alone."""
        rows = self.parts[chunk].rows
        also = [] if self._by_episode else [k for k, part in enumerate(self.parts) if part.rows == rows and k != chunk]
        lost = [k for k in [chunk, *also] if self._settle(k)]
        self._todo = deque(k for k in self._todo if not self._settled[k])
        return lost

    def _late(self, now: float) -> list[int]:
        """Chunks that one worker alone holds, and too long; so is what waits behind such a one."""
        found: list[tuple[float, int]] = []
        for held in filter(None, self._held.values()):
            since = held[0].since
            if now - since > max(LATE_S, LATE * self._expected_s(self.parts[held[0].chunk])):
                found += [(since, h.chunk) for h in held if not self._settled[h.chunk] and h.chunk not in self._copied]
        return [chunk for _, chunk in sorted(found)]
