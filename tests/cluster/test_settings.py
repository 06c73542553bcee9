"""What a run is asked to do: the observation, and the policy that goes with it."""

from dataclasses import replace

import pytest

from cluster.runs.settings import DqnSettings, EvolveSettings, SettingsError, from_dict, to_dict
from evolution.search.base import SearchConfig
from gridsim.maps.scenarios import REGISTRY


def test_the_policy_follows_the_observation():
    assert EvolveSettings().policy == "mlp:64+steering"
    assert EvolveSettings(observation="grid").policy == "cnn:8,16,32@1"
    assert EvolveSettings(observation="grid", policy="cnn").policy == "cnn"
    for settings in (EvolveSettings(), EvolveSettings(observation="grid"), EvolveSettings(policy="mlp:3")):
        settings.check()
        assert from_dict(EvolveSettings, to_dict(settings)) == settings


@pytest.mark.parametrize(
    ("observation", "policy", "hint"),
    [("grid", "mlp:6,7", "--observation rays"), ("rays", "cnn", "--observation grid")],
)
def test_a_policy_that_sees_something_else_is_refused(observation, policy, hint):
    with pytest.raises(SettingsError, match=rf"^policy {policy} sees the [^\n]*{hint}[^\n]*$"):
        EvolveSettings(observation=observation, policy=policy).check()


def test_an_unknown_observation_is_refused():
    values = to_dict(EvolveSettings())
    with pytest.raises(SettingsError, match="rays or grid"):
        from_dict(EvolveSettings, values | {"observation": "radar"})
    with pytest.raises(SettingsError, match="must be str"):
        from_dict(EvolveSettings, values | {"observation": 3})


def test_a_run_from_before_there_were_grids_sees_rays():
    values = to_dict(EvolveSettings(policy="mlp:9"))
    del values["observation"]
    assert from_dict(EvolveSettings, values).observation == "rays"


def test_what_is_not_given_suits_the_observation():
    rays, grid = DqnSettings(), DqnSettings(observation="grid", batch=32)
    for settings in (rays, grid):
        settings.check()
    assert (rays.batch, rays.updates, rays.replay) == (256, 4.0, 1_000_000)
    assert (grid.batch, grid.updates, grid.replay) == (32, 16.0, 100_000)
    assert from_dict(DqnSettings, to_dict(grid)) == grid


def test_evolution_s_default_budget_is_of_car_steps():
    assert (EvolveSettings().generations, EvolveSettings().car_steps) == (0, 30_000_000)
    assert EvolveSettings(traffic=1).car_steps == EvolveSettings("highway").car_steps == 90_000_000
    assert EvolveSettings("highway", traffic=0).car_steps == 30_000_000
    assert EvolveSettings(generations=2_000).car_steps == 0  # whoever says how long means it
    assert EvolveSettings(car_steps=7).generations == 0
    assert EvolveSettings(car_steps=7).car_steps == 7
    both = EvolveSettings(generations=9, car_steps=7)
    assert (both.generations, both.car_steps) == (9, 7)
    settings = from_dict(EvolveSettings, to_dict(EvolveSettings()))
    assert settings == EvolveSettings()
    assert settings.ended({"solved": False, "generation": 1, "car_steps": 30_000_000})
    assert not settings.ended({"solved": False, "generation": 10**9, "car_steps": 29_999_999})
    assert EvolveSettings(generations=4).ended({"solved": False, "generation": 4, "car_steps": 0})
    assert not EvolveSettings(generations=4).ended({"solved": False, "generation": 3, "car_steps": 10**12})
    assert settings.ended({"solved": True, "generation": 0, "car_steps": 0})


def test_more_generations_of_a_run_of_the_default_budget_are_not_cut_short_by_it():
    usual, short = EvolveSettings(seed=3), EvolveSettings(generations=9, car_steps=100)
    assert replace(usual, generations=500).extending(usual) == EvolveSettings(seed=3, generations=500)
    assert usual.extending(usual) == usual
    busy = EvolveSettings("city")
    assert replace(busy, generations=500).extending(busy) == EvolveSettings("city", generations=500)
    assert replace(short, generations=10).extending(short) == EvolveSettings(generations=10, car_steps=100)
    assert DqnSettings().extending(DqnSettings()) == DqnSettings()


def test_evolution_sees_motion_in_traffic():
    for scenario in REGISTRY:
        assert EvolveSettings(scenario, traffic=2).policy == "mlp:64+motion+steering"
        assert EvolveSettings(scenario, traffic=0).policy == "mlp:64+steering"
    assert EvolveSettings("city").policy == "mlp:64+motion+steering"
    assert EvolveSettings("city", observation="grid").policy == EvolveSettings(observation="grid").policy
    assert EvolveSettings("city", policy="mlp:5").policy == "mlp:5"


# --- The search ------------------------------------------------------------------------------------------------------


def test_the_search_s_parameters_are_the_settings():
    settings = EvolveSettings(recombination="two", population=64, tournament=3, sigma=0.7, elites=2, mutation_rate=0.1)
    settings.check()
    assert settings.search_config() == SearchConfig(64, 4, 3, 0.7, 2, 0.1)
    EvolveSettings().check()
    assert EvolveSettings().search_config() == SearchConfig(256, 8, 8, 0.5, 8, 0.03)


def test_there_are_no_more_groups_than_members_for_them():
    """Of a group's members the best are to be good."""
    for population, groups in ((4, 1), (31, 1), (32, 2), (63, 3), (64, 4), (127, 7), (1000, 8)):
        settings = EvolveSettings(population=population)
        settings.check()
        assert settings.curriculum().groups == settings.search_config().groups == groups


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"elites": 4}, "--elites is for --recombination two"),
        ({"mutation_rate": 0.1}, "--mutation-rate is for --recombination two"),
        ({"recombination": "two", "population": 8}, "--elites must be"),
        ({"recombination": "two", "elites": -1}, "--elites must be"),
        ({"recombination": "two", "elites": 10_001, "population": 20_000}, "--elites must be"),
        ({"recombination": "two", "mutation_rate": -0.5}, "--mutation-rate must be 0 to 1"),
        ({"recombination": "two", "mutation_rate": 1.5}, "--mutation-rate must be 0 to 1"),
        ({"population": 3}, "population must be 4 or more"),
        ({"population": 1_000_001}, "--population must be 1,000,000 or less"),
        ({"tournament": 0}, "tournament"),
        ({"sigma": -1.0}, "sigma must be above 0"),
        ({"sigma": float("nan")}, "sigma must be above 0"),
        ({"generations": -1}, "--generations"),
    ],
)
def test_searches_that_make_no_sense_are_refused_in_one_line(wrong, told):
    with pytest.raises(SettingsError, match=rf"^[^\n]*{told}[^\n]*$"):
        EvolveSettings(**wrong).check()


@pytest.mark.parametrize("name", ["parents", "crossover", "islands", "ranking", "bump_rate"])
def test_settings_that_went_are_unknown(name):
    with pytest.raises(SettingsError, match=f"^unknown setting '{name}'$"):
        from_dict(EvolveSettings, to_dict(EvolveSettings()) | {name: 1})


def test_another_recombination_is_refused():
    with pytest.raises(SettingsError, match="'recombination' must be all or two"):
        from_dict(EvolveSettings, to_dict(EvolveSettings()) | {"recombination": "some"})
