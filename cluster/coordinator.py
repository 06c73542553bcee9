"""The generation loop of the genetic algorithm: ask, evaluate, race, validate, tell; and which population goes on.

Populations that begin alike end far apart: what the first crude drivers do with their sensors decides for good how well
their children can drive, and it shows soon. So a run begins with an island, and with another one where its champion is
not promising; the best of them goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cluster.learning import Champion, Learning, champion_of, copies, genes_of, made_good, some_left, told
from cluster.pool import Chunk
from cluster.settings import GENERATIONS, EvolveSettings
from evolution import fitness
from evolution.breeding import Mutation
from evolution.curriculum import success_rate
from evolution.episodes import Episodes
from evolution.genetic import Genetic, GeneticConfig
from evolution.rollout import EPISODE, Limits, targets
from gridsim.world import check_worlds

COLUMNS = (
    "fitness/best", "fitness/mean", "fitness/std", "distance_m/best", "distance_m/mean", "speed_mps/best",
    "speed_mps/mean", "target_m", "race/success_rate", "validation/success_rate", "car_steps", "wall_s",
    "car_steps_per_s", "island",
)  # fmt: skip
"""Columns of history.csv after `generation`; the names that MLflow has them under."""


AHEAD = 3  # generations for which training maps are built
PROMISING = 0.5  # score of an island's champion at which no other island is tried


@dataclass
class Population:
    """What a generation leaves for the next one.

    Attributes:
        parents: genomes float32 [parents, genes], elites first.
        elites: how many of them are elites.
        crashes: EPISODE [n] that are remembered.
        worlds: their traffic, float32 [n, cars, world.FIELDS].
        target: m, the length of its episodes.
    """

    parents: np.ndarray
    elites: int
    crashes: np.ndarray
    worlds: np.ndarray
    target: float


@dataclass
class Evolution(Learning):
    """One run of the genetic algorithm.

    Attributes:
        island: number of the population that evolves, from 0.
        islands: populations that have had their share, and their champions.
        settled: whether it is known which of them goes on.
        island_began: car-steps of the run when this one began.
    """

    columns: ClassVar[tuple[str, ...]] = COLUMNS
    step_name: ClassVar[str] = "generation"
    verb: ClassVar[str] = "evolving"

    settings: EvolveSettings
    score: Callable[[np.ndarray, np.ndarray | float], np.ndarray] = fitness.scalar  # (RESULT [n, e], targets m) -> [n]

    def __post_init__(self) -> None:
        super().__post_init__()
        s = self.settings
        self.genetic = Genetic(
            self.spec,
            GeneticConfig(s.population, s.elites, s.tournament, s.parents, s.crossover),
            s.seed,
            random_search=s.search == "random",
        )
        self._new = self._population()
        self.island, self.island_began = 0, 0
        self.islands: list[tuple[Population, Champion | None]] = []
        self.settled = s.islands == 1 or self.initial is not None or self.genetic.random_search
        if self.initial is not None:
            self.genetic.seed_with(self.initial)

    def _score(self, results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
        """Scores float64 [n]; what is not a number loses."""
        score = np.asarray(self.score(results, target), dtype=np.float64)
        if score.shape != (len(results),):
            raise ValueError(f"a fitness returns one number a member, [{len(results)}], not {score.shape}")
        finite = np.isfinite(score)
        return np.where(finite, score, score[finite].min(initial=0.0) - 1.0)

    def _mutation(self) -> Mutation:
        s = self.settings
        return Mutation(s.mutation_rate, self.curriculum.sigma(s.sigma), s.bump_rate)

    # ------------------------------------------------------------------------------------------------ a generation

    @property
    def generation(self) -> int:
        """Generations that are done."""
        return self.genetic.generation

    def step(self) -> dict[str, float]:
        """Evolve one generation. Returns its row of the history (COLUMNS), without the wall clock's columns."""
        s, curriculum = self.settings, self.curriculum
        self.outcomes.clear()
        generation, limits = self.generation, curriculum.limits()
        mean = self.genetic.mean()
        episodes = curriculum.episodes(generation)
        self._build_ahead(curriculum.map_seeds[: curriculum.maps_in_use(generation + AHEAD)])
        results, lost = self._evaluate_all(episodes, limits)
        some_left(lost, "evolve")
        groups, n = curriculum.config.groups, results.shape[1]
        goals = targets(episodes.rows, limits)[:n]  # of any group
        own = self._score(results, goals)
        score = fitness.pooled(own, groups)
        rank = score
        if s.ranking == "pareto":
            rank = fitness.pooled(fitness.pareto(fitness.elements(results, goals)), groups)
        rank = np.where(lost, -np.inf, rank)  # whatever a fitness says of somebody who drove nowhere

        # The generation's best race on more episodes; who raced comes before who did not.
        best = np.argsort(-np.nan_to_num(rank, nan=-np.inf), kind="stable")[: curriculum.config.racers]
        best = best[~lost[best]]
        race = curriculum.race(generation)
        racers = self.genetic.genomes(best)
        race_limits = curriculum.race_limits()
        driven = self.drive("race", racers, race, race_limits, curriculum.config.rewind)
        some_left(driven.lost, "race")
        raced = driven.results
        m = len(race.rows)
        race_score = (n * score[best] + m * self._score(raced, race_limits.target)) / (n + m)
        race_score = np.where(driven.lost, -np.inf, race_score)
        order = np.argsort(-race_score, kind="stable")
        total = rank - rank.max() - 1.0  # below 0
        total[best[order]] = np.arange(len(order), 0, -1)
        total[best[driven.lost]] = -np.inf
        order = order[: np.count_nonzero(~driven.lost)]
        race_success = float(success_rate(raced)[order[:8]].mean())
        curriculum.raced(order, raced, race)
        self.genetic.tell(total)
        self.genetic.admit_mean()
        if self.champion is not None:
            self.genetic.readmit(self.champion.genome)

        if limits.target >= curriculum.config.validation_target and generation % curriculum.config.validate_every == 0:
            contenders = racers[order[: curriculum.config.contenders - len(mean)]]
            self.trials.enter(np.concatenate([mean, contenders]), generation)
        self.elites.append(racers[order[0]])
        top = order[0]
        seconds = results["steps"] * self.sim.episode.control_period
        speed = results["distance"].sum(axis=1) / np.maximum(seconds.sum(axis=1), 1e-9)
        row = {
            "fitness/best": float(race_score[top]),
            "fitness/mean": float(own.mean()),
            "fitness/std": float(own.std()),
            "distance_m/best": float(raced["distance"][top].mean()),
            "distance_m/mean": float(results["distance"].mean()),
            "speed_mps/best": made_good(raced[top], self.sim.episode.control_period),
            "speed_mps/mean": float(speed.mean()),
            "target_m": limits.target,
            "race/success_rate": race_success,
            "validation/success_rate": self.champion.success_rate if self.champion else 0.0,
            "car_steps": float(self.car_steps),
            "island": float(self.island),
        }
        self.history.append(row)
        if not self.settled and self.car_steps - self.island_began >= s.island_car_steps:
            self._leave_island()
        return row

    def latest(self) -> np.ndarray:
        """The mating pool's mean, and who won the last race."""
        return np.concatenate([self.genetic.mean(), self.elites[-1][None]])

    def _evaluate_all(self, episodes: Episodes, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
        """Drive a generation, each member on its group's episodes; who is on trial drives beside it.

        Returns: results RESULT [population, a group's episodes], and who was lost.
        """
        recipes, key = self.genetic.ask(self._mutation())
        groups, n = self.curriculum.config.groups, len(recipes)
        e = len(episodes.rows) // groups
        # Members of a group come side by side; elites, which are the first, are in all of them.
        order = np.argsort(np.arange(n) % groups, kind="stable")
        first = np.searchsorted(order % groups, np.arange(groups + 1))
        asked = [Chunk(slice(*first[g : g + 2].tolist()), slice(g * e, (g + 1) * e)) for g in range(groups)]
        parents, members, all_episodes = self.genetic.parents, recipes[order], episodes
        if len(self.trials):
            trial, tried = self._trial()
            at = len(episodes.rows)
            all_episodes = episodes.and_then(trial)
            tried = [
                Chunk(slice(n + rows.start, n + rows.stop), slice(at + columns.start, at + columns.stop))
                for rows, columns in tried
            ]
            asked = [*tried, *asked]  # the longest first
            members = np.concatenate([members, copies(len(self.trials), len(parents))])
            parents = np.concatenate([parents, self.trials.first, self.trials.last])
        driven = self._evaluate(
            "evolve", parents, members, key, all_episodes, limits, asked=asked, meanwhile=self.meanwhile
        )
        if len(self.trials):
            self._judge(driven.results[n:, at:], driven.lost[n:])
        results, lost = np.empty((n, e), dtype=driven.results.dtype), np.empty(n, dtype=bool)
        for g in range(groups):
            results[g::groups] = driven.results[first[g] : first[g + 1], g * e : (g + 1) * e]
        lost[order] = driven.lost[:n]
        return results, lost

    # ------------------------------------------------------------------------------------------------------ islands

    def _population(self) -> Population:
        genetic, curriculum = self.genetic, self.curriculum
        return Population(
            genetic.parents, genetic.elites, curriculum.crashes, curriculum.crash_worlds, curriculum.target
        )

    def _go_on_with(self, population: Population, champion: Champion | None) -> None:
        self.genetic.parents, self.genetic.elites = population.parents, population.elites
        self.curriculum.crashes, self.curriculum.crash_worlds = population.crashes, population.worlds
        self.curriculum.target = population.target
        self.champion = champion

    def _leave_island(self) -> None:
        """Begin another population, or go on with the best of them if there were enough, or this one is promising."""
        self._settle_trials()
        if self.solved:
            return
        self.islands.append((self._population(), self.champion))
        self.island_began = self.car_steps
        score = self.champion.score if self.champion else 0.0
        if score < PROMISING and len(self.islands) < self.settings.islands:
            self.island = len(self.islands)
            self._go_on_with(self._new, None)
            return
        self.island = max(range(len(self.islands)), key=lambda k: _quality(self.islands[k][1]))
        self._go_on_with(*self.islands[self.island])
        self.islands, self.settled = [], True

    def conclude(self) -> None:
        self.champion = max([self.champion, *(champion for _, champion in self.islands)], key=_quality)
        super().conclude()

    # ------------------------------------------------------------------------------------------------------- state

    def counts(self) -> dict[str, int]:
        return {"generation": self.generation, "car_steps": self.car_steps}

    def summary(self) -> dict[str, Any]:
        return {"generations": self.generation}

    def way(self) -> tuple[float, float, str]:
        s = self.settings
        if s.car_steps and s.generations == GENERATIONS:  # nobody asked for a number of them
            return self.car_steps / 1e6, s.car_steps / 1e6, "M car-steps"
        return self.generation, s.generations, "generation"

    def describe(self, row: dict[str, float]) -> str:
        generation = f"generation {self.generation}  " if self.way()[2] != "generation" else ""
        island = "" if self.settled else f"island {self.island + 1}  "
        return (
            f"{generation}{island}distance {row['distance_m/best']:,.0f} m best, {row['distance_m/mean']:,.0f} mean of "
            f"{row['target_m']:,.0f}  {row['speed_mps/best']:.1f} m/s"
        )

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, meta = super().state()
        populations = [self._population(), *(population for population, _ in self.islands)]
        champions = [champion for _, champion in self.islands]
        for k, population in enumerate(populations):
            arrays |= {
                f"parents{k}": population.parents,
                f"crashes{k}": _plain(population.crashes),
                f"crash_worlds{k}": population.worlds,
            }
        for k, champion in enumerate(champions, 1):
            arrays[f"champion{k}"] = genes_of(champion)
        meta |= {
            "populations": [[population.elites, population.target] for population in populations],
            "champions": [told(champion) for champion in champions],
            "island": self.island,
            "island_began": self.island_began,
            "settled": self.settled,
        }
        return arrays, meta

    def _restore(self, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
        super()._restore(arrays, meta)
        generation, island, began = int(meta["generation"]), int(meta["island"]), int(meta["island_began"])
        settled = meta["settled"]
        fits = (
            generation == len(self.history)
            and type(settled) is bool
            and 0 <= island < self.settings.islands
            and 0 <= began <= self.car_steps
            and len(meta["populations"]) == len(meta["champions"]) + 1 == (1 if settled else island + 1)
        )
        if not fits:
            raise ValueError("its parts do not fit each other")
        populations = [self._restored(arrays, k, *figures) for k, figures in enumerate(meta["populations"])]
        champions = [
            champion_of(arrays[f"champion{k}"], figures, self.spec.size)
            for k, figures in enumerate(meta["champions"], 1)
        ]
        self._go_on_with(populations[0], self.champion)
        self.islands = list(zip(populations[1:], champions, strict=True))
        self.genetic.generation = generation
        self.island, self.island_began, self.settled = island, began, settled

    def _restored(self, arrays: dict[str, np.ndarray], k: int, elites: int, target: float) -> Population:
        """A population from a checkpoint. Raises ValueError where it is none."""
        s = self.settings
        parents, crashes, worlds = arrays[f"parents{k}"], arrays[f"crashes{k}"], arrays[f"crash_worlds{k}"]
        elites, target = int(elites), float(target)
        fits = (
            parents.ndim == 2
            and parents.shape[1] == self.spec.size
            and parents.dtype == np.float32
            and len(parents) <= s.elites + s.parents
            and 0 <= elites <= min(s.elites, max(len(parents) - 1, 0))
            and crashes.ndim == 2
            and crashes.shape[1] == 6
            and worlds.shape == (len(crashes), *self._new.worlds.shape[1:])
            and worlds.dtype == np.float32
            and self._new.target <= target <= self.curriculum.goal
        )
        if not fits:
            raise ValueError("its parts do not fit each other")
        maps = np.arange(len(self.curriculum.map_seeds))
        if not np.isfinite(crashes).all() or not np.isin(crashes[:, 0], maps).all():
            raise ValueError("a crash is nowhere on its maps")
        check_worlds(worlds)  # and against its map when one is driven (`Curriculum.episodes`)
        return Population(parents, elites, _crashes(crashes), worlds, target)


def _quality(champion: Champion | None) -> tuple[float, float]:
    return (champion.score, champion.distance_m) if champion else (-1.0, 0.0)


def _plain(episodes: np.ndarray) -> np.ndarray:
    """EPISODE [n] as float64 [n, 6]."""
    return np.concatenate([episodes["map"][:, None].astype(np.float64), episodes["start"]], axis=1)


def _crashes(plain: np.ndarray) -> np.ndarray:
    episodes = np.zeros(len(plain), dtype=EPISODE)
    episodes["map"], episodes["start"] = plain[:, 0], plain[:, 1:]
    return episodes
