"""gridsim-compare: the paper's comparison in one command, or a comparison of finished runs."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from subprocess import Popen
from typing import Annotated, ClassVar

import tyro
from rich.box import MINIMAL
from rich.console import Console
from rich.table import Column, Table

from cluster import stopping
from cluster.commands import common
from cluster.commands.common import WorkFlags, command_path, fail, short_path
from cluster.commands.progress import Display, clock
from cluster.compare import report, tables
from cluster.compare.plan import MAX_WALL_S, Plan, is_finished, limits, read_plan, read_runs, write_plan
from cluster.compare.processes import is_sent, last_line, log_of, said, start
from cluster.compare.results import Run, measured, read_run
from cluster.redaction import redacted
from cluster.settings import IN_WORDS, check_workers
from cluster.store.folder import RunFolder, lock, new_folder
from cluster.tracking.address import check_uri
from cluster.tracking.tracking import Status, Tracking, saved_uri
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
WITH_RUNS = ("runs", "output", "name")  # flags for a comparison of finished runs
MAX_JOBS = 256  # each takes some 500 MB here
WAIT_FOR_MLFLOW_S = 30.0  # for the id of the comparison's run, to which those of its runs belong
LOOK_S = 0.2  # between two looks at the runs' processes


def _compare() -> int:
    arguments = sys.argv[1:]
    flags = common.parse(CompareFlags, PROG, arguments, QUICK if "--quick" in arguments else None)
    if flags.runs:
        return _compare_finished(flags)
    check_workers(flags.workers, flags.patience)
    if not 1 <= flags.jobs <= MAX_JOBS:
        raise GridSimError(f"--jobs must be 1 to {MAX_JOBS}, not {flags.jobs}")
    if flags.resume:
        path = Path(flags.resume).resolve()
        before = CompareFlags(**vars(read_plan(path)), output=str(path.parent), name=path.name)
        flags = common.parse(CompareFlags, PROG, arguments, before)
        common.check_unchanged(flags, before, MAY_DIFFER, ("seeds",), "comparison")
    else:
        path = new_folder(Path(flags.output), flags.name, "comparison")
    plan = common.select(Plan, flags)
    plan.check()
    uri, wall_s = check_uri(flags.tracking_uri, saved_uri(path)), limits(plan.budget)[1]
    work = Work(path, plan, flags.jobs)
    address = cluster_address(flags.address) if work.waiting else None
    lock(path)
    if flags.jobs > 1 and wall_s:
        _warn("runs at once share the cores, so that each learns less in the same time; use a --budget of car-steps")
    common.warn_of_many_workers(PROG, flags.jobs * max(flags.workers, 1), address)
    shared = {
        "workers": flags.workers, "address": address or "local", "patience": flags.patience,
        "wall_time": wall_s or MAX_WALL_S,  # with a limit, the time of a run counts from its first step
        "tracking_uri": redacted(uri), "experiment": flags.experiment,
    }  # fmt: skip
    stopping.listen()
    write_plan(path, plan)
    tracking = Tracking(path, uri, flags.experiment, report.read_comparison)
    again = f"{command_path(PROG)} --resume {short_path(path)}"
    status: Status = "FINISHED"
    try:
        with contextlib.closing(work), work.display:
            tracking.start()
            work.train(tracking, shared)
    except (KeyboardInterrupt, SystemExit):  # the latter by rich, if what reads the output has ended
        status = "KILLED"
    except (GridSimError, OSError) as error:
        tracking.close("FAILED")
        fail(PROG, str(error), f"continue with: {again}", common.FAILED)
    if work.runs:
        report.write(path, work.runs, plan)
    if unsent := tracking.close(status):
        _warn(f"{unsent}; send it later with: {again}")
    if work.runs:
        _print(work.console, path, work.runs, plan)
    work.console.print(f"compare: {tracking.where(command_path('mlflow'))}", soft_wrap=True)
    if status == "KILLED":
        print(f"{PROG}: stopped; continue with: {again}", file=sys.stderr)
        return stopping.INTERRUPTED
    if work.failed:
        fail(PROG, f"{work.failed} of {len(work.planned)} runs failed", f"continue with: {again}", common.FAILED)
    return 0


class Work:
    """Trains what is left of a comparison, so many runs at once as `jobs` says, and reads and measures all runs.

    A run that fails does not stop the others.
    """

    def __init__(self, path: Path, plan: Plan, jobs: int):
        self.console = common.new_console()
        self.planned, self.runs, self.failed = plan.planned(path), list[Run](), 0
        self.waiting = deque(run for run in self.planned if not (is_finished(run) and is_sent(run)))
        self._path, self._plan, self._jobs, self.display = path, plan, jobs, Display(self.console)
        self._running = list[tuple[RunFolder, Popen[bytes]]]()
        self._ends_at = math.nan  # `perf_counter`, as far as it can be told

    def train(self, tracking: Tracking, flags: Mapping[str, object]) -> None:
        """Train what is left, with these flags besides those of each run. Raises: Stopped, OSError."""
        total, left = len(self.planned), len(self.waiting)
        finished = f", {total - left} of them finished" if left < total else ""
        self.console.print(f"comparing {total} runs{finished} -> {short_path(self._path)}", soft_wrap=True)
        for run in self.planned:
            if run not in self.waiting:
                self._take_in(run)
        self._show("waiting for MLflow")
        parent = tracking.wait_id(WAIT_FOR_MLFLOW_S) if self.waiting else ""
        environment = {
            "MLFLOW_TRACKING_URI": tracking.uri,  # with its password, which no flag may hold
            "MLFLOW_RUN_CONTEXT": json.dumps({"mlflow.parentRunId": parent} if parent else {}),
        }
        began = time.perf_counter()
        self._ends_at = began + (limits(self._plan.budget)[1] or math.nan) * left / self._jobs
        while self.waiting or self._running:
            while self.waiting and len(self._running) < self._jobs:
                run = self.waiting.popleft()
                self._running.append((run, start(run, flags, environment)))
            self._show(*(f"{run.name}  {last_line(run)}" for run, _ in self._running))
            time.sleep(LOOK_S)
            stopping.check()
            for run, process in [each for each in self._running if each[1].poll() is not None]:
                self._running.remove((run, process))
                _repeat(run)
                now, to_do = time.perf_counter(), len(self.waiting) + len(self._running)
                self._ends_at = now + to_do * (now - began) / (left - to_do)
                self._take_in(run, process.returncode)

    def close(self) -> None:
        """Ask what is running to save and to end, and wait until it has."""
        if self._running:
            common.new_console(stderr=True).print("stopping; runs are being saved ...", style="dim")
        for _, process in self._running:
            process.terminate()
        for run, process in self._running:
            process.wait()
            _repeat(run)

    def _take_in(self, planned: RunFolder, code: int = 0) -> None:
        """Read a run whose process has ended with this exit code, and measure its errors, unless it has failed."""
        self._show(f"{planned.name}  measuring errors")
        try:
            if code:
                raise GridSimError(f"its process ended with exit code {code}; see {short_path(log_of(planned))}")
            run = read_run(planned.path)
            if run.settings != planned.settings:
                what = f"{planned.path} is not what comparison.json asks for"
                raise GridSimError(f"{what}; was it edited, or made by another version? Start a new comparison")
            self.runs.append(measured(run))
        except GridSimError as error:
            self.failed += 1
            print(f"{PROG}: {planned.name} failed: {error}", file=sys.stderr, flush=True)
            return
        report.write_tables(self._path, self.runs, self._plan)
        figures = self.runs[-1].figures
        self.console.print(
            f"{self.display.head}  {planned.name}: success {figures['success_rate']:.0%}, "
            f"{figures['distance_m']:,.0f} m, velocity error {figures['velocity_error_percent']:.1f} %, "
            f"{figures['training_s']:.0f} s  {self.display.facts}",
            soft_wrap=True, highlight=False,
        )  # fmt: skip

    def _show(self, *lines: str) -> None:
        """Show these lines under how many runs are done, and when all will be."""
        total, seconds = len(self.planned), self._ends_at - time.perf_counter()
        done = total - len(self.waiting) - len(self._running)
        self.display.head, self.display.share = f"run {done}/{total}", done / total
        self.display.facts = f"ETA {clock(max(seconds, 0.0)) if math.isfinite(seconds) else '-:--'}"
        self.display.rest = "\n".join(lines)


def _repeat(run: RunFolder) -> None:
    """Print what a run's process has warned of, and why it failed."""
    for kind, text in said(run):
        print(f"{run.name}: {kind}: {text}", file=sys.stderr, flush=True)


def _warn(text: str) -> None:
    print(f"{PROG}: warning: {text}", file=sys.stderr, flush=True)


def _compare_finished(flags: CompareFlags) -> int:
    """Compare finished runs. Raises GridSimError."""
    default, console = CompareFlags(), common.new_console()
    for f in dataclasses.fields(CompareFlags):
        if f.name not in WITH_RUNS and getattr(flags, f.name) != getattr(default, f.name):
            raise GridSimError(f"{common.as_flag(f.name)}: finished runs are compared as they are; leave it out")
    found, runs = read_runs(map(Path, flags.runs)), list[Run]()
    path = new_folder(Path(flags.output), flags.name, "comparison")
    with Display(console) as shown:
        for run in found:
            shown.head, shown.share = f"run {len(runs)}/{len(found)}", len(runs) / len(found)
            shown.rest = f"{run.folder.name}  measuring errors"
            runs.append(measured(run))
    path.mkdir(parents=True)
    report.write(path, runs, None)
    _print(console, path, runs, None)
    return 0


def _print(console: Console, path: Path, runs: Sequence[Run], plan: Plan | None) -> None:
    """Print the tables without their quartiles, and where the complete ones are."""
    groups = tables.group(runs, plan)
    console.print(tables.introduction(plan))
    for columns in (tables.DRIVING, tables.ERRORS):
        names, *rows = tables.table(groups, columns, spread=False)
        heads = [name.replace(",", "").replace(" ", "\n") for name in names]  # a word a line, to be narrow
        table = Table(
            *(Column(head, overflow="fold", no_wrap=k < 2) for k, head in enumerate(heads)),
            box=MINIMAL, padding=0, pad_edge=False, show_edge=False,
        )  # fmt: skip
        for row in rows:
            table.add_row(*row)
        console.print(table, "")
    for note in tables.notes(groups):
        console.print(f"- {note}".replace(", quartiles in brackets", ""), highlight=False)
    console.print(f"tables, picture and drives: {short_path(path / report.REPORT)}", soft_wrap=True)


compare_main = partial(common.main, PROG, _compare)
