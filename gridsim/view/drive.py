"""Manual driving: a person drives in a window; drives are recorded as CSV files, read and replayed.

A row is a control step: the car's state, and the action taken. So a file is a list of (state, action) pairs to learn
from. Replaying its actions gives the same poses, bit for bit.
"""

from __future__ import annotations

import csv
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gridsim.car.ego import COS, DISTANCE, SIN, SPEED, STEERING, STEPS, End, X, Y
from gridsim.car.vehicle import Action
from gridsim.config import EpisodeConfig, SimConfig
from gridsim.envs.simulator import Simulator
from gridsim.errors import GridSimError
from gridsim.maps.map import Map
from gridsim.maps.scenarios import check_name
from gridsim.traffic.world import LANE
from gridsim.view.render import Renderer, Window, interpolate

#: The columns of a recorded drive, and what their numbers are within; whole numbers are from 0.
_LIMITS: dict[str, float] = {
    "time_s": 1e7,  # since the episode's start
    "x_m": 1e5,
    "y_m": 1e5,
    "heading_rad": 100.0,
    "speed_mps": 200.0,
    "steering_rad": 3.2,
    "action": len(Action) - 1,
    "episode": 1 << 31,  # which one of the file: a restart begins the next one
    "traffic": 1000,  # other cars
    "scenario": math.nan,  # a name
    "map_seed": (1 << 63) - 1,
}
COLUMNS = tuple(_LIMITS)
MAX_BYTES = 1 << 28  # of a file that is read
FPS = 30  # pictures a second in the window
STANDING = 0.05  # m/s, below which the down key reverses and no longer brakes
_ENDLESS = 10_000_000  # control steps

HELP = "arrows drive   space brakes   R restarts   Esc ends"


class DriveError(GridSimError):
    """A recorded drive that cannot be written, read or replayed; the message is one line for the user."""


@dataclass(frozen=True)
class Drive:
    """A recorded drive; n control steps of one or more episodes on one map.

    Map and episode determine where the other cars begin.
    """

    scenario: str
    map_seed: int
    traffic: int  # number of other cars
    episodes: np.ndarray  # int64 [n], counted from 0; each begins at the pose of its first row
    poses: np.ndarray  # float32 [n, 5]: x, y (m), heading (rad), speed (m/s), steering (rad) before each step
    actions: np.ndarray  # int64 [n]

    def __len__(self) -> int:
        return len(self.actions)


def manual(road_map: Map, traffic: int = 0) -> Simulator:
    """A simulator of one car in traffic, whose episode ends only with a collision."""
    config = SimConfig(episode=EpisodeConfig(patience=_ENDLESS))
    return Simulator([road_map], 1, config, target=math.inf, max_steps=_ENDLESS, traffic=traffic)


def _key(road_map: Map, episode: int) -> int:
    """The key from which an episode's traffic is spawned."""
    return int(np.random.SeedSequence([road_map.seed, episode, *b"drive"]).generate_state(1, np.uint64)[0])


def poses_of(states: np.ndarray) -> np.ndarray:
    """Poses float32 [..., 5] of states [..., FIELDS]: x, y (m), heading (rad), speed (m/s), steering (rad)."""
    poses = states[..., [X, Y, SIN, SPEED, STEERING]]
    poses[..., 2] = np.arctan2(states[..., SIN], states[..., COS])
    return poses


def action_for(keys: set[str], speed: float) -> Action:
    """The action for the keys that are held (named as in "up"), at a speed in m/s.

    Braking has priority, left and right cancel each other, and down reverses once the car stands.
    """
    if "space" in keys or ("down" in keys and speed > STANDING):
        return Action.BRAKE
    if "down" in keys:
        return Action.REVERSE
    turn = ("left" in keys) - ("right" in keys)
    if "up" in keys:
        return (Action.ACCELERATE, Action.ACCELERATE_LEFT, Action.ACCELERATE_RIGHT)[turn]
    return (Action.NONE, Action.LEFT, Action.RIGHT)[turn]


class Recorder:
    """Writes a drive to a new file row by row, so that an interrupted drive is kept too."""

    def __init__(self, path: str | os.PathLike[str], road_map: Map, period: float, traffic: int = 0):
        """Create the file. Raises: DriveError with one line if it exists or cannot be created."""
        self._map = (traffic, road_map.name, road_map.seed)
        self._period = period
        self.path, self.rows = Path(path), 0
        try:
            self._file = open(path, "x", newline="", encoding="utf-8", buffering=1)  # noqa: SIM115, closed by close()
        except FileExistsError:
            raise DriveError(f"{path} exists already; name another file") from None
        except OSError as error:
            raise DriveError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(COLUMNS)

    def write(self, step: int, pose: np.ndarray, action: int, episode: int) -> None:
        """Write one row: control steps since the episode's start; pose float32 [5]. Raises DriveError."""
        # Nine digits represent a float32 exactly.
        numbers = [f"{value:.9g}" for value in (round(step * self._period, 6), *pose.tolist())]
        try:
            self._writer.writerow([*numbers, int(action), episode, *self._map])
        except OSError as error:
            raise DriveError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        self.rows += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_drive(path: str | os.PathLike[str]) -> Drive:
    """Read a drive that `gridsim-drive --record` wrote.

    Raises: DriveError with one line that names the first problem and its place.
    """
    try:
        if os.stat(path).st_size > MAX_BYTES:
            raise DriveError(f"{path}: too large for a recorded drive")
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file, strict=True))
    except OSError as error:
        raise DriveError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DriveError(f"{path}: not a recorded drive: it is not a CSV file ({type(error).__name__})") from error
    if not rows or tuple(rows[0]) != COLUMNS:
        raise DriveError(f"{path}: not a recorded drive: its first line must be {','.join(COLUMNS)}")
    if len(rows) < 2:
        raise DriveError(f"{path}: nothing was driven: it has no rows")
    table: list[list[float]] = []
    for line, row in enumerate(rows[1:], start=2):
        try:
            if len(row) != len(COLUMNS):
                raise ValueError(f"it has {len(row)} columns, not {len(COLUMNS)}; was the file cut off?")
            table.append([_number(*pair) for pair in zip(COLUMNS, row, strict=True) if pair[0] != "scenario"])
            check_name(row[9][:1000])
            time, episode = table[-1][0], table[-1][7]
            before, last = (table[-2][0], table[-2][7]) if line > 2 else (0.0, -1)
            if episode not in (last, last + 1):
                raise ValueError(f"episode {episode} does not follow the one before")
            if (time <= before) if episode == last else (time != 0.0):
                raise ValueError(f"time_s {row[0]} does not follow the time before")
            if row[8:] != rows[1][8:]:
                raise ValueError("traffic, scenario and map_seed must be the same in all rows")
        except ValueError as error:
            raise DriveError(f"{path}, line {line}: {error}") from error
    traffic, seed = table[0][8:]
    poses = np.array([numbers[1:6] for numbers in table], dtype=np.float32)
    actions, episodes = np.array([numbers[6:8] for numbers in table], dtype=np.int64).T
    return Drive(rows[1][9], int(seed), int(traffic), episodes, poses, actions)


def _number(column: str, text: str) -> float:
    """The number in a column. Raises ValueError."""
    limit = _LIMITS[column]
    if isinstance(limit, int):
        if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= limit):
            raise ValueError(f"{column} is {text[:40]!r}, not a whole number from 0 to {limit}")
        return int(text)
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{column} is {text[:40]!r}, which is not a number") from None
    if not abs(value) <= limit:
        raise ValueError(f"{column} is {value:g}, which is outside the possible range")
    return value


def replay(drive: Drive, road_map: Map) -> tuple[np.ndarray, ...]:
    """Replay a recorded drive by its actions.

    Returns: (poses float32 [n, 5], as in `drive.poses`; states float32 [n, FIELDS]; ranges float32 [n, rays] in m; the
    traffic float32 [n, others, world.FIELDS]).
    Raises: DriveError with one line if an episode ends too early, which means that the map is another one.
    """
    simulator = manual(road_map, drive.traffic)
    n = len(drive)
    begins = np.diff(drive.episodes, prepend=-1) != 0
    rows = []
    for k in range(n):
        if begins[k]:
            ranges, _ = simulator.reset(drive.poses[k : k + 1], keys=_key(road_map, int(drive.episodes[k])))
        else:
            ranges, _, _, ends = simulator.step(drive.actions[k - 1 : k])
            if ends[0] != End.RUNNING:
                raise DriveError(f"replayed, the drive ends at row {k} of {n}: it was driven on another map")
        rows.append((simulator.state.cars[0].copy(), ranges[0].copy(), simulator.state.worlds[0].copy()))
    cars, views, worlds = (np.stack(column) for column in zip(*rows, strict=True))
    return np.where(begins[:, None], drive.poses, poses_of(cars)), cars, views, worlds


def _present(world: np.ndarray) -> np.ndarray:
    """The cars [n, world.FIELDS] of a world that are on a lane: a copy."""
    return world[world[:, LANE] >= 0.0]


def drive(
    road_map: Map,
    start: np.ndarray,
    window: Window,
    renderer: Renderer,
    recorder: Recorder | None = None,
    seconds: float = math.inf,
    traffic: int = 0,
) -> dict[str, float]:
    """Let a person drive in real time until the window is closed, or for `seconds` of simulated time.

    Args: start float32 [5]: x, y (m), heading (rad), speed (m/s), steering (rad).
    Returns: seconds driven, episodes, and distance_m of new ground in the best of them.
    Raises: DriveError with one line if the recording cannot be written.
    """
    simulator = manual(road_map, traffic)
    period = simulator.config.episode.control_period
    pictures = max(1, round(period * FPS))
    start = np.asarray(start, dtype=np.float32)
    title = f"{road_map.name}, map {road_map.seed:,}    {HELP}"
    episode, steps, best = 0, 0, 0.0
    ranges, _ = simulator.reset(start[None], keys=_key(road_map, 0))
    path = [start[:2].copy()]
    while True:
        pressed, held = window.keys()
        if window.closed or pressed & {"escape", "q"} or steps * period >= seconds:
            return {"seconds": steps * period, "episodes": episode + 1, "distance_m": best}
        if "r" in pressed:
            if simulator.state.cars[0, STEPS] > 0:
                episode += 1
            ranges, _ = simulator.reset(start[None], keys=_key(road_map, episode))
            path = [start[:2].copy()]
        before, view, there = simulator.state.cars[0].copy(), ranges[0], _present(simulator.state.worlds[0])
        ended = simulator.state.ends[0] != End.RUNNING
        if not ended:
            step = int(before[STEPS])
            action = action_for(held, float(before[SPEED]))
            if recorder is not None:
                recorder.write(step, start if step == 0 else poses_of(before), action, episode)
            ranges, _, _, _ = simulator.step(np.array([int(action)]))
            steps += 1
        after, then = simulator.state.cars[0], _present(simulator.state.worlds[0])
        best = max(best, float(after[DISTANCE]))
        for k in range(1, pictures + 1):
            part = k / pictures
            car = interpolate(before, after, part, road_map)
            text = f"{car[SPEED]:.1f} m/s    {car[DISTANCE]:,.0f} m    {car[STEPS] * period:.1f} s"
            if ended:
                text += "    collision: R restarts"
            trace = np.array([*path, car[[X, Y]]])
            image = renderer.draw(
                car, boxes=interpolate(there, then, part, road_map) if len(then) else None,
                ranges=view + np.float32(part) * (ranges[0] - view), path=trace, text=(text, title),
            )  # fmt: skip
            window.show(image, pictures / period)
        path.append(after[[X, Y]].copy())
