"""gridsim-evolve, gridsim-dqn and gridsim-evaluate.

Wrong use exits with one clear line and code 2. Ctrl-C saves what a run has learned, and exits with code 130.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from cluster import fitness, stopping
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
    short_path,
    warn_of_many_workers,
)
from cluster.commands.entry import STARTED
from cluster.commands.progress import RunDisplay
from cluster.commands.tables import driving_table, errors_table, stress_table
from cluster.compare.results import series
from cluster.report import stress, suite
from cluster.run import Place, Session, send, train
from cluster.settings import IN_WORDS, DqnSettings, EvolveSettings, RunSettings, check_workers
from cluster.stopping import INTERRUPTED
from cluster.store.champion import Champion, drives, load_champion
from cluster.store.checkpoint import CHAMPION, CHECKPOINT, CONFIG, CheckpointError, write_json
from cluster.store.folder import PAGE, RunFolder, is_finished, lock, new_run, open_run, read_config
from cluster.text import as_argument, count
from cluster.tracking.address import check_uri
from cluster.tracking.tracking import saved_uri
from cluster.workers.address import cluster_address
from evolution.episodes.figures import summarise
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.parts import is_map_file
from gridsim.maps.scenarios import REGISTRY, Traffic, has_lanes, label
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
class EvolveFlags:
    """Evolve a driver: a population of neural networks is evaluated in parallel and recombined.

    The run's folder holds the champion, history, pictures and a checkpoint, which is renewed every second, or after a
    generation that takes longer; MLflow holds its curves. Except with --wall-time, the same flags give the same
    champion on one type of machine, whatever the workers do.
    """

    example: ClassVar[str] = "gridsim-evolve --scenario city --traffic 6 --seed 1"
    learning: EvolveSettings
    work: WorkFlags
    run: RunFlags


@dataclass(frozen=True)
class DqnFlags:
    """Train a driver by deep Q-learning: workers collect experience while the learner trains on what they collected.

    The run's folder holds the champion, history, pictures and a checkpoint after every evaluation; MLflow holds its
    curves, on the same axes as those of gridsim-evolve. The champion is the network that did best on validation. Except
    with --wall-time, the same flags give the same champion on one type of machine, whatever the workers do.
    """

    example: ClassVar[str] = "gridsim-dqn --scenario curved --seed 1"
    learning: DqnSettings
    work: WorkFlags
    run: RunFlags


Flags = EvolveFlags | DqnFlags
FLAGS: dict[str, Any] = {EvolveSettings.command: EvolveFlags, DqnSettings.command: DqnFlags}
# Flags, apart from settings, that may differ when a run is resumed: where it is computed and logged, how it is found,
# and its time limit.
MAY_DIFFER = {f.name for f in dataclasses.fields(WorkFlags)} - {"output"}
MAY_DIFFER |= {"resume", "resume_if_exists", "config", "wall_time"}


@dataclass(frozen=True)
class EvaluateFlags(RoadFlags):
    """Drive a champion through episodes on maps it never saw, and report how well it drives."""

    champion: tyro.conf.Positional[str]
    """A champion.npz, or a run's folder."""
    episodes: int = 64
    """Number of episodes on each road; the default 64 are the held-out episodes of every run."""
    errors: bool = False
    """Also its velocity and steering errors against the reference driver."""
    stress: bool = False
    """Also drive it with more and more noise, dropped readings, latency and ever less grip: a table, and stress.png
    beside the champion."""
    suite: bool = False
    """Drive the suite: all five roads with usual traffic, 512 drives each, the same for everybody. Compares the result
    with suite.json beside the champion, and writes that anew (docs/results.md)."""
    json: bool = False
    """Print one JSON object and nothing else."""

    example: ClassVar[str] = "gridsim-evaluate runs/NAME --scenario city --episodes 500"


def _prepare(prog: str, arguments: Sequence[str]) -> tuple[Flags, RunFolder]:
    """Flags and the run's folder, checked; nothing is written yet. Raises GridSimError."""
    kind = FLAGS[prog]
    flags, run, base = parse(kind, prog, arguments), None, None
    resume = _folder_to_resume(flags)
    if source := resume or flags.run.config:  # the settings of that run are the defaults
        if resume:
            run = open_run(Path(resume))
            settings, start = run.settings, RunFlags(name=run.name, init=run.init)
        else:
            settings, init = read_config(Path(source))
            start = RunFlags(init=init)
        if settings.command != prog:
            again = f"{settings.command} {'--resume' if resume else '--config'} {as_argument(Path(source))}"
            raise GridSimError(f"{source} belongs to another learner; use {again}")
        if _fitness(settings) and not _fitness(flags.learning):
            again = f"give --fitness {_fitness(settings)} again"
            raise GridSimError(f"{source} has a fitness of its own, whose code runs only if you name it; {again}")
        base = kind(settings, WorkFlags(output=str(run.path.parent)) if run else WorkFlags(), start)
        flags = parse(kind, prog, arguments, base)
    settings = flags.learning
    if settings.traffic and len(settings.crowds) == 1 and not has_lanes(settings.scenario):
        print(f"{prog}: {settings.scenario} has no lanes for traffic; running without", file=sys.stderr)
        return _prepare(prog, [*arguments, "--traffic", "0"])
    check_workers(flags.work.workers, flags.work.patience)
    if not 0.0 <= flags.run.wall_time < math.inf:
        raise GridSimError(f"--wall-time must be 0 or more, not {flags.run.wall_time:g}")
    if run and base:
        settings = settings.extending(run.settings)
        check_unchanged(settings, run.settings, (), settings.extendable, "run")
        check_unchanged(flags.work, base.work, MAY_DIFFER, (), "run")
        check_unchanged(flags.run, base.run, MAY_DIFFER, (), "run")
    settings.check()
    if _fitness(settings):
        fitness.load(_fitness(settings))  # raises GridSimError
    if isinstance(settings, DqnSettings) and settings.device == "cuda":
        from evolution.dqn.learner import device_of  # imports PyTorch

        device_of("cuda")  # raises GridSimError if there is none
    if run:
        run.settings = settings
        return flags, run
    digest = ""
    if init := flags.run.init:
        champion = load_champion(init)
        ours, theirs = PolicySpec.parse(settings.policy), PolicySpec.parse(champion.policy)
        if ours.actions != theirs.actions:
            raise GridSimError(f"--init {init} has {theirs.actions} actions, this run {ours.actions} ones")
        if ours != theirs:
            raise GridSimError(f"--init {init} is a {champion.policy}; use --policy {champion.policy}")
        digest = champion.sha256
        if base and init == base.run.init and digest != json.loads(Path(source).read_bytes()).get("init_sha256"):
            raise GridSimError(f"--init {init} is not what it was for {source}; put it back, or start a new run")
    place = Path(flags.work.output), flags.run.name
    init = os.path.abspath(init) if init else ""  # config.json may be read from another folder
    return flags, new_run(*place, settings, init, digest, may_exist=flags.run.resume_if_exists)


def _fitness(settings: RunSettings) -> str:
    """The name of the user's own fitness function (--fitness) in these settings, or ""."""
    return settings.fitness if isinstance(settings, EvolveSettings) else ""


def _folder_to_resume(flags: Flags) -> str:
    """The folder of the run that these flags continue, or "" for a new run. Raises GridSimError."""
    given = flags.run
    if not given.resume_if_exists:
        if given.resume and given.config:
            text = "--resume and --config exclude each other: --resume continues a run, --config repeats it"
            raise GridSimError(text)
        return given.resume
    if given.resume or not given.name:
        raise GridSimError("--resume-if-exists starts or continues the run of a --name; give that, and no --resume")
    path = Path(flags.work.output, given.name)
    return str(path) if (path / CHECKPOINT).is_file() else ""


def _learn(prog: str) -> int:
    console = new_console()
    flags, run = _prepare(prog, sys.argv[1:])
    settings, work, folder = run.settings, flags.work, short_path(run.path)
    if run.saved and is_finished(run):
        return _send_missing(console, run, run.saved[1], work)
    place = Place(
        work.workers,
        cluster_address(work.address),
        work.patience,
        check_uri(work.tracking_uri, saved_uri(run.path)),
        work.experiment,
        flags.run.wall_time or math.inf,
    )
    warn_of_many_workers(prog, place.workers, place.address)
    lock(run.path)
    if run.saved is None and (run.path / CHECKPOINT).exists():
        raise GridSimError(f"{folder}: another process has just begun this run; start the command again to continue it")
    stopping.listen()
    resume = f"{command_path(prog)} --resume {folder}"
    if given := _fitness(settings):
        resume += f" --fitness {shlex.quote(given)}"
    hint = f"continue with: {resume}"
    verb = "continuing" if run.saved else settings.verb
    road = settings.scenario if len(settings.crowds) == 1 else label(settings.scenario)
    console.print(f"{verb} {settings.policy} on {road}, seed {settings.seed} -> {folder}", soft_wrap=True)
    try:
        initial = load_champion(run.init).genome if run.init and run.saved is None else None
        with RunDisplay(console, settings) as shown:
            session = train(run, place, shown.event, shown.row, initial=initial, started=STARTED)
    except (KeyboardInterrupt, SystemExit):  # SystemExit is rich's, if the output's reader has ended
        problem = ""
    except (GridSimError, FloatingPointError, MemoryError, OSError) as error:
        problem = str(error) or type(error).__name__
        if isinstance(error, FloatingPointError):  # if resumed, it would fail again
            hint = f"repeat it with: {command_path(prog)} --config {short_path(run.path / CONFIG)} --learning-rate ..."
    else:
        _print_end(console, session, resume)
        return 0
    if not (run.path / CHECKPOINT).is_file():
        hint = ""
        with contextlib.suppress(OSError):
            run.path.rmdir()
    if problem:
        fail(prog, problem, hint, FAILED)
    print(f"{prog}: stopped; {hint or f'no {settings.step_name} was done yet'}", file=sys.stderr)
    return INTERRUPTED


def _send_missing(console: Console, run: RunFolder, meta: Mapping[str, Any], work: WorkFlags) -> int:
    """Send to MLflow what it lacks of a finished run, and say how to go on."""
    settings = run.settings
    sent, unsent = send(run, work.tracking_uri, work.experiment)
    done = f"sent to MLflow: {sent}" if sent else "nothing to do"
    limits = [as_flag(name) for name in settings.extendable if getattr(settings, name)]
    more = f" To go on beyond its end, resume it with a greater {' or '.join(limits)}." if limits else ""
    if meta["solved"] or meta.get("converged"):
        how = "solved" if meta["solved"] else "done, as its network no longer changes (--converged)"
        more = f" It is {how}; to go on from its champion, start a run with --init {short_path(run.path)}."
    steps = count(meta[settings.step_name], settings.step_name)
    console.print(f"{short_path(run.path)} is finished: {steps}; {done}.{more}", soft_wrap=True)
    if unsent:
        print(f"{settings.command}: warning: {unsent}", file=sys.stderr)
    return 0


def _print_end(console: Console, session: Session, resume: str) -> None:
    """Print how a finished run did, and where to look next."""
    summary, settings, path = session.summary, session.run.settings, session.run.path
    title = f"The champion on {summary['held_out_place']}"
    target, roads = session.learning.sim.episode.target, summary["held_out_by_road"]
    console.print(driving_table(title, summary["held_out"], roads, settings.crowds, target))
    steps, solved = count(summary[f"{settings.step_name}s"], settings.step_name), summary["solved"]
    reached = [name for name in settings.extendable if 0 < getattr(settings, name) <= summary[name]]
    longer = " ".join(f"{as_flag(name)} {2 * summary[name]}" for name in reached)
    more = f"\nto go on: {resume} {longer}" if longer and not solved else ""
    how = "solved" if solved else "ended" if _fitness(settings) else "not solved yet"
    console.print(
        f"{how} after {steps}, {summary['car_steps']:,} car-steps, "
        f"{summary['wall_s']:.0f} s{more}\n"
        f"success in validation{', on which the champion was chosen' if solved else ' at the end'}: "
        f"{summary['validation_success_rate']:.1%} "
        "(in MLflow validation/success_rate; the table's is held_out/success_rate)\n"
        f"run: {short_path(path)}   champion: {short_path(path / CHAMPION)}\n"
        f"watch it: open {short_path(path / PAGE)} in a browser, or "
        f"{command_path('gridsim-watch')} {short_path(path)}\n"
        f"compare: {session.tracking.where(command_path('mlflow'))}",
        soft_wrap=True,
    )


def _evaluate() -> int:
    flags = parse(EvaluateFlags, "gridsim-evaluate", sys.argv[1:])
    if flags.suite:
        return _evaluate_suite(flags)
    champion = load_champion(flags.champion).in_sim(flags.sim)
    name, episode = flags.scenario or champion.scenario, champion.sim.episode
    chosen = (name, flags.episodes, flags.seed, flags.asked)
    driven = list(drives(champion, *chosen))
    roads = {label(road): summarise(results, episode.control_period) for road, _, results in driven}
    figures = summarise(np.concatenate([results for _, _, results in driven]), episode.control_period)
    compared = series(champion, *chosen) if flags.errors else []
    missed = errors(compared, champion.sim.vehicle) if compared else None
    place = Path(flags.champion)
    picture = (place if place.is_dir() else place.parent) / stress.PICTURE
    found = _stress(champion, chosen, flags) if flags.stress else []
    if flags.json:
        more: dict[str, Any] = {"by_road": roads} if len(roads) > 1 else {}
        if missed is not None:
            more["errors"] = missed
        if found:
            more["stress"] = [
                {"what": f"{each.part}.{each.name}", "level": level, **driven} for each, level, driven in found
            ]
        print(json.dumps({**figures, **more}))
    else:
        crowds, title = [cars for _, cars, _ in driven], f"{flags.champion} on {', '.join(roads)}"
        title += f", {crowds[0]} cars" if crowds[0] and len(roads) == 1 else ""
        title += "" if is_map_file(driven[0][0]) else f", maps from seed {flags.seed:,}"
        new_console().print(driving_table(title, figures, roads, crowds, episode.target))
        if missed is not None:
            new_console().print(errors_table("Errors against the reference driver", missed))
        if found:
            new_console().print(stress_table(found), f"picture: {short_path(picture)}", sep="\n", soft_wrap=True)
    if flags.errors and missed is None:
        text = "no drive is long enough to be compared with the reference driver"
        print(f"gridsim-evaluate: warning: {text}", file=sys.stderr)
    if found:  # last, so that figures are shown even if this fails
        stress.draw(found, f"{flags.champion} on {label(name)}", picture)
    return 0


def _evaluate_suite(flags: EvaluateFlags) -> int:
    """Drive the suite, print its table (with --json its figures), and write suite.json beside the champion."""
    usual = EvaluateFlags(flags.champion, suite=True, json=flags.json)
    if other := [f.name for f in dataclasses.fields(flags) if getattr(flags, f.name) != getattr(usual, f.name)]:
        raise GridSimError(f"--suite is the same for everybody; leave out {as_flag(other[0])}")
    champion, place = load_champion(flags.champion), Path(flags.champion)
    path = (place if place.is_dir() else place.parent) / suite.FILE
    before = suite.earlier(path)
    shown = new_console(stderr=True)
    roads = track(
        suite.drive(champion), "driving the suite", len(REGISTRY), console=shown, transient=True, disable=flags.json
    )
    driven = list(roads)
    found = suite.report(champion, driven)
    if flags.json:
        print(json.dumps(found))
    else:
        title, crowds = f"{flags.champion} in suite {suite.NUMBER}", [cars for _, cars, _ in driven]
        new_console().print(driving_table(title, found, found["by_road"], crowds, SimConfig().episode.target))
        line = f"digest {found['digest'][:16]}, champion {champion.sha256[:16]}: {short_path(path)}"
        lines = [line, *filter(None, [suite.compared(before, found)])]
        new_console().print(*lines, sep="\n", soft_wrap=True)
    write_json(path, found)  # last, so that figures are shown even if this fails
    return 0


def _stress(champion: Champion, chosen: tuple[str, int, int, Traffic | None], flags: EvaluateFlags) -> list[Any]:
    """Drive a champion at each level of each stress. Returns what was measured."""
    asked = stress.stresses(champion)
    drives = stress.drive(champion, asked, *chosen)
    total = sum(len(each.levels) for each in asked)
    shown = new_console(stderr=True)
    return list(track(drives, "driving under stress", total, console=shown, transient=True, disable=flags.json))


evolve_main, dqn_main = (partial(main, prog, partial(_learn, prog)) for prog in FLAGS)
evaluate_main = partial(main, "gridsim-evaluate", _evaluate, {CheckpointError: "give a run's folder or a champion.npz"})
