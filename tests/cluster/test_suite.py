"""gridsim-evaluate --suite: the drives in which champions of anybody are compared."""

import dataclasses
import json

import numpy as np
import pytest
from commands import refused

from cluster.commands.cli import evaluate_main
from cluster.report import suite
from cluster.store.champion import Champion
from evolution.networks.policy import PolicySpec
from gridsim.config import SensorConfig, SimConfig
from gridsim.maps.scenarios import REGISTRY


def driver(noise: float = 0.0) -> Champion:
    """One that drives straight on."""
    genome = np.zeros(PolicySpec.parse("mlp:8").size, dtype=np.float32)
    return Champion(genome, "mlp:8", "highway", SimConfig(sensors=SensorConfig(noise=noise)))


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    monkeypatch.setattr(suite, "EPISODES", 4)


def run(monkeypatch, capsys, *flags):
    monkeypatch.setattr("sys.argv", ["gridsim-evaluate", "champion.npz", "--suite", *flags])
    with pytest.raises(SystemExit) as ended:
        evaluate_main()
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_a_suite_has_all_roads_with_usual_traffic_and_a_digest_by_which_it_is_checked(here, monkeypatch, capsys):
    driver().save("champion.npz")
    table = run(monkeypatch, capsys)
    written = json.loads((here / "suite.json").read_bytes())
    assert list(written["by_road"]) == list(REGISTRY)
    assert [road["cars"] for road in written["by_road"].values()] == [8, 6, 6, 4, 6]
    assert written["episodes"] == 4 * len(REGISTRY)
    assert written["digest"][:16] in table
    assert json.loads(run(monkeypatch, capsys, "--json")) == written
    assert "suite.json had the same drives: checked" in run(monkeypatch, capsys)
    (here / "suite.json").write_text(json.dumps(written | {"digest": "00"}))
    assert "suite.json had other drives (digest 00, now " in run(monkeypatch, capsys)
    assert json.loads((here / "suite.json").read_bytes()) == written
    dataclasses.replace(driver(), policy="mlp:8+steering", genome=np.ones(8 * 34 + 72, np.float32)).save("champion.npz")
    assert "suite.json" in run(monkeypatch, capsys), "another champion's file is replaced without a word"


def test_the_car_and_the_sensor_are_the_same_for_everybody():
    """A champion that learned with noise drives the suite without."""
    alone, noisy = (suite.report(each, list(suite.drive(each))) for each in (driver(), driver(noise=0.5)))
    assert alone == noisy


@pytest.mark.parametrize(
    ("flags", "said"), [(["--episodes", "5"], "leave out --episodes"), (["--traffic", "0"], "leave out --traffic")]
)
def test_what_would_change_the_suite_is_refused(here, monkeypatch, capsys, flags, said):
    driver().save("champion.npz")
    assert said in refused(evaluate_main, monkeypatch, capsys, "champion.npz", "--suite", *flags)[0]


def test_a_damaged_suite_json_is_named(here, monkeypatch, capsys):
    driver().save("champion.npz")
    (here / "suite.json").write_text("{")
    assert "suite.json cannot be read" in refused(evaluate_main, monkeypatch, capsys, "champion.npz", "--suite")[0]
