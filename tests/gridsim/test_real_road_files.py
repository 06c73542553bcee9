"""Files of real roads: crops, caches, packed, odd and damaged ones, the side of the road, and gridsim-map."""

from __future__ import annotations

import gzip
import pickle

import numpy as np
import pytest
from test_real_roads import CROSSING, SIM, written
from written_roads import HALF, commonroad, opendrive, osm, street

from gridsim.config import LIMITS
from gridsim.errors import GridSimError
from gridsim.maps.real import content, load, select, sumo
from gridsim.maps.real import lanelet2 as reader
from gridsim.maps.scenarios import build, label, traffic_on


def test_cache_gives_the_same_map_without_netconvert(tmp_path, monkeypatch):
    name = written(tmp_path, "a 'street'.osm", osm([street((0.0, 0.0), (200.0, 0.0))]))
    first = build(name, 0)
    load.load.cache_clear()
    monkeypatch.setattr(sumo, "_netconvert", None)
    again = build(name, 0)
    assert again is not first
    assert pickle.dumps(again.network) == pickle.dumps(first.network)
    assert np.array_equal(again.road.field, first.road.field)
    assert (label(name), traffic_on(name)) == ("a 'street'", 8)


def test_a_damaged_cache_is_made_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(load, "CACHE_FOLDER", tmp_path)
    name = written(tmp_path, "a.osm", osm([street((0.0, 0.0), (200.0, 0.0))]))
    first = build(name, 0)
    assert first.size.min() >= 2 * LIMITS["sensors"]["range"][1], "a ray is shorter than half a side"
    (cache,) = tmp_path.glob("road-*.npz")
    for damaged in (b"", cache.read_bytes()[:-200]):
        load.load.cache_clear()
        cache.write_bytes(damaged)
        assert pickle.dumps(build(name, 0).network) == pickle.dumps(first.network)


def test_crop(tmp_path):
    ways = [*CROSSING, street((120.0, 0.0), (400.0, 0.0))]
    name = written(tmp_path, "long.osm", osm(ways))
    whole, part = build(name, 0), build(f"{name}@50.0,9.0,200", 0)
    assert part.mileage[-1] < 0.8 * whole.mileage[-1]
    with pytest.raises(GridSimError, match="No edges"):
        build(f"{name}@51.0,9.0,200", 0)


def test_crop_is_in_the_coordinates_of_the_file(tmp_path):
    name = written(tmp_path, "far.xodr", opendrive(400.0).replace('x="0" y="0"', 'x="5000" y="-3000"'))
    assert build(f"{name}@5200,-3000,500", 0).mileage[-1] > 800.0
    with pytest.raises(GridSimError, match="no road"):
        build(f"{name}@200,0,500", 0)
    low = next(note for note in load.described(name, SIM).notes if "lower left corner" in note)
    assert "x 4944 m" in low


def test_odd_lanelets():
    assert reader._joined([[], ["a", "b"], ["c", "b"]]) == ["a", "b", "c"]
    assert not reader._may_cross({"subtype": "dashed", "lane_change": "no"})
    assert not reader._for_cars({"subtype": "bus_lane"})
    west = np.array([[10.0, 0.0], [5.0, 0.0], [5.0, 0.0], [0.0, 0.0]])
    assert not select._is_tight(west), "a vertex that is there twice is no turn"


def test_a_way_round_the_world_does_not_come_back_over_the_map(tmp_path):
    lanes = [([(a, HALF), (b, HALF)], [(a, -HALF), (b, -HALF)]) for a, b in ((0.0, 8.0), (8.0, 290.0))]
    network = build(written(tmp_path, "oneway.xml", commonroad(lanes, {1: [2]})), 0).network
    steps = np.diff(network.points, axis=0)[[k for k in range(len(network.points) - 1) if k + 1 not in network.offsets]]
    assert (steps[:, 0] > 0.0).all(), "all lanes lead east"


@pytest.mark.parametrize(
    ("place", "left"),
    [
        ((51.5, -0.1), True), ((50.73, 1.61), False), ((22.3, 114.17), True), ((22.54, 114.06), False),
        ((-8.84, 13.23), False), ((-11.66, 27.48), False), ((-12.82, 28.21), True), ((-1.95, 30.06), False),
        ((-1.29, 36.82), True), ((34.5, 69.2), False), ((30.18, 66.99), True), ((29.65, 91.1), False),
        ((27.7, 85.3), True), ((16.43, 102.83), True), ((17.97, 102.63), False), ((27.5, 94.9), True),
        ((16.8, 96.2), False), ((11.66, 92.74), True), ((13.75, 100.5), True), ((18.78, 100.77), True),
        ((11.56, 104.9), False),
        ((21.03, 105.85), False), ((2.82, -60.67), False), ((6.8, -58.16), True), ((-22.27, 166.45), False),
        ((-33.9, 151.2), True), ((49.19, -2.11), True), ((13.1, -59.6), True), ((37.57, 126.98), False),
        ((35.68, 139.7), True), ((48.85, 2.35), False), ((52.52, 13.4), False), ((40.7, -74.0), False),
    ],
)  # fmt: skip
def test_the_side_of_cities(place, left):
    assert sumo.keeps_left(*place) == left


def test_packed_openstreetmap_is_the_same(tmp_path):
    osmium = pytest.importorskip("osmium")
    name = written(tmp_path, "a.osm", osm(CROSSING))
    with osmium.SimpleWriter(str(tmp_path / "b.osm.pbf")) as writer:
        for thing in osmium.FileProcessor(name):
            writer.add(thing)
    packed = tmp_path / "b.osm.pbf"
    (tmp_path / "d.osm").write_bytes(gzip.compress(packed.read_bytes()))  # its name tells nothing
    wanted = build(name, 0).network.points
    for file in (packed, tmp_path / "d.osm"):
        assert np.abs(build(str(file), 0).network.points - wanted).max() < 0.05  # it has seven digits of a degree
    (tmp_path / "c.osm.pbf").write_bytes(packed.read_bytes()[:-40])
    with pytest.raises(GridSimError, match="truncated or damaged"):
        build(str(tmp_path / "c.osm.pbf"), 0)


BOMB = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "cc"><!ENTITY d "&b;&b;">]><osm>&d;</osm>'


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.osm", b"", "empty"),
        ("b.osm", osm(CROSSING)[:400], "truncated"),
        ("c.osm", BOMB, "entities"),
        ("d.xml", "<svg/>", "another kind"),
        ("e.xodr", "hello", "neither XML"),
        ("f.osm", osm([street((0.0, 0.0), (200.0, 0.0), highway="footway")]), "no road|netconvert failed"),
        ("g.osm.gz", gzip.compress(b"<osm>" + b" " * 3000, mtime=0), "when unpacked"),
        ("h.osm.gz", gzip.compress(b"<osm>" + b" " * 300, mtime=0)[:20], "damaged"),
        ("i.osm", "<osm></osm>", "no nodes"),
        ("j.xml", commonroad([]), "no road"),
        ("k.net.xml", "<net></net>", "no road"),
        ("l.osm", osm(CROSSING).replace('lat="', 'lat="x', 1), "damaged, or not as its format says"),
        ("m.osm", osm([street((0.0, 0.0), (3e3, 0.0), (3e3, 3e3))]), r"its middle: FILE@50\.\d+,9\.\d+,2000$"),
        ("n.xml", commonroad([([(200, 0), (201, 0), (200, 0.1)], [(200, -3.2), (204, 1.6), (200, 3.2)])]), "no road"),
    ],
)
def test_bad_files(tmp_path, monkeypatch, name, data, says):
    monkeypatch.setattr(content, "MAX_BYTES", 2000)
    path = written(tmp_path, name, data)
    with pytest.raises(GridSimError, match=says) as error:
        build(path, 0)
    assert str(error.value).startswith(path)
    assert len(str(error.value).splitlines()) == 1


def test_without_sumo_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "find_spec", lambda name: None)
    with pytest.raises(GridSimError, match=r'pip install "gridsim-driving\[roads\]"'):
        build(written(tmp_path, "a.osm", osm([street((0.0, 0.0), (201.0, 0.0))])), 0)


def test_map_command(tmp_path, capsys, monkeypatch):
    from cluster.commands import roads

    name = written(tmp_path, "crossing.osm", osm(CROSSING))
    monkeypatch.setattr("sys.argv", ["gridsim-map", name, "--output", str(tmp_path / "a.png")])
    with pytest.raises(SystemExit) as ended:
        roads.map_main()
    printed = capsys.readouterr().out
    assert ended.value.code == 0
    assert "1 junctions, traffic keeps right" in printed
    assert (tmp_path / "a.png").stat().st_size > 5000
