"""gridsim-watch and gridsim-drive: a window on a drive, or a film of it."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console

from cluster.commands.common import INTERRUPTED, UsageError, called, fail, parse
from cluster.report.film import SUFFIXES, Recording, VideoError, frames, others, picture, record, write_video
from cluster.runs import checkpoint
from cluster.runs.champion import Champion, UnfinishedError, load_champion
from cluster.runs.checkpoint import CheckpointError
from cluster.runs.run import CHECKPOINT, CONFIG, ELITES, RunError, read_config
from cluster.runs.settings import MAX_TRAFFIC
from evolution.networks.policy import PolicySpec
from gridsim.car.ego import End
from gridsim.config import SimConfig
from gridsim.maps.map import Map, sample_starts
from gridsim.maps.scenarios import HELD_OUT_SEED, build, check_name, default_traffic, label
from gridsim.traffic.world import spawn
from gridsim.view.drive import DriveError, Recorder, drive, read_drive, replay
from gridsim.view.render import NoDisplayError, Renderer, Window

FILM_S = 60.0  # s of a film, unless told
FOLLOW_S = 10.0  # s that an elite is watched before a newer one may take its place
LINGER_S = 1.5  # s that the last picture of a drive stays


@dataclass(frozen=True)
class WatchFlags:
    """Watch a champion drive roads it never saw: in a window, or as a film.

    In the window: N goes on to the next road, Esc or Q ends.
    """

    source: tyro.conf.Positional[str]
    """A run's folder, a champion.npz, or a recorded drive.csv."""
    output: str = ""
    """Write a film, .mp4 or .gif, in place of the window."""
    generation: int | None = None
    """Watch this generation's elite (of a DQN: this evaluation's network), not the champion; 0 is the first, as in
    history.csv and MLflow."""
    follow: bool = False
    """Watch the newest elite, while the run is still going."""
    scenario: str = ""
    """Road to drive on; by default the one it learned on."""
    traffic: int = -1
    """Other cars on the road; -1: as many as it learned among, or as another scenario has by default."""
    seed: int = HELD_OUT_SEED
    """Seed of the first map and of the starts; those of held-out maps begin at 2,000,000."""
    seconds: float = 0.0
    """Seconds of driving to show; by default all of a recorded drive, else 60 in a film and no limit in a window."""
    fps: int = 0
    """Pictures a second; by default 30 in a window, 20 in an .mp4, 10 in a .gif."""
    size: str = ""
    """Width x height in pixels; by default 960x640 in a window, 640x360 in a film."""


@dataclass(frozen=True)
class DriveFlags:
    """Drive yourself, with the arrow keys: up accelerates, down brakes (and reverses once the car stands).

    Space brakes, R restarts, Esc or Q ends. A recorded drive is a plain CSV file, a row for each control step of 0.1 s:
    time, pose, speed, steering, action, and the map; gridsim-watch shows it again.
    """

    scenario: str = "seamless"
    """Road to drive on: its name, or a map's file."""
    traffic: int = -1
    """Other cars on the road; -1: as many as the scenario has by default."""
    record: str = ""
    """Keep the drive in this new CSV file."""
    seed: int = 0
    """Seed of the map and of the start."""
    seconds: float = 0.0
    """End after so many seconds of driving; 0: when the window is closed."""
    size: str = "960x640"
    """Width x height of the window, in pixels."""


@contextlib.contextmanager
def _as_usage_error() -> Iterator[None]:
    """What is wrong with a map or its name is the user's to put right."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def _size(text: str) -> tuple[int, int]:
    """Read `640x360`. Raises UsageError."""
    match = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(size) < 64 or max(size) > 4096 or size[0] % 2 or size[1] % 2:
        raise UsageError(f"--size {text}: give width x height, even and from 64 to 4096, as in 640x360")
    return size


def _seconds(value: float) -> float:
    """Raises UsageError for a time that is none."""
    if not 0.0 <= value <= 36_000.0:
        raise UsageError(f"--seconds must be 0 to 36,000, not {value:g}")
    return value


def _traffic(value: int, default: int) -> int:
    """Raises UsageError for a number of cars that is none."""
    if not -1 <= value <= MAX_TRAFFIC:
        raise UsageError(f"--traffic must be 0 to {MAX_TRAFFIC}, not {value}")
    return default if value == -1 else value


def _map(name: str, seed: int, config: SimConfig) -> tuple[Map, np.ndarray]:
    """A map and a start float32 [5] on it, both of this seed. Raises UsageError."""
    with _as_usage_error():
        scenario = build(name, seed, config)
    return scenario, sample_starts(scenario, 1, np.random.default_rng(np.random.SeedSequence([seed, 7])))[0]


# ------------------------------------------------------------------------------------------------------------- watch


class Elites:
    """The elite of each generation, of a DQN the network of each evaluation; of a run that is over, or still going."""

    def __init__(self, folder: Path):
        """Read the run's settings. Raises RunError."""
        if not (folder / CONFIG).is_file():
            raise RunError(f"{folder} is no run's folder: it has no {CONFIG}")
        self.folder = folder
        self.settings, _ = read_config(folder / CONFIG)

    def changed(self) -> int:
        """A number that changes with the checkpoint; 0 before there is one."""
        try:
            return (self.folder / CHECKPOINT).stat().st_mtime_ns
        except OSError:
            return 0

    def read(self) -> np.ndarray:
        """Genomes float32 [generations, genes]. Raises CheckpointError."""
        path, name = self.folder / CHECKPOINT, "elites"
        if not path.is_file():
            path, name = self.folder / ELITES, "genomes"
        arrays, _ = checkpoint.load(path)
        genomes = arrays.get(name)
        genes = PolicySpec.parse(self.settings.policy).size
        if genomes is None or genomes.dtype != np.float32 or genomes.shape[1:] != (genes,) or not len(genomes):
            raise CheckpointError(f"{path}: its elites are no {self.settings.policy}")
        return genomes

    def get(self, generation: int | None) -> tuple[Champion, str]:
        """The elite of a generation, or the newest, and what it is called. Raises CheckpointError, UsageError."""
        genomes, settings = self.read(), self.settings
        step = settings.counts[0]  # generation, or evaluation
        number = len(genomes) - 1 if generation is None else generation
        if not 0 <= number < len(genomes):
            raise UsageError(f"--generation {number}: the run has {step}s 0 to {len(genomes) - 1}")
        champion = Champion(genomes[number], settings.policy, settings.scenario, SimConfig(), settings.traffic)
        return champion, f"elite of {step} {number}"


def _driver(flags: WatchFlags) -> Callable[[], tuple[Champion, str]]:
    """Who is watched; asked again before each drive. Raises UsageError, RunError, CheckpointError."""
    source = Path(flags.source)
    if flags.generation is not None and flags.follow:
        raise UsageError("--generation and --follow exclude each other")
    if (flags.generation is not None or flags.follow) and source.is_file():
        raise UsageError(f"{source} holds one driver; give a run's folder with --generation or --follow")
    if flags.follow and flags.output:
        raise UsageError("--follow needs a window; leave out --output, or film one elite with --generation")
    if not source.exists():
        raise UsageError(f"{source}: no such file or folder; give a run's folder or a champion.npz")
    if flags.generation is None and not flags.follow:
        champion = load_champion(source)
        return lambda: (champion, "champion")
    elites = Elites(source)
    if flags.follow and not elites.changed():
        print(f"waiting for the first {elites.settings.counts[0]} ...", flush=True)
        while not elites.changed():
            time.sleep(0.1)
    if flags.generation is not None:
        found = elites.get(flags.generation)
        return lambda: found
    return lambda: elites.get(None)


def _is_recording(flags: WatchFlags) -> bool:
    return flags.source.lower().endswith(".csv")


def _drives(flags: WatchFlags, seconds: float) -> Iterator[tuple[Recording, str]]:
    """Drives to show, without an end but for a recorded one, and what they are. Raises as `_driver`, DriveError."""
    if _is_recording(flags):
        yield from _recorded(flags)
        return
    driver = _driver(flags)
    for k in range(1 << 30):
        champion, name = driver()
        road = flags.scenario or champion.scenario
        scenario, start = _map(road, flags.seed + k, champion.sim)
        traffic = _traffic(flags.traffic, champion.traffic if road == champion.scenario else default_traffic(road))
        world = spawn(scenario.network, start[None], traffic, np.array([scenario.seed]), champion.sim.traffic)[0]
        drive = record(champion, scenario, start, seconds, world)
        yield drive, f"{name}    {label(road)}, map {scenario.seed:,}"


def _recorded(flags: WatchFlags) -> Iterator[tuple[Recording, str]]:
    """The episodes of a recorded drive."""
    if flags.generation is not None or flags.follow or flags.scenario or flags.traffic != -1:
        raise UsageError("a recorded drive has its own driver and road; leave out all but --output and how it looks")
    kept = read_drive(flags.source)
    config = SimConfig()
    scenario, _ = _map(kept.scenario, kept.map_seed, config)
    _, cars, ranges, worlds = replay(kept, scenario, config)
    title = f"{Path(flags.source).name}    {label(scenario.name)}, map {scenario.seed:,}"
    episodes = int(kept.episodes[-1]) + 1
    for episode in range(episodes):
        own = kept.episodes == episode
        drive = Recording(
            scenario, cars[own], ranges[own], others(worlds[own]), End.RUNNING, config.episode.control_period
        )
        yield drive, f"{title}    episode {episode + 1} of {episodes}" if episodes > 1 else title


def _film(flags: WatchFlags, console: Console) -> str:
    """Write --output. Returns the closing words."""
    output = Path(flags.output)
    if output.suffix.lower() not in SUFFIXES:
        raise UsageError(f"--output {output}: a film is written as .mp4 or .gif")
    if not output.parent.is_dir():
        raise UsageError(f"--output {output}: there is no folder {output.parent}")
    gif = output.suffix.lower() == ".gif"
    fps = flags.fps or (10 if gif else 20)
    if gif and 100 % fps:
        raise UsageError(f"--fps {fps}: a GIF counts in hundredths of a second; use 5, 10, 20, 25 or 50")
    size = _size(flags.size or "640x360")
    recorded = _is_recording(flags)
    limit = _seconds(flags.seconds) or (math.inf if recorded else FILM_S)
    drives = list(_recorded(flags)) if recorded else [next(_drives(flags, limit))]
    seconds = min(limit, sum(drive.seconds for drive, _ in drives))
    total = max(1, round(seconds * fps))
    renderer = Renderer(drives[0][0].scenario, size)
    pictures = itertools.chain.from_iterable(frames(renderer, drive, fps, title) for drive, title in drives)
    with console.status(f"filming {seconds:.0f} s of driving") as status:

        def counted() -> Iterator[np.ndarray]:
            for k, image in enumerate(itertools.islice(pictures, total)):
                status.update(f"filming {seconds:.0f} s of driving: picture {k} of {total}")
                yield image

        count = write_video(output, counted(), size, fps)
    end = drives[0][0].end
    how = "" if end == End.RUNNING else f", to its end: {end.name.lower()}"
    return f"{output}: {seconds:.1f} s{how}, {count} pictures, {output.stat().st_size / 1e6:.1f} MB"


def _show(flags: WatchFlags) -> None:
    """Show drives in a window until it is closed."""
    fps = flags.fps or 30
    limit = _seconds(flags.seconds) or math.inf
    size = _size(flags.size or "960x640")
    drives = _drives(flags, SimConfig().episode.time_limit)
    coming = next(drives, None)  # what is wrong is said before there is a window
    elites = Elites(Path(flags.source)) if flags.follow else None
    shown = 0.0
    with Window(size, f"GridSim: {flags.source}") as window:
        while coming is not None and not window.closed and shown < limit:
            seen = elites.changed() if elites else 0
            drive, title = coming
            renderer = Renderer(drive.scenario, size)
            end = round((drive.seconds + LINGER_S) * fps)
            for k in range(end + 1):
                if shown >= limit:
                    break
                window.show(picture(renderer, drive, k / fps, title), fps)
                shown += 1 / fps
                pressed, _ = window.keys()
                if window.closed or pressed & {"escape", "q"}:
                    return
                newer = elites is not None and k / fps >= FOLLOW_S and elites.changed() != seen
                if "n" in pressed or newer:
                    break
            coming = next(drives, None) if shown < limit else None


def watch_main() -> None:
    """Entry point of `gridsim-watch`."""
    prog = "gridsim-watch"
    try:
        flags = parse(WatchFlags, prog, sys.argv[1:])
        try:
            if not 0 <= flags.fps <= 120:
                raise UsageError(f"--fps must be 1 to 120, not {flags.fps}")
            _traffic(flags.traffic, 0)
            if flags.scenario:
                with _as_usage_error():
                    check_name(flags.scenario)
            if flags.output:
                console = Console()
                console.print(_film(flags, console), soft_wrap=True)
            else:
                _show(flags)
        except NoDisplayError as error:
            fail(prog, str(error), "to write a film in place of a window: --output film.mp4")
        except UnfinishedError as error:
            fail(prog, str(error), "to watch it as it stands: --follow, or --generation N")
        except (UsageError, RunError, CheckpointError, DriveError) as error:
            fail(prog, str(error))
        except VideoError as error:
            fail(prog, str(error), code=1)
    except KeyboardInterrupt:
        print(f"{prog}: stopped", file=sys.stderr)
        sys.exit(INTERRUPTED)


# ------------------------------------------------------------------------------------------------------------- drive


def drive_main() -> None:
    """Entry point of `gridsim-drive`."""
    prog = "gridsim-drive"
    recorder: Recorder | None = None
    try:
        flags = parse(DriveFlags, prog, sys.argv[1:])
        try:
            size, seconds = _size(flags.size), _seconds(flags.seconds) or math.inf
            config = SimConfig()
            scenario, start = _map(flags.scenario, flags.seed, config)
            traffic = _traffic(flags.traffic, default_traffic(flags.scenario))
            with contextlib.ExitStack() as stack:
                window = stack.enter_context(Window(size, f"GridSim: {flags.scenario}"))
                if flags.record:
                    period = config.episode.control_period
                    recorder = stack.enter_context(Recorder(flags.record, scenario, period, traffic))
                view = Renderer(scenario, size)
                done = drive(scenario, start, window, view, recorder, config, seconds, traffic)
            print(f"drove {done['seconds']:.1f} s; the longest of {done['episodes']}: {done['distance_m']:,.0f} m")
        except NoDisplayError as error:
            fail(prog, str(error))
        except (UsageError, DriveError) as error:
            fail(prog, str(error))
        _kept(recorder)
    except KeyboardInterrupt:
        print(f"{prog}: stopped", file=sys.stderr)
        _kept(recorder)
        sys.exit(INTERRUPTED)


def _kept(recorder: Recorder | None) -> None:
    if recorder is not None:
        print(f"kept {recorder.rows} steps; watch them: {called('gridsim-watch')} {recorder.path}")
