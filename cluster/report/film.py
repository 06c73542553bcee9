"""Films: a champion's drive, kept state by state, drawn picture by picture, written as MP4 or GIF at true speed.

Run as `python -m cluster.report.film CHAMPION SEED FILM TITLE`, it is a process that draws a run's champion.mp4 while
the run does what else there is to do at its end (`Filming`).
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster.runs.champion import Champion, load_champion
from cluster.runs.checkpoint import CheckpointError
from evolution.episodes.rollout import Limits, trajectory
from evolution.networks.policy import PolicySpec
from gridsim.car.ego import DISTANCE, SPEED, End, X, Y
from gridsim.envs.simulator import views
from gridsim.errors import GridSimError
from gridsim.maps.map import Map
from gridsim.maps.scenarios import build
from gridsim.traffic.world import LANE
from gridsim.view.render import Renderer, interpolate

SUFFIXES = (".mp4", ".gif")
SIZE, FPS, SECONDS = (640, 360), 15, 20.0  # of champion.mp4, which a run waits for: a second or two of one core


class VideoError(GridSimError):
    """A film that cannot be written; the message is one line for the user."""


@dataclass(frozen=True)
class Recording:
    """A drive, state by state, from its start on.

    Attributes:
        scenario: the map.
        cars: float32 [steps + 1, FIELDS], the car's states (`gridsim.car.ego`).
        ranges: float32 [steps + 1, rays], what its rays say, m.
        boxes: float32 [steps + 1, others, 4 or more], other cars: x, y (m), heading (cosine, sine).
        end: how it ended; RUNNING where the recording did.
        period: s from state to state.
    """

    scenario: Map
    cars: np.ndarray
    ranges: np.ndarray
    boxes: np.ndarray
    end: End
    period: float

    @property
    def seconds(self) -> float:
        """Simulated time from the first state to the last."""
        return (len(self.cars) - 1) * self.period


def record(
    champion: Champion, scenario: Map, start: np.ndarray, seconds: float, world: np.ndarray | None = None
) -> Recording:
    """Drive from `start` float32 [5] (x, y, heading, speed, steering) to the episode's end, or for so many seconds.

    Args: world float32 [others, world.FIELDS], the traffic at the start.
    """
    episode = champion.sim.episode
    steps = max(1, round(min(seconds, episode.time_limit) / episode.control_period))
    result, cars, worlds = trajectory(
        PolicySpec.parse(champion.policy), champion.genome, scenario, np.asarray(start, dtype=np.float32),
        Limits(episode.target, steps), champion.sim, world,
    )  # fmt: skip
    end = End(int(result["end"]))
    if end == End.TIME and steps < round(episode.time_limit / episode.control_period):
        end = End.RUNNING
    return Recording(
        scenario, cars, views(scenario, cars, worlds, champion.sim), others(worlds), end, episode.control_period
    )


def others(worlds: np.ndarray) -> np.ndarray:
    """The other cars' x, y (m) and heading (cosine, sine) [steps, others, 4] of traffic [steps, others, FIELDS]."""
    return worlds[:, (worlds[:, :, LANE] >= 0.0).all(axis=0), :4]


def picture(renderer: Renderer, drive: Recording, seconds: float, title: str = "") -> np.ndarray:
    """The picture uint8 [h, w, 3] of a drive at a time since its start."""
    at = min(max(seconds / drive.period, 0.0), len(drive.cars) - 1.0)
    k = min(int(at), len(drive.cars) - 2) if len(drive.cars) > 1 else 0
    following = min(k + 1, len(drive.cars) - 1)
    part = at - k
    car = interpolate(drive.cars[k], drive.cars[following], part, drive.scenario)
    boxes = interpolate(drive.boxes[k], drive.boxes[following], part, drive.scenario) if drive.boxes.shape[1] else None
    ranges, then = drive.ranges[k], drive.ranges[following]
    # A ray that leaps from one thing to another is shown on either, never between them.
    ranges = np.where(np.abs(then - ranges) < 3.0, ranges + part * (then - ranges), ranges if part < 0.5 else then)
    path = np.concatenate([drive.cars[: k + 1, [X, Y]], car[None, [X, Y]]])
    minutes, rest = divmod(min(seconds, drive.seconds), 60)
    text = f"{car[SPEED]:.1f} m/s    {car[DISTANCE]:,.0f} m    {minutes:.0f}:{rest:04.1f}"
    if drive.end != End.RUNNING and seconds >= drive.seconds - 1e-9:
        text += f"    {drive.end.name.lower()}"
    return renderer.draw(car, boxes=boxes, ranges=ranges, path=path, text=(text, title))


def frames(renderer: Renderer, drive: Recording, fps: float, title: str = "") -> Iterator[np.ndarray]:
    """Pictures uint8 [h, w, 3] of a whole drive: as many as it lasts seconds times `fps`, and one at least."""
    for k in range(max(1, round(drive.seconds * fps))):
        yield picture(renderer, drive, k / fps, title)


class Filming:
    """A process that films the first SECONDS of a champion's drive."""

    def __init__(
        self, champion: str | os.PathLike[str], seed: int, start: np.ndarray, world: np.ndarray,
        film: str | os.PathLike[str], title: str,
    ):  # fmt: skip
        """Begin to film the champion of a file on its scenario's map of a seed; `start` and `world` are `record`'s."""
        self._film, self._failure = Path(film), ""
        self._process: subprocess.Popen[bytes] | None = None
        place = io.BytesIO()
        np.savez(place, start=start, world=world)
        command = [sys.executable, "-P", "-m", "cluster.report.film", str(champion), str(seed), str(film), title]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is ours to handle
            )
            assert self._process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # it says why it left
                self._process.stdin.write(place.getvalue())
                self._process.stdin.close()
        except OSError as error:
            self._failure = f"no process can be started: {error.strerror or error}"

    def wait(self, on_progress: Callable[[str, int, int], None] | None = None) -> None:
        """Wait for its end. Raises VideoError with one line where there is no film."""
        if self._process is None or self._process.stdout is None:
            raise VideoError(self._failure)
        said = ""
        for line in self._process.stdout:
            words = line.decode(errors="replace").strip()
            done, _, total = words.partition(" of ")
            if done.isdecimal() and total.isdecimal():
                if on_progress:
                    on_progress(self._film.name, int(done), int(total))
            elif words:
                said = words
        if code := self._process.wait():
            raise VideoError(said if said and code > 0 else f"its process ended with {code}")

    def stop(self) -> None:
        """End it and its ffmpeg, if it still goes on; it leaves nothing then."""
        if self._process is None:
            return
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        with contextlib.suppress(OSError):
            _temporary(self._film, self._process.pid).unlink()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


def film_champion(champion: str, seed: int, film: str, title: str, place: bytes) -> None:
    """What that process does. Raises VideoError, CheckpointError."""
    loaded = load_champion(champion)
    with np.load(io.BytesIO(place), allow_pickle=False) as given:
        scenario = build(loaded.scenario, seed, loaded.sim)
        drive = record(loaded, scenario, given["start"], SECONDS, given["world"])
    renderer = Renderer(scenario, SIZE, config=loaded.sim)
    total = max(1, round(drive.seconds * FPS))

    def counted() -> Iterator[np.ndarray]:
        for k, image in enumerate(frames(renderer, drive, FPS, title)):
            if k % FPS == 0:
                print(f"{k} of {total}", flush=True)
            yield image

    write_video(film, counted(), SIZE, FPS, apart=False)  # who stops us stops all of our session


def _temporary(path: Path, pid: int) -> Path:
    """Where a process writes a film until it is whole."""
    return path.with_name(f".{path.name}.{pid}.tmp")


def write_video(
    path: str | os.PathLike[str], pictures: Iterator[np.ndarray], size: tuple[int, int], fps: float, apart: bool = True
) -> int:
    """Write pictures uint8 [h, w, 3] as H.264 in an MP4, or as a GIF, by the path's suffix; whole or not at all.

    Args: whether ffmpeg is in a session of its own, where Ctrl-C does not reach it.
    Returns: how many there were. Raises: VideoError with one line; a file that was there before is then kept.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise VideoError(f"{path}: a film is written as .mp4 or .gif, not {suffix or 'without a suffix'}")
    if size[0] % 2 or size[1] % 2:
        raise VideoError(f"a film's sides must be even, not {size[0]} x {size[1]}")
    temporary = _temporary(path, os.getpid())
    if suffix == ".gif":
        one_palette = "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
        coding = ["-filter_complex", one_palette, "-f", "gif"]
    else:
        # Flat colours compress well: some 3 MB a minute. The index in front lets a browser begin at once.
        coding = ["-c:v", "libx264", "-preset", "superfast", "-crf", "25", "-pix_fmt", "yuv420p"]
        coding += ["-movflags", "+faststart", "-f", "mp4"]
    try:
        try:
            temporary.touch()  # what is wrong with the place is said better here than by ffmpeg
            count = _encode(temporary, pictures, size, fps, coding, apart)
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise VideoError(f"{path}: cannot be written: {error.strerror or error}") from error
    return count


def _encode(
    path: Path, pictures: Iterator[np.ndarray], size: tuple[int, int], fps: float, coding: list[str], apart: bool
) -> int:  # fmt: skip
    """Pipe pictures through ffmpeg. Raises VideoError where there is none or it fails."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise VideoError("there is no ffmpeg here; install one, or name it with IMAGEIO_FFMPEG_EXE") from error
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}", "-i", "-"]
    try:
        process = subprocess.Popen(
            [program, "-y", "-v", "error", *raw, "-an", *coding, str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=apart,  # Ctrl-C is ours to handle
        )
    except OSError as error:
        raise VideoError(f"ffmpeg cannot be started: {program}: {error.strerror or error}") from error
    assert process.stdin is not None
    assert process.stderr is not None
    count = 0
    try:
        for image in pictures:
            try:
                process.stdin.write(np.ascontiguousarray(image).data)
            except BrokenPipeError:  # ffmpeg says below why it left
                break
            count += 1
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        message = process.stderr.read().decode(errors="replace").strip()
        if process.wait() != 0:
            raise VideoError(f"ffmpeg failed: {message.splitlines()[-1][:160] if message else process.returncode}")
        return count
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        for pipe in (process.stdin, process.stderr):
            with contextlib.suppress(OSError):
                pipe.close()


if __name__ == "__main__":
    try:
        film_champion(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4], sys.stdin.buffer.read())
    except (VideoError, CheckpointError, ValueError, OSError) as error:  # a map file may be another one by now
        sys.exit(" ".join(str(error).split()))
