"""Maps of files are divided into those to learn on, to choose the champion on, and to judge it on."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from written_roads import both_ways, commonroad

import gridsim
from gridsim.envs.env import GridSimEnv
from gridsim.errors import GridSimError
from gridsim.maps.map import sample_starts
from gridsim.maps.parts import FIRST_SEEDS, divided, held_out_place, seeds_of_files
from gridsim.maps.scenarios import build, has_lanes, label

NAMES = [f"{k}.png" for k in range(7)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Seven rings, the k-th with a radius of 36 + k m, at a resolution of 0.5 m a pixel; and files that are no maps."""
    path = tmp_path_factory.mktemp("rings")
    x, y = np.meshgrid(np.arange(200) / 2 - 50, np.arange(200) / 2 - 50)
    for k, name in enumerate(NAMES):
        ring = np.abs(np.hypot(x, y) - 36 - k) < 5
        Image.fromarray(np.where(ring, 254, 0).astype(np.uint8)).save(path / name)
        (path / f"{k}.yaml").write_text(f"image: {name}\nresolution: 0.5\n")
    (path / "INDEX.md").write_text("Rings.")
    return path


def radius(road_map):
    """Of a ring's middle line, m."""
    low, high = road_map.starts[:, 0].min(), road_map.starts[:, 0].max()
    return (high - low) / 2


def test_files_of_a_folder_are_divided(folder):
    parts = [[int(name[-6]) for name in part] for part in divided(str(folder))]
    assert parts == [[0, 3, 4, 5], [1, 6], [2]]
    assert [[int(name[-6]) for name in part] for part in divided(f"{folder}/[0-2].yaml")] == [[0], [1], [2]]
    built = [build(str(folder), seed) for seed in seeds_of_files(str(folder))]
    assert [round(radius(each)) - 36 for each in built] == [k for part in parts for k in part]
    assert build(str(folder), 1_000_005) is build(str(folder), 1_000_001)
    assert not has_lanes(str(folder))
    assert (label(str(folder)), label(f"{folder}/[0-2].yaml")) == (folder.name, f"{folder.name}-0-2")
    assert held_out_place(str(folder), built[-1]) == "held-out maps: 2.yaml"
    assert divided(f"{folder}/*") == divided(str(folder)), "pictures are not maps beside YAML files"
    with pytest.raises(GridSimError, match="2 map files; it needs 3 or more"):
        build(f"{folder}/[01].yaml", 0)


def test_learning_judging_and_environments_use_their_own_files(folder):
    champion, _ = gridsim.evolve(scenario=str(folder), generations=1, population=32, workers=0)
    assert gridsim.evaluate(champion, episodes=8)["episodes"] == 8
    env = GridSimEnv(str(folder))
    seen = set()
    for seed in range(20):
        env.reset(seed=seed)
        seen.add(env.cars.simulator.maps[0].name[-6])
    assert seen == set("0345")


def test_on_a_single_map_each_part_begins_in_regions_of_its_own(tmp_path, folder):
    lanes = tmp_path / "lanes.xml"
    lanes.write_text(commonroad(both_ways(300.0)))
    for name in (str(lanes), str(folder / "3.yaml")):
        maps = [build(name, first) for first in FIRST_SEEDS]
        starts = [sample_starts(each, 300, np.random.default_rng(k))[:, :2] for k, each in enumerate(maps)]
        side = np.ptp(np.concatenate(starts), axis=0).max() / 10
        low = np.concatenate(starts).min(axis=0)
        regions = [{*map(tuple, np.floor((each - low) / side).astype(int).tolist())} for each in starts]
        assert len(regions[0] & regions[1]) + len(regions[0] & regions[2]) + len(regions[1] & regions[2]) <= 6
        assert all(len(each) >= 2 for each in regions)
        assert held_out_place(name, maps[2]) == "this map, from held-out regions"
