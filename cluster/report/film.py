"""Films: drives, recorded state by state, are drawn and written as MP4 or GIF at true speed."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from subprocess import PIPE, Popen
from typing import TYPE_CHECKING

import numpy as np

from cluster import stopping
from cluster.store.champion import Champion
from cluster.store.checkpoint import WriteError
from evolution.episodes.rollout import trajectory
from evolution.networks.policy import MlpSpec, PolicySpec, outputs_of
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.sensing.route import points_ahead
from gridsim.simulator import views
from gridsim.state import DISTANCE, LANE, SPEED, End, X, Y

if TYPE_CHECKING:
    from gridsim.view.render import Renderer

CODING = {
    # Flat colours compress well: some 3 MB a minute. With the index in front, a browser can start at once.
    ".mp4": "-c:v libx264 -preset superfast -crf 25 -pix_fmt yuv420p -movflags +faststart -f mp4",
    ".gif": "-filter_complex split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none:"
    "diff_mode=rectangle -f gif",
}


@dataclass(frozen=True)
class Recording:
    """A drive, state by state, from its start on."""

    scenario: Map
    cars: np.ndarray  # float32 [steps + 1, CAR_FIELDS], the car's states (`gridsim.state`)
    ranges: np.ndarray  # float32 [steps + 1, rays], the readings of its rays, m, late ones if there is a latency
    boxes: np.ndarray  # float32 [steps + 1, others, 4 or more], other cars: x, y (m), heading (cosine, sine)
    end: End  # how the drive ended; RUNNING if the recording was stopped first, and for any drive by a person
    sim: SimConfig  # the simulator's parameters during the drive; of a champion with the vehicle drawn for it
    outputs: np.ndarray | None = None  # float32 [steps + 1, 8 or 2], a perceptron's outputs; None for other drivers

    @property
    def period(self) -> float:
        """Seconds from state to state."""
        return self.sim.episode.control_period

    @cached_property
    def route(self) -> np.ndarray:
        """Points (m) of the route ahead of each state: float32 [steps + 1, points, 2]; no points without a route."""
        return points_ahead(self.scenario, self.cars)

    @property
    def seconds(self) -> float:
        """Simulated time from the first state to the last."""
        return (len(self.cars) - 1) * self.period


def record(
    champion: Champion, scenario: Map, start: np.ndarray, seconds: float, world: np.ndarray | None = None
) -> Recording:
    """Record a champion's drive from `start` to the episode's end, or until `seconds` have passed.

    Args: `start`, a pose float32 [5], or [8] (`state.START_FIELDS`); `world` float32 [others, TRAFFIC_FIELDS], the
    traffic at the start; None: no other cars.
    """
    sim, episode, spec = champion.sim, champion.sim.episode, PolicySpec.parse(champion.policy)
    steps = max(1, round(min(seconds, episode.time_limit) / episode.control_period))
    start, goal = np.asarray(start, dtype=np.float32), episode.target
    result, cars, worlds = trajectory(spec, champion.genome, scenario, start, goal, steps, sim, world)
    end = End(int(result["end"]))
    if end == End.TIME and steps < episode.steps:
        end = End.RUNNING
    ranges, seen = views(scenario, cars, worlds, sim, spec.features, start)
    outputs = outputs_of(spec, champion.genome, seen, sim) if isinstance(spec, MlpSpec) else None
    return Recording(scenario, cars, ranges, other_cars(worlds), end, sim.drawn(start), outputs)


def other_cars(worlds: np.ndarray) -> np.ndarray:
    """Poses float32 [states, others, 4] of the cars that are present in all states: x, y (m), heading (cosine, sine).

    Args: `worlds` float32 [states, cars, TRAFFIC_FIELDS]. A car that is absent in any state is left out of all.
    """
    return worlds[:, (worlds[:, :, LANE] >= 0.0).all(axis=0), :4]


def picture(renderer: Renderer, drive: Recording, seconds: float, title: str = "") -> np.ndarray:
    """Draw a drive `seconds` after its start, interpolated between states; after its end, draw the last state.

    Returns: a picture uint8 [h, w, 3] with `title` in its upper left corner.
    """
    from gridsim.view.render import interpolate  # imported here, as `write_report` needs no renderer

    at = min(max(seconds / drive.period, 0.0), len(drive.cars) - 1.0)
    k = min(int(at), len(drive.cars) - 2) if len(drive.cars) > 1 else 0
    following = min(k + 1, len(drive.cars) - 1)
    part = at - k
    car = interpolate(drive.cars[k], drive.cars[following], part, drive.scenario)
    boxes = interpolate(drive.boxes[k], drive.boxes[following], part, drive.scenario) if drive.boxes.shape[1] else None
    ranges, then = drive.ranges[k], drive.ranges[following]
    # A ray that jumps from one object to another is shown on one of the two, never between them.
    same = np.abs(then - ranges) < 3.0 * drive.scenario.road.unit
    ranges = np.where(same, ranges + part * (then - ranges), ranges if part < 0.5 else then)
    path = np.concatenate([drive.cars[: k + 1, [X, Y]], car[None, [X, Y]]])
    minutes, tenths = divmod(round(10 * min(seconds, drive.seconds)), 600)
    text = f"{car[SPEED]:.1f} m/s    {car[DISTANCE]:,.0f} m    {minutes}:{tenths / 10:04.1f}"
    if drive.end != End.RUNNING and seconds >= drive.seconds - 1e-9:
        text += f"    {drive.end.name.lower()}"
    route = drive.route[k] + part * drive.scenario.shortest(drive.route[following] - drive.route[k])
    return renderer.draw(car, boxes=boxes, ranges=ranges, path=path, text=(text, title), route=route)


def frames(renderer: Renderer, drive: Recording, fps: float, title: str = "") -> Iterator[np.ndarray]:
    """Pictures uint8 [h, w, 3] of a whole drive: `fps` for each second of it, and at least one. Raises Stopped.

    The last one shows how the drive ended, if it did.
    """
    count = max(1, round(drive.seconds * fps))
    for k in range(count):
        stopping.check()
        ends = k == count - 1 and drive.end != End.RUNNING
        yield picture(renderer, drive, drive.seconds if ends else k / fps, title)


def write_video(path: Path, pictures: Iterable[np.ndarray], size: tuple[int, int], fps: float) -> int:
    """Write pictures uint8 [h, w, 3] as H.264 in an MP4, or as a GIF, by the path's suffix; whole or not at all.

    Args: `size`, (width, height) in pixels.
    Returns: the number of pictures. Raises: WriteError; a file that was there before is then kept.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.touch()  # where nothing can be written, Python's error is clearer than ffmpeg's
        count = _encode(temporary, pictures, size, fps, CODING[path.suffix.lower()].split())
        os.replace(temporary, path)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return count


def _encode(path: Path, pictures: Iterable[np.ndarray], size: tuple[int, int], fps: float, coding: list[str]) -> int:
    """Pipe pictures through ffmpeg. Returns their number. Raises WriteError if there is no ffmpeg or it fails.

    imageio-ffmpeg's own writer ignores ffmpeg's exit code: a full disk would leave a film that looks finished.
    """
    from imageio_ffmpeg import get_ffmpeg_exe

    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}", "-i", "-"]
    # Without `file:`, ffmpeg takes what stands before a colon in a name for a protocol.
    arguments = ["-y", "-v", "error", *raw, "-an", *coding, f"file:{path}"]
    count = 0
    with tempfile.TemporaryFile() as messages:  # a pipe that nobody reads would fill up and stop ffmpeg
        try:  # in a session of its own, where Ctrl-C does not reach it
            process = Popen([get_ffmpeg_exe(), *arguments], stdin=PIPE, stderr=messages, start_new_session=True)
        except (OSError, RuntimeError) as error:
            raise WriteError(f"ffmpeg cannot be started: {error}") from error
        with process, contextlib.suppress(BrokenPipeError):  # if ffmpeg ends early, its message is read below
            assert process.stdin is not None
            with process.stdin as stream:
                for image in pictures:
                    stream.write(np.ascontiguousarray(image).data)
                    count += 1
        messages.seek(0)
        message = messages.read().decode(errors="replace").strip()
    if process.returncode:
        raise WriteError(f"ffmpeg failed: {message.splitlines()[-1][:160] if message else process.returncode}")
    return count
