"""A pool of threads of this process: kernels release Python's lock, so all cores are used and maps shared."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from cluster.workers.cores import cores
from cluster.workers.pool import BuildMap, Call, Chunk, PoolError, WorkerPool, cut, last_line
from cluster.workers.worker import Worker
from gridsim.maps.map import Map

# Metres in a piece. The largest piece takes a small network some 20 ms. After each piece a thread needs Python's lock,
# and waits up to 5 ms for it while another thread runs Python: with pieces of 2 ms a second thread gained nothing.
LEAST_M, MOST_M = 5_000.0, 20_000.0

Answer = tuple[Call, int, Chunk, tuple[Any, ...] | Exception]


class ThreadPool(WorkerPool):
    """Workers are threads. The caller's thread builds the maps and does not evaluate.

    Args:
        threads: how many; 0 is one for each core.
        worker_factory: makes the one `Worker` that all threads share.
    """

    workers = 0

    def __init__(self, build_map: BuildMap, threads: int = 0, worker_factory: Callable[[], Worker] = Worker):
        self._build_map, self._threads, self._worker = build_map, threads or cores(), worker_factory()
        self._executor = ThreadPoolExecutor(self._threads)
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()

    def _start(self, call: Call) -> None:
        maps = [self._build_map(*name) for name in call.task.maps]
        for piece in cut(call, self._threads, LEAST_M, MOST_M):
            self._executor.submit(self._work, call, maps, piece)

    def _work(self, call: Call, maps: Sequence[Map], piece: Chunk) -> None:
        if call is self._call:
            answer: tuple[Any, ...] | Exception
            try:
                answer = self._worker.answer(call.task, maps, call.recipes[piece.rows], piece.columns)
            except Exception as error:
                answer = error
            self._answers.put((call, threading.get_ident(), piece, answer))

    def _take_in(self, timeout_s: float) -> None:
        try:
            call, thread, piece, answer = self._answers.get(timeout=timeout_s)
        except queue.Empty:
            return
        if call is self._call:
            if isinstance(answer, Exception):
                raise PoolError(f"a worker failed on {call.span(piece)}: {last_line(answer)}") from answer
            call.add(thread, piece, *answer)

    def close(self) -> None:
        self._call = None
        self._executor.shutdown()
