"""Populations that begin a run one after another: each from nothing, the best goes on, and a resumed run knows them."""

import dataclasses

import pytest

from cluster import coordinator
from cluster.checkpoint import CheckpointError, load, save
from cluster.coordinator import Evolution, Population
from cluster.learning import Champion, Maps
from cluster.pool import SerialPool
from cluster.settings import EvolveSettings, SettingsError
from gridsim.config import SimConfig

SETTINGS = EvolveSettings(
    traffic=3, population=32, generations=100, elites=2, parents=8, seed=9, islands=3, island_car_steps=25_000
)


@pytest.fixture(scope="module")
def maps():
    maps = Maps(SETTINGS.scenario, SimConfig())
    yield maps
    maps.close()


def begin(maps, settings=SETTINGS, initial=None):
    """A run with a short validation."""
    evolution = Evolution(settings, SerialPool(maps.build), maps, initial)
    curriculum = evolution.curriculum
    curriculum.config = dataclasses.replace(curriculum.config, validation=8, first_validation=4, contenders=2)
    return evolution


def go_on(evolution):
    """One generation more, at a second each."""
    evolution.timed(evolution.step(), float(evolution.generation), None)


def until_settled(evolution):
    while not evolution.settled:
        go_on(evolution)
    return evolution


def state_of(evolution):
    arrays, meta = evolution.state()
    return {name: array.tobytes() for name, array in arrays.items()}, meta


def test_each_begins_from_nothing_and_the_best_goes_on(maps):
    evolution = begin(maps)
    left: list[tuple[Population, Champion | None]] = []
    while not evolution.settled:
        go_on(evolution)
        if len(evolution.islands) > len(left):  # the next one has just begun
            left.append(evolution.islands[-1])
            assert (len(evolution.genetic.parents), len(evolution.curriculum.crashes)) == (0, 0)
            assert evolution.curriculum.target == evolution.curriculum.config.first_target
            assert evolution.champion is None
            assert not len(evolution.trials)
    assert len(left) == 2  # and the third is judged with them
    islands = [int(row["island"]) for row in evolution.history]
    assert sorted(islands) == islands
    assert set(islands) == {0, 1, 2}
    first = [evolution.elites[islands.index(k)].tobytes() for k in range(3)]
    assert len(set(first)) == 3  # random numbers of their own
    for (population, champion), k in zip(left, range(2), strict=True):
        if k == evolution.island:
            assert evolution.champion is champion
            assert evolution.genetic.parents is population.parents
        else:
            assert champion is not None
            assert (evolution.champion.score, evolution.champion.distance_m) >= (champion.score, champion.distance_m)
    go_on(evolution)
    assert evolution.history[-1]["island"] == evolution.island
    assert evolution.settled


def test_whose_champion_is_promising_goes_on_at_once(maps, monkeypatch):
    monkeypatch.setattr(coordinator, "PROMISING", 0.0)
    evolution = until_settled(begin(maps))
    assert {row["island"] for row in evolution.history} == {0.0}
    assert evolution.champion is not None
    parents = evolution.genetic.parents.copy()
    go_on(evolution)
    assert len(parents) == SETTINGS.elites + SETTINGS.parents
    assert evolution.history[-1]["island"] == 0.0


@pytest.mark.parametrize("settings", [{"islands": 1}, {"search": "random"}, {"island_car_steps": 10**9}])
def test_a_run_without_islands(maps, settings):
    evolution = begin(maps, dataclasses.replace(SETTINGS, **settings))
    for _ in range(3):
        go_on(evolution)
    assert {row["island"] for row in evolution.history} == {0.0}


def test_networks_on_the_grid_have_one_island_by_default():
    assert EvolveSettings(observation="grid").islands == 1
    assert EvolveSettings().islands == 4
    assert EvolveSettings(observation="grid", islands=2).islands == 2


def test_who_begins_with_a_champion_has_no_islands(maps):
    plain = begin(maps)
    go_on(plain)
    assert begin(maps, initial=plain.elites[0]).settled


def test_a_run_goes_on_exactly_from_any_of_its_islands(maps, tmp_path):
    straight = begin(maps)
    saved = []
    while not straight.settled:
        go_on(straight)
        save(tmp_path / f"{straight.steps}.npz", *straight.state())
        saved.append((straight.steps, straight.island))
    for _ in range(2):
        go_on(straight)
    for island in range(3):
        steps = max(step for step, of in saved[:-1] if of == island)
        resumed = begin(maps)
        resumed.restore(*load(tmp_path / f"{steps}.npz"))
        assert resumed.island == island
        while resumed.steps < straight.steps:
            go_on(resumed)
        assert state_of(resumed) == state_of(straight)


def test_a_run_that_ends_early_has_the_best_champion_of_all_islands(maps):
    evolution = begin(maps)
    while evolution.island < 2:
        go_on(evolution)
    go_on(evolution)
    best = Champion(evolution.elites[0].copy(), 0.99, 0.99, 1990.0, 0)
    evolution.islands[0] = evolution.islands[0][0], best
    before = evolution.state()
    evolution.conclude()
    assert evolution.champion is best
    extended = begin(maps)
    extended.restore(*before)  # what would go on is what was there
    assert extended.champion is not best
    assert extended.islands[0][1].score == 0.99


@pytest.mark.parametrize(
    "spoil",
    [
        {"island": 0}, {"island": 2}, {"island": 3}, {"island": -1}, {"island_began": -1}, {"island_began": 10**12},
        {"settled": True}, {"settled": 1}, {"populations": []}, {"populations": None}, {"champions": []},
        {"champions": None}, {"champions": [[0.5]]},
    ],
)  # fmt: skip
def test_a_checkpoint_of_impossible_islands_is_refused(maps, spoil):
    evolution = begin(maps)
    while evolution.island < 1:
        go_on(evolution)
    arrays, meta = evolution.state()
    begin(maps).restore(arrays, meta)
    with pytest.raises(CheckpointError, match="does not belong to this run"):
        begin(maps).restore(arrays, meta | spoil)
    for name in ("parents1", "crashes1", "crash_worlds1", "champion1"):
        with pytest.raises(CheckpointError, match="does not belong to this run"):
            begin(maps).restore(arrays | {name: arrays[name][..., :-1]}, meta)


def test_islands_are_checked():
    for islands, car_steps in ((-1, 1), (1001, 1), (2, 0)):
        with pytest.raises(SettingsError, match="--island"):
            dataclasses.replace(SETTINGS, islands=islands, island_car_steps=car_steps).check()
