"""Films and windows on champions: frame counts and rates read back, runs that are over or still going, wrong use."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from cluster.commands.common import UsageError
from cluster.commands.watch import Elites, watch_main
from cluster.report import film as video
from cluster.report.film import Filming, Recording, VideoError, frames, picture, record, write_video
from cluster.runs import checkpoint
from cluster.runs.champion import load_champion
from evolution.episodes.curriculum import spread_starts
from gridsim.car.ego import DISTANCE, End
from gridsim.config import SimConfig
from gridsim.envs.simulator import Simulator
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.view.drive import Recorder, pose, without_idle_limit
from gridsim.view.render import Renderer

ROOT = Path(__file__).parents[2]
SMALL = ["--workers", "0", "--population", "48", "--generations", "4", "--seed", "5"]


def run(command, *arguments, cwd, timeout=240, **environment):
    """A command, run to its end without a display: `run("watch", ...)` is gridsim-watch."""
    bare = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")}
    return subprocess.run(
        [
            sys.executable,
            "-c",
            f"from cluster.commands.entry import {command}_main; {command}_main()",
            *map(str, arguments),
        ],
        cwd=cwd,
        env={**bare, "PYTHONPATH": str(ROOT), **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


def probe(path):
    """What ffmpeg says of a film: (codec, pixel format, width, height, pictures a second, count, seconds)."""
    exe = imageio_ffmpeg.get_ffmpeg_exe()
    said = subprocess.run([exe, "-i", str(path)], capture_output=True, text=True, check=False).stderr
    stream = re.search(r"Video: (\w+).*?, (\w+)[(,].*?(\d{2,})x(\d+).*?([\d.]+) fps", said)
    assert stream, said
    count, seconds = imageio_ffmpeg.count_frames_and_secs(path)
    return stream[1], stream[2], int(stream[3]), int(stream[4]), float(stream[5]), count, seconds


@pytest.fixture(scope="module")
def driver():
    """A champion that drives well."""
    return load_champion(ROOT / "benchmarks/champion.npz")


@pytest.fixture(scope="module")
def drive(driver):
    scenario = build("seamless", 2_000_000, driver.sim)
    start = sample_starts(scenario, 1, np.random.default_rng(3))[0]
    return record(driver, scenario, start, 12.0)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A tiny real run: the folder in which `runs/ref` lies."""
    cwd = tmp_path_factory.mktemp("watch")
    done = run("evolve", *SMALL, "--name", "ref", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd


# --------------------------------------------------------------------------------------------------------- recordings


def test_recording_is_the_environments_drive(driver, drive):
    env = driver.make_env(maps=[drive.scenario])
    start = np.array([*pose(drive.cars[0])])
    observation, _ = env.reset(seed=0, options={"map_seed": drive.scenario.seed, "start": start})
    for _ in range(60):
        observation, _, _, _, info = env.step(driver.act(observation))
    assert info["distance_m"] == pytest.approx(float(drive.cars[60, DISTANCE]), abs=0.05)
    assert drive.seconds == pytest.approx(12.0)
    assert drive.end == End.RUNNING
    assert len(drive.cars) == len(drive.ranges) == 121


def test_recording_ends_with_its_episode():
    scenario = build("seamless", 4)
    driver = load_champion(ROOT / "benchmarks/champion.npz")
    blind = type(driver)(np.zeros_like(driver.genome), driver.policy, driver.scenario, driver.sim)  # accelerates
    drive = record(blind, scenario, sample_starts(scenario, 1, np.random.default_rng(0))[0], 60.0)
    assert drive.end == End.COLLISION
    assert drive.seconds < 30
    lost = type(driver)(np.full_like(driver.genome, np.nan), driver.policy, driver.scenario, driver.sim)
    assert len(record(lost, scenario, drive.cars[0, :5] * 0 + 128, 60.0).cars) == 1


def test_film_lasts_as_long_as_the_drive(drive, tmp_path):
    size, path = (160, 120), tmp_path / "f.mp4"
    for fps in (10, 30):
        assert write_video(path, frames(Renderer(drive.scenario, size), drive, fps), size, fps) == 12 * fps
        codec, pixels, width, height, rate, count, seconds = probe(path)
        assert (codec, pixels, width, height) == ("h264", "yuv420p", 160, 120)
        assert (rate, count) == (fps, 12 * fps)
        assert seconds == pytest.approx(drive.seconds, abs=0.02)
    assert [f.name for f in tmp_path.iterdir()] == ["f.mp4"]


def test_picture_shows_other_cars_between_two_states(drive):
    boxes = np.zeros((len(drive.cars), 1, 5), dtype=np.float32)
    boxes[:, 0, :4] = drive.cars[:, :4]
    boxes[:, 0, :2] += 6.0 * drive.cars[:, 2:4]  # six metres ahead
    seen = Recording(drive.scenario, drive.cars, drive.ranges, boxes, drive.end, drive.period)
    renderer = Renderer(drive.scenario, (320, 240))
    for seconds in (3.0, 3.05, 12.0, 99.0):
        assert (picture(renderer, seen, seconds) != picture(renderer, drive, seconds)).any()


def test_film_is_whole_or_not_there(drive, tmp_path):
    path, size = tmp_path / "f.mp4", (160, 120)
    path.write_bytes(b"the one before")

    def broken():
        yield np.zeros((120, 160, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken(), size, 10)
    assert path.read_bytes() == b"the one before"
    assert [f.name for f in tmp_path.iterdir()] == ["f.mp4"]
    for wrong, expected in (("f.avi", "mp4 or .gif"), ("f", "mp4 or .gif"), ("none/f.mp4", "cannot be written")):
        with pytest.raises(VideoError, match=expected):
            write_video(tmp_path / wrong, frames(Renderer(drive.scenario, size), drive, 2), size, 2)
    with pytest.raises(VideoError, match="even"):
        write_video(path, iter([]), (161, 120), 10)


def test_without_ffmpeg_a_film_says_so(drive, tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    with pytest.raises(VideoError, match=r"ffmpeg cannot be started: .*none: No such file"):
        write_video(tmp_path / "f.mp4", frames(Renderer(drive.scenario, (64, 64)), drive, 1), (64, 64), 1)


@pytest.fixture
def filming(tmp_path):
    """Begins to film a run's champion on its first held-out drive."""
    started = []

    def begin():
        episodes = spread_starts(partial(build, "seamless"), range(2_000_000, 2_000_001), 1)
        champion = ROOT / "benchmarks/champion.npz"
        place = episodes.rows[0]["start"], episodes.worlds[0]
        started.append(Filming(champion, 2_000_000, *place, tmp_path / "f.mp4", "held out"))
        return started[-1]

    yield begin
    for film in started:
        film.stop()


def test_a_champion_is_filmed_by_another_process(filming, tmp_path, tmp_path_factory, monkeypatch):
    elsewhere = tmp_path_factory.mktemp("started here")
    (elsewhere / "numpy.py").write_text("raise ImportError('not this one')\n")  # no part of it, wherever it is started
    monkeypatch.chdir(elsewhere)
    seen = []
    filming().wait(lambda *told: seen.append(told))
    assert probe(tmp_path / "f.mp4")[2:6] == (*video.SIZE, video.FPS, 20 * video.FPS)
    assert seen == [("f.mp4", k, 20 * video.FPS) for k in range(0, 20 * video.FPS, video.FPS)]
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    with pytest.raises(VideoError, match="ffmpeg cannot be started") as caught:
        filming().wait()
    assert "\n" not in str(caught.value)
    assert [f.name for f in tmp_path.iterdir()] == ["f.mp4"]


def _ends(film, seconds=60.0):
    """Whether a filming process and its ffmpeg end by themselves."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        film._process.poll()  # else it is a zombie
        try:
            os.killpg(film._process.pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("begun", [False, True])
@pytest.mark.parametrize("how", ["killed", "stopped", "its run was killed"])
def test_who_films_and_dies_leaves_nothing(filming, tmp_path, how, begun):
    film = filming()
    deadline = time.monotonic() + 60.0
    # Until the file is there, or until there are pictures in it.
    while not any(f.stat().st_size >= begun for f in tmp_path.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert [f.suffix for f in tmp_path.iterdir()] == [".tmp"]
    if how == "killed":
        os.kill(film._process.pid, signal.SIGKILL)
        with pytest.raises(VideoError, match="-9"):
            film.wait()
    elif how == "its run was killed":
        film._process.stdout.close()  # nobody listens any more
        assert _ends(film)
        assert list(tmp_path.iterdir()) == []
    film.stop()
    assert _ends(film)
    if how != "killed" or begun:
        assert list(tmp_path.iterdir()) == []


def test_no_process_to_film_with_says_so(filming, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(VideoError, match="no process can be started: No such file"):
        filming().wait()


# -------------------------------------------------------------------------------------------------------- the command


@pytest.mark.e2e
def test_run_leaves_a_film_at_true_speed(run_folder):
    folder = run_folder / "runs/ref"
    codec, pixels, width, height, rate, count, seconds = probe(folder / "champion.mp4")
    assert (codec, pixels, width, height) == ("h264", "yuv420p", *video.SIZE)
    assert rate == video.FPS
    assert count == round(seconds * rate)
    assert 0 < seconds <= 60.01
    held_out = json.loads((folder / "summary.json").read_text())["held_out"]
    assert held_out["episodes"] == 64
    artifacts = list((run_folder / "mlartifacts").rglob("champion.mp4"))
    assert [a.read_bytes() for a in artifacts] == [(folder / "champion.mp4").read_bytes()]


@pytest.mark.e2e
def test_watch_writes_films(run_folder, tmp_path):
    done = run("watch", run_folder / "runs/ref", "--output", "a.mp4", "--seconds", 1, "--size", "320x180", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert probe(tmp_path / "a.mp4")[2:6] == (320, 180, 20.0, 20)
    champion = ROOT / "benchmarks/champion.npz"
    done = run("watch", champion, "--output", "b.gif", "--seconds", 2, "--size", "160x90", "--seed", 7, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert probe(tmp_path / "b.gif")[0] == "gif"
    assert probe(tmp_path / "b.gif")[5] == 20
    folder = run_folder / "runs/ref"
    done = run(
        "watch", folder, "--generation", 0, "--output", "c.mp4", "--size", "64x64", "--seconds", "1", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert sorted(f.name for f in tmp_path.iterdir()) == ["a.mp4", "b.gif", "c.mp4"]


@pytest.mark.e2e
def test_watch_shows_a_recorded_drive(tmp_path):
    scenario = build("seamless", 3)
    simulator = Simulator([scenario], 1, without_idle_limit())
    start = sample_starts(scenario, 1, np.random.default_rng(1))[0]
    with Recorder(tmp_path / "drive.csv", scenario, 0.1) as recorder:
        for episode, steps in enumerate((16, 11)):
            simulator.reset(start[None])
            for k in range(steps):
                recorder.write(k, start if k == 0 else pose(simulator.state.cars[0]), 0, episode)
                simulator.step(np.array([0]))
    for arguments, pictures in (([], 25), (["--seconds", 2], 20)):
        film = ["--output", "d.mp4", "--fps", 10, "--size", "64x64", *arguments]
        done = run("watch", "drive.csv", *film, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert probe(tmp_path / "d.mp4")[5] == pictures
        assert f"{pictures / 10:.1f} s, {pictures} pictures" in done.stdout
    (tmp_path / "cut.csv").write_text((tmp_path / "drive.csv").read_text()[:-30])
    done = run("watch", "cut.csv", "--output", "e.mp4", cwd=tmp_path)
    assert done.returncode == 2
    assert "cut.csv, line 28" in done.stderr


@pytest.mark.e2e
def test_window_is_shown_on_a_chosen_driver_for_so_long(run_folder, tmp_path):
    folder = run_folder / "runs/ref"
    began = time.monotonic()
    done = run("watch", folder, "--seconds", 3, "--size", "320x180", cwd=tmp_path, SDL_VIDEODRIVER="dummy")
    assert done.returncode == 0, done.stderr
    assert time.monotonic() - began > 3.0


@pytest.mark.e2e
def test_follow_takes_the_newest_elite_while_the_run_goes_on(run_folder, tmp_path):
    """A run's folder as it is while the run goes on: config.json and, some time later, a checkpoint."""
    folder = tmp_path / "going"
    folder.mkdir()
    shutil.copy(run_folder / "runs/ref/config.json", folder)
    assert "has no champion.npz yet" in run("watch", "going", cwd=tmp_path).stderr
    process = subprocess.Popen(
        [sys.executable, "-c", "from cluster.commands.entry import watch_main; watch_main()", "going", "--follow",
         "--seconds", "1", "--size", "64x64"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT), "SDL_VIDEODRIVER": "dummy"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert "waiting" in process.stdout.readline()
        shutil.copy(run_folder / "runs/ref/checkpoint.npz", folder / "part")
        (folder / "part").rename(folder / "checkpoint.npz")
        _, err = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert err == ""


def test_newest_elite_is_read_anew(run_folder, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run_folder / "runs/ref", folder)
    elites = Elites(folder)
    first, name = elites.get(None)
    assert name == "elite of generation 3"
    arrays, meta = checkpoint.load(folder / "checkpoint.npz")
    assert (first.genome == arrays["elites"][3]).all()
    before = elites.changed()
    arrays["elites"] = np.concatenate([arrays["elites"], arrays["elites"][:1]])
    checkpoint.save(folder / "checkpoint.npz", arrays, meta)
    assert elites.changed() != before
    assert (elites.get(None)[0].genome == arrays["elites"][0]).all()
    assert (elites.get(2)[0].genome == arrays["elites"][2]).all()
    (folder / "checkpoint.npz").unlink()  # elites.npz, which a run leaves at its end, will do
    assert (elites.get(2)[0].genome == arrays["elites"][2]).all()
    assert elites.get(0)[0].sim == SimConfig()
    with pytest.raises(UsageError, match="0 to 3"):
        elites.get(-1)


WRONG = {
    "missing folder": (["nothing"], "nothing: no such file"),
    "folder of no run": (["."], "no run's folder"),
    "file that is none": (["/etc/hostname", "--output", "a.mp4"], "/etc/hostname"),
    "generation out of range": (["RUN", "--generation", "99", "--output", "a.mp4"], "0 to 3"),
    "negative generation": (["RUN", "--generation", "-1", "--output", "a.mp4"], "0 to 3"),
    "generation of a champion": (["CHAMPION", "--generation", "1"], "run's folder"),
    "follow and film": (["RUN", "--follow", "--output", "a.mp4"], "--follow"),
    "suffix": (["RUN", "--output", "a.avi"], ".mp4 or .gif"),
    "no suffix": (["RUN", "--output", "film"], ".mp4 or .gif"),
    "folder of the film": (["RUN", "--output", "no/a.mp4"], "no folder"),
    "size": (["RUN", "--output", "a.mp4", "--size", "641x360"], "--size"),
    "rate of a GIF": (["RUN", "--output", "a.gif", "--fps", "30"], "--fps"),
    "rate": (["RUN", "--output", "a.mp4", "--fps", "1000"], "--fps"),
    "seconds": (["RUN", "--output", "a.mp4", "--seconds", "nan"], "--seconds"),
    "scenario": (["RUN", "--output", "a.mp4", "--scenario", "moon"], "unknown scenario"),
    "seed": (["RUN", "--output", "a.mp4", "--seed", "-4"], "seed"),
    "no display": (["RUN"], "DISPLAY"),
}


@pytest.mark.e2e
@pytest.mark.parametrize("name", WRONG)
def test_wrong_use_is_one_clear_line(run_folder, tmp_path, name, monkeypatch, capsys):
    arguments, expected = WRONG[name]
    if name == "no display" and not sys.platform.startswith("linux"):
        pytest.skip("elsewhere there is always a display")
    places = {"RUN": run_folder / "runs/ref", "CHAMPION": ROOT / "benchmarks/champion.npz"}
    monkeypatch.setattr(sys, "argv", ["gridsim-watch", *[str(places.get(a, a)) for a in arguments]])
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        watch_main()
    said = capsys.readouterr()
    assert stop.value.code == 2
    lines = said.err.strip().splitlines()
    assert lines[0].startswith("gridsim-watch: error: ")
    assert len(lines) <= 3
    assert expected in said.err
    assert said.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.e2e
def test_wrong_use_in_a_process_of_its_own(run_folder, tmp_path):
    done = run("watch", run_folder / "runs/ref", "--frobnicate", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("gridsim-watch: error: ")
    done = run("watch", run_folder / "runs/ref", "--output", "a.mp4", "--seconds", 1, cwd="/proc")
    assert done.returncode == 1  # right use, but nothing can be written there
    assert len(done.stderr.strip().splitlines()) == 1
    assert "cannot be written" in done.stderr
