"""Films: a champion's drive, kept state by state, drawn picture by picture, written as MP4 or GIF at true speed."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster.champion import Champion
from evolution.policy import PolicySpec
from evolution.rollout import Limits, trajectory
from gridsim.ego import DISTANCE, SPEED, End, X, Y
from gridsim.render import Renderer, between
from gridsim.scenarios import Scenario
from gridsim.simulator import views
from gridsim.world import LANE

SUFFIXES = (".mp4", ".gif")
SIZE, FPS, SECONDS = (640, 360), 15, 60.0  # of champion.mp4, which a run waits for: a few seconds of one core


class VideoError(Exception):
    """A film that cannot be written; the message is one line for the user."""


@dataclass(frozen=True)
class Recording:
    """A drive, state by state, from its start on.

    Attributes:
        scenario: the map.
        cars: float32 [steps + 1, FIELDS], the car's states (`gridsim.ego`).
        ranges: float32 [steps + 1, rays], what its rays say, m.
        boxes: float32 [steps + 1, others, 4 or more], other cars: x, y (m), heading (cosine, sine).
        end: how it ended; RUNNING where the recording did.
        period: s from state to state.
    """

    scenario: Scenario
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
    champion: Champion, scenario: Scenario, start: np.ndarray, seconds: float, world: np.ndarray | None = None
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
    car = between(drive.cars[k], drive.cars[following], part, drive.scenario)
    boxes = between(drive.boxes[k], drive.boxes[following], part, drive.scenario) if drive.boxes.shape[1] else None
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


def champion_video(
    champion: Champion,
    scenario: Scenario,
    start: np.ndarray,
    path: str | os.PathLike[str],
    title: str,
    on_progress: Callable[[str, int, int], None] | None = None,
    world: np.ndarray | None = None,
) -> Recording:
    """Film the first SECONDS of a champion's drive, which begins as `record`'s. Raises VideoError with one line."""
    drive = record(champion, scenario, start, SECONDS, world)
    renderer = Renderer(scenario, SIZE, config=champion.sim)
    total = max(1, round(drive.seconds * FPS))

    def counted() -> Iterator[np.ndarray]:
        for k, image in enumerate(frames(renderer, drive, FPS, title)):
            if on_progress and k % FPS == 0:
                on_progress(Path(path).name, k, total)
            yield image

    write_video(path, counted(), SIZE, FPS)
    return drive


def write_video(path: str | os.PathLike[str], pictures: Iterator[np.ndarray], size: tuple[int, int], fps: float) -> int:
    """Write pictures uint8 [h, w, 3] as H.264 in an MP4, or as a GIF, by the path's suffix; whole or not at all.

    Returns: how many there were. Raises: VideoError with one line; a file that was there before is then kept.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise VideoError(f"{path}: a film is written as .mp4 or .gif, not {suffix or 'without a suffix'}")
    if size[0] % 2 or size[1] % 2:
        raise VideoError(f"a film's sides must be even, not {size[0]} x {size[1]}")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
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
            count = _encode(temporary, pictures, size, fps, coding)
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise VideoError(f"{path}: cannot be written: {error.strerror or error}") from error
    return count


def _encode(
    path: Path, pictures: Iterator[np.ndarray], size: tuple[int, int], fps: float, coding: list[str]
) -> int:  # fmt: skip
    """Pipe pictures through ffmpeg. Raises VideoError where there is none or it fails."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise VideoError("there is no ffmpeg here; install one, or name it with IMAGEIO_FFMPEG_EXE") from error
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}", "-i", "-"]
    process = subprocess.Popen(
        [program, "-y", "-v", "error", *raw, "-an", *coding, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is ours to handle
    )
    assert process.stdin is not None
    assert process.stderr is not None
    count = 0
    try:
        with contextlib.suppress(BrokenPipeError):  # ffmpeg says below why it left
            for image in pictures:
                process.stdin.write(np.ascontiguousarray(image).data)
                count += 1
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
