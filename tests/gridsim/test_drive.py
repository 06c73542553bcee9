"""A person's drive: keys to actions, the recorded file and its replay, and a real window driven by real key events."""

import contextlib
import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import finish, refused, running, wait_until
from pictures import record_drive

from cluster.commands.watch import drive_main
from gridsim.car.vehicle import Action
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.simulator import Simulator
from gridsim.state import LANE, X, Y
from gridsim.view.drive import COLUMNS, Recorder, action_for, drive, read_drive, replay


@pytest.fixture(scope="module")
def scenario():
    return build("seamless", 11)


@pytest.fixture(scope="module")
def recorded(scenario, tmp_path_factory):
    """A file of two episodes, driven by random keys: (path, states in it)."""
    path = tmp_path_factory.mktemp("drive") / "drive.csv"
    rng = np.random.default_rng(0)
    start = sample_starts(scenario, 1, rng)[0]
    return path, record_drive(path, scenario, start, rng.choice([0, 0, 1, 2, 3, 4, 5, 6, 7], (2, 60)).tolist())


KEYS = "up=ACCELERATE, left=LEFT, up left=ACCELERATE_LEFT, up right=ACCELERATE_RIGHT, down=BRAKE, space up=BRAKE"


def test_keys_are_the_eight_actions():
    for keys, _, action in (pair.partition("=") for pair in KEYS.split(", ")):
        assert action_for(set(keys.split()), 5.0) == Action[action], keys
    assert [action_for({key}, 0.0) for key in ("f1", "down", "space")] == [Action.NONE, Action.REVERSE, Action.BRAKE]


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
    again, *_ = replay(drive, build(drive.scenario, drive.map_seed))
    assert again.tobytes() == poses.tobytes()
    assert np.ptp(again[:, 0]) > 1.0


def test_a_drive_is_replayed_in_its_own_car_and_one_of_former_versions_in_the_default(scenario, recorded, tmp_path):
    small = build("curved", 3, SimConfig.load("f1tenth"))
    start = sample_starts(small, 1, np.random.default_rng(0))[0]
    poses = record_drive(tmp_path / "small.csv", small, start, [[0] * 8], sim="f1tenth")
    drive = read_drive(tmp_path / "small.csv")
    assert len(drive) == 8
    assert replay(drive, small)[0].tobytes() == poses.tobytes()
    rows = recorded[0].read_text().splitlines()
    (tmp_path / "old.csv").write_text("\n".join(row.rpartition(",")[0] for row in rows))
    assert replay(read_drive(tmp_path / "old.csv"), scenario)[0].tobytes() == recorded[1].tobytes()


def test_a_drive_that_is_begun_anew_in_traffic_replays_among_the_same_cars(scenario, tmp_path):
    shown: list[np.ndarray] = []
    pressed = iter([*[set()] * 5, {"r"}, *[set()] * 5, {"q"}])
    window: Any = SimpleNamespace(closed=False, keys=lambda: (next(pressed), {"up"}), show=lambda *_: None)
    renderer: Any = SimpleNamespace(config=SimConfig(), draw=lambda car, boxes, **_: shown.append(boxes))
    start = sample_starts(scenario, 1, np.random.default_rng(0))[0]
    with contextlib.closing(Recorder(tmp_path / "drive.csv", scenario, traffic=6)) as recorder:
        drive(scenario, start, window, renderer, recorder, traffic=6)
    recorded = read_drive(tmp_path / "drive.csv")
    assert recorded.episodes.tolist() == [0] * 5 + [1] * 6
    *_, worlds = replay(recorded, scenario)
    after = shown[len(shown) // len(recorded) - 1 :: len(shown) // len(recorded)]  # the last picture of each step
    for k in (0, 3, 5, 9):
        assert after[k][:, [X, Y]] == pytest.approx(worlds[k + 1][worlds[k + 1][:, LANE] >= 0][:, [X, Y]], abs=1e-3)
    assert np.abs(worlds[0] - worlds[5]).max() > 1.0, "other cars than at first"


def test_a_car_that_traffic_takes_away_is_no_longer_shown(scenario, monkeypatch):
    """As after a minute in which the person's car blocks a junction."""
    step = Simulator.step

    def without_the_first(simulator, actions):
        step(simulator, actions)
        simulator.worlds[0, 0, LANE] = -1.0

    monkeypatch.setattr(Simulator, "step", without_the_first)
    shown: list[np.ndarray] = []
    pressed = iter([set(), set(), {"q"}])
    window: Any = SimpleNamespace(closed=False, keys=lambda: (next(pressed), {"up"}), show=lambda *_: None)
    renderer: Any = SimpleNamespace(config=SimConfig(), draw=lambda car, boxes, **_: shown.append(boxes))
    drive(scenario, sample_starts(scenario, 1, np.random.default_rng(0))[0], window, renderer, traffic=6)
    assert {len(boxes) for boxes in shown} == {5}


DAMAGES = {
    "cut off": (lambda text: text[: len(text) // 2 - 3], "or incomplete: "),
    "header only": (lambda text: text.splitlines()[0] + "\n", "no rows"),
    "other table": (lambda text: "a,b\n1,2\n", "line 1: not a recorded drive, or incomplete: the first line must be"),
    "not a number": (lambda text: _edit(text, 3, "x_m", "nan"), "line 5: "),
    "a row left out": (lambda text: text.replace(text.splitlines(True)[2], ""), "time_s must be 0.1; rows missing"),
    "faster than any car": (lambda text: _edit(text, 3, "speed_mps", "5000"), "line 5: .* pose is out of range"),
    "action 8": (lambda text: _edit(text, 3, "action", "8"), "action must be 0 to 7"),
    "skipped episode": (lambda text: _edit(text, 3, "episode", "2"), "episode"),
    "two maps": (lambda text: _edit(text, 3, "map_seed", "4"), "same in all rows"),
    "unknown scenario": (lambda text: text.replace("seamless", "moon"), "unknown scenario"),
    "no text": (lambda text: b"\xff\xfe\x00binary", "can't decode"),
}


def _edit(text, row, column, value):
    rows = [line.split(",") for line in text.splitlines()]
    rows[row + 1][COLUMNS.index(column)] = value
    return "".join(",".join(fields) + "\n" for fields in rows)


@pytest.mark.parametrize(("change", "expected"), DAMAGES.values(), ids=DAMAGES)
def test_damaged_file_is_one_clear_line(recorded, tmp_path, change, expected):
    damaged, path = change(recorded[0].read_text()), tmp_path / "drive.csv"
    with pytest.raises(GridSimError, match="cannot be read: No such file"):
        read_drive(path)
    path.write_bytes(damaged if isinstance(damaged, bytes) else damaged.encode())
    with pytest.raises(GridSimError, match=rf"^[^\n]*{expected}[^\n]*$"):
        read_drive(path)


@pytest.fixture
def display(monkeypatch, no_display):
    """An X server without a screen, that DISPLAY names."""
    missing = [name for name in ("Xvfb", "xdotool") if not shutil.which(name)]
    if missing:
        pytest.skip(f"needs {' and '.join(missing)} (Debian: apt install xvfb xdotool)")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24", "-noreset", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[write], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        os.close(write)
        try:
            with os.fdopen(read) as file:
                number = file.readline().strip()
            assert number, "Xvfb did not start"
            monkeypatch.setenv("DISPLAY", f":{number}")
            yield
        finally:
            server.terminate()


def keys(*words):
    return subprocess.run(["xdotool", *words], capture_output=True, text=True, check=False).stdout


def focus():
    """Give the keys to the window; whether it is there."""
    for found in keys("search", "--class", "").split():
        if keys("getwindowname", found).startswith("GridSim"):
            keys("windowfocus", "--sync", found)
            return True
    return False


def wait_for(process, condition):
    wait_until(lambda: process.poll() is not None or condition())
    assert process.poll() is None, process.communicate()


@contextlib.contextmanager
def driving(path):
    """gridsim-drive in a window that has the keys, recorded: (process, how to wait for more than so many rows)."""
    arguments = ["--scenario", "seamless", "--seed", "11", "--size", "320x240", "--record", path.name]
    with running("gridsim-drive", *arguments, cwd=path.parent) as process:
        wait_for(process, focus)
        yield process, lambda rows: wait_for(process, lambda: path.exists() and path.read_text().count("\n") > rows)


@pytest.mark.e2e
def test_real_keys_drive_a_real_window(display, tmp_path):
    path = tmp_path / "drive.csv"
    with driving(path) as (process, wait_for_rows):
        wait_for_rows(3)
        began, rows = time.monotonic(), path.read_text().count("\n")
        keys("keydown", "Up")
        wait_for_rows(rows + 12)
        keys("keydown", "Left")
        wait_for_rows(rows + 15)
        keys("keyup", "Left", "keyup", "Up", "keydown", "space")
        wait_for_rows(rows + 18)
        keys("keyup", "space")
        wait_for_rows(rows + 30)
        took = time.monotonic() - began
        keys("key", "r")
        wait_for_rows(rows + 34)
        keys("key", "Escape")
        out, err = process.communicate(timeout=30)
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
    with driving(tmp_path / "drive.csv") as (process, wait_for_rows):
        wait_for_rows(5)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Traceback" not in out + err
    assert len(read_drive(tmp_path / "drive.csv")) >= 5


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is always a display")
@pytest.mark.usefixtures("no_display")
@pytest.mark.parametrize("display", ["", ":77"])  # none, and one that does not answer
def test_without_a_display_it_says_so_and_makes_no_file(display, tmp_path):
    done = finish("gridsim-drive", "--record", "drive.csv", cwd=tmp_path, code=2, DISPLAY=display)
    assert re.fullmatch(r"gridsim-drive: error: no window can be opened [^\n]* DISPLAY [^\n]*\n", done.stderr)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("dummy")
def test_wrong_flags_and_a_file_that_exists_or_cannot_be_written(here, monkeypatch, capsys):
    (here / "drive.csv").write_text("mine")
    for line, said in (
        ("--record drive.csv", "exists already"),
        ("--record nowhere/drive.csv", "cannot be written"),
        ("--size big", "--size"),
    ):
        assert said in refused(drive_main, monkeypatch, capsys, *line.split())[0]
    assert (here / "drive.csv").read_text() == "mine"
