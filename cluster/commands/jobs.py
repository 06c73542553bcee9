"""A comparison's runs: one after another in this process, or several at once, each in a process of its own.

Such a process, a job, trains one run after another, so that its workers serve all of them; jobs are forked from a
process that has all imports (`forked`). Through a pipe a job receives its runs and sends their events; files, locks and
resuming are those of any run. If this process dies, a job cannot send its next event: it saves its run and ends.
"""

from __future__ import annotations

import contextlib
import multiprocessing.util
import os
import signal
import tempfile
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, Literal

from cluster.commands.common import command_path, short_path
from cluster.commands.entry import interrupt
from cluster.commands.progress import progress_of
from cluster.compare.plan import Cell
from cluster.compare.results import measured, read_run
from cluster.run import Reporter, Session, Workers
from cluster.workers import kernels
from gridsim.errors import GridSimError

LONGEST_FOLDER = 70  # bytes of a temporary folder's path, to which multiprocessing adds up to 32; a socket may have 107
CLOSING_S = 90.0  # for a run to be saved and closed after a signal; Ray takes most of it
Kind = Literal["begin", "note", "warning", "done", "failed"]
OnEvent = Callable[[Cell, Kind, Any], None]
"""Receives the events of a run: "begin"; "note", "warning" or "failed" with a text; "done" with its `Run`."""
Train = Callable[..., Session]
"""`train` with all arguments but the run and the reporter."""


def train_all(cells: Iterable[Cell], workers: Workers, train: Train, jobs: int, on_event: OnEvent) -> None:
    """Train runs, as many at once as `jobs` says, each with such workers. A run that fails does not stop the others.

    Raises: KeyboardInterrupt, once all are saved; for what stops all of them, such as a full disk, MemoryError and
    OSError, or with several `jobs` GridSimError.
    """
    if jobs > 1:
        _at_once(deque(cells), workers, train, jobs, on_event)
        return
    try:
        for cell in cells:
            _train(cell, workers, train, on_event)
    finally:
        workers.close()


def _train(cell: Cell, workers: Workers, train: Train, on_event: OnEvent) -> None:
    on_event(cell, "begin", None)
    try:
        reporter = _CellReporter(cell, on_event)
        train(cell.open(), reporter=reporter)
        reporter.note("measuring errors")
        on_event(cell, "done", measured(read_run(cell.path)))
    except (GridSimError, FloatingPointError) as error:  # the other runs go on
        on_event(cell, "failed", str(error))
        workers.close()  # the next run starts new ones


class _CellReporter(Reporter):
    """Turns how one run goes into events."""

    def __init__(self, cell: Cell, on_event: OnEvent):
        self._send = partial(on_event, cell)
        self.resume = f"{command_path(cell.settings.command)} --resume {short_path(cell.path)}"

    def note(self, text: str) -> None:
        self._send("note", text)

    def warn(self, text: str) -> None:
        self._send("warning", text)

    def compiling(self) -> AbstractContextManager[object]:
        self.note("compiling the simulator for runs of this kind, once")
        return nullcontext()

    def learning(self, session: Session) -> AbstractContextManager[object]:
        self._learning = session.learning
        return nullcontext()

    def row(self, steps: int, row: dict[str, float]) -> None:
        success = f"success {row['validation/success_rate']:.0%}"
        self.note(f"{progress_of(self._learning, bound=False)}  {success}  {self._learning.describe(row)}")


class _Job:
    """A process that trains runs, and the one that it is training."""

    def __init__(self, workers: Workers, train: Train):
        self.cell: Cell | None = None
        _shorten_socket_paths()
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["cluster.commands.forked"])
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=_main, args=(there, workers, train))
        self.process.start()
        there.close()

    def assign(self, cells: deque[Cell]) -> None:
        """Send it the next run, or the order to end."""
        self.cell = cells.popleft() if cells else None
        with contextlib.suppress(OSError):  # it has died, which shows at the pipe's end
            self.pipe.send(self.cell)


def _shorten_socket_paths() -> None:
    """Have multiprocessing keep its sockets in /tmp if the temporary folder's path is too long, as Slurm's may be."""
    usual = tempfile.gettempdir()
    if len(os.fsencode(usual)) > LONGEST_FOLDER:
        tempfile.tempdir = "/tmp"
    multiprocessing.util.get_temp_dir()  # remembers what it is now
    tempfile.tempdir = usual


def _at_once(cells: deque[Cell], workers: Workers, train: Train, number: int, on_event: OnEvent) -> None:
    _compile(cells, on_event)
    jobs: list[_Job] = []
    try:
        while cells or jobs:
            while cells and len(jobs) < number:  # at first, and in place of one that has died
                jobs.append(_Job(workers, train))
                jobs[-1].assign(cells)
            ready = wait([job.pipe for job in jobs])
            for job in [job for job in jobs if job.pipe in ready]:
                try:
                    kind, content = job.pipe.recv()
                except (EOFError, OSError):  # its process has ended
                    jobs.remove(job)
                    job.process.join()
                    if job.cell is not None:
                        on_event(job.cell, "failed", f"its process ended with exit code {job.process.exitcode}")
                    continue
                if kind == "stopped":
                    raise GridSimError(content)
                assert job.cell is not None
                on_event(job.cell, kind, content)
                if kind in ("done", "failed"):
                    job.assign(cells)
    finally:
        for job in jobs:
            job.process.terminate()
            job.pipe.close()  # ends a job that ignored the signal while it closed its run, and waits for the next one
        for job in jobs:
            job.process.join(CLOSING_S)
            job.process.kill()


def _compile(cells: Sequence[Cell], on_event: OnEvent) -> None:
    """Compile the runs' kernels, once for all processes."""
    for cell in cells:
        warming = kernels.Warming(cell.settings)
        try:
            warming.start()
            if warming.processes:
                on_event(cells[0], "note", "compiling the simulator for runs of this kind, once")
                warming.wait()
        finally:
            warming.stop()


def _main(pipe: Connection, workers: Workers, train: Train) -> None:
    """A job's process: train the runs that come through the pipe. SIGTERM and SIGHUP stop it."""
    signal.signal(signal.SIGTERM, interrupt)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, interrupt)

    def on_event(cell: Cell, kind: Kind, content: Any) -> None:
        try:
            pipe.send((kind, content))
        except OSError:
            raise KeyboardInterrupt from None  # the parent has died

    try:
        while (cell := pipe.recv()) is not None:
            warnings.showwarning = lambda message, *_, cell=cell, **__: on_event(cell, "warning", str(message))
            _train(cell, workers, train, on_event)
    except (KeyboardInterrupt, EOFError):
        pass
    except (MemoryError, OSError) as error:
        with contextlib.suppress(OSError):
            pipe.send(("stopped", str(error) or type(error).__name__))
    finally:
        workers.close()
    os._exit(0)  # at once, as commands do (`entry`)
