"""A pool of threads of this process: kernels release Python's lock, so all cores are used and maps shared."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from typing import Any

from cluster.workers.cores import cores
from cluster.workers.pool import BuildMap, Call, Chunk, PoolError, WorkerPool, cut, last_line
from cluster.workers.worker import Worker
from gridsim.maps.map import Map

# Metres in a piece. The largest takes a small network some 20 ms. Then a thread needs Python's lock, and may wait 5 ms
# for it if another one is busy with Python (an import, a save): with pieces of 2 ms a second thread gained nothing.
LEAST_M, MOST_M = 5_000.0, 20_000.0

Answer = tuple[Call, int, Chunk, tuple[Any, ...] | Exception]


class ThreadPool(WorkerPool):
    """Workers are threads, which take pieces from one queue. The caller's thread does not evaluate.

    Args:
        build_map: builds a map, in the caller's thread.
        threads: how many; 0 is one for each core.
        worker_factory: makes what evaluates, which all threads share.
    """

    workers = 0

    def __init__(self, build_map: BuildMap, threads: int = 0, worker_factory: Callable[[], Worker] = Worker):
        self._build_map = build_map
        self._count = threads or cores()
        self._worker = worker_factory()
        self._pieces: queue.SimpleQueue[tuple[Call, Sequence[Map], Chunk] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []

    def _start(self, call: Call) -> None:
        maps = [self._build_map(*name) for name in call.task.maps]
        for piece in cut(call.task, call.asked, self._count, LEAST_M, MOST_M):
            self._pieces.put((call, maps, piece))
        while len(self._threads) < self._count:
            thread = threading.Thread(
                target=self._work, args=(len(self._threads),), name=f"worker-{len(self._threads)}", daemon=True
            )
            thread.start()
            self._threads.append(thread)

    def _work(self, number: int) -> None:
        """Do pieces until there is a None."""
        while item := self._pieces.get():
            call, maps, piece = item
            if call is self._call:
                try:
                    self._answers.put((call, number, piece, self._worker.answer(call.task, maps, *call.work(piece))))
                except Exception as error:
                    self._answers.put((call, number, piece, error))

    def _take_in(self, call: Call, timeout_s: float) -> bool:
        try:
            owner, number, piece, answer = self._answers.get(timeout=timeout_s)
        except queue.Empty:
            return False
        if owner is not call:
            return False
        if isinstance(answer, Exception):
            raise PoolError(f"a worker failed on {call.rows_of(piece)}: {last_line(answer)}") from answer
        call.add(number, piece, *answer)
        return True

    def close(self) -> None:
        self._call = None
        for _ in self._threads:
            self._pieces.put(None)
        for thread in self._threads:
            thread.join()
        self._threads.clear()
