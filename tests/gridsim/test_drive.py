"""A person's drive: keys to actions, the recorded file and its replay, and a real window driven by real key events."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from commands import call

from cluster.commands.watch import drive_main
from gridsim.car.ego import End
from gridsim.car.vehicle import Action
from gridsim.errors import GridSimError
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.view.drive import (
    COLUMNS,
    Recorder,
    action_for,
    manual,
    poses_of,
    read_drive,
    replay,
)

COMMAND = [sys.executable, "-c", "from cluster.commands.entry import drive_main; drive_main()"]


@pytest.fixture(scope="module")
def scenario():
    return build("seamless", 11)


@pytest.fixture(scope="module")
def recorded(scenario, tmp_path_factory):
    """A file of two episodes, driven by random keys: (path, states in it)."""
    path = tmp_path_factory.mktemp("drive") / "drive.csv"
    rng = np.random.default_rng(0)
    start = sample_starts(scenario, 1, rng)[0]
    simulator = manual(scenario)
    poses = []
    with closing(Recorder(path, scenario, 0.1)) as recorder:
        for episode in range(2):
            simulator.reset(start[None])
            for step in range(60):
                here = start if step == 0 else poses_of(simulator.state.cars[0])
                action = int(rng.choice([0, 0, 1, 2, 3, 4, 5, 6, 7]))
                recorder.write(step, here, action, episode)
                poses.append(here)
                _, _, _, ends = simulator.step(np.array([action]))
                if ends[0] != End.RUNNING:
                    break
    return path, np.array(poses)


@pytest.mark.parametrize(
    ("keys", "speed", "action"),
    [
        ("a f1", 5.0, Action.NONE),
        ("up", 5.0, Action.ACCELERATE),
        ("left", 5.0, Action.LEFT),
        ("right", 5.0, Action.RIGHT),
        ("up left", 5.0, Action.ACCELERATE_LEFT),
        ("up right", 5.0, Action.ACCELERATE_RIGHT),
        ("left right", 5.0, Action.NONE),
        ("up left right", 5.0, Action.ACCELERATE),
        ("down", 5.0, Action.BRAKE),
        ("down", 0.0, Action.REVERSE),
        ("down", -2.0, Action.REVERSE),
        ("space", 0.0, Action.BRAKE),
        ("up space left", 5.0, Action.BRAKE),
    ],
)
def test_keys_are_the_eight_actions(keys, speed, action):
    assert action_for(set(keys.split()), speed) == action


def test_recorded_drive_replays_to_the_same_poses(scenario, recorded):
    path, poses = recorded
    drive = read_drive(path)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert COLUMNS[:7] == ("time_s", "x_m", "y_m", "heading_rad", "speed_mps", "steering_rad", "action")
    assert [row["time_s"] for row in rows[:12]] == [f"{k / 10:g}" for k in range(12)]
    assert (drive.scenario, drive.map_seed, len(drive), len(rows)) == ("seamless", 11, len(poses), len(poses))
    assert set(drive.episodes.tolist()) == {0, 1}
    assert drive.poses.tobytes() == poses.tobytes()  # nine digits lose nothing
    again, cars, ranges, _ = replay(drive, build(drive.scenario, drive.map_seed))
    assert again.tobytes() == poses.tobytes()
    assert np.ptp(again[:, 0]) > 1.0
    assert (len(cars), len(ranges)) == (len(poses), len(poses))


def test_recorder_overwrites_nothing(scenario, recorded, tmp_path):
    before = recorded[0].read_bytes()
    with pytest.raises(GridSimError, match="exists already"):
        Recorder(recorded[0], scenario, 0.1)
    assert recorded[0].read_bytes() == before
    with pytest.raises(GridSimError, match="cannot be written"):
        Recorder(tmp_path / "nowhere" / "drive.csv", scenario, 0.1)


DAMAGES = {
    "cut off": (lambda text: text[: len(text) // 2 - 3], "or incomplete: "),
    "header only": (lambda text: text.splitlines()[0] + "\n", "no rows"),
    "other table": (lambda text: "a,b\n1,2\n", "line 1: not a recorded drive, or incomplete: the first line must be"),
    "not a number": (lambda text: _edit(text, 3, "x_m", "nan"), "line 5: "),
    "action 8": (lambda text: _edit(text, 3, "action", "8"), "action must be 0 to 7"),
    "skipped episode": (lambda text: _edit(text, 3, "episode", "2"), "episode"),
    "a seed of 64 bits": (lambda text: _edit(text, 0, "map_seed", str(1 << 63)), "map_seed must be"),
    "two maps": (lambda text: _edit(text, 3, "map_seed", "4"), "same in all rows"),
    "unknown scenario": (lambda text: text.replace("seamless", "moon"), "unknown scenario"),
    "no text": (lambda text: b"\xff\xfe\x00binary", "can't decode"),
}


def _edit(text, row, column, value):
    """One field of a data row, changed."""
    lines = text.splitlines()
    fields = lines[row + 1].split(",")
    fields[COLUMNS.index(column)] = value
    lines[row + 1] = ",".join(fields)
    return "\n".join(lines) + "\n"


def test_a_missing_file_is_one_clear_line(tmp_path):
    for path in (tmp_path / "nothing.csv", tmp_path):
        with pytest.raises(GridSimError, match="cannot be read"):
            read_drive(path)


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_file_is_one_clear_line(recorded, tmp_path, name):
    change, expected = DAMAGES[name]
    damaged = change(recorded[0].read_text())
    path = tmp_path / "drive.csv"
    path.write_bytes(damaged if isinstance(damaged, bytes) else damaged.encode())
    with pytest.raises(GridSimError) as error:
        read_drive(path)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


@pytest.fixture
def display(tmp_path):
    """An X server without a screen."""
    missing = [name for name in ("Xvfb", "xdotool") if not shutil.which(name)]
    if missing:
        pytest.skip(f"needs {' and '.join(missing)} (Debian: apt install xvfb xdotool)")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24", "-nolisten", "tcp"],
        pass_fds=[write],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as file:
            number = file.readline().strip()
        assert number, "Xvfb did not start"
        yield f":{number}"
    finally:
        server.terminate()
        server.wait(10)


def start_driving(display, folder, *arguments):
    """gridsim-drive in a window on that display, once the window is there: (process, how to press keys)."""
    environment = {**os.environ, "DISPLAY": display}
    environment.pop("SDL_VIDEODRIVER", None)
    process = subprocess.Popen(
        [*COMMAND, "--scenario", "seamless", "--seed", "11", "--size", "320x240", *arguments],
        cwd=folder,
        env={**environment, "PYTHONPATH": str(Path(__file__).parents[2])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )

    def keys(*words):
        return subprocess.run(["xdotool", *words], env=environment, capture_output=True, text=True, check=False)

    end = time.monotonic() + 120
    while True:
        for found in keys("search", "--class", "").stdout.split():
            if keys("getwindowname", found).stdout.startswith("GridSim"):
                keys("windowfocus", "--sync", found)
                return process, keys
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.1)


def wait_for_rows(path, count, process):
    end = time.monotonic() + 60
    while not path.exists() or path.read_text().count("\n") <= count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.e2e
def test_real_keys_drive_a_real_window(display, tmp_path):
    path = tmp_path / "drive.csv"
    process, keys = start_driving(display, tmp_path, "--record", "drive.csv")
    try:
        wait_for_rows(path, 3, process)
        began, rows = time.monotonic(), path.read_text().count("\n")
        keys("keydown", "Up")
        wait_for_rows(path, rows + 12, process)
        keys("keydown", "Left")
        wait_for_rows(path, rows + 15, process)
        keys("keyup", "Left", "keyup", "Up", "keydown", "space")
        wait_for_rows(path, rows + 18, process)
        keys("keyup", "space")
        wait_for_rows(path, rows + 30, process)
        took = time.monotonic() - began
        keys("key", "r")
        wait_for_rows(path, rows + 34, process)
        keys("key", "Escape")
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert err == ""
    assert "gridsim-watch drive.csv" in out
    drive = read_drive(path)
    own = drive.actions[drive.episodes == 0].tolist()
    assert own[:3] == [Action.NONE] * 3
    pressed = [Action(a) for a, before in zip(own, [None, *own], strict=False) if a != before]
    assert pressed[:3] == [Action.NONE, Action.ACCELERATE, Action.ACCELERATE_LEFT]
    assert Action.BRAKE in pressed
    assert drive.episodes[-1] == 1  # R began anew, where the first one began
    assert drive.poses[drive.episodes == 1][0].tobytes() == drive.poses[0].tobytes()
    assert took > 2.7  # 30 steps of 0.1 s at true speed (a slow machine may take longer)
    again, *_ = replay(drive, build("seamless", 11))
    assert again.tobytes() == drive.poses.tobytes()


@pytest.mark.e2e
def test_ctrl_c_keeps_the_drive(display, tmp_path):
    process, _ = start_driving(display, tmp_path, "--record", "drive.csv")
    try:
        wait_for_rows(tmp_path / "drive.csv", 5, process)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "Traceback" not in out + err
    assert len(read_drive(tmp_path / "drive.csv")) >= 5


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Calls gridsim-drive in an empty folder, which refuses it: what it says."""
    monkeypatch.chdir(tmp_path)

    def said(*arguments):
        code, out, err = call(drive_main, monkeypatch, capsys, *arguments)
        assert (code, out) == (2, "")
        assert err.startswith("gridsim-drive: error: ")
        assert err.count("\n") <= 3
        return err

    return said


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is always a display")
def test_without_a_display_it_says_so_and_makes_no_file(refused, monkeypatch, tmp_path):
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(variable, raising=False)
    assert "DISPLAY" in refused("--record", "drive.csv")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("dummy")
def test_wrong_flags_and_an_existing_file(refused, tmp_path):
    (tmp_path / "drive.csv").write_text("mine")
    assert "exists already" in refused("--record", "drive.csv")
    assert (tmp_path / "drive.csv").read_text() == "mine"
    assert "--size" in refused("--size", "big")
    assert "unknown scenario" in refused("--scenario", "moon")
