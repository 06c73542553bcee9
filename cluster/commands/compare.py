"""gridsim-compare: the paper's comparison in one command, or a comparison of finished runs."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
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
from cluster.compare.plan import MAX_WALL_S, Plan, has_summary, limits, read_finished, read_plan, read_runs, write_plan
from cluster.compare.processes import is_sent, last_line, log_of, said, start
from cluster.compare.results import Run, measured, read_run
from cluster.redaction import redacted
from cluster.settings import IN_WORDS, check_workers
from cluster.store.folder import RunFolder, lock, new_folder
from cluster.text import km_per_collision
from cluster.tracking.address import check_uri
from cluster.tracking.tracking import Status, Tracking, saved_uri
from cluster.workers.address import cluster_address
from cluster.workers.child import Child
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
    """For a new comparison: a first look, in minutes, with one seed and 10 s per run."""
    name: Annotated[str, IN_WORDS] = ""
    """Name of the comparison; by default made from the time."""
    resume: Annotated[str, IN_WORDS] = ""
    """Folder of a comparison to continue; a larger --seeds adds to it."""
    jobs: int = 1
    """Runs that are trained at once, each with --workers of its own: on a cluster as many as it has room for. On one
    machine they share the cores, so give a --budget of car-steps."""

    example: ClassVar[str] = "gridsim-compare --scenarios curved city --learners evolution dqn --seeds 5"


QUICK = CompareFlags(seeds=1, budget="10s")
# Flags that may differ in a resumed comparison, besides a larger --seeds.
MAY_DIFFER = ("resume", "jobs", "workers", "address", "patience", "tracking_uri", "experiment")
WITH_RUNS = ("runs", "output", "name")  # the only flags for a comparison of finished runs
MAX_JOBS = 256  # each takes some 500 MB on this machine
WAIT_FOR_MLFLOW_S = 30.0  # at most, for the id of the comparison's run in MLflow, the parent of its training runs
LOOK_S = 0.2  # between two looks at the runs' processes


def _compare() -> int:
    arguments, console = sys.argv[1:], common.new_console()
    flags = common.parse(CompareFlags, PROG, arguments, QUICK if "--quick" in arguments else None)
    if flags.runs:
        return _compare_finished(console, flags)
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
    total, done = len(plan.planned(path)), len(read_finished(path, plan))
    left = [run for run in plan.planned(path) if not (has_summary(run) and is_sent(run))]
    uri, wall_s = check_uri(flags.tracking_uri, saved_uri(path)), limits(plan.budget)[1]
    address = cluster_address(flags.address) if left else None
    lock(path)
    if flags.jobs > 1 and wall_s:
        text = "runs at once share the cores, so that each learns less in the same time; use a --budget of car-steps"
        _say(f"{PROG}: warning: {text}")
    common.warn_of_many_workers(PROG, flags.jobs * max(flags.workers, 1), address)
    shared = {
        "workers": flags.workers, "address": address or "local", "patience": flags.patience,
        "wall_time": wall_s or MAX_WALL_S,  # with any limit, a run's time counts from its first step
        "tracking_uri": redacted(uri), "experiment": flags.experiment,
    }  # fmt: skip
    stopping.listen()
    write_plan(path, plan)
    console.print(f"comparing {total} runs, {done} of them finished -> {short_path(path)}", soft_wrap=True)
    tracking = Tracking(path, uri, flags.experiment, report.read_comparison)
    again = f"{command_path(PROG)} --resume {short_path(path)}"
    status: Status = "FINISHED"
    failed = 0
    try:
        tracking.start()
        tracking.listen()
        if left:
            with console.status("waiting for MLflow"):
                parent = tracking.wait_id(WAIT_FOR_MLFLOW_S)
            environment = {
                "MLFLOW_TRACKING_URI": tracking.uri,  # with its password, which no flag may hold
                "MLFLOW_RUN_CONTEXT": json.dumps({"mlflow.parentRunId": parent} if parent else {}),
            }
            start_run = partial(start, flags=shared, environment=environment)
            failed = _train(console, left, total, flags.jobs, wall_s or math.nan, start_run)
        failed += _report(console, path, read_finished(path, plan), plan)
        stopping.check()
    except (KeyboardInterrupt, SystemExit):  # SystemExit is rich's, if the output's reader has ended
        status = "KILLED"
    except (GridSimError, OSError) as error:
        tracking.close("FAILED")
        fail(PROG, str(error), f"continue with: {again}", common.FAILED)
    if unsent := tracking.close(status):
        _say(f"{PROG}: warning: {unsent}; send it later with: {again}")
    console.print(f"compare: {tracking.where(command_path('mlflow'))}", soft_wrap=True)
    if status == "KILLED":
        _say(f"{PROG}: stopped; continue with: {again}")
        return stopping.INTERRUPTED
    if failed:
        fail(PROG, f"{failed} of {total} runs failed", f"continue with: {again}", common.FAILED)
    return 0


def _compare_finished(console: Console, flags: CompareFlags) -> int:
    for f in dataclasses.fields(flags):
        if f.name not in WITH_RUNS and getattr(flags, f.name) != getattr(CompareFlags(), f.name):
            name = "--quick" if flags.quick else common.as_flag(f.name)
            raise GridSimError(f"{name}: finished runs are compared as they are; leave it out")
    runs = read_runs(map(Path, flags.runs))
    path = new_folder(Path(flags.output), flags.name, "comparison")
    path.mkdir(parents=True, exist_ok=True)
    return common.FAILED if _report(console, path, runs, None) else 0


def _train(
    console: Console, left: Sequence[RunFolder], total: int, jobs: int, run_s: float,
    start: Callable[[RunFolder], Child],
) -> int:  # fmt: skip
    """Train the runs `left` of `total` ones, `jobs` at a time, until a signal comes; a run that fails stops no other.

    Args: `run_s`, the wall time (s) that a run may take, nan if not limited, which is used for the first ETA alone;
    `start`, which starts a run's process.
    Returns: how many failed.
    """
    waiting, running, failed = deque(left), list[tuple[RunFolder, Child]](), 0
    began = time.perf_counter()
    ends_at = began + run_s * len(left) / jobs
    try:
        with Display(console) as shown:
            while (waiting or running) and not stopping.requested():
                while waiting and len(running) < jobs:
                    run = waiting.popleft()
                    running.append((run, start(run)))
                done = total - len(waiting) - len(running)
                shown.head, shown.share = f"run {done}/{total}", done / total
                shown.facts = f"ETA {clock(ends_at - time.perf_counter())}"
                shown.rest = "\n".join(f"{run.name}  {last_line(run)}" for run, _ in running)
                time.sleep(LOOK_S)
                for run, process in [each for each in running if each[1].exit_code() is not None]:
                    running.remove((run, process))
                    process.close(0.0)
                    _repeat(run)
                    now, to_do = time.perf_counter(), len(waiting) + len(running)
                    ends_at = now + to_do * (now - began) / (len(left) - to_do)
                    if code := process.exit_code():
                        failed += 1
                        see = f"its process ended with exit code {code}; see {short_path(log_of(run))}"
                        _say(f"{PROG}: {run.name} failed: {see}")
                    else:
                        figures = read_run(run.path).figures
                        console.print(
                            f"run {total - to_do}/{total}  {run.name}: success {figures['success_rate']:.0%}, "
                            f"{figures['distance_m']:,.0f} m, {km_per_collision(figures)} km per collision, "
                            f"{figures['training_s']:.0f} s  "
                            f"ETA {clock(ends_at - now)}",
                            soft_wrap=True, highlight=False,
                        )  # fmt: skip
    finally:
        if running:
            common.new_console(stderr=True).print("stopping; runs are being saved ...", style="dim")
        for _, process in running:
            process.terminate()
        for run, process in running:
            process.close(None)
            _repeat(run)
    return failed


def _repeat(run: RunFolder) -> None:
    """Print what a run's process has warned of, and why it failed."""
    for kind, text in said(run):
        _say(f"{run.name}: {kind}: {text}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _report(console: Console, path: Path, found: Sequence[Run], plan: Plan | None) -> int:
    """Measure finished runs' errors against the reference driver, and write and print the runs' tables.

    After a signal, errors are no longer measured. Returns: how many runs could not be measured.
    """
    runs, failed = list[Run](), 0
    with Display(console) as shown:
        for k, run in enumerate(found):
            shown.head, shown.share = f"run {k}/{len(found)}", k / len(found)
            shown.rest = f"{run.folder.name}  measuring errors"
            try:
                runs.append(run if stopping.requested() else measured(run))
            except GridSimError as error:
                failed += 1
                _say(f"{PROG}: {run.folder.name} failed: {error}")
    if not runs:
        return failed
    groups = tables.group(runs, plan)
    report.write(path, groups, plan)
    console.print(tables.introduction(plan))
    for columns in (tables.DRIVING, tables.ERRORS):
        names, *rows = tables.table(groups, columns, spread=False)
        heads = [name.replace(",", "").replace(" ", "\n") for name in names]  # a word on each line, for narrow columns
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
    return failed


compare_main = partial(common.main, PROG, _compare)
