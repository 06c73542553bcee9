"""One driver for several roads: its episodes, how its champion is chosen, and its figures by road."""

import contextlib
import json

import numpy as np
import pytest
from commands import CHAMPION, call, refused, summary
from learners import Untracked, pool_of

import gridsim
from cluster import run as module
from cluster.commands.cli import dqn_main, evaluate_main, evolve_main
from cluster.commands.watch import watch_main
from cluster.learn.evolution import Evolution
from cluster.learn.maps import Maps
from cluster.settings import DqnSettings, EvolveSettings
from cluster.store.champion import load_champion
from cluster.tracking.description import held_out_metrics
from evolution.episodes.curriculum import FINAL_SEEDS, spread_starts
from evolution.episodes.rollout import RESULT
from gridsim.maps.parts import road_of
from gridsim.maps.scenarios import REGISTRY
from gridsim.state import LANE, End


class Silent(Untracked):
    def __init__(self, *_):
        pass

    def where(self, command):
        return command


@pytest.fixture(autouse=True)
def _undisturbed(monkeypatch):
    """Runs without MLflow, which compile what they need as they need it."""
    monkeypatch.setattr(module, "Tracking", Silent)
    monkeypatch.setattr(module.kernels, "is_compiled", lambda settings: True)


SETTINGS = EvolveSettings("all", population=64)
ROADS = list(REGISTRY)


@pytest.fixture(scope="module")
def learning():
    with contextlib.closing(Maps(SETTINGS.scenario, SETTINGS.simulator())) as maps:
        yield Evolution(SETTINGS, pool_of(maps), maps)


def roads_of_episodes(episodes):
    """The number of each episode's road."""
    return np.array([ROADS.index(road_of(SETTINGS.scenario, episodes.maps[m])[0]) for m in episodes.rows["map"]])


def test_settings_of_several_roads_have_usual_traffic_and_the_network_for_it():
    network = "mlp:128+motion+steering+limit+mirrors"  # one driver has to tell a highway from a city
    assert (SETTINGS.scenario, SETTINGS.traffic, SETTINGS.policy) == (",".join(ROADS), "usual", network)
    assert DqnSettings("all").policy == "mlp:64,64+steering+limit+mirrors"
    assert EvolveSettings("all", 0).policy == "mlp:64+steering+limit"
    alone = [EvolveSettings(road, "usual", population=64).curriculum() for road in ROADS]
    assert SETTINGS.curriculum().pace == tuple(each.pace[0] for each in alone)
    assert SETTINGS.curriculum().champion_pace == tuple(each.champion_pace[0] for each in alone)
    assert EvolveSettings("city", "heavy").traffic == 12
    assert EvolveSettings("seamless").traffic == 0
    assert EvolveSettings("all", 0).traffic == 0 == EvolveSettings("all", sim="f1tenth").traffic


def test_a_driver_of_several_roads_meets_lights_in_the_city():
    sims = {roads: EvolveSettings(roads).sim for roads in ("all", "seamless,city", "seamless,curved", "city")}
    assert sims == {"all": "lights", "seamless,city": "lights", "seamless,curved": "default", "city": "default"}
    assert EvolveSettings("all", sim="default").sim == "default"


def test_training_meets_all_roads_alike(learning):
    curriculum, config = learning.curriculum, learning.curriculum.config
    assert {road_of(SETTINGS.scenario, seed)[0] for seed in curriculum.map_seeds[: curriculum.maps_in_use(0)]} == {
        *ROADS
    }
    met = np.zeros((config.groups, len(ROADS)), dtype=int)
    limits: dict[int, set[int]] = {road: set() for road in range(len(ROADS))}
    for generation in range(len(ROADS)):
        episodes = curriculum.episodes(generation)
        roads = roads_of_episodes(episodes).reshape(config.groups, config.starts)
        counts = np.bincount(roads.ravel(), minlength=len(ROADS))
        assert counts.max() - counts.min() <= 1
        for road in range(len(ROADS)):
            limits[road] |= set(episodes.rows["steps"][roads.ravel() == road])
        for group, own in enumerate(roads):
            met[group] += np.bincount(own, minlength=len(ROADS))
    assert met.min() == met.max() == config.starts
    for road, pace in enumerate(config.pace):
        assert limits[road] == {np.ceil(10.0 * (curriculum.target / pace + config.slack))}
    cars = (episodes.worlds[..., LANE] >= 0).sum(axis=1)
    assert all(cars[roads.ravel() == road].max(initial=0) <= 2 * own for road, own in enumerate(SETTINGS.crowds))
    assert cars[roads.ravel() == 0].min(initial=12) >= 12


def test_validation_of_a_road_is_that_of_a_run_on_it_alone(learning):
    """So are the held-out drives."""
    seeds, each = FINAL_SEEDS[:3], learning.curriculum.config.validation
    episodes = learning.curriculum.validation(seeds)
    assert (roads_of_episodes(episodes) == np.repeat(range(len(ROADS)), each)).all()
    with contextlib.closing(Maps("roundabout", SETTINGS.simulator())) as maps:
        alone = spread_starts(maps.get, seeds, each, (4,), learning.sim)
    own = slice(3 * each, 4 * each)
    assert episodes.rows["start"][own].tobytes() == alone.rows["start"].tobytes()
    assert episodes.worlds[own, :4].tobytes() == alone.worlds.tobytes()
    assert (episodes.worlds[own, 4:, LANE] == -1.0).all()


def test_a_champion_is_chosen_on_its_worst_road_first(learning):
    """And then on the mean; --until is for the worst road, too."""
    each = learning.curriculum.config.validation

    def driven(*failures, slow=1):
        results = np.zeros((1, len(ROADS), each), dtype=RESULT)
        results["end"], results["distance"], results["steps"] = End.SUCCESS, 2000.0, 800
        for road, count in enumerate(failures):
            results["end"][0, road, :count] = End.COLLISION
        results["steps"][0, 0] *= slow
        return results.reshape(1, -1)

    def better(first, second):
        learning.champion = None
        for k, failures in enumerate((first, second)):
            learning._judge(np.array([k], dtype=np.float32), driven(*failures), k)
        return learning.champion.step == 1

    assert better((0, 0, 0, 0, 9), (5, 5, 5, 5, 5))
    assert better((0, 2, 2, 2, 9), (0, 0, 0, 0, 9))
    assert not better((0, 0, 0, 0, 9), (0, 2, 2, 2, 9))
    for step, results in enumerate((driven(0, 0, 0, 0, each // 20), driven(0, 0, 0, 0, 0, slow=3))):
        learning._judge(np.zeros(1, dtype=np.float32), results, step)
        assert (learning.champion.step, learning.solved) == (step, False)
        assert learning.champion.success_rate > 0.989
    learning._judge(np.zeros(1, dtype=np.float32), driven(0, 0, 0, 0, 0), 2)
    assert learning.solved


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--scenario all --pace 7", "--pace 7: each of the 5 roads has a pace of its own; leave it out"),
        ("--scenario highway,cty", "unknown scenario 'cty'; did you mean city?"),
        ("--scenario highway,,city", "the name of a road is empty"),
        ("--scenario all,city", "city is there twice"),
        ("--scenario city --traffic dense", "--traffic: 'dense' is neither usual, heavy nor a whole number"),
        ("--scenario all --traffic 101", "--traffic must be 0 to 100, not 101"),
        ("--scenario all,lab.png", "lab.png has no lanes for traffic; use --traffic 0, or leave it out of --scenario"),
        ("--scenario all,lab.png --traffic heavy", "--traffic heavy: "),
    ],
)
def test_roads_that_do_not_go_together_are_refused(here, monkeypatch, capsys, flags, said):
    assert said in refused(evolve_main, monkeypatch, capsys, *flags.split())[0]


def test_a_run_on_several_roads_has_figures_by_road(here, monkeypatch, capsys):
    monkeypatch.setattr(module, "Tracking", Silent)
    flags = ["--policy", "mlp:4+motion", "--population", "16", "--generations", "2", "--name", "r", "--traffic", "2"]
    code, out, _ = call(evolve_main, monkeypatch, capsys, "--scenario", "highway,curved", *flags)
    assert code == 0
    ended = summary(here / "runs/r")
    by_road, whole = ended["held_out_by_road"], ended["held_out"]
    assert list(by_road) == ["highway", "curved"]
    for name in ("success_rate", "speed_mps", "distance_m", "collision_rate"):
        assert whole[name] == pytest.approx(np.mean([by_road[road][name] for road in by_road]), rel=1e-6)
    assert whole["episodes"] == 128
    for words in ("held-out drives of 2 roads", "│ highway │", "│ curved", "│ all", "64 episodes each"):
        assert words in out
    metrics = held_out_metrics(ended)
    assert metrics["held_out/curved/success_rate"] == by_road["curved"]["success_rate"]
    assert metrics["held_out/km_per_collision"] == whole["km_per_collision"]
    champion = load_champion(here / "runs/r")
    assert (champion.scenario, champion.traffic) == ("highway,curved", 2)
    for road, figures in by_road.items():  # the same drives as those of `evaluate` on one of its roads
        assert gridsim.evaluate(champion, road) == pytest.approx(figures)
    said = json.loads(call(evaluate_main, monkeypatch, capsys, "runs/r", "--json")[1])
    assert said["by_road"] == {road: pytest.approx(figures) for road, figures in by_road.items()}
    env = champion.make_env()
    env.reset(seed=0)
    for seed, road in ((2_000_000, "highway"), (2_000_001, "curved")):
        page = "--seed", seed, "--seconds", 1, "--output", "d.html"
        assert call(watch_main, monkeypatch, capsys, "runs/r", *page)[0] == 0
        assert f"GridSim: runs/r on {road}" in (here / "d.html").read_text()


def test_any_champion_is_evaluated_on_all_roads(monkeypatch, capsys):
    code, out, _ = call(evaluate_main, monkeypatch, capsys, CHAMPION, "--scenario", "all", "--episodes", 2)
    assert code == 0
    rows = {line.split()[1]: line.split()[3] for line in out.splitlines() if line.startswith("│ ")}
    assert list(rows) == [*ROADS, "all"]
    assert [rows[road] for road in ROADS] == ["8", "6", "6", "4", "6"]


def test_the_dqn_learns_on_several_roads(here, monkeypatch, capsys):
    flags = "--car-steps 2e4 --evaluate-every 1e4 --policy mlp:4 --replay 2000 --name d --scenario highway,curved"
    assert call(dqn_main, monkeypatch, capsys, *flags.split())[0] == 0
    assert list(summary(here / "runs/d")["held_out_by_road"]) == ["highway", "curved"]
