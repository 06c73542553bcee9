"""gridsim-watch and gridsim-drive: a drive in a window, as a film, or on a page."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import os
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro
from rich.progress import track

from cluster import stopping
from cluster.commands.common import RoadFlags, command_path, main, new_console, parse, short_path
from cluster.report.film import CODING, Recording, frames, other_cars, picture, record, write_video
from cluster.report.page import Shown, write_page
from cluster.settings import IN_WORDS, MAX_TRAFFIC, ROADS
from cluster.store.champion import Champion, UnfinishedError, load_champion
from cluster.store.checkpoint import CHAMPION, CheckpointError
from cluster.store.folder import CHECKPOINT, CONFIG, RunError, read_config
from cluster.store.steps import read_elites
from gridsim.config import SimConfig, names_file
from gridsim.errors import GridSimError
from gridsim.maps.map import Map, sample_starts
from gridsim.maps.parts import is_map_file, road_number, seed_of_map
from gridsim.maps.scenarios import Traffic, build, check_name, full_name, label, traffic_on
from gridsim.state import End
from gridsim.traffic.world import spawn
from gridsim.view.drive import Recorder, drive, read_drive, replay
from gridsim.view.render import NoDisplayError, Renderer, Window

WATCH, DRIVE = "gridsim-watch", "gridsim-drive"
HINTS: dict[type[GridSimError], str] = {
    NoDisplayError: "to write a page or a film in place of a window: --output drive.html, or film.mp4",
    UnfinishedError: "to watch it as it stands: --follow, or --generation N",
    RunError: "--generation and --follow need a run's folder",
    CheckpointError: "give a run's folder, a champion.npz or a recorded drive.csv",
}
FILM_S = 60.0  # s of a film by default, unless it is of a recorded drive
FOLLOW_S = 20.0  # s that an elite drives at most with --follow, before the newest one takes its place
LINGER_S = 1.5  # s that the last picture of a drive stays in the window


@dataclass(frozen=True)
class WatchFlags(RoadFlags):
    """Watch a champion drive roads it never saw: in a window, as a film, or on a page for any browser.

    In the window: N goes on to the next road, Esc or Q ends.
    """

    example: ClassVar[str] = "gridsim-watch runs/NAME --scenario city --output drive.gif"
    source: tyro.conf.Positional[str]
    """A run's folder, a champion.npz, or a recorded drive.csv."""
    beside: tyro.conf.Positional[tuple[str, ...]] = ()
    """More of them, to compare on one page on the same road; needs --output FILE.html."""
    output: Annotated[str, IN_WORDS] = ""
    """Write a film, .mp4 or .gif, or a page, .html, in place of the window."""
    generation: Annotated[int | None, IN_WORDS] = None
    """Watch this generation's elite, which is its leader (of a DQN: this evaluation's network), not the champion; 0 is
    the first, as in history.csv and MLflow."""
    follow: bool = False
    """Watch the newest elite, while the run is still going."""
    seconds: Annotated[float, IN_WORDS] = 0.0
    """Seconds of driving to show; by default all of a recorded drive, else 60 in a film and no limit in a window."""
    fps: Annotated[int, IN_WORDS] = 0
    """Pictures a second; by default 30 in a window, 20 in an .mp4, 10 in a .gif."""
    size: Annotated[str, IN_WORDS] = ""
    """Width x height in pixels; by default 960x640 in a window, 640x360 in a film."""


@dataclass(frozen=True)
class DriveFlags:
    """Drive yourself, with the arrow keys: up accelerates, down brakes (and reverses once the car stands).

    Space brakes, R restarts, Esc or Q ends. A recorded drive is a plain CSV file, a row for each control step:
    time, pose, speed, steering, action, and the map; gridsim-watch shows it again.
    """

    example: ClassVar[str] = "gridsim-drive --scenario city --record drive.csv"
    scenario: Annotated[str, tyro.conf.arg(help=f"Road to drive on: {ROADS}")] = "seamless"
    sim: str = "default"
    """Car, sensor, episode and traffic: default, f1tenth, sedan, truck, lights, or a YAML file (docs/own.md)."""
    traffic: Annotated[Traffic, IN_WORDS] = -1
    """Other cars on the road: usual, heavy or a number; by default as for gridsim-evolve."""
    record: Annotated[str, IN_WORDS] = ""
    """Record the drive to this new CSV file."""
    seed: int = 0
    """Seed of the map and of the start."""
    seconds: Annotated[float, IN_WORDS] = 0.0
    """End after so many seconds of driving; by default when the window is closed."""
    size: str = "960x640"
    """Width x height of the window, in pixels."""


class _Window(Window):
    """A window that a signal closes."""

    def keys(self) -> tuple[set[str], set[str]]:
        pressed = super().keys()
        self.closed = self.closed or stopping.requested()
        return pressed


def _size_and_seconds(size: str, seconds: float, traffic: Traffic) -> tuple[tuple[int, int], float]:
    """Width and height in pixels, and seconds, infinite for 0. Raises GridSimError if these or --traffic are wrong."""
    match = re.fullmatch(r"(\d{2,4})x(\d{2,4})", size)
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (64 <= min(width, height) <= max(width, height) <= 4096) or width % 2 or height % 2:
        raise GridSimError(f"--size {size}: give width x height, even and from 64 to 4096, as in 640x360")
    if not 0.0 <= seconds <= 36_000.0:
        raise GridSimError(f"--seconds must be 0 to 36,000, not {seconds:g}")
    if isinstance(traffic, int) and not -1 <= traffic <= MAX_TRAFFIC:
        raise GridSimError(f"--traffic must be 0 to {MAX_TRAFFIC}, not {traffic}")
    return (width, height), seconds or math.inf


def _map(name: str, seed: int, config: SimConfig) -> tuple[Map, np.ndarray]:
    """A map and a start float32 [5] on it, both of this seed. Raises GridSimError."""
    scenario = build(name, seed, config)
    return scenario, sample_starts(scenario, 1, np.random.default_rng(np.random.SeedSequence([seed, 7])))[0]


def _watch() -> int:
    flags = parse(WatchFlags, WATCH, sys.argv[1:])
    stopping.listen()
    if not 0 <= flags.fps <= 120:
        raise GridSimError(f"--fps must be 1 to 120, not {flags.fps}")
    usual = "640x360" if flags.output else "960x640"
    size, seconds = _size_and_seconds(flags.size or usual, flags.seconds, flags.traffic)
    if flags.scenario:
        check_name(full_name(flags.scenario))
    if flags.follow and (flags.output or flags.generation is not None):
        raise GridSimError("--follow shows the newest elite in a window; leave out --output and --generation")
    output = Path(flags.output)
    suffix = output.suffix.lower()
    if flags.beside and suffix != ".html":
        raise GridSimError("several champions can only be shown on a page: --output drive.html")
    if not flags.output:
        _show(flags, size, seconds)
        stopping.check()
        return 0
    if suffix not in (*CODING, ".html"):
        raise GridSimError(f"--output {output}: a film is written as .mp4 or .gif, a page as .html")
    if not output.parent.is_dir():
        raise GridSimError(f"--output {output}: there is no folder {output.parent}; create it first")
    if suffix == ".html":
        _page(flags, output, seconds)
    else:
        _film(flags, output, size, seconds)
    return 0


def _elite(run: Path, generation: int | None) -> tuple[Champion, str]:
    """The elite of a run's generation (of a DQN: the network of an evaluation), and its name.

    If `generation` is None, it is the newest one; before the first, this waits. Raises GridSimError, Stopped.
    """
    settings, _ = read_config(run / CONFIG)
    step = settings.step_name
    if generation is None and not (run / CHECKPOINT).exists():
        print(f"waiting for the first {step} ...", flush=True)
        while not (run / CHECKPOINT).exists():
            stopping.check()
            time.sleep(0.1)
    genomes = read_elites(run, settings.policy)
    number = len(genomes) - 1 if generation is None else generation
    if not 0 <= number < len(genomes):
        raise GridSimError(f"--generation {number}: the run has {step}s 0 to {len(genomes) - 1}")
    champion = Champion(genomes[number], settings.policy, settings.scenario, settings.simulator(), settings.traffic)
    return champion, f"elite of {step} {number}"


def _is_recording(source: str) -> bool:
    return source.lower().endswith(".csv") and not Path(source).is_dir()


def _drives(flags: WatchFlags, seconds: float) -> Iterator[tuple[Recording, str]]:
    """Yield drives, each with its driver's name. Raises GridSimError.

    Of a recording these are its episodes. A champion or elite drives once for a film or a page; for a window it drives
    map after map, without end.
    """
    if _is_recording(flags.source):
        yield from _recorded(flags)
        return
    source = Path(flags.source)
    for seed in itertools.count(flags.seed) if not flags.output else (flags.seed,):
        champion, name = _driver(source, flags)
        road = full_name(flags.scenario or champion.scenario)
        scenario, start = _map(road, seed, champion.sim)
        cars = _cars(champion, road, seed, flags)
        world = spawn(scenario.network, start[None], cars, np.array([scenario.seed]), champion.sim)[0]
        yield record(champion, scenario, start, seconds, world), name


def _cars(champion: Champion, road: str, seed: int, flags: WatchFlags) -> int:
    """The number of other cars on the map of a seed, absent ones included."""
    crowds = champion.crowds_on(road, flags.asked)
    return crowds[road_number(seed, len(crowds))]


def _driver(source: Path, flags: WatchFlags) -> tuple[Champion, str]:
    """The champion or elite that drives, in the car of --sim, and its name."""
    elite = flags.follow or flags.generation is not None
    champion, name = _elite(source, flags.generation) if elite else (load_champion(source), "champion")
    return champion.in_sim(flags.sim), name


def _recorded(flags: WatchFlags) -> Iterator[tuple[Recording, str]]:
    """The episodes of a recorded drive."""
    if flags.generation is not None or flags.follow or flags.scenario or flags.sim or flags.traffic != -1:
        own = "a recorded drive has its own driver, car and road"
        raise GridSimError(f"{own}; leave out --generation, --follow, --scenario, --sim and --traffic")
    recorded = read_drive(flags.source)
    config = SimConfig.load(recorded.sim)
    scenario, _ = _map(recorded.scenario, recorded.map_seed, config)
    _, cars, ranges, worlds = replay(recorded, scenario)
    for episode in range(int(recorded.episodes[-1]) + 1):
        own = recorded.episodes == episode
        sim = config.drawn(recorded.poses[own][0])
        drive = Recording(scenario, cars[own], ranges[own], other_cars(worlds[own]), End.RUNNING, sim)
        yield drive, f"episode {episode + 1}"


def _title(drive: Recording, name: str) -> str:
    """Who drives where: the driver, the road, and the map's seed, except that a map file has only one map."""
    road = drive.scenario
    return f"{name}    {label(road.name)}" + ("" if is_map_file(road.name) else f", map {road.seed:,}")


def _page(flags: WatchFlags, output: Path, limit: float) -> None:
    """Write a page: drives of all sources from the same start, on the same road."""
    shown: list[Shown] = []
    sources, asked = (flags.source, *flags.beside), flags
    for source in sources:
        path = Path(source).resolve()
        of = path.parent.name if path.name == CHAMPION else path.name
        given = asked if _is_recording(source) else flags  # a recording has its own road
        for k, (found, name) in enumerate(_drives(dataclasses.replace(given, source=source), limit), 1):
            mark = str(k) if not flags.beside else of if k == 1 else f"{of} {k}"
            shown.append(Shown(f"{name} of {source}", mark, found))
            if not _is_recording(source):  # the sources after it drive on the same road, among as many cars
                champion, _ = _driver(Path(source), flags)
                road = full_name(flags.scenario or champion.scenario)
                flags = dataclasses.replace(flags, scenario=road, traffic=_cars(champion, road, flags.seed, flags))
    roads = [each.drive.scenario for each in shown]
    if len({(road.name, seed_of_map(road.name, road.seed)) for road in roads}) > 1:
        raise GridSimError("a page shows drives on one road; give --scenario and --seed, or one recorded drive")
    sims = [each.drive.sim for each in shown]
    if len({(sim.vehicle.length, sim.vehicle.width, sim.traffic.lights, sim.traffic.city_lights) for sim in sims}) > 1:
        raise GridSimError("a page shows cars of one size, either with traffic lights or without; give --sim")
    title = f"GridSim: {', '.join(sources)} on {shown[0].drive.scenario.name}"
    write_page(output, title, shown, together=bool(flags.beside))
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB; open it in any browser")


def _film(flags: WatchFlags, output: Path, size: tuple[int, int], limit: float) -> None:
    """Write a film."""
    gif = output.suffix.lower() == ".gif"
    fps = flags.fps or (10 if gif else 20)
    if gif and 100 % fps:
        raise GridSimError(f"--fps {fps}: a GIF counts in hundredths of a second; use 5, 10, 20, 25 or 50")
    if not (flags.seconds or _is_recording(flags.source)):
        limit = FILM_S
    drives = list(_drives(flags, limit))
    seconds = min(limit, sum(each.seconds for each, _ in drives))
    total = max(1, round(seconds * fps))
    renderer = Renderer(drives[0][0].scenario, size, drives[0][0].sim)
    pictures = (each for drive, name in drives for each in frames(renderer, drive, fps, _title(drive, name)))
    console, doing = new_console(), f"filming {seconds:.0f} s of driving"
    shown = track(itertools.islice(pictures, total), doing, total, console=console, transient=True)
    count = write_video(output, shown, size, fps)
    end = drives[0][0].end
    how = "" if end == End.RUNNING else f", to its end: {end.name.lower()}"
    size_mb = output.stat().st_size / 1e6
    console.print(f"{output}: {seconds:.1f} s{how}, {count} pictures, {size_mb:.1f} MB", soft_wrap=True)


def _show(flags: WatchFlags, size: tuple[int, int], limit: float) -> None:
    """Show drives in a window until it is closed (also by Esc or Q), `limit` s were shown, or no drive is left."""
    fps = flags.fps or 30
    drives = _drives(flags, FOLLOW_S if flags.follow else math.inf)
    first = next(drives)  # raises errors before the window opens
    shown = 0.0
    with contextlib.closing(_Window(size, f"GridSim: {flags.source}")) as window:
        for each, name in itertools.chain([first], drives):
            renderer, title = Renderer(each.scenario, size, each.sim), _title(each, name)
            for k in range(round((each.seconds + LINGER_S) * fps) + 1):
                window.show(picture(renderer, each, k / fps, title), fps)
                shown += 1 / fps
                pressed, _ = window.keys()
                if window.closed or pressed & {"escape", "q"} or shown >= limit:
                    return
                if "n" in pressed:
                    break


def _drive() -> int:
    flags = parse(DriveFlags, DRIVE, sys.argv[1:])
    stopping.listen()
    size, seconds = _size_and_seconds(flags.size, flags.seconds, flags.traffic)
    sim = os.path.abspath(flags.sim) if names_file(flags.sim) else flags.sim
    config = SimConfig.load(sim)
    scenario, start = _map(full_name(flags.scenario), flags.seed, config)
    traffic = traffic_on(scenario.name, None if flags.traffic == -1 else flags.traffic, config)
    with contextlib.closing(_Window(size, f"GridSim: {flags.scenario}")) as window:
        recorder = Recorder(flags.record, scenario, traffic, sim) if flags.record else None
        try:
            renderer = Renderer(scenario, size, config.drawn(start))
            done = drive(scenario, start, window, renderer, recorder, seconds, traffic, config)
            print(f"drove {done['seconds']:.1f} s; the longest of {done['episodes']}: {done['distance_m']:,.0f} m")
        finally:  # also if the drive is interrupted
            if recorder is not None:
                with contextlib.suppress(OSError):  # the error of a row that could not be written says more
                    recorder.close()
                print(f"kept {recorder.rows} steps; watch them: {command_path(WATCH)} {short_path(recorder.path)}")
    stopping.check()
    return 0


watch_main = partial(main, WATCH, _watch, HINTS)
drive_main = partial(main, DRIVE, _drive)
