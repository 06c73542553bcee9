"""gridsim-compare: the paper's comparison in one command, or a comparison of runs that are there."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress as Live
from rich.table import Table

from cluster.commands.common import (
    FAILED,
    INTERRUPTED,
    TERMINATED,
    Stopped,
    called,
    cores,
    fail,
    main,
    parse,
    typed,
    warn_of_crowd,
)
from cluster.commands.progress import Line, clock
from cluster.comparison import plan as experiment
from cluster.comparison import tables
from cluster.comparison.plan import Budget, Cell, CellError, ComparisonFolder, Plan
from cluster.comparison.results import (
    ERROR_FIGURES,
    ERRORS_KEPT,
    LEARNERS,
    Errors,
    ExperimentError,
    Learner,
    Run,
    errors_of,
    read_run,
    series_of,
)
from cluster.runs import checkpoint
from cluster.runs.checkpoint import CheckpointError
from cluster.runs.run import RunError, lock
from cluster.runs.settings import SettingsError, check_workers
from evolution.networks.policy import Observation
from gridsim.maps.scenarios import REGISTRY

if TYPE_CHECKING:
    from cluster.tracking.tracker import Tracker

PROG = "gridsim-compare"
TABLE, ROWS, PICTURE, ROUTE = "table.md", "table.csv", "comparison.png", "route.png"
ROUTE_M = 400.0  # m of the seamless route that are drawn
QUICK_SEEDS, QUICK_BUDGET = 1, "10s"


@dataclass(frozen=True)
class CompareFlags:
    """Compare learners: the same car on the same roads, each learner with the same budget, over several seeds.

    Trains every learner on every scenario with every seed, then writes table.md, table.csv and two pictures. A run's
    folder is kept for each, and what is finished is never done again. With RUNS, folders of runs (or of comparisons)
    that are there, it trains nothing and compares these.
    """

    runs: tyro.conf.Positional[tuple[str, ...]] = ()
    """Folders of finished runs to compare, in place of training."""
    scenarios: tuple[str, ...] = tuple(REGISTRY)
    """Roads to compare on."""
    learners: tuple[Learner, ...] = LEARNERS
    """Who is compared."""
    seeds: int = 3
    """Seeds of each, 0 and up; 1 with --quick."""
    observation: Observation = "rays"
    """What the networks see: 31 ranges, or the occupancy grid; and the speed."""
    budget: str = "60s"
    """What a run may use at most: car-steps (20M, 500k) or wall time (60s, 5min, 1h); 10s with --quick. Car-steps give
    the same networks on any machine. A run also ends by its learner's own rule."""
    quick: bool = False
    """A first look, in minutes."""
    traffic: int = -1
    """Other cars on the road; -1: as many as each scenario has by default."""
    reference: str = ""
    """A drive that gridsim-drive recorded, to measure errors against in place of the reference driver."""
    workers: int = field(default_factory=cores)
    """Worker processes; 0 evaluates in this process."""
    output: str = "runs"
    """Folder in which the comparison's folder is made."""
    name: str = ""
    """Name of the comparison; by default made of the time."""
    resume: str = ""
    """Folder of a comparison to continue; a larger --seeds adds to it."""
    address: str = ""
    """An existing Ray cluster: auto, or host:port. By default RAY_ADDRESS, else a Ray is started here."""
    patience: float = 0.0
    """Seconds to wait for workers when there are none; 0: 300 on a cluster, else 60. Then a run fails."""
    tracking_uri: str = ""
    """MLflow's store. By default MLFLOW_TRACKING_URI, else sqlite:///mlflow.db."""
    experiment: str = "gridsim"
    """MLflow's experiment."""
    population: int = 0
    """Members of a generation, of evolution and random search; 0: as gridsim-evolve has it."""
    generations: int = 0
    """Generations at most, of evolution and random search; 0: any number, within the budget."""

    def plan(self) -> Plan:
        """What decides the runs, checked. Raises ExperimentError."""
        plan = Plan(
            self.scenarios, self.learners, self.seeds, Budget.parse(self.budget), self.observation, self.traffic,
            self.reference, self.population, self.generations,
        )  # fmt: skip
        plan.check()
        return plan


# May differ when a comparison is resumed.
FREE = ("resume", "workers", "address", "patience", "tracking_uri", "experiment")
KEPT = ("runs", "output", "name", "reference")  # go with --runs


def compare_main() -> None:
    """Entry point of `gridsim-compare`."""
    main(PROG, lambda: _compare(sys.argv[1:]))


def _compare(arguments: Sequence[str]) -> int:
    from cluster.tracking.address import TrackingError, check_uri

    flags = parse(CompareFlags, PROG, arguments)
    if flags.quick and not flags.resume:
        flags = parse(CompareFlags, PROG, arguments, CompareFlags(seeds=QUICK_SEEDS, budget=QUICK_BUDGET))
    console = Console()
    try:
        if flags.runs:
            return _existing(console, flags)
        folder, flags = _prepare(arguments, flags)
        cells = folder.cells()
        uri = check_uri(flags.tracking_uri or None)
        lock(folder.path)
    except (ExperimentError, CheckpointError, RunError, SettingsError) as error:
        fail(PROG, str(error))
    except TrackingError as error:
        fail(PROG, str(error))
    warn_of_crowd(PROG, flags.workers, flags.address)
    return _experiment(console, folder, cells, flags, uri)


def _stamped(flags: CompareFlags) -> str:
    if flags.name:
        return flags.name
    name = f"comparison-{time.strftime('%Y%m%d-%H%M%S')}"
    return f"{name}-{os.getpid()}" if (Path(flags.output) / name).exists() else name


def _prepare(arguments: Sequence[str], flags: CompareFlags) -> tuple[ComparisonFolder, CompareFlags]:
    """The comparison's folder, checked; nothing is written yet. Raises ExperimentError, SettingsError."""
    check_workers(flags.workers, flags.address, flags.patience)
    if not flags.resume:
        plan = flags.plan()
        return ComparisonFolder(experiment.new_folder(Path(flags.output), _stamped(flags)), plan), flags
    folder = experiment.open_comparison(Path(flags.resume))
    plan = folder.plan
    base = CompareFlags(
        scenarios=plan.scenarios, learners=plan.learners, seeds=plan.seeds, budget=str(plan.budget),
        observation=plan.observation, traffic=plan.traffic, reference=plan.reference, population=plan.population,
        generations=plan.generations, output=str(folder.path.parent), name=folder.path.name,
    )  # fmt: skip
    flags = parse(CompareFlags, PROG, arguments, base)
    asked = dataclasses.replace(flags, output=str(Path(flags.output).resolve()))
    if str(asked.plan().budget) == base.budget:
        asked = dataclasses.replace(asked, budget=base.budget)
    for f in dataclasses.fields(CompareFlags):
        now, then = getattr(asked, f.name), getattr(base, f.name)
        if f.name not in FREE and now != then and not (f.name == "seeds" and now > then):
            word = f.name.replace("_", "-")
            now, then = (" ".join(v) if isinstance(v, tuple) else v for v in (now, then))
            raise ExperimentError(
                f"--{word} {now} contradicts the comparison's {then}; leave it out, or start a new one"
            )
    folder.plan = asked.plan()
    return folder, flags


# ---------------------------------------------------------------------------------------------------------- training


def _experiment(console: Console, folder: ComparisonFolder, cells: list[Cell], flags: CompareFlags, uri: str) -> int:
    """Train what is not finished, and write what can be said of what is."""
    from cluster.comparison.cells import Cells
    from cluster.tracking.address import TrackingError

    left = [cell for cell in cells if not cell.finished()]
    status, code = "FAILED", FAILED
    failed = 0
    problem = ""
    tracker: Tracker | None = None
    results: Results | None = None
    try:
        folder.write()
        tracker = _tracker(folder, uri, flags.experiment)
        results = Results(folder.path, folder.plan)
        with Progress(console, folder.path, cells, left, folder.plan.budget) as shown:
            shown.note("reading what is finished" if len(left) < len(cells) else "starting")
            results.take(folder.runs())
            parent = ""
            if left:
                try:
                    parent = tracker.wait_ready(30.0)
                except TrackingError as error:
                    shown.line(f"{PROG}: warning: its runs are not nested in MLflow: {error}")
            execute = Cells(flags.workers, flags.address, uri, flags.experiment, parent, shown.note, flags.patience)

            def done(cell: Cell, error: CellError | None) -> None:
                if error:
                    shown.failed(cell, str(error))
                    return
                shown.note("measuring errors")
                run = results.take([read_run(cell.folder)])[0]
                results.write_tables()
                tracker.log_row(len(results.runs), {"runs_done": len(results.runs)})
                shown.done(cell, run)

            try:
                failed = experiment.train(cells, execute, done, shown.begin)
            finally:
                execute.close()
        status, code = "FINISHED", 0
    except KeyboardInterrupt:
        status, code = "KILLED", INTERRUPTED
    except Stopped:
        status, code = "KILLED", TERMINATED
    except (ExperimentError, CheckpointError, MemoryError, OSError) as error:
        problem = str(error) or type(error).__name__
    if results and results.runs and not problem:
        with console.status("writing tables and pictures"):
            results.write()
    lost = _close(tracker, results, status) if tracker else None
    if lost:
        print(f"{PROG}: warning: {lost}", file=sys.stderr)
    again = f"continue with: {called(PROG)} --resume {typed(folder.path)}"
    if problem:
        fail(PROG, problem, again, FAILED)
    if results and results.runs:
        results.show(console)
    if tracker:
        console.print(f"compare: {tracker.where()}", soft_wrap=True)
    if status == "KILLED":
        print(f"{PROG}: stopped; {again}", file=sys.stderr)
    elif failed:
        fail(PROG, f"{failed} of {len(cells)} runs failed", again, FAILED)
    return code


def _tracker(folder: ComparisonFolder, uri: str, name: str) -> Tracker:
    """MLflow's parent run."""
    from cluster.tracking.mlflow_run import Identity
    from cluster.tracking.tracker import Tracker

    params = {key: " ".join(v) if isinstance(v, list) else str(v) for key, v in folder.plan.to_dict().items()}
    tags = {"algorithm": "comparison"}
    return Tracker(Identity(uri, name, folder.path.name, params, tags, key=folder.tracking_key))


def _close(tracker: Tracker, results: Results | None, status: str) -> str | None:
    """Log medians and files, and end the parent run."""
    if results and results.runs:
        tracker.log_row(len(results.runs), results.medians())
        tracker.log_files(results.files())
    return tracker.close(status, timeout_s=60.0 if status == "FINISHED" else 15.0)  # type: ignore[arg-type]


class Results:
    """Finished runs with their errors, and the files that tell of them."""

    def __init__(self, path: Path, plan: Plan | None = None, reference: str = ""):
        self.path, self.plan = path, plan
        self.reference = plan.reference if plan else reference
        self.runs: list[Run] = []
        self._errors = Errors(path / ERRORS_KEPT, self.reference, errors_of)

    def take(self, runs: Sequence[Run]) -> list[Run]:
        """Add runs. Returns them with their errors."""
        found = [self._errors.of(run) for run in runs]
        self.runs += found
        return found

    @property
    def groups(self) -> list[tables.Group]:
        return tables.group(self.runs, self.plan)

    def write_tables(self) -> None:
        """Write table.md and table.csv."""
        groups = self.groups
        checkpoint.write_atomic(self.path / TABLE, tables.table_md(groups, self.plan), durable=False)
        checkpoint.write_atomic(self.path / ROWS, tables.table_csv(groups, self.path), durable=False)

    def write(self) -> None:
        """Write tables and pictures."""
        from cluster.report import pictures

        self.write_tables()
        pictures.comparison(self.groups, self.path / PICTURE)
        drives = {}
        for learner in ("evolution", "dqn"):
            runs = self._on_seamless(learner)
            found = [series[0] for run in runs if (series := series_of(run, self.reference, 1))]
            if found:
                drives[learner] = found
        if drives:
            compared = {group.learner for group in self.groups if group.scenario == "seamless"}
            missing = [name for learner, name in tables.NAMES.items() if learner in compared - set(drives)]
            pictures.along_route(drives, tables.NAMES, ROUTE_M, self.path / ROUTE, _route_title(drives, missing))

    def _on_seamless(self, learner: str) -> list[Run]:
        """The learner's runs there: the one whose velocity error is the median first."""
        for group in self.groups:
            if (group.scenario, group.learner) == ("seamless", learner):
                runs = sorted(group.runs, key=lambda run: _last_if_none(run.figures["velocity_error_percent"]))
                middle = (len(runs) - 1) // 2
                return [runs[middle], *runs[:middle], *runs[middle + 1 :]] if runs else []
        return []

    def files(self) -> list[Path]:
        """That were written."""
        names = (experiment.COMPARISON, TABLE, ROWS, PICTURE, ROUTE)
        return [self.path / name for name in names if (self.path / name).is_file()]

    def medians(self) -> dict[str, float]:
        """Metrics for MLflow."""
        found = {
            re.sub(r"[^/\w.\- :]", "", f"{figure}/{group.road}/{group.learner}"): group.median(figure)
            for group in self.groups
            for figure in ("success_rate", "distance_m", "speed_mps", "training_s", *ERROR_FIGURES)
        }
        return {name: value for name, value in found.items() if math.isfinite(value)}

    def show(self, console: Console) -> None:
        """Print the tables without their quartiles, and where the whole ones are."""
        console.print(tables.introduction(self.groups, self.plan).replace(", quartiles in brackets", ""))
        for head, *rows in (tables.driving(self.groups), tables.errors(self.groups)):
            table = Table(box=SIMPLE, padding=0, pad_edge=False, show_edge=False)
            for name in head:  # a word a line, so that it is narrow
                table.add_column(
                    name.replace(",", "").replace(" ", "\n"), overflow="fold", no_wrap=name in ("road", "learner")
                )
            for row in rows:
                table.add_row(*(cell.partition(" (")[0] for cell in row))
            console.print(table, "")
        console.print("\n".join(f"- {note}" for note in tables.notes(self.groups)), highlight=False)
        console.print(f"tables and pictures: {typed(self.path)}/", soft_wrap=True)


def _last_if_none(value: float) -> float:
    return value if math.isfinite(value) else math.inf


def _route_title(drives: dict, missing: Sequence[str]) -> str:
    title = "Errors along the seamless road, from the same start on a held-out map"
    if max(len(found) for found in drives.values()) > 1:
        title += "\nlines: the seed whose mean error is the median; bands: all seeds; crosses: crashed"
    return title + (f"\nnot drawn: {', '.join(missing)}" if missing else "")


# ------------------------------------------------------------------------------------------------ runs that are there


def _existing(console: Console, flags: CompareFlags) -> int:
    """Compare runs that are there. Raises ExperimentError, CheckpointError."""
    plain = CompareFlags()
    for f in dataclasses.fields(CompareFlags):
        if f.name not in KEPT and getattr(flags, f.name) != getattr(plain, f.name):
            word = f.name.replace("_", "-")
            raise ExperimentError(f"--{word}: runs that are there are compared as they are; leave it out")
    if flags.reference:
        from gridsim.view.drive import DriveError, read_drive

        try:
            read_drive(flags.reference)
        except DriveError as error:
            raise ExperimentError(f"--reference {error}") from error
    runs = experiment.read_runs([Path(name) for name in flags.runs])
    path = experiment.new_folder(Path(flags.output), _stamped(flags))
    path.mkdir(parents=True)
    try:
        results = Results(path, reference=flags.reference)
        with console.status("measuring errors") as shown:
            for k, run in enumerate(runs):
                shown.update(f"measuring errors, {k + 1} of {len(runs)}: {run.folder.name}")
                results.take([run])
            shown.update("writing tables and pictures")
            results.write()
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)  # it was made just now
        raise
    results.show(console)
    return 0


# ---------------------------------------------------------------------------------------------------------- progress


class Progress:
    """Shows which run is trained, what it says, and ETA: a line on a terminal, plain lines elsewhere."""

    def __init__(self, console: Console, path: Path, cells: Sequence[Cell], left: Sequence[Cell], budget: Budget):
        self._console, self._budget = console, budget
        self._total, self._left = len(cells), len(left)
        self._ends: list[float] = []
        self._started = time.perf_counter()
        self._name = ""
        self._bar = Live(Line(), console=console, disable=not console.is_terminal, transient=True)
        self._task = self._bar.add_task("compare", total=None, head="", facts="", rest="")
        there = f", {self._total - self._left} of them finished" if self._left < self._total else ""
        console.print(f"comparing {self._total} runs{there} -> {typed(path)}", soft_wrap=True)

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, cell: Cell) -> None:
        """A run begins, or goes on."""
        self._name = cell.name
        self.note("starting")

    def note(self, text: str, more: str = "") -> None:
        """What it says, and more where there is room."""
        head = f"run {self._total - self._left}/{self._total}"
        self._bar.update(self._task, head=head, facts=f"ETA {self._eta()}  {text}", rest=f"{self._name}  {more}")

    def done(self, cell: Cell, run: Run) -> None:
        """It is trained and measured."""
        error = run.figures["velocity_error_percent"]
        self._next()
        self.line(
            f"run {self._total - self._left}/{self._total}  {cell.name}: success {run.figures['success_rate']:.0%}, "
            f"{run.figures['distance_m']:,.0f} m, "
            + (f"velocity error {error:.1f} %, " if math.isfinite(error) else "")
            + f"{run.figures['training_s']:.0f} s"
            + (f"  ETA {self._eta()}" if self._left else "")
        )

    def failed(self, cell: Cell, reason: str) -> None:
        """It could not be trained."""
        self._next()
        print(f"{PROG}: {cell.name} failed: {reason}", file=sys.stderr, flush=True)

    def line(self, text: str) -> None:
        """A line that stays."""
        self._console.print(text, soft_wrap=True, highlight=False)

    def _next(self) -> None:
        self._left -= 1
        self._ends.append(time.perf_counter())

    def _eta(self) -> str:
        """From the runs so far; before there are any, from a budget of wall time."""
        if self._ends:
            seconds = (self._ends[-1] - self._started) / len(self._ends) * self._left
        elif self._budget.wall_s:
            seconds = self._budget.wall_s * self._left
        else:
            return "-:--"
        begun = self._ends[-1] if self._ends else self._started
        return clock(max(seconds - (time.perf_counter() - begun), 0.0))
