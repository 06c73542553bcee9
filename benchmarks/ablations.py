"""What each part of the default search is worth: python benchmarks/ablations.py [VARIANT ...] [--scenario NAME] ...

Each variant changes one thing and learns with several seeds, without validation. The table has the leader's success in
the 256 validation drives after so many million car-steps: the mean over the seeds, and the worst of them in brackets.
All variants on `seamless` with 8 seeds take half an hour on two cores.
"""

from __future__ import annotations

import argparse
import dataclasses
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

import numpy as np

from cluster.learn.evolution import Evolution
from cluster.learn.learning import finish
from cluster.learn.maps import Maps
from cluster.settings import EvolveSettings
from cluster.workers.open import open_pool
from evolution.episodes import curriculum
from evolution.episodes.curriculum import Curriculum, success_rate
from evolution.search import recombination
from evolution.search.base import Generation
from evolution.search.breeding import Kind
from evolution.search.recombination import Recombination


class FixedStepSize(Recombination):
    """The overall step size stays as it is."""

    def _tell(self, asked: Generation, scores: np.ndarray) -> None:
        super()._tell(asked, scores)
        self.sigma = self.config.sigma


class Unpaired(Recombination):
    """The second child of each pair has noise of its own.

    The update takes it for a mirror image, so noise and step size have to be corrected: to the update each child is a
    pair of its own, of which the other one never wins.
    """

    def _ask(self, key: int) -> Generation:
        asked = super()._ask(key)
        if len(self.centre):
            children = asked.recipes[2:]
            children["kind"], children["seed"] = Kind.STEP, np.arange(len(children))
        return asked

    def _tell(self, asked: Generation, scores: np.ndarray) -> None:
        if not len(self.centre):
            return super()._tell(asked, scores)
        n = len(scores) - 2
        standing = recombination.ranks(scores, asked.groups)
        weights = recombination.tournament_weights(standing, self.config.tournament)
        doubled = np.zeros(2 + 2 * n)
        doubled[:2], doubled[2::2] = weights[:2], weights[2:]
        given = recombination.tournament_weights
        recombination.tournament_weights = lambda *_: doubled
        try:
            super()._tell(asked, scores)
        finally:
            recombination.tournament_weights = given
        return None


@dataclass(frozen=True)
class Variant:
    """One change.

    Attributes:
        settings: of EvolveSettings.
        curriculum: of CurriculumConfig.
        search: the class of the search.
        constants: of the modules `recombination` and `curriculum`.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    curriculum: dict[str, Any] = field(default_factory=dict)
    search: type[Recombination] = Recombination
    constants: dict[str, float] = field(default_factory=dict)


VARIANTS = {
    "as it is": Variant(),
    "one group": Variant(curriculum={"groups": 1}),
    "no mirrored pairs": Variant(search=Unpaired),
    "fixed step size": Variant(search=FixedStepSize),
    "to the winners' mean": Variant(constants={"_LEARNING_RATE": 1.0}),
    "tournaments of 8": Variant(settings={"tournament": 8}),
    "the centre leads": Variant(constants={"_KEPT": 0.0}),
    "no crash starts": Variant(curriculum={"starts": 2, "crash_starts": 0}),
    "crash starts alike": Variant(constants={"LEAST_CRASH_WEIGHT": 1.0}),
    "all maps at once": Variant(curriculum={"first_maps": 128}),
    "32 maps": Variant(curriculum={"maps": 32}),
    "64 crashes": Variant(curriculum={"crash_memory": 64}),
    "crash starts earlier": Variant(curriculum={"rewind": 64}),
    "128 members": Variant(settings={"population": 128}),
    "256 members": Variant(settings={"population": 256}),
}


def learn(name: str, seed: int, scenario: str, traffic: int, budgets: list[float]) -> list[float]:
    """Success of the leader after each budget, million car-steps. Once per process only: constants stay changed."""
    variant = VARIANTS[name]
    for constant, value in variant.constants.items():
        setattr(curriculum if hasattr(curriculum, constant) else recombination, constant, value)
    settings = EvolveSettings(scenario=scenario, traffic=traffic, seed=seed, **variant.settings)
    maps = Maps(scenario, settings.simulator())
    learner = Evolution(settings, open_pool(0, None, 0.0, maps.build), maps)
    config = dataclasses.replace(settings.curriculum(), promising=2.0, **variant.curriculum)  # so nothing is validated
    learner.curriculum = Curriculum(config, seed, maps.get, maps.config, settings.crowds)
    search = dataclasses.replace(settings.search_config(), groups=config.groups)
    learner.search = variant.search(learner.search.space, search, seed)
    found = []
    for budget in budgets:
        while learner.car_steps < 1e6 * budget:
            finish(learner.step())
        taken, leader = learner.car_steps, learner.candidate()
        assert leader is not None
        driven = finish(learner.drive("validate", leader[None], learner.curriculum.validation()))
        learner.car_steps = taken
        found.append(float(success_rate(driven.results)[0]))
    return found


def main() -> None:
    """Learn and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variants", nargs="*", choices=[[], *VARIANTS], metavar="VARIANT", help="by default all")
    parser.add_argument("--scenario", default="seamless")
    parser.add_argument("--traffic", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--millions", type=float, nargs="+", default=[4.0, 8.0, 12.0], help="car-steps")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    print(f"| {options.scenario}, {options.traffic} cars | {' | '.join(f'{m:g}' for m in options.millions)} |")
    print("| --- |" + " ---: |" * len(options.millions), flush=True)
    with ProcessPoolExecutor(options.processes, get_context("spawn"), max_tasks_per_child=1) as pool:
        runs = {
            name: [
                pool.submit(learn, name, seed, options.scenario, options.traffic, options.millions)
                for seed in range(options.seeds)
            ]
            for name in options.variants or VARIANTS
        }
        for name, seeds in runs.items():
            found = np.array([seed.result() for seed in seeds])
            cells = [
                f"{mean:.3f} ({least:.2f})" for mean, least in zip(found.mean(axis=0), found.min(axis=0), strict=True)
            ]
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
