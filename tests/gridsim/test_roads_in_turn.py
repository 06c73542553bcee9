"""A scenario's name may list several roads, whose maps take turns; each road has traffic of its own."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from written_roads import both_ways, commonroad

from gridsim.config import SimConfig
from gridsim.envs.env import GridSimEnv, GridSimVectorEnv
from gridsim.errors import GridSimError
from gridsim.maps.atlas import make_atlas
from gridsim.maps.parts import FIRST_SEEDS, is_map_file, road_of, roads_of, seed_of_map, seed_on, seeds_on
from gridsim.maps.scenarios import REGISTRY, build, check_name, crowds, full_name, has_lanes, label, map_digest
from gridsim.state import LANE

ALL = ",".join(REGISTRY)


@pytest.mark.parametrize(
    ("name", "roads"),
    [
        ("city", ["city"]),
        ("highway,city", ["highway", "city"]),
        ("a.osm@52.4,-13,400,city", ["a.osm@52.4,-13,400", "city"]),
        ("city,a.xodr@1,2,3,b.osm@4.5,5,6", ["city", "a.xodr@1,2,3", "b.osm@4.5,5,6"]),
        ("highway,,city", ["highway", "", "city"]),
    ],
)
def test_a_name_lists_roads_and_crops_stay_whole(name, roads):
    assert roads_of(name) == roads


def test_files_whose_names_have_commas_are_one_road(here):
    (here / "my,town.osm").touch()
    assert roads_of("my,town.osm") == ["my,town.osm"]
    assert is_map_file("my,town.osm")
    assert not is_map_file("your,town.osm,city")


def test_a_folder_does_not_hide_the_road_of_its_name(here):
    (here / "city").mkdir()
    assert not is_map_file("city")
    assert is_map_file("./city")


def test_maps_whose_lanes_fork_into_different_numbers_are_driven_together():
    here = build("city", 0)
    more = np.pad(here.network.successors, ((0, 0), (0, 2)), constant_values=-1)
    atlas = make_atlas([here.road, here.road], [here.network, here.network._replace(successors=more)])
    assert (atlas.lanes.successors == np.concatenate([more, more])).all()


def test_all_and_paths_are_written_out(here):
    assert full_name("all") == ALL
    assert full_name("all,./a.osm@1,2,3") == f"{ALL},{here}/a.osm@1,2,3"
    assert (label(ALL), label(f"{here}/a.osm,{ALL}"), label("highway,city")) == ("all", "all+a", "highway+city")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("highway,cty", "unknown scenario 'cty'; did you mean city?"),
        ("moon", "unknown scenario 'moon'; there are: city, curved"),
        ("highway,", "the name of a road is empty"),
        ("city,highway,city", "city is there twice"),
        ("a/town.osm,b/town.osm", "two of its roads have the name town; rename or copy a file"),
    ],
)
def test_names_that_are_wrong_are_told_in_one_line(name, said):
    with pytest.raises(GridSimError, match=rf"^[^\n]*{said}[^\n]*$"):
        check_name(name)


def test_roads_take_turns_in_each_part():
    for first in FIRST_SEEDS:
        for k in range(10):
            road, own = road_of(ALL, first + k)
            assert (road, own) == (list(REGISTRY)[k % 5], first + k // 5)
            assert seed_on(k % 5, 5, own) == first + k == seed_of_map(ALL, first + k)
    assert seeds_on(range(1_000_002, 1_000_004), 5) == range(1_000_010, 1_000_020)
    here, alone = build("highway,curved", 3), build("curved", 1)
    assert (here.name, here.seed, float(here.road.speed_low)) == ("curved", 1, 6.0)
    assert here.network.points.tobytes() == alone.network.points.tobytes()


def test_a_file_in_a_list_is_divided_like_alone(tmp_path):
    lanes = tmp_path / "lanes.xml"
    lanes.write_text(commonroad(both_ways(300.0)))
    name = f"curved,{lanes}"
    seeds = [1, 1_000_001, 2_000_001, 2_000_003]
    maps = [build(name, seed) for seed in seeds]
    assert [each.name for each in maps] == [str(lanes)] * 4
    assert [each.begins.tobytes() for each in maps[:3]] == [build(str(lanes), f).begins.tobytes() for f in FIRST_SEEDS]
    assert [seed_of_map(name, seed) for seed in seeds] == [1, 1_000_001, 2_000_001, 2_000_001]
    assert map_digest(name) == map_digest(str(lanes)) != ""
    assert map_digest(ALL) == ""


@pytest.mark.parametrize(
    ("name", "asked", "cars"),
    [
        ("curved", None, (0,)),
        ("curved", "usual", (6,)),
        ("seamless", "usual", (6,)),
        ("city", "usual", (6,)),
        ("highway", "heavy", (16,)),
        ("town.osm", "heavy", (16,)),
        ("lab.png", "heavy", (0,)),
        ("city", 3, (3,)),
        (ALL, None, (8, 6, 6, 4, 6)),
        (ALL, "heavy", (16, 12, 12, 8, 12)),
        (ALL, 2, (2,) * 5),
        ("lab.png,city", None, (0, 6)),
    ],
)
def test_traffic_is_a_number_or_follows_from_the_road(name, asked, cars):
    assert crowds(name, asked) == cars
    assert not any(crowds(name, "usual", SimConfig.load("f1tenth")))
    with pytest.raises(GridSimError, match="usual, heavy or a number of cars, not 'dense'"):
        crowds(name, "dense")  # type: ignore[arg-type]


def test_environments_drive_on_several_roads_among_each_ones_traffic(tmp_path):
    cars = GridSimVectorEnv(64, scenario="highway,roundabout", maps=4, traffic="heavy")
    cars.reset(seed=0)
    there = (cars.simulator.worlds[..., LANE] >= 0).sum(axis=1)
    roads = np.array([cars.simulator.maps[i].name for i in range(64)])
    assert set(roads) == {"highway", "roundabout"}
    assert (there[roads == "roundabout"] <= 8).all()
    assert there[roads == "highway"].mean() > 12
    for _ in range(20):
        cars.step(np.zeros(64, dtype=np.int64))
    assert GridSimEnv("curved", traffic="usual").cars.simulator.worlds.shape[1] == 6
    Image.fromarray(np.full((400, 400), 255, dtype=np.uint8)).save(tmp_path / "lab.png")
    assert not has_lanes(f"city,{tmp_path}/lab.png")
    with pytest.raises(ValueError, match="has no lanes for traffic"):
        GridSimEnv(f"city,{tmp_path}/lab.png")
