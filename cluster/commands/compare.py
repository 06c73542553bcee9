"""gridsim-compare: the paper's comparison in one command, or a comparison of finished runs."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import tyro
from rich.box import MINIMAL
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cluster import stopping
from cluster.commands import common
from cluster.commands.common import WorkFlags, command_path, fail, short_path
from cluster.commands.progress import clock, progress_in_words, row_in_words
from cluster.compare import report, tables
from cluster.compare.plan import MAX_WALL_S, ComparisonFolder, Plan, PlannedRun, limits, open_comparison, read_runs
from cluster.compare.processes import Processes, RunProcess, is_sent
from cluster.compare.report import read_comparison
from cluster.compare.results import Run, measured, read_run
from cluster.redaction import redacted
from cluster.settings import IN_WORDS, check_workers
from cluster.store.folder import lock, new_folder
from cluster.tracking.address import check_uri
from cluster.tracking.tracking import Status, Tracking, saved_uri
from cluster.workers import kernels
from cluster.workers.address import cluster_address
from gridsim.errors import GridSimError

PROG = "gridsim-compare"


@dataclass(frozen=True)
class CompareFlags(WorkFlags, Plan):
    """Compare learners: the same car on the same roads, each learner with the same budget, over several seeds.

    Runs gridsim-evolve and gridsim-dqn for every learner on every scenario with every seed, then writes
    comparison.html: tables, a picture, and a link to each champion's drive; also table.md, table.csv and
    comparison.png. Each run's folder is kept, and a finished run is never repeated. With RUNS, folders of finished runs
    or of comparisons, it only compares these.
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
    """Runs that are trained at once, each with --workers of its own: on a cluster as many as it has room for. On one
    machine they share the cores, so give a --budget of car-steps."""

    example: ClassVar[str] = "gridsim-compare --scenarios curved city --learners evolution dqn --seeds 5"


QUICK = CompareFlags(seeds=1, budget="10s")
# Flags that may differ in a resumed comparison.
MAY_DIFFER = ("resume", "jobs", "workers", "address", "patience", "tracking_uri", "experiment")
MAX_JOBS = 256  # each takes some 500 MB here
WITH_RUNS = ("runs", "output", "name")  # flags for a comparison of finished runs
WAIT_FOR_MLFLOW_S = 30.0  # for the id of the comparison's run, to which those of its runs belong


def _compare() -> int:
    arguments = sys.argv[1:]
    flags = common.parse(CompareFlags, PROG, arguments)
    if flags.quick and not flags.resume:
        flags = common.parse(CompareFlags, PROG, arguments, QUICK)
    if flags.runs:
        return _compare_finished(flags)
    check_workers(flags.workers, flags.patience)
    if not 1 <= flags.jobs <= MAX_JOBS:
        raise GridSimError(f"--jobs must be 1 to {MAX_JOBS}, not {flags.jobs}")
    folder, flags = _prepare(arguments, flags)
    uri, wall_s = check_uri(flags.tracking_uri, saved_uri(folder.path)), limits(flags.budget)[1]
    left = [run for run in folder.planned() if not (run.finished() and is_sent(run))]
    address = cluster_address(flags.address) if left else None
    lock(folder.path)
    if flags.jobs > 1 and wall_s:
        _warn("runs at once share the cores, so that each learns less in the same time; use a --budget of car-steps")
    common.warn_of_many_workers(PROG, flags.jobs * max(flags.workers, 1), address)
    shared = {
        "workers": flags.workers, "address": address or "local", "patience": flags.patience,
        "wall-time": wall_s or MAX_WALL_S,  # with a limit, the time of a run counts from its first step
        "tracking-uri": redacted(uri), "experiment": flags.experiment,
    }  # fmt: skip
    stopping.listen()
    folder.write()
    tracking = Tracking(folder.path, uri, flags.experiment, read_comparison)
    processes = Processes(left, flags.jobs, [f"--{name}={value}" for name, value in shared.items()])
    return _train_and_compare(folder, left, tracking, processes)


def _prepare(arguments: Sequence[str], flags: CompareFlags) -> tuple[ComparisonFolder, CompareFlags]:
    """The comparison's folder, checked; nothing is written yet. Raises GridSimError."""
    if not flags.resume:
        plan = common.select(Plan, flags)
        plan.check()
        return ComparisonFolder(new_folder(Path(flags.output), flags.name, "comparison"), plan), flags
    folder = open_comparison(Path(flags.resume))
    before = CompareFlags(**vars(folder.plan), output=str(folder.path.parent), name=folder.path.name)
    flags = common.parse(CompareFlags, PROG, arguments, before)
    if limits(flags.budget) == limits(before.budget):
        flags = dataclasses.replace(flags, budget=before.budget)
    common.check_unchanged(flags, before, MAY_DIFFER, ("seeds",), "comparison")
    folder.plan = common.select(Plan, flags)
    folder.plan.check()
    return folder, flags


def _train_and_compare(
    folder: ComparisonFolder, left: Sequence[PlannedRun], tracking: Tracking, processes: Processes
) -> int:
    """Make the runs that are left, and compare all."""
    console, problem = common.new_console(), ""
    again = f"{command_path(PROG)} --resume {short_path(folder.path)}"
    status: Status = "FINISHED"
    shown = Progress(console, folder, len(left), processes.jobs)
    try:
        with shown:
            tracking.start()
            for run in folder.planned():
                if run not in left:
                    shown.read(run)
            if left:
                processes.environment = _environment(tracking, shown)
            for run in left:  # once for all processes, and not in their time
                if not kernels.is_compiled(run.settings):
                    shown.note("compiling the simulator for runs of this kind, once")
                    kernels.compile_ahead(run.settings)
            while processes.waiting or processes.running:
                ended = processes.wait()
                shown.show(processes.running)
                for process in ended:
                    shown.ended(process)
    except (KeyboardInterrupt, SystemExit):  # the latter by rich, if what reads the output has ended
        status = "KILLED"
        common.new_console(stderr=True).print("stopping; runs are being saved ...", style="dim")
    except (GridSimError, MemoryError, OSError) as error:
        problem, status = str(error) or type(error).__name__, "FAILED"
    finally:
        processes.stop()
    for process in processes.running:  # that were stopped
        shown.report(process, "warning", "error")
    if shown.runs and not problem:
        with console.status("writing tables and the picture"):
            report.write(folder.path, shown.groups(), folder.plan)
    if unsent := tracking.close(status):
        _warn(f"{unsent}; send it later with: {again}")
    if problem:
        fail(PROG, problem, f"continue with: {again}", common.FAILED)
    if shown.runs:
        _print(console, folder.path, shown.groups(), folder.plan)
    console.print(f"compare: {tracking.where(command_path('mlflow'))}", soft_wrap=True)
    if status == "KILLED":
        print(f"{PROG}: stopped; continue with: {again}", file=sys.stderr)
        return stopping.INTERRUPTED
    if shown.failed:
        fail(PROG, f"{shown.failed} of {len(folder.planned())} runs failed", f"continue with: {again}", common.FAILED)
    return 0


def _environment(tracking: Tracking, shown: Progress) -> dict[str, str]:
    """Of the runs: MLflow's address with its password, which no flag may hold, and the run to which theirs belong."""
    shown.note("waiting for MLflow")
    parent = tracking.wait_id(WAIT_FOR_MLFLOW_S)
    if not parent:
        reason = f"{redacted(tracking.uri)}: {tracking.error or 'no answer in time'}"
        _warn(f"its runs are not nested in MLflow: {reason}")
    context = {"mlflow.parentRunId": parent} if parent else {}
    return {"MLFLOW_TRACKING_URI": tracking.uri, "MLFLOW_RUN_CONTEXT": json.dumps(context)}


def _compare_finished(flags: CompareFlags) -> int:
    """Compare finished runs. Raises GridSimError."""
    default, console = CompareFlags(), common.new_console()
    for f in dataclasses.fields(CompareFlags):
        if f.name not in WITH_RUNS and getattr(flags, f.name) != getattr(default, f.name):
            raise GridSimError(f"{common.as_flag(f.name)}: finished runs are compared as they are; leave it out")
    found = read_runs([Path(name) for name in flags.runs])
    path, runs = new_folder(Path(flags.output), flags.name, "comparison"), []
    with console.status("measuring errors") as shown:
        for k, run in enumerate(found):
            shown.update(Text(f"measuring errors, {k + 1} of {len(found)}: {run.folder.name}"))
            runs.append(measured(run))
        shown.update("writing tables and the picture")
        path.mkdir(parents=True)
        groups = tables.group(runs)
        report.write(path, groups, None)
    _print(console, path, groups, None)
    return 0


def _print(console: Console, path: Path, groups: tables.Groups, plan: Plan | None) -> None:
    """Print the tables without their quartiles, and where the complete ones are."""
    console.print(tables.introduction(plan))
    for columns in (tables.DRIVING, tables.ERRORS):
        head, *rows = tables.table(groups, columns, spread=False)
        table = Table(box=MINIMAL, padding=0, pad_edge=False, show_edge=False)
        for k, name in enumerate(head):  # one word per line, to be narrow
            table.add_column(name.replace(",", "").replace(" ", "\n"), overflow="fold", no_wrap=k < 2)
        for row in rows:
            table.add_row(*row)
        console.print(table, "")
    for note in tables.notes(groups):
        console.print(f"- {note}".replace(", quartiles in brackets", ""), highlight=False)
    console.print(f"tables, picture and drives: {short_path(path / report.REPORT)}", soft_wrap=True)


def _warn(text: str) -> None:
    print(f"{PROG}: warning: {text}", file=sys.stderr, flush=True)


class Progress(Live):
    """Shows the runs that are being made, with an ETA, and keeps those that are done.

    On a terminal there is a line for each that is being made, elsewhere one for each that is done.
    """

    def __init__(self, console: Console, folder: ComparisonFolder, left: int, jobs: int):
        super().__init__(console=console, auto_refresh=console.is_terminal, transient=True)
        self.runs: list[Run] = []
        self.failed = 0
        self._folder, self._left, self._jobs, self._total = folder, left, jobs, len(folder.planned())
        self._run_s = limits(folder.plan.budget)[1] or math.nan  # of the latest run; at first its limit
        self._spent_s = 0.0  # by those that are being made
        there = f", {self._total - left} of them finished" if left < self._total else ""
        console.print(f"comparing {self._total} runs{there} -> {short_path(folder.path)}", soft_wrap=True)

    def groups(self) -> tables.Groups:
        """The runs that are done, in groups."""
        return tables.group(self.runs, self._folder.plan)

    def note(self, *lines: str) -> None:
        """Show lines under how many runs are done."""
        text = Text(f"{self._counter()}  ETA {self._eta()}", "bold")
        self.update(Text("\n", overflow="ellipsis", no_wrap=True).join([text, *map(Text, lines)]))

    def show(self, running: Sequence[RunProcess]) -> None:
        """Show the newest row of each."""
        self._spent_s = sum(time.perf_counter() - process.began for process in running)
        if self.console.is_terminal:
            self.note(*map(_in_words, running))

    def ended(self, process: RunProcess) -> None:
        """Take in a run whose process has ended."""
        self._left -= 1
        self.report(process, "warning")
        if code := process.process.returncode:
            said = f"its process ended with exit code {code}; see {short_path(process.log)}"
            self._fail(process.run, [said, *process.said("error")][-1])
        elif run := self.read(process.run):
            self._run_s = time.perf_counter() - process.began
            report.write_tables(self._folder.path, self.groups(), self._folder.plan)
            error = run.figures["velocity_error_percent"]
            self.console.print(
                f"{self._counter()}  {run.folder.name}: success {run.figures['success_rate']:.0%}, "
                f"{run.figures['distance_m']:,.0f} m, "
                + (f"velocity error {error:.1f} %, " if math.isfinite(error) else "")
                + f"{run.figures['training_s']:.0f} s"
                + (f"  ETA {self._eta()}" if self._left else ""),
                soft_wrap=True, highlight=False,
            )  # fmt: skip

    def report(self, process: RunProcess, *kinds: str) -> None:
        """Print a process's messages of these kinds."""
        for kind in kinds:
            for text in process.said(kind):
                print(f"{process.run.name}: {kind}: {text}", file=sys.stderr, flush=True)

    def read(self, planned: PlannedRun) -> Run | None:
        """Read a finished run and measure its errors; one that is damaged, or not what was planned, has failed."""
        self.note(f"{planned.name}  measuring errors")
        try:
            run = read_run(planned.path)
            if run.settings != planned.settings:
                said = "one of them was edited, or another version of GridSim wrote it; start a new comparison"
                raise GridSimError(f"{planned.path} is not what comparison.json asks for: {said}")
            self.runs.append(measured(run))
            return self.runs[-1]
        except GridSimError as error:
            self._fail(planned, str(error))
            return None

    def _fail(self, planned: PlannedRun, reason: str) -> None:
        self.failed += 1
        print(f"{PROG}: {planned.name} failed: {reason}", file=sys.stderr, flush=True)

    def _counter(self) -> str:
        return f"run {self._total - self._left}/{self._total}"

    def _eta(self) -> str:
        """The ETA if each run takes as long as the latest one."""
        seconds = (self._run_s * self._left - self._spent_s) / self._jobs
        return clock(max(seconds, 0.0)) if math.isfinite(seconds) else "-:--"


def _in_words(process: RunProcess) -> str:
    """How far a run is, by the newest row of its history."""
    row, settings = process.newest_row(), process.run.settings
    if not row:
        return f"{process.run.name}  starting"
    steps = int(row[settings.step_name]) + 1
    done = progress_in_words(settings, steps, row, bounded=False)
    success = f"success {row['validation/success_rate']:.0%}"
    return f"{process.run.name}  {done}  {success}  {row_in_words(settings, steps, row)}"


compare_main = partial(common.main, PROG, _compare)
