"""What a run is asked to do: the flags, their defaults and bounds, and how config.json is read."""

from dataclasses import asdict, replace

import pytest

from cluster.settings import DqnSettings, EvolveSettings, from_dict
from gridsim.errors import GridSimError

POLICIES = {
    "mlp:64+steering": EvolveSettings("city", traffic=0),
    "mlp:64+motion+steering": EvolveSettings("curved", traffic=2),
    "cnn:8,16,32@1": EvolveSettings("city", observation="grid"),
    "mlp:5": EvolveSettings("city", policy="mlp:5"),
    "cnn:16,32,256@4": DqnSettings(observation="grid", batch=32),
}


@pytest.mark.parametrize(("policy", "settings"), POLICIES.items())
def test_the_policy_suits_observation_and_traffic(policy, settings):
    settings.check()
    assert settings.policy == policy
    assert from_dict(type(settings), asdict(settings)) == settings


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"observation": "radar"}, "rays or grid"),
        ({"population": True}, "must be int"),
        ({"recombination": "some"}, "--recombination must be all or two"),
        ({"crossover": 1}, "^unknown setting 'crossover', perhaps of another version of GridSim; start a new run$"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(change, said):
    with pytest.raises(GridSimError, match=said):
        from_dict(EvolveSettings, asdict(EvolveSettings()) | change)


def test_what_is_not_given_suits_the_observation():
    rays, grid = DqnSettings(), DqnSettings(observation="grid", batch=32)
    assert (rays.batch, rays.updates, rays.replay) == (256, 4.0, 1_000_000)
    assert (grid.batch, grid.updates, grid.replay) == (32, 16.0, 100_000)


def test_evolution_s_default_budget_is_of_car_steps():
    usual, short = EvolveSettings(), EvolveSettings(generations=4)
    assert (usual.generations, usual.car_steps) == (0, 30_000_000)
    assert (usual.population, EvolveSettings("highway").population) == (256, 128)
    assert EvolveSettings("highway").car_steps == 60_000_000
    assert (short.generations, short.car_steps) == (4, 0)  # whoever says how long means it
    assert usual.ended({"solved": False, "generation": 1, "car_steps": 30_000_000})
    assert not usual.ended({"solved": False, "generation": 10**9, "car_steps": 29_999_999})
    assert usual.ended({"solved": True, "generation": 0, "car_steps": 0})
    assert short.ended({"solved": False, "generation": 4, "car_steps": 0})
    assert not short.ended({"solved": False, "generation": 3, "car_steps": 10**12})


def test_more_generations_of_a_run_of_the_default_budget_are_not_cut_short_by_it():
    usual, short = EvolveSettings("city", seed=3), EvolveSettings(generations=9, car_steps=100)
    assert replace(usual, generations=500).extending(usual) == EvolveSettings("city", seed=3, generations=500)
    assert usual.extending(usual) == usual
    assert replace(short, generations=10).extending(short) == EvolveSettings(generations=10, car_steps=100)


@pytest.mark.parametrize(("population", "groups"), [(4, 1), (31, 1), (32, 2), (127, 7), (1000, 8)])
def test_there_are_no_more_groups_than_members_for_them(population, groups):
    """The best of a group's members are to be good."""
    settings = EvolveSettings(population=population)
    settings.check()
    assert settings.curriculum().groups == settings.search_config().groups == groups


@pytest.mark.parametrize(
    ("kind", "wrong", "said"),
    [
        (EvolveSettings, {"observation": "grid", "policy": "mlp:5"}, "policy mlp:5 sees the rays.*--observation rays"),
        (EvolveSettings, {"elites": 4}, "--elites is for --recombination two"),
        (EvolveSettings, {"recombination": "two", "mutation_rate": 1.5}, "--mutation-rate must be 0 to 1"),
        (EvolveSettings, {"tournament": 0}, "--tournament must be 1 to"),
        (EvolveSettings, {"sigma": float("nan")}, "--sigma must be above 0"),
        (DqnSettings, {"discount": 1.5}, "--discount must be 0 to 1, not 1.5"),
        (DqnSettings, {"replay": 10}, "--replay must be 256 to 10,000,000, not 10"),
        (EvolveSettings, {"observation": "pixels"}, "--observation must be rays or grid, not pixels"),
        (DqnSettings, {"anneal": 10**400}, "--anneal must be 1 to 1,000,000,000,000,000"),
    ],
)
def test_settings_that_make_no_sense_are_refused_in_one_line(kind, wrong, said):
    with pytest.raises(GridSimError, match=rf"^[^\n]*{said}[^\n]*$"):
        kind(**wrong).check()
