"""Manual driving: a person drives in a window; drives are recorded as CSV files, read and replayed.

A row is a control step: the car's pose before it, and the action taken. So a file is a list of (state, action) pairs
to learn from. Replaying its actions gives the same poses, bit for bit.
"""

from __future__ import annotations

import csv
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gridsim.car.vehicle import Action
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.map import Map
from gridsim.maps.parts import seed_of_map
from gridsim.maps.scenarios import check_name
from gridsim.simulator import Simulator
from gridsim.state import DISTANCE, LANE, SPEED, STEPS, End, X, Y, poses_of
from gridsim.traffic.world import spawn
from gridsim.view.render import Renderer, Window, interpolate

# The columns of a recorded drive: the time is since the episode's start, and a restart begins the next episode.
_POSE = ("x_m", "y_m", "heading_rad", "speed_mps", "steering_rad")
COLUMNS = ("time_s", *_POSE, "action", "episode", "traffic", "scenario", "map_seed", "sim")
MAX_TRAFFIC = 1000  # other cars in a recorded drive that is read, at most
LIMITS = (262_144.0, 262_144.0, 100.0, 200.0, 3.2)  # m, m, rad, m/s, rad: the most that is read in a pose, either sign
FPS = 30  # pictures a second in the window, roughly; but at least one for each control step
STANDING = 0.05  # m/s, below which the down key reverses and no longer brakes
_ENDLESS = 10_000_000  # control steps
_PATIENCE = 1e6  # s

HELP = "arrows drive   space brakes   R restarts   Esc ends"


@dataclass(frozen=True)
class Drive:
    """A recorded drive: n control steps on one map.

    The map, the episode and its first pose determine where the other cars begin.
    """

    scenario: str
    map_seed: int
    traffic: int  # number of other cars
    episodes: np.ndarray  # int64 [n], counted from 0; each begins at the pose of its first row
    poses: np.ndarray  # float32 [n, 5]: x, y (m), heading (rad), speed (m/s), steering (rad) before each step
    actions: np.ndarray  # int64 [n]
    sim: str  # what `SimConfig.load` takes

    def __len__(self) -> int:
        return len(self.actions)


def manual(config: SimConfig, traffic: int = 0) -> Simulator:
    """A simulator of one car in traffic, whose episode ends only with a collision."""
    config = replace(config, episode=replace(config.episode, patience=_PATIENCE))
    return Simulator(1, config, target=math.inf, max_steps=_ENDLESS, traffic=traffic)


def _begin(simulator: Simulator, road_map: Map, start: np.ndarray, episode: int) -> None:
    """Begin an episode at start float32 [5], in traffic drawn with the map's seed and the episode's number."""
    seed = seed_of_map(road_map.name, road_map.seed)  # a file is read again by its own name, not as one of a folder
    key = np.random.SeedSequence([seed, episode, *b"drive"]).generate_state(1, np.uint64)
    worlds = spawn(road_map.network, start[None], simulator.worlds.shape[1], key, simulator.config)
    simulator.reset(road_map, start[None], worlds=worlds)


def action_for(keys: set[str], speed: float) -> Action:
    """The action for the held keys (named as in "up"), at a speed in m/s.

    Braking and reversing exclude steering. Space brakes; down brakes, and reverses once the car stands. Left and right
    cancel each other.
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
    """Writes a drive to a new file row by row, so that an interrupted drive is kept, too."""

    def __init__(self, path: str | os.PathLike[str], road_map: Map, traffic: int = 0, sim: str = "default"):
        """Create the file; `sim` as in Drive. Raises: GridSimError if it exists or cannot be created."""
        self._map = (traffic, road_map.name, road_map.seed, sim)
        self._period = SimConfig.load(sim).episode.control_period
        self.path, self.rows = Path(path), 0
        try:
            self._file = open(path, "x", newline="", encoding="utf-8", buffering=1)  # noqa: SIM115, closed by close()
        except FileExistsError:
            raise GridSimError(f"{path} exists already; name another file") from None
        except OSError as error:
            raise GridSimError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(COLUMNS)

    def write(self, step: int, pose: np.ndarray, action: int, episode: int) -> None:
        """Write one row: an action, and the control steps since the episode's start and the pose float32 [5] before it.

        Raises: GridSimError.
        """
        # Nine digits represent a float32 exactly.
        numbers = [f"{value:.9g}" for value in (round(step * self._period, 6), *pose.tolist())]
        try:
            self._writer.writerow([*numbers, int(action), episode, *self._map])
        except OSError as error:
            raise GridSimError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        self.rows += 1

    def close(self) -> None:
        self._file.close()


def read_drive(path: str | os.PathLike[str]) -> Drive:
    """Read a drive that `gridsim-drive --record` wrote. Raises: GridSimError that names the first problem."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, restval="", strict=True)
            try:
                return _drive_of(reader)
            except (csv.Error, ValueError) as error:
                place = f"{path}, line {max(reader.line_num, 1)}"
                raise GridSimError(f"{place}: not a recorded drive, or incomplete: {str(error)[:200]}") from error
    except OSError as error:
        raise GridSimError(f"{path}: cannot be read: {error.strerror or error}") from error


def _drive_of(reader: csv.DictReader[str]) -> Drive:
    """The drive of a file's rows. Raises: ValueError or csv.Error at the first one that does not fit."""
    if reader.fieldnames not in (
        [*COLUMNS],
        [*COLUMNS[:-1]],
    ):  # without `sim`, as earlier versions wrote it: the default car
        raise ValueError(f"the first line must be {','.join(COLUMNS)}")
    poses: list[list[float]] = []
    actions: list[int] = []
    episodes = [-1]
    roads: set[tuple[str, int, int, str]] = set()
    period = 0.0
    steps = 0  # since the episode's start
    for row in reader:
        time, *pose = (float(row[name]) for name in COLUMNS[:6])
        poses.append(pose)
        action, episode, traffic, seed = (int(row[name]) for name in ("action", "episode", "traffic", "map_seed"))
        roads.add((row["scenario"], seed, traffic, row.get("sim", "default")))
        if not period:
            check_name(row["scenario"])
            period = SimConfig.load(row.get("sim", "default")).episode.control_period
        steps = steps + 1 if episode == episodes[-1] else 0
        for fits, text in (
            (None not in row, f"it has more than {len(COLUMNS)} columns"),
            (all(abs(value) <= limit for value, limit in zip(pose, LIMITS, strict=True)), "its pose is out of range"),
            (0 <= action < len(Action), f"action must be 0 to {len(Action) - 1}"),
            (episode in (max(episodes[-1], 0), episodes[-1] + 1), "its episode does not follow the one before"),
            (abs(time - steps * period) < period / 2, f"time_s must be {steps * period:g}; rows missing or doubled?"),
            (0 <= traffic <= MAX_TRAFFIC, f"traffic must be 0 to {MAX_TRAFFIC} cars"),
            (0 <= seed < 1 << 63, "map_seed must be 0 or more, and fit 63 bits"),
            (len(roads) == 1, "traffic, scenario, map_seed and sim must be the same in all rows"),
        ):
            if not fits:
                raise ValueError(text)
        actions.append(action)
        episodes.append(episode)
    if not poses:
        raise ValueError("it has no rows; nothing was driven")
    ((scenario, seed, traffic, sim),) = roads
    poses_, actions_ = np.array(poses, np.float32), np.array(actions)
    return Drive(scenario, seed, traffic, np.array(episodes[1:]), poses_, actions_, sim)


def replay(drive: Drive, road_map: Map) -> tuple[np.ndarray, ...]:
    """Replay a recorded drive by its actions.

    Returns: (poses float32 [n, 5], as in `drive.poses`; states float32 [n, CAR_FIELDS]; ranges float32 [n, rays] in m;
    the traffic float32 [n, others, TRAFFIC_FIELDS]).
    Raises: GridSimError if an episode ends too early, which means that the map is another one.
    """
    simulator, n, rows = manual(SimConfig.load(drive.sim), drive.traffic), len(drive), []
    begins = np.diff(drive.episodes, prepend=-1) != 0
    for k in range(n):
        if begins[k]:
            _begin(simulator, road_map, drive.poses[k], int(drive.episodes[k]))
        else:
            simulator.step(drive.actions[k - 1 : k])
            if simulator.ends[0] != End.RUNNING:
                raise GridSimError(f"the replay ends at row {k} of {n}: the drive was recorded on another map")
        rows.append((simulator.cars[0].copy(), simulator.ranges[0].copy(), simulator.worlds[0].copy()))
    cars, views, worlds = (np.stack(column) for column in zip(*rows, strict=True))
    return np.where(begins[:, None], drive.poses, poses_of(cars)), cars, views, worlds


def drive(
    road_map: Map,
    start: np.ndarray,
    window: Window,
    renderer: Renderer,
    recorder: Recorder | None = None,
    seconds: float = math.inf,
    traffic: int = 0,
    config: SimConfig | None = None,
) -> dict[str, float]:
    """Let a person drive in real time until Esc, Q or the window's closing, or for `seconds` of simulated time.

    Args: start float32 [5]: x, y (m), heading (rad), speed (m/s), steering (rad); `config`, by default the renderer's.
    Returns: seconds driven, episodes, and distance_m of new ground in the best of them. Raises: GridSimError.
    """
    simulator = manual(config or renderer.config, traffic)
    period = renderer.config.episode.control_period
    pictures = max(round(period * FPS), 1)  # per control step
    title = f"{road_map.name}, map {road_map.seed:,}    {HELP}"
    episode, steps, best = 0, 0, 0.0
    _begin(simulator, road_map, start, 0)
    path = [start[:2].copy()]
    while True:
        pressed, held = window.keys()
        if window.closed or pressed & {"escape", "q"} or steps * period >= seconds:
            return {"seconds": steps * period, "episodes": episode + 1, "distance_m": best}
        if "r" in pressed:
            if simulator.cars[0, STEPS] > 0:
                episode += 1
            _begin(simulator, road_map, start, episode)
            path = [start[:2].copy()]
        before, view, there = simulator.cars[0].copy(), simulator.ranges[0].copy(), simulator.worlds[0].copy()
        ended = simulator.ends[0] != End.RUNNING
        if not ended:
            step = int(before[STEPS])
            action = action_for(held, float(before[SPEED]))
            if recorder is not None:
                recorder.write(step, start if step == 0 else poses_of(before), action, episode)
            simulator.step(np.array([int(action)]))
            steps += 1
        after, then = simulator.cars[0], simulator.worlds[0]
        present = then[:, LANE] >= 0.0  # traffic may have taken a car away (`config.GRIDLOCK`)
        best = max(best, float(after[DISTANCE]))
        for k in range(1, pictures + 1):
            part = k / pictures
            car = interpolate(before, after, part, road_map)
            text = f"{car[SPEED]:.1f} m/s    {car[DISTANCE]:,.0f} m    {car[STEPS] * period:.1f} s"
            if ended:
                text += "    collision: R restarts"
            trace = np.array([*path, car[[X, Y]]])
            image = renderer.draw(
                car, boxes=interpolate(there[present], then[present], part, road_map),
                ranges=view + np.float32(part) * (simulator.ranges[0] - view), path=trace, text=(text, title),
            )  # fmt: skip
            window.show(image, pictures / period)
        path.append(after[[X, Y]].copy())
