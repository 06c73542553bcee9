"""What a run is asked to do: the observation, and the policy that goes with it."""

import pytest

from cluster.settings import EvolveSettings, SettingsError, from_dict, to_dict


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
