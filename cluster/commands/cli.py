"""The commands: parse, build, run. Wrong use exits with one clear line and 2, Ctrl-C saves and exits with 130."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro
from rich.console import Console

from cluster import stopping
from cluster.commands.common import (
    FAILED,
    RoadFlags,
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
from cluster.commands.entry import STARTED
from cluster.commands.progress import RunDisplay
from cluster.commands.tables import errors_table, held_out_table
from cluster.compare.results import series
from cluster.run import Place, Session, train
from cluster.settings import IN_WORDS, DqnSettings, EvolveSettings, check_workers
from cluster.stopping import INTERRUPTED
from cluster.store.champion import evaluate, load_champion
from cluster.store.checkpoint import CHECKPOINT, CONFIG, STEPS, SUMMARY, CheckpointError
from cluster.store.folder import RunFolder, is_finished, lock, new_run, open_run, read_config, write_summary
from cluster.text import as_argument, count
from cluster.tracking.address import check_uri
from cluster.tracking.description import read_run
from cluster.tracking.tracking import saved_run_id, saved_uri, sync
from cluster.workers.address import cluster_address
from evolution.networks.policy import PolicySpec
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import is_map_file, label
from gridsim.reference import errors


@dataclass(frozen=True)
class RunFlags:
    """The run's name, and what it starts from."""

    name: Annotated[str, IN_WORDS] = ""
    """Name of the run; by default made from scenario, algorithm, seed and time."""
    resume: Annotated[str, IN_WORDS] = ""
    """Folder of a run to continue exactly from its checkpoint."""
    resume_if_exists: bool = False
    """Start the run of that --name, or continue it if it was begun: for clusters that start a job again."""
    config: Annotated[str, IN_WORDS] = ""
    """A run's config.json: repeat that run; other flags override it."""
    init: Annotated[str, IN_WORDS] = ""
    """A champion.npz, or a run's folder, to start from in place of random networks."""
    wall_time: Annotated[float, IN_WORDS] = 0.0
    """Seconds of learning at most, by default any number. What is learned in them depends on the machine's speed."""


@dataclass(frozen=True)
class EvolveFlags(RunFlags, WorkFlags, EvolveSettings):
    """Evolve a driver: a population of neural networks is evaluated in parallel and recombined.

    The run's folder holds the champion, history, pictures and a checkpoint after every generation; MLflow holds its
    curves. The champion depends on the scenario, the seed and the algorithm's parameters alone, never on the workers.
    """

    groups: ClassVar[dict[str, type]] = {"learning": EvolveSettings, "work": WorkFlags, "run": RunFlags}
    example: ClassVar[str] = "gridsim-evolve --scenario city --traffic 6 --seed 1"
    #: Flags of version 0.1, and what replaces them.
    removed: ClassVar[dict[str, str]] = {
        "--islands": "a run has one population; use --recombination all, the default, which needs no islands",
        "--island-car-steps": "a run has one population; use --car-steps for its budget",
        "--parents": "the mating pool of --recombination two has a fixed size; use --tournament for selection pressure",
        "--crossover": "all children of --recombination two have two parents; use --recombination",
        "--bump-rate": "mutation is Gaussian; use --sigma for its size",
        "--ranking": "members are ranked by their fitness alone; from Python, give a fitness of your own",
    }


@dataclass(frozen=True)
class DqnFlags(RunFlags, WorkFlags, DqnSettings):
    """Train a driver by deep Q-learning: workers collect experience while the learner trains on what they collected.

    The run's folder holds the champion, history, pictures and a checkpoint after every evaluation; MLflow holds its
    curves, on the same axes as those of gridsim-evolve. The champion is the network that did best on validation. It
    depends on the scenario, the seed and the algorithm's parameters alone, never on the workers.
    """

    groups: ClassVar[dict[str, type]] = {"learning": DqnSettings, "work": WorkFlags, "run": RunFlags}
    example: ClassVar[str] = "gridsim-dqn --scenario curved --seed 1"
    #: Flags of version 0.2, and why they were removed.
    removed: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("--prioritised", "--no-prioritised"), "transitions are drawn uniformly, which does as well"),
        **dict.fromkeys(("--double", "--no-double"), "the DQN is always a double DQN"),
        "--n-step": "targets have one step of rewards; more gained nothing",
    }


Flags = EvolveFlags | DqnFlags


@dataclass(frozen=True)
class EvaluateFlags(RoadFlags):
    """Drive a champion through episodes on maps it never saw, and report how well it drives."""

    champion: tyro.conf.Positional[str]
    """A champion.npz, or a run's folder."""
    episodes: int = 64
    """Number of episodes; the default 64 are the held-out episodes of every run."""
    errors: bool = False
    """Also its velocity and steering errors against the reference driver."""
    json: bool = False
    """Print one JSON object and nothing else."""

    example: ClassVar[str] = "gridsim-evaluate runs/NAME --scenario city --episodes 500"
    removed: ClassVar[dict[str, str]] = {"--reference": "errors are those against the reference driver; use --errors"}


def _prepare(kind: type[Flags], arguments: Sequence[str]) -> tuple[Flags, RunFolder]:
    """Flags and the run's folder, checked; nothing is written yet. Raises GridSimError."""
    prog = kind.command
    flags = parse(kind, prog, arguments)
    resume = _folder_to_resume(flags)
    base: Flags | None = None
    if resume or flags.config:  # the settings of that run are the defaults
        if resume:
            run = open_run(Path(resume))
            settings, init = run.settings, run.init
        else:
            settings, init = read_config(Path(flags.config))
        if settings.command != prog:
            flag, path = ("--resume", resume) if resume else ("--config", flags.config)
            again = f"{settings.command} {flag} {as_argument(Path(path))}"
            raise GridSimError(f"{path} belongs to another learner; use {again}")
        base = kind(**dataclasses.asdict(settings), init=init)
        if resume:
            base = dataclasses.replace(base, resume=flags.resume, output=str(run.path.parent), name=run.name)
        flags = parse(kind, prog, arguments, base)
    if flags.traffic and is_map_file(flags.scenario):
        print(f"{prog}: {flags.scenario} has no lanes for traffic; running without", file=sys.stderr)
        return _prepare(kind, [*arguments, "--traffic", "0"])
    check_workers(flags.workers, flags.patience)
    if not 0.0 <= flags.wall_time < math.inf:
        raise GridSimError(f"--wall-time must be 0 or more, not {flags.wall_time:g}")
    if base and resume:
        flags = flags.extending(base)
        free = {f.name for f in dataclasses.fields(WorkFlags)} - {"output"} | {"resume_if_exists", "wall_time"}
        check_unchanged(flags, base, free, kind.extendable, "run")
    settings = select(EvolveSettings if isinstance(flags, EvolveFlags) else DqnSettings, flags)
    settings.check()
    if isinstance(flags, DqnFlags) and flags.device == "cuda":
        _check_cuda(resume)
    if resume:
        run.settings = settings
        return flags, run
    digest = ""
    if flags.init:
        champion = load_champion(flags.init)
        if PolicySpec.parse(champion.policy) != PolicySpec.parse(settings.policy):
            raise GridSimError(f"--init {flags.init} is a {champion.policy}; use --policy {champion.policy}")
        if not np.isfinite(champion.genome).all():
            raise GridSimError(f"--init {flags.init}: some of its genes are not numbers; choose another champion")
        digest = champion.sha256
    output = Path(flags.output)
    return flags, new_run(output, flags.name, settings, flags.init, digest, may_exist=flags.resume_if_exists)


def _folder_to_resume(flags: Flags) -> str:
    """The folder of the run that these flags continue, or "" for a new run. Raises GridSimError."""
    if not flags.resume_if_exists:
        if flags.resume and flags.config:
            text = "--resume and --config exclude each other: --resume continues a run, --config repeats it"
            raise GridSimError(text)
        return flags.resume
    if flags.resume or not flags.name:
        raise GridSimError("--resume-if-exists starts or continues the run of a --name; give that, and no --resume")
    path = Path(flags.output, flags.name)
    return str(path) if (path / CHECKPOINT).is_file() else ""


def _check_cuda(resume: str) -> None:
    """Raises GridSimError if there is no GPU."""
    from evolution.dqn.learner import device_of  # imports PyTorch

    try:
        device_of("cuda")
    except ValueError as error:
        there = f"{resume} was trained with --device cuda, and PyTorch finds no GPU; continue it where there is one"
        raise GridSimError(there if resume else f"--device cuda: {error}") from error


def _learn(kind: type[Flags]) -> int:
    prog, step = kind.command, kind.step_name
    console = new_console()
    flags, run = _prepare(kind, sys.argv[1:])
    settings, folder = run.settings, short_path(run.path)
    if run.saved and is_finished(run):
        return _send_missing(console, run, flags)
    place = Place(
        flags.workers,
        cluster_address(flags.address),
        flags.patience,
        check_uri(flags.tracking_uri, saved_uri(run.path)),
        flags.experiment,
        flags.wall_time or math.inf,
    )
    warn_of_many_workers(prog, place.workers, place.address)
    new_folders = [path for path in (run.path, *run.path.parents) if not path.exists()]
    lock(run.path)
    if run.saved is None and (run.path / CHECKPOINT).exists():
        raise GridSimError(f"{folder}: another process has just begun this run; start the command again to continue it")
    stopping.listen()
    resume = f"{command_path(prog)} --resume {folder}"
    hint = f"continue with: {resume}"
    verb = "continuing" if run.saved else kind.verb
    console.print(f"{verb} {settings.policy} on {settings.scenario}, seed {settings.seed} -> {folder}", soft_wrap=True)
    code, message = 0, ""
    try:
        initial = load_champion(flags.init).genome if flags.init and run.saved is None else None
        with RunDisplay(console, settings) as shown:
            session = train(run, place, shown.event, shown.row, initial=initial, started=STARTED)
    except (KeyboardInterrupt, SystemExit):  # the latter by rich, if what reads the output has ended
        code = INTERRUPTED
    except (GridSimError, FloatingPointError, MemoryError, OSError) as error:
        code, message = FAILED, str(error) or type(error).__name__
        if isinstance(error, FloatingPointError):  # if resumed, it would fail again
            hint = f"repeat it with: {command_path(prog)} --config {short_path(run.path / CONFIG)} --learning-rate ..."
    if code == 0:
        _print_end(console, session, resume)
        return code
    resumable = (run.path / CHECKPOINT).is_file()
    if not resumable:
        with contextlib.suppress(OSError):
            for name in (CONFIG, STEPS):
                (run.path / name).unlink(missing_ok=True)
            for path in new_folders:
                path.rmdir()
    if code == FAILED:
        fail(prog, message, hint if resumable else "", FAILED)
    print(f"{prog}: stopped; {hint if resumable else f'no {step} was done yet'}", file=sys.stderr)
    return code


def _send_missing(console: Console, run: RunFolder, flags: Flags) -> int:
    """Send to MLflow what it lacks of a finished run, and say how to go on."""
    settings, saved = run.settings, run.saved
    assert saved is not None
    meta = saved[1]
    sent, unsent = sync(run.path, flags.tracking_uri, flags.experiment, read_run)
    if sent:  # perhaps MLflow was away as the run ended
        summary = json.loads((run.path / SUMMARY).read_bytes())
        write_summary(run.path, summary | {"mlflow_run_id": saved_run_id(run.path)})
    sent = f"sent to MLflow: {sent}" if sent else "nothing to do"
    limits = [as_flag(name) for name in settings.extendable if getattr(settings, name)]
    more = f" To go on beyond its end, resume it with a greater {' or '.join(limits)}." if limits else ""
    if meta["solved"]:
        more = f" It is solved; to go on from its champion, start a run with --init {short_path(run.path)}."
    steps = count(meta[settings.step_name], settings.step_name)
    console.print(f"{short_path(run.path)} is finished: {steps}; {sent}.{more}", soft_wrap=True)
    if unsent:
        print(f"{settings.command}: warning: {unsent}", file=sys.stderr)
    return 0


def _print_end(console: Console, session: Session, resume: str) -> None:
    """Print how a finished run did, and where to look next."""
    summary, name, path = session.summary, session.run.settings.step_name, session.run.path
    settings = session.run.settings
    where = "this map, from many starts" if is_map_file(settings.scenario) else "held-out drives"
    console.print(held_out_table(f"The champion on {where}", summary["held_out"]))
    steps, solved = count(summary[name + "s"], name), summary["solved"]
    reached = [each for each in settings.extendable if 0 < getattr(settings, each) <= summary[each]]
    longer = " ".join(f"{as_flag(each)} {2 * summary[each]}" for each in reached)
    more = "" if solved or not longer else f"\nto go on: {resume} {longer}"
    console.print(
        f"{'solved' if solved else 'not solved yet'} after {steps}, {summary['car_steps']:,} car-steps, "
        f"{summary['wall_s']:.0f} s{more}\n"
        f"success in validation{', on which the champion was chosen' if solved else ' at the end'}: "
        f"{summary['validation_success_rate']:.1%} "
        "(in MLflow validation/success_rate; the table's is held_out/success_rate)\n"
        f"run: {short_path(path)}   champion: {short_path(path / 'champion.npz')}\n"
        f"watch it: open {short_path(path / 'drive.html')} in a browser, or "
        f"{command_path('gridsim-watch')} {short_path(path)}\n"
        f"compare: {session.tracking.where(command_path('mlflow'))}",
        soft_wrap=True,
    )


def _evaluate() -> int:
    flags = parse(EvaluateFlags, "gridsim-evaluate", sys.argv[1:])
    champion = load_champion(flags.champion)
    road = flags.scenario or champion.scenario
    traffic = champion.traffic_on(road) if flags.traffic == -1 else flags.traffic
    chosen = (road, flags.episodes, flags.seed, traffic)
    figures = evaluate(champion, *chosen)
    missed = errors(series(champion, *chosen), champion.sim.vehicle) if flags.errors else None
    if flags.json:
        print(json.dumps(figures if missed is None else {**figures, "errors": missed}))
        return 0
    title = f"{flags.champion} on {label(road)}" + (f", {traffic} cars" if traffic else "")
    title += "" if is_map_file(road) else f", maps from seed {flags.seed:,}"
    new_console().print(held_out_table(title, figures))
    if missed is not None:
        new_console().print(errors_table("Errors against the reference driver", missed))
    return 0


evolve_main = partial(main, EvolveFlags.command, partial(_learn, EvolveFlags))
dqn_main = partial(main, DqnFlags.command, partial(_learn, DqnFlags))
evaluate_main = partial(main, "gridsim-evaluate", _evaluate, {CheckpointError: "give a run's folder or a champion.npz"})
