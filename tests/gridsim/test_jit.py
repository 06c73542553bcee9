"""Compiled kernels: never stale after an edit anywhere, and the same as plain Python."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from evolution.episodes.collecting import collect
from evolution.episodes.rollout import EPISODE, Limits, evaluate
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import RECIPE, Mutation, breed, moments
from gridsim import jit
from gridsim.car.ego import COS, DISTANCE, FIELDS, SIN, SPEED, STEERING, X, Y, control, look, place
from gridsim.car.vehicle import act
from gridsim.config import SimConfig, constants
from gridsim.maps.map import Map, sample_starts
from gridsim.maps.roads import Strips, clearance_nodes, make_road
from gridsim.maps.scenarios import build
from gridsim.sensing.rays import SIMD_RAYS, fan

F = np.float32

# `collides` is in one file, `clearance`, which it calls, and the constant in there are in another.
CALLER = """
import json
import numpy as np
from gridsim import jit
from gridsim.car import ego
from gridsim.maps import roads
from gridsim.config import SimConfig, constants
u, f = np.uint32, np.float32
byte = 150  # of clearance at every node: 2.69 m above the floor of -2 m
word = byte * 0x01010101
road = roads.Road(roads.freeze(np.full(64, word, dtype=u)), roads.freeze(np.zeros(16, dtype=np.int32)),
                  roads.freeze(np.zeros(200, dtype=np.uint8)), u(8), u(8), f(4), f(4), f(5), f(12))
hit = ego.collides(road, constants(SimConfig()), f(1), f(1), f(1), f(0))
hits = sum(ego.collides.stats.cache_hits.values())
print(json.dumps({"file": roads.__file__, "folder": str(jit.CACHE_FOLDER), "hit": bool(hit), "from_cache": hits}))
"""

DIGESTS = """
import json
from pathlib import Path
from gridsim import jit
digests = {"before": jit.kernel_digest()}
for path in sorted(Path(".").rglob("*.py")):
    text = path.read_bytes()
    path.write_bytes(text + b"# edited\\n")
    digests[str(path)] = jit.kernel_digest()
    path.write_bytes(text)
digests["after"] = jit.kernel_digest()
print(json.dumps(digests))
"""


@pytest.fixture
def copy(root, tmp_path):
    """A copy of the packages that hold kernels, to be edited."""
    folder = tmp_path / "copy"
    for package in jit.KERNEL_PACKAGES:
        shutil.copytree(root / package, folder / package, ignore=shutil.ignore_patterns("__pycache__", "*.nb?"))
    return folder


def python(code, folder, cache, **environment):
    """Run a script in a process of its own; its last line is JSON."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "GRIDSIM_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1", **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_an_edited_kernel_is_compiled_anew_and_a_copy_elsewhere_is_not(copy, tmp_path):
    cache = tmp_path / "cache"
    first = python(CALLER, copy, cache)
    assert Path(first["file"]).is_relative_to(copy)
    assert Path(first["folder"]).is_relative_to(cache)
    assert (first["hit"], first["from_cache"]) == (False, 0)

    elsewhere = tmp_path / "shipped" / "unpacked"
    shutil.copytree(copy, elsewhere)
    again = python(CALLER, elsewhere, cache)
    assert Path(again["file"]).is_relative_to(elsewhere)
    assert again["folder"] == first["folder"]
    assert (again["hit"], again["from_cache"]) == (False, 1)

    roads = copy / "gridsim" / "maps" / "roads.py"
    text, edits = re.subn(r"(?m)^FIELD_FLOOR = -2\.0\b", "FIELD_FLOOR = -9.0", roads.read_text())
    assert edits == 1
    roads.write_text(text)
    edited = python(CALLER, copy, cache)
    assert edited["folder"] != first["folder"]
    assert (edited["hit"], edited["from_cache"]) == (True, 0)


def test_an_edit_of_any_file_is_another_cache_folder(copy, tmp_path):
    digests = python(DIGESTS, copy, tmp_path / "cache")
    assert digests.pop("after") == digests["before"]
    files = {str(p.relative_to(copy)) for p in copy.rglob("*.py")}
    assert {"gridsim/car/vehicle.py", "gridsim/config.py", "evolution/networks/policy.py"} < files
    assert set(digests) == files | {"before"}
    assert len(set(digests.values())) == len(digests)


def test_the_cache_folder_is_the_users_choice_or_temporary(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert jit.cache_folder().is_relative_to(tmp_path / "xdg")
    monkeypatch.setenv("GRIDSIM_CACHE_DIR", str(tmp_path / "mine"))
    assert jit.cache_folder().is_relative_to(tmp_path / "mine")
    assert jit.cache_folder().name.endswith(jit.kernel_digest())
    (tmp_path / "file").touch()  # nothing can be written below it
    monkeypatch.setenv("GRIDSIM_CACHE_DIR", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    assert jit.cache_folder().is_relative_to(tmp_path / "temporary")
    assert jit.cache_folder().is_dir()


# --- Plain Python ----------------------------------------------------------------------------------------------------

SPEC = PolicySpec.parse("mlp:5,3")
STEPS = 25
CONFIG = SimConfig()


def drive_a_while(scenario, start, actions):
    """States [n, FIELDS] and ranges [n, 31] of one car under given actions."""
    k = constants(CONFIG)
    rays = fan(31, k.ray_first, k.ray_step)
    car, visits = np.zeros(FIELDS, dtype=F), np.zeros(64 * 64, dtype=F)
    beams, ranges = np.empty((3, SIMD_RAYS), dtype=F), np.empty(31, dtype=F)
    place(scenario.road, start, car, visits)
    states, seen, ends = [], [], []
    for action in actions:
        look(scenario.road, k, rays, car, None, beams, ranges, None)
        pedal, wheel = map(F, act(k, int(action), car[SPEED], car[STEERING]))
        ends.append(control(scenario.road, k, car, visits, None, pedal, wheel, F(1000.0), 1000))
        states.append(car.copy())
        seen.append(ranges.copy())
    return {"states": np.array(states), "ranges": np.array(seen), "ends": np.array(ends)}


def roll_out(scenario, start, genomes):
    episodes = np.zeros(1, dtype=EPISODE)
    episodes["start"] = start
    results, _, _ = evaluate(SPEC, genomes, [scenario], episodes, Limits(1000.0, STEPS), CONFIG)
    return {name: results[name] for name in ("distance", "paced", "steps", "end")}


def collect_some(scenario, start, genomes):
    """Half of the actions random."""
    episodes = np.zeros(2, dtype=EPISODE)
    episodes["start"] = start
    epsilons, keys = np.full(2, 0.5, dtype=F), np.array([2**63 + 9, 4], dtype=np.uint64)
    limits = Limits(1000.0, STEPS)
    experience, _ = collect(SPEC, genomes[0], [scenario], episodes, epsilons, keys, limits, CONFIG)
    return experience._asdict()


def have_children(parents):
    """One of each kind, and two of crossover."""
    recipes = np.array(
        [(0, 0, 0, 0), (1, 0, 0, 3), (2, 0, 1, 5), (3, 0, 1, 5), (4, 1, 2, 1), (4, 1, 1, 2)], dtype=RECIPE
    )
    seeds = np.arange(7)
    first, second = moments(seeds, seeds - 2.5, seeds / 7.0, 2**62 + 5, SPEC)
    children = breed(parents, recipes, 2**62 + 5, SPEC, Mutation(rate=0.2, sigma=0.5))
    return {"children": children, "first": first, "second": second}


def lay_a_road():
    strips = Strips.of([[0.0, 5.0, 16.0, 5.0, 2.0]], [[8.0, 9.0, 4.0, 0.3, -4.0, 1.0]])
    nodes = clearance_nodes(strips, 16.0, 16.0)
    road = make_road(nodes, (5.0, 12.0), 50.0)
    return {"nodes": nodes, "field": road.field, "start_row": road.start_row, "start": road.start}


def everything(given):
    """The arrays of each part, by name."""
    scenario = Map.from_arrays({k[4:]: v for k, v in given.items() if k.startswith("map_")})
    parts = {
        "drive": drive_a_while(scenario, given["start"], given["actions"]),
        "rollout": roll_out(scenario, given["start"], given["genomes"]),
        "collect": collect_some(scenario, given["start"], given["genomes"]),
        "breed": have_children(given["genomes"]),
        "road": lay_a_road(),
    }
    return {f"{name}_{key}": value for name, part in parts.items() for key, value in part.items()}


@pytest.fixture(scope="module")
def both(root, tmp_path_factory):
    """Results of the compiled kernels, and of a process in which they are plain Python."""
    folder = tmp_path_factory.mktemp("plain")
    scenario = build("seamless", 3)
    rng = np.random.default_rng(5)
    given = {f"map_{k}": v for k, v in scenario.arrays().items()}
    given["start"] = sample_starts(scenario, 1, rng)[0]
    given["start"][3] = 5.0  # m/s
    given["actions"] = np.array([0, 0, 4, 1, 5, 2, 2, 6, 4, 3, 0, 7, 7, 0, 5, 1, 4, 2, 0, 3, 0, 4, 4, 0, 1])
    given["genomes"] = rng.normal(size=(3, SPEC.size)).astype(F)
    np.savez(folder / "given.npz", allow_pickle=False, **given)
    code = f"""
import sys, json, numpy as np
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_jit
from gridsim.car import vehicle
assert type(vehicle.act).__name__ == "function"
np.savez({str(folder / "plain.npz")!r}, **test_jit.everything(dict(np.load({str(folder / "given.npz")!r}))))
print(json.dumps("done"))
"""
    assert python(code, root, folder, NUMBA_DISABLE_JIT="1") == "done"
    return everything(given), dict(np.load(folder / "plain.npz"))


def test_plain_python_drives_the_same_way(both):
    compiled, plain = both
    assert (plain["drive_ends"] == compiled["drive_ends"]).all()
    states, same = compiled["drive_states"], plain["drive_states"]
    for column in (X, Y, COS, SIN, SPEED, STEERING, DISTANCE):
        assert same[:, column] == pytest.approx(states[:, column], abs=1e-4), column
    assert same == pytest.approx(states, abs=1e-3)
    assert states[-1, DISTANCE] > 10.0
    # Some cm, and more where a ray grazes.
    away = np.abs(plain["drive_ranges"] - compiled["drive_ranges"])
    assert np.quantile(away, 0.9) < 0.02
    assert np.quantile(away, 0.97) < 0.2
    for name in ("distance", "paced", "steps", "end"):
        assert plain[f"rollout_{name}"] == pytest.approx(compiled[f"rollout_{name}"], abs=1e-3)
    assert compiled["rollout_distance"].max() > 5.0
    for name in ("actions", "ends"):
        assert (plain[f"collect_{name}"] == compiled[f"collect_{name}"]).all()
    assert plain["collect_rewards"] == pytest.approx(compiled["collect_rewards"], abs=0.01)
    away = np.abs(plain["collect_observations"].astype(int) - compiled["collect_observations"])
    assert np.quantile(away, 0.9) < 20  # as of the ranges above
    assert len(set(compiled["collect_actions"])) > 5


def test_plain_python_breeds_the_same_children_and_lays_the_same_road(both):
    compiled, plain = both
    children, same = compiled["breed_children"], plain["breed_children"]
    assert same[0].tobytes() == children[0].tobytes()
    assert same == pytest.approx(children, abs=1e-4)
    assert len(np.unique(children, axis=0)) == 6
    for moment in ("breed_first", "breed_second"):
        assert plain[moment] == pytest.approx(compiled[moment], rel=1e-4, abs=1e-4)
    assert plain["road_nodes"] == pytest.approx(compiled["road_nodes"], abs=1e-5)
    assert (plain["road_start_row"] == compiled["road_start_row"]).all()
    assert (plain["road_field"] == compiled["road_field"]).mean() > 0.99
    away = plain["road_start"].astype(int) - compiled["road_start"].astype(int)
    assert np.abs(away).max() <= 1
    assert (away == 0).mean() > 0.99
