"""Runs for the tests of what is made of finished runs: folders as small as one can be, and figures."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from cluster.compare.plan import Plan
from cluster.compare.results import ERROR_FIGURES, RUN_FIGURES, Run
from cluster.store.champion import Champion
from cluster.store.folder import RunFolder
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig

HELD_OUT = {
    "episodes": 64, "success_rate": 0.5, "distance_m": 90.0, "speed_mps": 7.0, "collision_rate": 0.5,
    "km_per_collision": 0.18,
}  # fmt: skip


def make_run(folder, learner="evolution", scenario="curved", seed=0, settings=None):
    """A finished run's folder, as small as one can be; `settings` in place of what a comparison asks for."""
    folder.mkdir(parents=True, exist_ok=True)
    settings = settings or Plan(traffic=0).settings(scenario, learner, seed)
    rng = np.random.default_rng(np.random.SeedSequence(list(f"{folder.name} {settings.seed}".encode())))
    genome = rng.standard_normal(PolicySpec.parse(settings.policy).size).astype(np.float32)
    champion = Champion(genome, settings.policy, settings.scenario, SimConfig(), settings.traffic)
    champion.save(folder / "champion.npz")
    summary = {
        "scenario": settings.scenario, "seed": settings.seed, "car_steps": 5000, "wall_s": 12.5,
        "champion_generation": 1, "training_s": 6.0, "best_car_steps": 3000.0, "best_wall_s": 4.0,
        "champion_sha256": champion.sha256, "held_out": dict(HELD_OUT),
    }  # fmt: skip
    RunFolder(folder, settings).write_config()
    (folder / "summary.json").write_text(json.dumps(summary))
    return summary


def run(learner, scenario, seed, percent, traffic=0, observation="rays", **more):
    figures = dict.fromkeys([*RUN_FIGURES, *ERROR_FIGURES], 1.0)
    figures |= {"velocity_error_percent": percent, "training_s": 10.0, "success_rate": 0.9} | more
    name = f"{scenario}-{learner}-s{seed}"
    settings = Plan(traffic=traffic, observation=observation, budget="1k").settings(scenario, learner, seed)
    return Run(Path(name), settings, name, figures)


def with_errors(run):
    """In place of `measured`, which drives."""
    return dataclasses.replace(run, figures={**run.figures, **dict.fromkeys(ERROR_FIGURES, 2.5)})
