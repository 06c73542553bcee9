"""The commands: parse, build, run. Wrong use ends with one clear line and 2, Ctrl-C with a clean save and 130."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import tyro
from rich.console import Console

from cluster.commands.common import (
    FAILED,
    INTERRUPTED,
    TERMINATED,
    RoadFlags,
    Stopped,
    UsageError,
    WorkFlags,
    called,
    check_unchanged,
    fail,
    main,
    parse,
    stoppable,
    typed,
    warn_of_crowd,
    wrong_use,
)
from cluster.runs.checkpoint import CheckpointError
from cluster.runs.settings import DqnSettings, EvolveSettings, RunSettings, check_workers
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import default_traffic, is_map_file, label

if TYPE_CHECKING:
    from cluster.runs.run import RunFolder
    from cluster.runs.train import Session


@dataclass(frozen=True)
class RunFlags(WorkFlags):
    """Which run it is, and where it is computed, kept and logged."""

    name: str = ""
    """Name of the run; by default made of scenario, algorithm, seed and time."""
    resume: str = ""
    """Folder of a run to continue, exactly where its checkpoint stands."""
    config: str = ""
    """A run's config.json: repeat that run; flags beside it change it."""
    init: str = ""
    """A champion.npz, or a run's folder, to start from in place of random networks."""


@dataclass(frozen=True)
class EvolveFlags(RunFlags, EvolveSettings):
    """Evolve a driver: a population of neural networks is evaluated in parallel and recombined.

    The run's folder holds the champion, history, pictures and a checkpoint after every generation; MLflow holds its
    curves. The champion depends on the scenario, the seed and the algorithm's parameters alone, never on the workers.
    """

    #: Flags that version 0.1 had, and what takes their place.
    removed: ClassVar[dict[str, str]] = {
        "--islands": "a run has one population; use --recombination all, the default, which needs no others",
        "--island-car-steps": "a run has one population; use --car-steps for its budget",
        "--parents": "the mating pool of --recombination two has a fixed size; use --tournament for selection pressure",
        "--crossover": "all children of --recombination two have two parents; use --recombination",
        "--bump-rate": "mutation is Gaussian; use --sigma for its size",
        "--ranking": "members are ranked by their fitness alone; from Python, give a fitness of your own",
    }


@dataclass(frozen=True)
class DqnFlags(RunFlags, DqnSettings):
    """Train a driver by deep Q-learning: the workers collect experience while the learner trains on what they brought.

    The run's folder holds the champion, history, pictures and a checkpoint after every evaluation; MLflow holds its
    curves, on the same axes as those of gridsim-evolve. The champion is the network that did best on validation. It
    depends on the scenario, the seed and the algorithm's parameters alone, never on the workers.
    """

    #: Flags that version 0.2 had, and why they went.
    removed: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("--prioritised", "--no-prioritised"), "transitions are drawn uniformly, which does as well"),
        **dict.fromkeys(("--double", "--no-double"), "the DQN is always a double DQN"),
        "--n-step": "targets have one step of rewards; more gained nothing",
    }


Flags = EvolveFlags | DqnFlags


@dataclass(frozen=True)
class EvaluateFlags(RoadFlags):
    """Drive a champion through episodes on maps it never saw, and say how good it is."""

    champion: tyro.conf.Positional[str]
    """A champion.npz, or a run's folder."""
    episodes: int = 64
    """How many; the default 64 are the held-out episodes of every run."""
    errors: bool = False
    """Also its velocity and steering errors against the reference driver."""
    reference: str = ""
    """A drive.csv of gridsim-drive: errors against that drive, on its map and in its traffic, in place of --errors."""
    json: bool = False
    """Print one JSON object and nothing else."""


def process_age_s() -> float:
    """Seconds since this process was started (0 where the system does not tell)."""
    try:
        ticks = Path("/proc/self/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[19]
        return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - float(ticks) / os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError, AttributeError):
        return 0.0


def evolve_main() -> None:
    """Entry point of `gridsim-evolve`."""
    _learn_main(EvolveFlags)


def dqn_main() -> None:
    """Entry point of `gridsim-dqn`."""
    _learn_main(DqnFlags)


def _learn_main(kind: type[Flags]) -> None:
    started = time.perf_counter() - process_age_s()
    main(kind.command, lambda: _learn(kind, sys.argv[1:], started))


def _prepare(kind: type[Flags], arguments: Sequence[str]) -> tuple[Flags, RunFolder]:
    """Flags and the run's folder, checked; nothing is written yet. Raises GridSimError."""
    from cluster.runs import run as runs
    from cluster.runs.champion import load_champion
    from evolution.networks.policy import PolicySpec

    prog = kind.command
    base: Flags | None = None
    flags = parse(kind, prog, arguments)
    resume, config = flags.resume, flags.config
    if resume and config:
        raise UsageError("--resume and --config exclude each other: --resume continues a run, --config repeats it")
    if resume:
        run = runs.open_run(Path(resume))
        settings, init = run.settings, run.init
    elif config:
        settings, init = runs.read_config(Path(config))
    if resume or config:  # they are the defaults
        if settings.command != prog:
            raise UsageError(f"{resume or config} is a run of {settings.command}; give it to that command")
        base = kind(**dataclasses.asdict(settings), init=init)
        if resume:
            base = dataclasses.replace(base, resume=resume, output=str(run.path.parent), name=run.name)
        flags = parse(kind, prog, arguments, base)
    if flags.traffic and is_map_file(flags.scenario):
        print(f"{prog}: {flags.scenario} has no lanes for traffic; running without", file=sys.stderr)
        return _prepare(kind, [*arguments, "--traffic", "0"])
    check_workers(flags.workers, flags.address, flags.patience)
    if base and resume:
        flags = flags.extending(base)
        free = {f.name for f in dataclasses.fields(WorkFlags)} - {"output"}
        check_unchanged(flags, base, free, kind.unbound, "run")
    settings = settings_of(flags)
    settings.check()
    _check_device(flags)
    if resume:
        run.settings = settings
        return flags, run
    digest = ""
    if flags.init:
        champion = load_champion(flags.init)
        if PolicySpec.parse(champion.policy) != PolicySpec.parse(settings.policy):
            raise UsageError(f"--init {flags.init} is a {champion.policy}; use --policy {champion.policy}")
        if not np.isfinite(champion.genome).all():
            raise UsageError(f"--init {flags.init}: some of its genes are no numbers; choose another champion")
        digest = champion.sha256
    return flags, runs.new_run(Path(flags.output), flags.name, settings, flags.init, digest)


def _check_device(flags: Flags) -> None:
    """Raises UsageError for a device that is not there."""
    if isinstance(flags, DqnFlags) and flags.device == "cuda":
        from evolution.dqn.learner import device_of

        try:
            device_of(flags.device)
        except ValueError as error:
            there = f"{flags.resume} was trained with --device cuda, and PyTorch finds none; continue it where one is"
            raise UsageError(there if flags.resume else f"--device {flags.device}: {error}") from error


def settings_of(flags: Flags) -> RunSettings:
    """What decides the champion."""
    kind = EvolveSettings if isinstance(flags, EvolveFlags) else DqnSettings
    return kind(**{f.name: getattr(flags, f.name) for f in dataclasses.fields(kind)})


def _learn(kind: type[Flags], arguments: Sequence[str], started: float) -> int:
    prog = kind.command
    console = Console()
    flags, run = _prepare(kind, arguments)
    from cluster.commands.progress import Progress
    from cluster.runs.champion import load_champion
    from cluster.runs.run import is_finished
    from cluster.runs.train import Workers, send_missing, train, undisturbed
    from cluster.tracking.address import check_uri
    from cluster.workers.ray_session import check_address

    if is_finished(run):
        first = kind.counts[0]
        sent, lost = send_missing(run, flags.tracking_uri, flags.experiment)
        sent = f"sent to MLflow: {sent}" if sent else "nothing to do"
        console.print(f"{run.path} is finished: {run.saved[1][first]} {first}s; {sent}.", soft_wrap=True)  # type: ignore[index]
        if lost:
            print(f"{prog}: warning: {lost}", file=sys.stderr)
        return 0
    saved = run.saved[1]["tracking"]["uri"] if run.saved else ""
    uri = check_uri(flags.tracking_uri or saved or None)
    address = flags.address or os.environ.get("RAY_ADDRESS") or None
    if address and flags.workers:
        address = check_address(address)

    warn_of_crowd(prog, flags.workers, flags.address)
    made = _make_folder(run)
    workers = Workers(flags.workers, address, flags.patience)
    resume = f"{called(prog)} --resume {typed(run.path)}"
    again = f"continue with: {resume}"
    code, message = 0, ""
    try:
        with stoppable():
            initial = load_champion(flags.init).genome if flags.init and run.saved is None else None
            progress = Progress(console, prog, typed(run.path), resume)
            session = train(run, workers, uri, flags.experiment, progress, started, initial=initial)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except Stopped:
        code = TERMINATED
    except (GridSimError, FloatingPointError, MemoryError, OSError) as error:
        code, message = FAILED, str(error) or type(error).__name__
        if isinstance(error, FloatingPointError):  # to go on would be to come to the same
            again = f"repeat it with: {called(prog)} --config {typed(run.path)}/config.json --learning-rate ..."
    finally:
        with undisturbed():
            workers.close()
    if code == 0:
        _show_end(console, session)
        return code
    resumable = (run.path / "checkpoint.npz").is_file()
    if not resumable:
        _discard(made)
    if code == FAILED:
        fail(prog, message, again if resumable else "", FAILED)
    print(f"{prog}: stopped; {again if resumable else f'no {kind.counts[0]} was done yet'}", file=sys.stderr)
    return code


def _show_end(console: Console, session: Session) -> None:
    """The closing words of a finished run."""
    from cluster.report import pictures
    from cluster.tracking.tracker import count

    summary, name, path = session.summary, session.learning.step_name, session.run.path
    console.print(pictures.held_out_table("The champion on held-out drives", summary["held_out"]))
    steps, how = count(summary[name + "s"], name), "solved" if summary["solved"] else "the best so far"
    console.print(
        f"{how} ({summary['validation_success_rate']:.0%} of validation) "
        f"after {steps}, {summary['car_steps'] / 1e6:,.1f} million car-steps, {summary['wall_s']:.0f} s\n"
        f"run: {typed(path)}   champion: {typed(path / 'champion.npz')}\n"
        f"watch it: {called('gridsim-watch')} {typed(path)}\n"
        f"compare: {session.tracker.where()}",
        soft_wrap=True,
    )


def _make_folder(run: RunFolder) -> list[Path]:
    """Make a run's folder and lock it. Returns the folders that were made for it, the innermost first."""
    from cluster.runs.run import lock

    made = [path for path in (run.path, *run.path.parents) if not path.exists()]
    lock(run.path)
    return made


def _discard(made: list[Path]) -> None:
    """Remove the folders of a run in which nothing was done."""
    with contextlib.suppress(OSError):
        for path in made:
            if path == made[0]:
                (path / "config.json").unlink(missing_ok=True)
            path.rmdir()


def evaluate_main() -> None:
    """Entry point of `gridsim-evaluate`."""
    main("gridsim-evaluate", _evaluate, {CheckpointError: "give a run's folder or a champion.npz"})


def _evaluate() -> int:
    flags = parse(EvaluateFlags, "gridsim-evaluate", sys.argv[1:])
    from cluster.comparison.errors import series
    from cluster.report.pictures import errors_table, held_out_table
    from cluster.runs.champion import evaluate, load_champion
    from gridsim.reference.errors import combine

    champion = load_champion(flags.champion)
    traffic = None if flags.traffic == -1 else flags.traffic
    chosen = (flags.scenario or None, flags.episodes, flags.seed, traffic)
    missed = None
    with wrong_use():
        if flags.errors or flags.reference:  # first, as a wrong --reference is found at once
            parts = series(champion, *chosen, flags.reference or None)
            missed = combine([part.errors(champion.sim.vehicle) for part in parts]).figures()
        figures = evaluate(champion, *chosen)
    if flags.json:
        print(json.dumps(figures if missed is None else {**figures, "errors": missed}))
        return 0
    road, cars = flags.scenario or champion.scenario, flags.traffic
    if cars == -1:
        cars = champion.traffic if road == champion.scenario else default_traffic(road)
    title = f"{flags.champion} on {label(road)}" + (f", {cars} cars" if cars else "")
    title += "" if is_map_file(road) else f", maps from seed {flags.seed:,}"
    Console().print(held_out_table(title, figures))
    if missed is not None:
        Console().print(errors_table(f"Errors against {flags.reference or 'the reference driver'}", missed))
    return 0
