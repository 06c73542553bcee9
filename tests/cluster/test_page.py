"""The page of a drive, from which a browser reads the drive unchanged, and its picture."""

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, needs_chromium
from matplotlib.collections import LineCollection
from pictures import small_map

from cluster.report import pictures
from cluster.report.film import record
from cluster.report.page import Shown, write_page
from cluster.store.champion import load_champion
from evolution.networks.policy import PolicySpec
from gridsim.car.vehicle import act
from gridsim.config import SensorConfig, SimConfig, constants
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.sensing.route import points_ahead
from gridsim.state import CAR_FIELDS, COS, DISTANCE, SIN, SPEED, STEERING, X, Y
from gridsim.traffic.world import spawn

CHAMPION = Path(__file__).parents[2] / "benchmarks/champion_traffic.npz"


def channels(drive):
    """A drive's channels [channels, moments]: sums of differences that wrap at 16 bits, as the script has them."""
    count = 5 + 3 * drive["cars"] + drive["rays"] + len(drive["outputs"]) + 2 * drive["points"]
    series = np.frombuffer(zlib.decompress(base64.b64decode(drive["series"])), dtype="<u2").reshape(count, -1)
    return np.cumsum(series, axis=1, dtype=np.uint16).astype(float)


def test_a_page_holds_the_drives_to_the_centimetre(tmp_path):
    champion, drive, *shown = shown_drives()
    title = "</script><script>alert(1)</script>"  # a name of the user's own
    write_page(tmp_path / "drive.html", title, shown)
    page = (tmp_path / "drive.html").read_text()
    assert len(page.encode()) < 1_500_000
    assert "http://" not in page
    (found,) = re.findall(r'<script id="data" type="application/json">(.*)</script>', page)
    data = json.loads(found)
    assert data["title"] == title
    assert data["view"] == [0.0, data["width"], 0.0, data["height"]]
    for each, stride in zip(data["drives"], (2, 1), strict=True):
        found, cars, boxes = channels(each), drive.cars[::stride], drive.boxes[::stride]
        for first, states in ((0, cars), *((5 + 3 * k, boxes[:, k]) for k in range(boxes.shape[1]))):
            for offset, field, size in ((0, X, data["width"]), (1, Y, data["height"])):
                off = found[first + offset] / 65536 * size - states[:, field]
                assert np.abs(off - np.round(off / size) * size).max() < 0.01
            turned = found[first + 2] / 65536 * 2 * np.pi
            assert np.abs(np.cos(turned) - states[:, COS]).max() < 1e-3
            assert np.abs(np.sin(turned) - states[:, SIN]).max() < 1e-3
        assert found[3] / 100 == pytest.approx(np.maximum(cars[:, SPEED], 0.0), abs=0.006)
        assert found[4] / 10 == pytest.approx(cars[:, DISTANCE], abs=0.06)
        assert each["period"] == pytest.approx(0.1 * stride)
    first = 5 + 3 * boxes.shape[1]
    np.testing.assert_allclose(found[first : first + 31].T / 100, drive.ranges, atol=0.006)
    assert steers_by(drive, found[first + 31 :].argmax(axis=0))
    assert champion.sim == drive.sim


@pytest.mark.parametrize(
    "sim",
    [SimConfig(sensors=SensorConfig(latency=0.3)), SimConfig(randomise=(("steering_rate", 40.0, 59.0),))],
    ids=["late readings", "another car"],
)
def test_the_readings_and_the_car_of_a_drive_are_those_that_it_had(sim):
    champion, road_map = replace(load_champion(CHAMPION), sim=sim), build("seamless", 2_000_000)
    drive = record(champion, road_map, sample_starts(road_map, 1, np.random.default_rng(1))[0], 30.0)
    assert len(drive.cars) > 50
    assert drive.outputs is not None
    assert steers_by(drive, drive.outputs.argmax(axis=1))


def steers_by(drive, actions):
    """Whether these actions turn the wheels of a drive as they turned."""
    k, (speeds, angles) = constants(drive.sim), drive.cars[:, [SPEED, STEERING]].T
    turned = [act(k, *each)[1] for each in zip(actions, speeds, angles, strict=True)]
    return turned[:-1] == angles[1:].tolist()


def test_pedal_and_wheel_are_shown_from_the_middle():
    _, drive, _, shown = shown_drives()
    commands = np.random.default_rng(2).uniform(-1, 1, (len(drive.cars), 2)).astype(np.float32)
    packed = replace(shown, drive=replace(drive, outputs=commands)).packed()
    assert (packed["outputs"], packed["middle"]) == (["pedal", "wheel"], 50)
    assert pytest.approx(0.5 + 0.5 * commands * [1, -1], abs=1e-5) == channels(packed)[-2:].T / 65535  # left is left


def test_a_page_holds_the_points_of_the_route():
    road_map, policy = build("city", 3), "mlp:3+route"
    genome = np.zeros(PolicySpec.parse(policy).size, dtype=np.float32)  # accelerates
    driver = replace(load_champion(CHAMPION), policy=policy, genome=genome)
    drive = record(driver, road_map, sample_starts(road_map, 1, np.random.default_rng(2))[0], 20.0)
    points = points_ahead(road_map, drive.cars)
    assert points.shape == (len(drive.cars), 4, 2)
    found = channels(Shown("champion", "1", drive).packed())[-8:] / 65536 * float(road_map.road.width)
    assert np.abs(road_map.shortest(found.T.reshape(-1, 4, 2) - points)).max() < 0.01
    assert Shown("champion", "1", drive, stride=2).packed()["points"] == 0


def shown_drives():
    """Ways to show a drive of a minute among 3 cars: as an elite's, and as the champion's."""
    champion = load_champion(CHAMPION)
    road_map = build("seamless", 2_000_000)
    start = sample_starts(road_map, 1, np.random.default_rng(1))
    start[0, 3] = -1.0  # m/s; the page shows the speed forwards
    world = spawn(road_map.network, start, 3, np.array([1]), champion.sim)[0]
    drive = record(champion, road_map, start[0], 60.0, world)
    return champion, drive, Shown("elite", "1", drive, stride=2), Shown("champion", "champion", drive)


def test_a_map_file_is_shown_from_side_to_side_of_its_road():
    road_map = small_map([[20.0, 40.0, 44.0, 40.0, 4.0]])  # its ends are round
    assert pictures.bounds(road_map) == pytest.approx([16.0 - 5, 48.0 + 5, 36.0 - 5, 44.0 + 5], abs=0.6)


@pytest.mark.e2e
@needs_chromium
def test_a_browser_plays_the_page_offline_and_without_a_fault(tmp_path):
    _, drive, *shown = shown_drives()
    path, far = tmp_path / "drive.html", drive.cars.copy()
    far[:, DISTANCE] *= 40.0
    write_page(path, "one drive", [replace(shown[1], drive=replace(drive, cars=far))])
    with Browser(path.as_uri(), tmp_path / "profile") as browser:
        browser.wait_for("at > 1")
        assert browser.run("value(drives[0], DISTANCE, 1e9) / 10") == pytest.approx(far[-1, DISTANCE], abs=0.06)
        assert far[-1, DISTANCE] > 10_000.0
        assert browser.faults == []
    write_page(path, "two drives", shown, together=True)
    with Browser(path.as_uri(), tmp_path / "profile") as browser:
        browser.wait_for("$('time').max > 0")
        assert browser.run("$('label').textContent") == "elite"
        assert browser.run("$('all').checked")
        assert float(browser.run("$('time').max")) == pytest.approx(drive.seconds, abs=0.2)
    write_page(path, "two drives", shown)
    with Browser(f"{path.as_uri()}#t=3.2&paused", tmp_path / "profile") as browser:
        browser.wait_for("$('clock').textContent === '0:03.2'")
        assert browser.run("$('label').textContent") == "champion"
        assert float(browser.run("$('speed').textContent")) == pytest.approx(drive.cars[32, SPEED], abs=0.06)
        browser.run("document.getElementById('play').click()")
        browser.wait_for("at > 4")
        browser.run("$('which').value = 0; $('which').oninput(); $('all').checked = true; toggle()")
        browser.wait_for("$('label').textContent === 'elite'")
        browser.run("$('time').value = 6; $('time').oninput()")
        browser.wait_for("$('clock').textContent === '0:06.0'")
        ghosts = browser.run("let n = 0; const was = ghost; ghost = (...a) => { n++; was(...a); }; draw(); n")
        assert ghosts == 1
        assert browser.run("document.querySelectorAll('#outputs .chosen').length") == 0, "an elite's are not shown"
        browser.run("choose(1)")
        browser.wait_for("document.querySelectorAll('#outputs .chosen').length === 1")
        assert browser.faults == []
        browser.run("drives[1].channels[drives[1].outputChannel].fill(16384)")  # a quarter of a bar
        browser.run("drives[1].outputs = ['pedal', 'wheel']; drives[1].middle = 50; choose(1); panel(drives[1], 0)")
        bar = "$('outputs').querySelector('.bar div').style"
        assert browser.run(f"[{bar}.marginLeft, {bar}.width].map(parseFloat).map(Math.round)") == [25, 25]
        assert browser.run("document.querySelectorAll('#outputs .chosen').length") == 0
        assert {url for url in browser.requests if not url.startswith("data:")} == {path.as_uri()}


def test_the_picture_of_a_drive_over_the_edge_has_no_line_across(tmp_path, monkeypatch):
    figure = pictures.figure_of(4.0, 3.0)
    monkeypatch.setattr(pictures, "figure_of", lambda *size: figure)
    states = np.zeros((20, CAR_FIELDS), dtype=np.float32)
    states[:, X], states[:, Y] = np.arange(50, 90, 2) % 64, 32.0
    pictures.trajectory(small_map([[0, 32, 64, 32, 4.0]]), states, tmp_path / "drive.png", "a drive")
    (lines,) = (each for each in figure[1][0].collections if isinstance(each, LineCollection))
    assert [np.ptp(line, axis=0).tolist() for line in lines.get_segments()] == [[2.0, 0.0]] * 18
