"""What a run is asked to do: the observation, and the policy that goes with it."""

from dataclasses import replace

import pytest

from cluster.settings import DqnSettings, EvolveSettings, SettingsError, from_dict, to_dict


def test_the_policy_follows_the_observation():
    assert EvolveSettings().policy == "mlp:6,7"
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


def test_evolution_s_default_budget_is_of_generations_and_of_car_steps():
    assert (EvolveSettings().generations, EvolveSettings().car_steps) == (400, 135_000_000)
    assert EvolveSettings(traffic=1).car_steps == EvolveSettings("highway").car_steps == 175_000_000
    assert EvolveSettings("highway", traffic=0).car_steps == 135_000_000
    assert EvolveSettings(generations=2_000).car_steps == 0  # whoever says how long means it
    assert EvolveSettings(car_steps=7).generations == 400
    assert EvolveSettings(car_steps=7).car_steps == 7
    settings = from_dict(EvolveSettings, to_dict(EvolveSettings()))
    assert settings == EvolveSettings()
    for generation, car_steps in ((400, 1), (1, 135_000_000)):
        assert settings.ended({"solved": False, "generation": generation, "car_steps": car_steps})
    assert not settings.ended({"solved": False, "generation": 399, "car_steps": 134_999_999})


def test_more_generations_of_a_run_of_the_default_budget_are_not_cut_short_by_it():
    usual, short = EvolveSettings(seed=3), EvolveSettings(generations=9, car_steps=100)
    assert replace(usual, generations=500).extending(usual) == EvolveSettings(seed=3, generations=500)
    assert usual.extending(usual) == usual
    busy = EvolveSettings("city")
    assert replace(busy, generations=500).extending(busy) == EvolveSettings("city", generations=500)
    assert replace(short, generations=10).extending(short) == EvolveSettings(generations=10, car_steps=100)
    assert DqnSettings().extending(DqnSettings()) == DqnSettings()


def test_evolution_sees_motion_in_traffic_on_all_roads_but_one():
    for scenario in ("highway", "seamless", "roundabout", "city"):
        assert EvolveSettings(scenario, traffic=2).policy == "mlp:16,16+motion"
        assert EvolveSettings(scenario, traffic=0).policy == "mlp:6,7"
    assert EvolveSettings("city").policy == "mlp:16,16+motion"
    assert EvolveSettings("curved", traffic=2).policy == "mlp:6,7"
    assert EvolveSettings("city", observation="grid").policy == EvolveSettings(observation="grid").policy
    assert EvolveSettings("city", policy="mlp:5").policy == "mlp:5"
    assert EvolveSettings("city").mutation_rate == 0.012
    for settings in (EvolveSettings("city", traffic=0), EvolveSettings("city", policy="mlp:5")):
        assert settings.mutation_rate == 0.03
    for rate in (0.0, 0.5):
        assert EvolveSettings("city", mutation_rate=rate).mutation_rate == rate
    with pytest.raises(SettingsError, match="--mutation-rate"):
        EvolveSettings("city", mutation_rate=-0.5).check()
