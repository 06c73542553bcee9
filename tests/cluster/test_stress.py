"""gridsim-evaluate --stress: a champion with ever worse sensors, actuators and tyres."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cluster.commands.cli import evaluate_main
from cluster.report import stress
from cluster.store.champion import Champion
from evolution.networks.policy import PolicySpec
from gridsim.config import EpisodeConfig, SimConfig, VehicleConfig

LEVELS = (*stress.STRESSES, *stress.KINEMATIC)
SHORT = SimConfig(episode=EpisodeConfig(target=10.0, time_limit=20.0))


@pytest.fixture
def driver() -> Champion:
    """One that drives straight on, slowly at first."""
    genome = np.zeros(PolicySpec.parse("mlp:8").size, dtype=np.float32)
    return Champion(genome, "mlp:8", "highway", SHORT)


def test_each_level_is_measured_printed_and_drawn(
    driver: Champion, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    driver.save("champion.npz")
    for flags in ([], ["--json"]):
        monkeypatch.setattr(sys, "argv", ["gridsim-evaluate", "champion.npz", "--episodes", "2", "--stress", *flags])
        with pytest.raises(SystemExit) as ended:
            evaluate_main()
        assert ended.value.code == 0
    printed, line = capsys.readouterr().out.rsplit("\n{", 1)
    for each in LEVELS:
        assert each.label in printed
    figures = json.loads("{" + line)
    assert len(figures["stress"]) == sum(len(each.levels) for each in LEVELS)
    perfect = [
        row for row in figures["stress"] if row["level"] == (1.0 if row["what"] == "vehicle.lateral_grip" else 0.0)
    ]
    assert len(perfect) == len(LEVELS)
    for row in perfect:
        assert {name: row[name] for name in ("success_rate", "distance_m", "episodes")} == {
            name: figures[name] for name in ("success_rate", "distance_m", "episodes")
        }
    with Image.open("stress.png") as picture:
        assert picture.size == (1500, 320)


def test_what_is_drawn_for_each_episode_gets_worse_too() -> None:
    drawn = (("lateral_grip", 3.0, 4.0), ("latency", 0.1, 0.3), ("steering_rate", 40.0, 60.0))
    sim = dataclasses.replace(SHORT, randomise=drawn)
    assert stress.KINEMATIC[0].at(0.5, sim).randomise == (("lateral_grip", 1.5, 2.0), *drawn[1:])
    assert stress.STRESSES[3].at(0.4, sim).randomise == (drawn[0], ("latency", 0.4, 0.4), drawn[2])
    assert stress.STRESSES[2].at(0.4, sim).randomise == drawn


def test_a_dynamic_vehicle_is_stressed_by_friction_and_mass_in_place_of_grip(driver: Champion) -> None:
    sim = dataclasses.replace(SHORT, vehicle=VehicleConfig(model="single_track"))
    names = [each.name for each in stress.stresses(dataclasses.replace(driver, sim=sim))]
    assert "lateral_grip" not in names
    assert {"friction", "mass"} <= set(names)
    heavy = stress.DYNAMIC[1].at(1.5, sim).vehicle
    assert heavy.mass == pytest.approx(1.5 * sim.vehicle.mass)
