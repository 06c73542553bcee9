"""gridsim-compare: the paper's comparison in one command, or a comparison of finished runs."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro
from rich.box import MINIMAL
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cluster.commands.common import (
    FAILED,
    INTERRUPTED,
    WorkFlags,
    as_flag,
    check_unchanged,
    command_path,
    fail,
    main,
    new_console,
    parse,
    select,
    short_path,
    warn_of_many_workers,
)
from cluster.commands.jobs import Kind, train_all
from cluster.commands.progress import Line, clock
from cluster.compare import picture, tables
from cluster.compare.page import page
from cluster.compare.plan import COMPARISON, Cell, ComparisonFolder, Plan, limits, open_comparison, read_runs
from cluster.compare.results import Run, measured, read_run
from cluster.run import Workers, train
from cluster.settings import IN_WORDS, check_workers
from cluster.store import checkpoint
from cluster.store.folder import lock, new_folder
from cluster.tracking.address import TrackingError, check_uri
from cluster.tracking.mlflow_run import Identity, Status
from cluster.tracking.tracker import Tracker
from cluster.workers.address import cluster_address
from gridsim.errors import GridSimError

PROG = "gridsim-compare"
REPORT, TABLE, ROWS, PICTURE = "comparison.html", "table.md", "table.csv", "comparison.png"


@dataclass(frozen=True)
class CompareFlags(WorkFlags, Plan):
    """Compare learners: the same car on the same roads, each learner with the same budget, over several seeds.

    Trains every learner on every scenario with every seed, then writes comparison.html: tables, a picture, and a link
    to each champion's drive; also table.md, table.csv and comparison.png. Each run's folder is kept, and a finished run
    is never repeated. With RUNS, folders of finished runs or of comparisons, it only compares these.
    """

    runs: tyro.conf.Positional[tuple[str, ...]] = ()
    """Folders of finished runs to compare, in place of training."""
    quick: bool = False
    """A first look, in minutes: one seed, 10 s per run."""
    name: Annotated[str, IN_WORDS] = ""
    """Name of the comparison; by default made from the time."""
    resume: Annotated[str, IN_WORDS] = ""
    """Folder of a comparison to continue; a larger --seeds adds to it."""
    jobs: int = 1
    """Runs that are trained at once, each with --workers of its own. On one machine: as many as it has cores, with
    --workers 0; on a cluster: as many as it has room for. They share the cores, so give a --budget of car-steps."""

    example: ClassVar[str] = "gridsim-compare --scenarios curved city --learners evolution dqn --seeds 5"
    removed: ClassVar[dict[str, str]] = {"--reference": "errors are those against the reference driver; leave it out"}


QUICK = CompareFlags(seeds=1, budget="10s")
# Flags that may differ in a resumed comparison.
MAY_DIFFER = ("resume", "jobs", "workers", "address", "patience", "tracking_uri", "experiment")
MAX_JOBS = 256  # each takes some 500 MB here
WITH_RUNS = ("runs", "output", "name")  # flags for a comparison of finished runs


def _compare() -> int:
    arguments = sys.argv[1:]
    flags = parse(CompareFlags, PROG, arguments)
    if flags.quick and not flags.resume:
        flags = parse(CompareFlags, PROG, arguments, QUICK)
    console = new_console()
    if flags.runs:
        return _compare_finished(console, flags)
    folder, flags = _prepare(arguments, flags)
    cells = folder.plan.cells(folder.path)
    for cell in cells:
        cell.check()
    folder.tracking_uri = check_uri(flags.tracking_uri, folder.tracking_uri)
    lock(folder.path)
    if flags.jobs > 1 and limits(flags.budget)[1]:
        text = "runs at once share the cores, so that each learns less in the same time; use a --budget of car-steps"
        print(f"{PROG}: warning: {text}", file=sys.stderr)
    to_do = not all(cell.finished() for cell in cells)
    address = cluster_address(flags.address) if flags.workers and to_do else None
    warn_of_many_workers(PROG, flags.jobs * max(flags.workers, 1), address)
    return _train_and_compare(console, folder, cells, flags, Workers(flags.workers, address, flags.patience))


def _prepare(arguments: Sequence[str], flags: CompareFlags) -> tuple[ComparisonFolder, CompareFlags]:
    """The comparison's folder, checked; nothing is written yet. Raises GridSimError."""
    check_workers(flags.workers, flags.address, flags.patience)
    if not 1 <= flags.jobs <= MAX_JOBS:
        raise GridSimError(f"--jobs must be 1 to {MAX_JOBS}, not {flags.jobs}")
    if flags.resume:
        folder = open_comparison(Path(flags.resume))
        before = CompareFlags(**vars(folder.plan), output=str(folder.path.parent), name=folder.path.name)
        flags = parse(CompareFlags, PROG, arguments, before)
        if limits(flags.budget) == limits(before.budget):
            flags = dataclasses.replace(flags, budget=before.budget)
        check_unchanged(flags, before, MAY_DIFFER, ("seeds",), "comparison")
        folder.plan = select(Plan, flags)
        folder.plan.check()
        return folder, flags
    plan = select(Plan, flags)
    plan.check()
    return ComparisonFolder(new_folder(Path(flags.output), flags.name, "comparison"), plan), flags


def _train_and_compare(
    console: Console, folder: ComparisonFolder, cells: list[Cell], flags: CompareFlags, workers: Workers
) -> int:
    """Train the unfinished runs; write tables and a picture of all runs."""
    if not all(cell.finished() for cell in cells):
        workers.prepare()
    folder.write()
    uri = folder.tracking_uri
    params = {key: " ".join(v) if isinstance(v, tuple) else str(v) for key, v in vars(folder.plan).items()}
    tags = {"algorithm": "comparison"}
    tracker = Tracker(Identity(uri, flags.experiment, folder.path.name, params, tags, key=folder.tracking_key))
    results = Results(folder.path, folder.plan)
    code, problem, parent = 0, "", ""
    status: Status = "FINISHED"
    shown = Progress(console, folder, cells, flags.jobs, results)
    try:
        with shown:
            for cell in cells:
                if cell.finished():
                    shown.read(cell)
            if shown.left:
                try:
                    parent = tracker.wait_ready()
                except TrackingError as error:
                    print(f"{PROG}: warning: its runs are not nested in MLflow: {error}", file=sys.stderr)
            train_cell = partial(
                train, workers=workers, uri=uri, experiment=flags.experiment, parent_id=parent,
                wall_limit_s=limits(folder.plan.budget)[1] or math.inf,
            )  # fmt: skip
            train_all([cell for cell in cells if not cell.finished()], workers, train_cell, flags.jobs, shown.show)
    except (KeyboardInterrupt, SystemExit):  # the latter by rich, if what reads the output has ended
        code, status = INTERRUPTED, "KILLED"
    except (GridSimError, MemoryError, OSError) as error:
        problem, status = str(error) or type(error).__name__, "FAILED"
    if results.runs:
        if not problem:
            with console.status("writing tables and the picture"):
                results.write()
        tracker.log_row(len(results.runs), {"runs_done": len(results.runs)})
        files = [folder.path / name for name in (COMPARISON, REPORT, TABLE, ROWS, PICTURE)]
        tracker.log_files(path for path in files if path.is_file())
    again = f"{command_path(PROG)} --resume {short_path(folder.path)}"
    if unsent := tracker.close(status):
        print(f"{PROG}: warning: {unsent}; send it later with: {again}", file=sys.stderr)
    if problem:
        fail(PROG, problem, f"continue with: {again}", FAILED)
    if results.runs:
        results.show(console)
    console.print(f"compare: {tracker.where(command_path('mlflow'))}", soft_wrap=True)
    if code:
        print(f"{PROG}: stopped; continue with: {again}", file=sys.stderr)
    elif shown.failed:
        fail(PROG, f"{shown.failed} of {len(cells)} runs failed", f"continue with: {again}", FAILED)
    return code


class Results:
    """Finished runs with their errors, and the files made from them."""

    def __init__(self, path: Path, plan: Plan | None = None):
        self.path, self.plan = path, plan
        self.runs: list[Run] = []

    @property
    def groups(self) -> list[tables.Group]:
        return tables.group(self.runs, self.plan)

    def write_tables(self) -> None:
        groups = self.groups
        checkpoint.write_atomic(self.path / TABLE, tables.table_md(groups, self.plan), durable=False)
        checkpoint.write_atomic(self.path / ROWS, tables.table_csv(groups, self.path), durable=False)

    def write(self) -> None:
        """Write tables, the picture and the page."""
        self.write_tables()
        groups = self.groups
        picture.comparison(groups, self.path / PICTURE)
        checkpoint.write_atomic(self.path / REPORT, page(self.path, groups, self.plan, self.path / PICTURE))

    def show(self, console: Console) -> None:
        """Print the tables without their quartiles, and where the complete ones are."""
        console.print(tables.introduction(self.plan))
        for columns in (tables.DRIVING, tables.ERRORS):
            head, *rows = tables.table(self.groups, columns)
            table = Table(box=MINIMAL, padding=0, pad_edge=False, show_edge=False)
            for name in head:  # one word per line, to be narrow
                table.add_column(
                    name.replace(",", "").replace(" ", "\n"), overflow="fold", no_wrap=name in ("road", "learner")
                )
            for row in rows:
                table.add_row(*(cell.partition(" (")[0] for cell in row))
            console.print(table, "")
        for note in tables.notes(self.groups):
            console.print(f"- {note}".replace(", quartiles in brackets", ""), highlight=False)
        console.print(f"tables, picture and drives: {short_path(self.path / REPORT)}", soft_wrap=True)


def _compare_finished(console: Console, flags: CompareFlags) -> int:
    """Compare finished runs. Raises GridSimError."""
    default = CompareFlags()
    for f in dataclasses.fields(CompareFlags):
        if f.name not in WITH_RUNS and getattr(flags, f.name) != getattr(default, f.name):
            raise GridSimError(f"{as_flag(f.name)}: finished runs are compared as they are; leave it out")
    runs = read_runs([Path(name) for name in flags.runs])
    results = Results(new_folder(Path(flags.output), flags.name, "comparison"))
    with console.status("measuring errors") as shown:
        for k, run in enumerate(runs):
            shown.update(Text(f"measuring errors, {k + 1} of {len(runs)}: {run.folder.name}"))
            results.runs.append(measured(run))
        shown.update("writing tables and the picture")
        results.path.mkdir(parents=True)
        results.write()
    results.show(console)
    return 0


class Progress(Line):
    """Shows the runs that are being trained, and an ETA: a line for each on a terminal, plain lines elsewhere."""

    def __init__(self, console: Console, folder: ComparisonFolder, cells: Sequence[Cell], jobs: int, results: Results):
        super().__init__(console)
        self.failed = 0
        self._results, self._jobs, self._total = results, jobs, len(cells)
        self.left = sum(not cell.finished() for cell in cells)
        self._run_s = limits(folder.plan.budget)[1] or math.nan  # until the first run is done
        self._begun: dict[str, float] = {}  # when each run began that is being trained
        self._lines: dict[str, str] = {}  # of each of them
        there = f", {self._total - self.left} of them finished" if self.left < self._total else ""
        console.print(f"comparing {self._total} runs{there} -> {short_path(folder.path)}", soft_wrap=True)

    def read(self, cell: Cell) -> None:
        """Read a finished run; one that is damaged counts as failed."""
        self.head, self.facts, self.rest = self._counter(), "reading what is finished", cell.name
        try:
            self._results.runs.append(measured(read_run(cell.path)))
        except GridSimError as error:
            self._fail(cell, str(error))

    def show(self, cell: Cell, kind: Kind, content: Any) -> None:
        """Show an event of a run."""
        name, now = cell.name, time.perf_counter()
        if kind == "begin":
            self._begun[name], self._lines[name] = now, f"{name}  starting"
        elif kind == "note":
            self._lines[name] = f"{name}  {content}"
        elif kind == "warning":
            print(f"{name}: warning: {content}", file=sys.stderr, flush=True)
        else:
            self.left -= 1
            begun = self._begun.pop(name, now)
            self._lines.pop(name, None)
            if kind == "failed":
                self._fail(cell, content)
            else:
                self._run_s = now - begun
                self._done(content)
        self.head, self.facts, self.rest = self._counter(), f"ETA {self._eta()}", "\n".join(self._lines.values())

    def _fail(self, cell: Cell, reason: str) -> None:
        self.failed += 1
        print(f"{PROG}: {cell.name} failed: {reason}", file=sys.stderr, flush=True)

    def _done(self, run: Run) -> None:
        self._results.runs.append(run)
        self._results.write_tables()
        error = run.figures["velocity_error_percent"]
        self.console.print(
            f"{self._counter()}  {run.folder.name}: success {run.figures['success_rate']:.0%}, "
            f"{run.figures['distance_m']:,.0f} m, "
            + (f"velocity error {error:.1f} %, " if math.isfinite(error) else "")
            + f"{run.figures['training_s']:.0f} s"
            + (f"  ETA {self._eta()}" if self.left else ""),
            soft_wrap=True,
            highlight=False,
        )

    def _counter(self) -> str:
        return f"run {self._total - self.left}/{self._total}"

    def _eta(self) -> str:
        """The ETA if each run takes as long as the latest one, or at first as the budget of wall time."""
        now = time.perf_counter()
        seconds = (self._run_s * self.left - sum(now - begun for begun in self._begun.values())) / self._jobs
        return clock(max(seconds, 0.0)) if math.isfinite(seconds) else "-:--"


compare_main = partial(main, PROG, _compare)
