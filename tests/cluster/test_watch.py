"""Films and windows on champions: frame counts and rates read back, runs that are over or still going, wrong use."""

import errno
import json
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from commands import CHAMPION, call, refused
from pictures import record_drive

from cluster.commands import watch
from cluster.commands.watch import WatchFlags, _drives, watch_main
from cluster.report.film import frames, picture, record, write_video
from cluster.settings import EvolveSettings
from cluster.store import checkpoint
from cluster.store.champion import load_champion
from cluster.store.checkpoint import WriteError
from cluster.store.folder import RunFolder
from cluster.store.steps import Steps, read_elites
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.state import End
from gridsim.traffic.world import spawn
from gridsim.view.render import Renderer


def probe(path):
    """What ffmpeg says of a film: (codec, pixel format, width, height, pictures a second, count, seconds)."""
    exe = imageio_ffmpeg.get_ffmpeg_exe()
    said = subprocess.run([exe, "-i", str(path)], capture_output=True, text=True, check=False).stderr
    stream = re.search(r"Video: (\w+).*?, (\w+)[(,].*?(\d{2,})x(\d+).*?([\d.]+) fps", said)
    assert stream, said
    count, seconds = imageio_ffmpeg.count_frames_and_secs(path)
    return stream[1], stream[2], int(stream[3]), int(stream[4]), float(stream[5]), count, seconds


@pytest.fixture(scope="module")
def drive():
    scenario = build("seamless", 2_000_000)
    return record(load_champion(CHAMPION), scenario, sample_starts(scenario, 1, np.random.default_rng(3))[0], 12.0)


def test_recording_ends_with_its_episode():
    driver, scenario = load_champion(CHAMPION), build("seamless", 4)
    blind = replace(driver, genome=np.zeros_like(driver.genome))  # accelerates
    drive = record(blind, scenario, sample_starts(scenario, 1, np.random.default_rng(0))[0], 60.0)
    assert drive.end == End.COLLISION
    assert drive.seconds < 30
    lost = replace(driver, genome=np.full_like(driver.genome, np.nan))
    assert len(record(lost, scenario, drive.cars[0, :5] * 0 + 128, 60.0).cars) == 1


def test_picture_shows_other_cars_between_two_states(drive):
    boxes = np.zeros((len(drive.cars), 1, 5), dtype=np.float32)
    boxes[:, 0, :4] = drive.cars[:, :4]
    boxes[:, 0, :2] += 6.0 * drive.cars[:, 2:4]  # six metres ahead
    seen = replace(drive, boxes=boxes)
    renderer = Renderer(drive.scenario, (320, 240))
    for seconds in (3.0, 3.05, 12.0, 99.0):
        assert (picture(renderer, seen, seconds) != picture(renderer, drive, seconds)).any()


class Texts:
    """In place of a renderer: a picture is the text on it."""

    def draw(self, car, text, **_):
        return text[0]


def test_the_last_picture_shows_how_a_drive_ended_and_clocks_have_no_sixtieth_second(drive):
    texts: Any = Texts()
    last: Any
    *_, last = frames(texts, replace(drive, end=End.COLLISION), 7.0)
    assert last.endswith("0:12.0    collision")
    *_, last = frames(texts, drive, 7.0)
    assert "0:11." in last
    slow = replace(drive.sim, episode=replace(drive.sim.episode, control_period=0.5))
    last = picture(texts, replace(drive, sim=slow), 59.96)
    assert last.endswith("1:00.0")


def test_film_is_whole_or_not_there(drive, tmp_path, monkeypatch):
    path, size = tmp_path / "f.mp4", (160, 120)
    path.write_bytes(b"the one before")

    def broken():
        yield np.zeros((120, 160, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken(), size, 10)
    with pytest.raises(WriteError, match="cannot be written"):
        write_video(tmp_path / "none/f.mp4", frames(Renderer(drive.scenario, size), drive, 2), size, 2)
    with pytest.raises(WriteError, match="ffmpeg failed: "):
        write_video(path, frames(Renderer(drive.scenario, size), drive, 2), (161, 120), 10)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    with pytest.raises(WriteError, match=r"ffmpeg cannot be started: .*No such file.*none"):
        write_video(path, iter([]), size, 1)
    assert path.read_bytes() == b"the one before"
    assert [f.name for f in tmp_path.iterdir()] == ["f.mp4"]


def test_a_champion_is_watched_in_another_car():
    drive, _ = next(_drives(WatchFlags(str(CHAMPION), output="a.gif", sim="f1tenth"), 2.0))
    assert drive.sim == SimConfig.load("f1tenth")
    assert (drive.period, float(drive.scenario.road.unit), drive.ranges.max() <= 7.5) == (0.05, 0.125, True)


def test_watch_writes_films(here, monkeypatch, capsys):
    film = [CHAMPION, "--output", "a.mp4", "--seconds", 1, "--size", "320x180"]
    assert "a.mp4: 1.0 s, 20 pictures" in call(watch_main, monkeypatch, capsys, *film)[1]
    *said, seconds = probe(here / "a.mp4")
    assert (said, seconds) == (["h264", "yuv420p", 320, 180, 20.0, 20], pytest.approx(1.0, abs=0.02))
    film = [CHAMPION, "--output", "b.gif", "--seconds", 2, "--size", "160x90", "--seed", 7, "--scenario", "city"]
    assert call(watch_main, monkeypatch, capsys, *film)[0] == 0
    assert probe(here / "b.gif")[::5] == ("gif", 20)
    assert sorted(f.name for f in here.iterdir()) == ["a.mp4", "b.gif"]
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(here / "none"))  # right use, and it fails
    code, _, err = call(watch_main, monkeypatch, capsys, *film)
    assert (code, err.count("\n")) == (1, 1)
    assert "ffmpeg cannot be started" in err


@pytest.mark.parametrize("name", ["drive-12:30.mp4", "-v.mp4", "%d.gif", "http:a.gif", "a.csv/b.html"])
def test_films_and_pages_of_any_name_are_written(name, here, monkeypatch, capsys):
    (here / "a.csv").mkdir()
    shutil.copy(CHAMPION, "a.csv/champion.npz")
    asked = "a.csv", "--seconds", 1, "--size", "64x64", f"--output={name}"
    code, out, err = call(watch_main, monkeypatch, capsys, *asked)
    assert (code, err) == (0, "")
    assert f"{name}: " in out
    assert (here / name).stat().st_size > 0


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.html"])
def test_what_cannot_be_written_is_told_in_one_line(name, here, monkeypatch, capsys):
    def refuse(path, *_, **__):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    drive = CHAMPION, "--seconds", 1, "--size", "64x64", "--output"
    assert call(watch_main, monkeypatch, capsys, *drive, f"first-{name}")[0] == 0  # its kernels are compiled
    monkeypatch.setattr("builtins.open", lambda path, *_, **__: refuse(path))
    for method in ("touch", "unlink"):  # a read-only file system refuses to unlink even what is not there
        monkeypatch.setattr(Path, method, refuse)
    code, _, err = call(watch_main, monkeypatch, capsys, *drive, name)
    assert (code, err) == (1, f"gridsim-watch: error: {name}: cannot be written: Read-only file system\n")


def test_a_page_of_several_champions_begins_with_all_of_them(tmp_path, monkeypatch, capsys):
    files, page = [CHAMPION, CHAMPION.with_name("champion_traffic.npz")], tmp_path / "two.html"
    call(watch_main, monkeypatch, capsys, *files, "--seconds", "5", "--output", page)
    (found,) = re.findall(r'type="application/json">(.*)</script>', page.read_text())
    data = json.loads(found)
    assert [each["short"] for each in data["drives"]] == ["benchmarks", "champion_traffic.npz"]
    assert data["together"]


def test_drives_of_a_page_are_among_as_many_cars_though_some_find_no_room(here, monkeypatch, capsys):
    asked, shown = [], []

    def spawned(network, starts, cars, *others):
        asked.append(cars)
        return spawn(network, starts, cars, *others)

    def written(path, title, drives, together):
        path.touch()
        shown.extend(drives)

    monkeypatch.setattr(watch, "spawn", spawned)
    monkeypatch.setattr(watch, "write_page", written)
    crowded = "--scenario", "curved", "--traffic", 64, "--seconds", 1, "--output", "a.html"
    assert call(watch_main, monkeypatch, capsys, CHAMPION, CHAMPION, *crowded)[0] == 0
    assert asked == [64, 64]
    assert len({each.drive.boxes.shape for each in shown}) == 1
    assert shown[0].drive.boxes.shape[1] < 64


def test_watch_shows_a_recorded_drive(here, monkeypatch, capsys):
    scenario = build("seamless", 3)
    start = sample_starts(scenario, 1, np.random.default_rng(1))[0]
    record_drive(here / "drive.csv", scenario, start, [[0] * 16, [0] * 11])
    monkeypatch.setattr(watch, "FILM_S", 1.0)  # is not for recordings
    for arguments, pictures in (([], 25), (["--seconds", 2], 20)):
        film = ["drive.csv", "--output", "d.mp4", "--fps", 10, "--size", "64x64", *arguments]
        assert f"{pictures / 10:.1f} s, {pictures} pictures" in call(watch_main, monkeypatch, capsys, *film)[1]
        assert probe(here / "d.mp4")[5] == pictures
    for sources in ((CHAMPION, "drive.csv"), ("drive.csv", CHAMPION)):
        page = [*sources, "--seed", 3, "--seconds", 1, "--output", "d.html"]
        assert call(watch_main, monkeypatch, capsys, *page)[0] == 0
    (here / "cut.csv").write_text((here / "drive.csv").read_text()[:-30])
    for line, said in (("cut.csv", "cut.csv, line 28"), ("drive.csv --generation 1", "its own driver, car and road")):
        assert said in refused(watch_main, monkeypatch, capsys, *line.split(), "--output", "e.mp4")[0]


def test_window_is_shown_on_a_chosen_driver_for_so_long(dummy, monkeypatch, capsys):
    began = time.monotonic()
    assert call(watch_main, monkeypatch, capsys, CHAMPION, "--seconds", 3, "--size", "320x180") == (0, "", "")
    assert time.monotonic() - began > 3.0


@pytest.fixture
def going(tmp_path):
    """A run's folder as it is while the run goes on: elites of four generations."""
    run = RunFolder(tmp_path / "run", EvolveSettings("curved", policy="mlp:6,7"))
    run.path.mkdir()
    run.write_config()
    elites = np.random.default_rng(0).standard_normal((4, PolicySpec.parse("mlp:6,7").size)).astype(np.float32)
    saved = Steps(run.path, "generation", ["a", "b"], elites.shape[1])
    saved.append(np.zeros((len(elites), 2)), [*elites])
    checkpoint.save(run.path / "checkpoint.npz", {}, {"columns": ["a", "b"], "steps": saved.number})
    return run.path


def test_any_elite_is_watched_while_the_run_goes_on(going, dummy, monkeypatch, capsys):
    elites = read_elites(going, "mlp:6,7")
    for generation, number in ((None, 3), (0, 0)):
        driver, name = watch._elite(going, generation)
        assert (driver.genome.tobytes(), name) == (elites[number].tobytes(), f"elite of generation {number}")
    (going / "checkpoint.npz").rename(going / "part")
    monkeypatch.setattr(watch.time, "sleep", lambda _: (going / "part").rename(going / "checkpoint.npz"))
    code, out, err = call(watch_main, monkeypatch, capsys, going, "--follow", "--seconds", 1, "--size", "64x64")
    assert (code, out, err) == (0, "waiting for the first generation ...\n", "")


WRONG = [
    ("RUN", "gridsim-evolve --resume"),
    ("RUN", "to watch it as it stands: --follow, or --generation N"),
    (".", "not a run's folder"),
    (". --follow", "need a run's folder"),
    ("none.npz --output a.mp4", "No such file"),
    ("RUN --generation 99 --output a.mp4", "0 to 3"),
    ("CHAMPION --generation 1", "run's folder"),
    ("RUN --follow --output a.mp4", "--follow"),
    ("RUN --follow --generation 1", "--generation"),
    ("CHAMPION --output a.avi", ".mp4 or .gif"),
    ("CHAMPION --output no/a.mp4", "no folder"),
    ("CHAMPION --output a.gif --fps 30", "--fps"),
    ("CHAMPION --output a.mp4 --fps 1000", "--fps"),
    ("CHAMPION --output a.mp4 --seconds nan", "--seconds"),
    ("CHAMPION --output a.mp4 --traffic 999", "--traffic"),
    ("CHAMPION --output a.mp4 --seed -4", "seed"),
    ("CHAMPION", "DISPLAY"),
]


@pytest.mark.usefixtures("no_display")
@pytest.mark.parametrize(("line", "expected"), WRONG)
def test_wrong_use_is_one_clear_line(going, here, line, expected, monkeypatch, capsys):
    if expected == "DISPLAY" and not sys.platform.startswith("linux"):
        pytest.skip("elsewhere there is always a display")
    arguments = line.replace("RUN", str(going)).replace("CHAMPION", str(CHAMPION)).split()
    assert expected in " ".join(refused(watch_main, monkeypatch, capsys, *arguments))
    assert [f.name for f in here.iterdir()] == ["run"]
