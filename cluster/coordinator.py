"""The generation loop of the genetic algorithm: ask, evaluate, race, validate, tell, save.

The coordinator alone builds maps, selects, saves and logs. Everything it decides follows from the seed and from what
the workers return; nothing follows from the clock or from who returned it.
"""

from __future__ import annotations

import csv
import io
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cluster.checkpoint import CheckpointError
from cluster.pool import Chunk, Outcome, WorkerPool
from cluster.settings import EvolveSettings
from cluster.worker import Task
from evolution import fitness
from evolution.breeding import RECIPE, Mutation
from evolution.curriculum import (
    HELD_OUT_EPISODES,
    HELD_OUT_MAPS,
    TRIED_KEPT,
    Curriculum,
    Trials,
    spread_starts,
    success_rate,
)
from evolution.episodes import Episodes
from evolution.genetic import Genetic, GeneticConfig
from evolution.policy import PolicySpec
from evolution.rollout import EPISODE, Limits, targets
from gridsim.config import SimConfig
from gridsim.ego import End
from gridsim.scenarios import HELD_OUT_SEED, Scenario, build, map_of
from gridsim.world import check_worlds

COLUMNS = (
    "fitness/best", "fitness/mean", "fitness/std", "distance_m/best", "distance_m/mean", "speed_mps/best",
    "speed_mps/mean", "target_m", "race/success_rate", "validation/success_rate", "car_steps", "wall_s",
    "car_steps_per_s",
)  # fmt: skip
"""Columns of history.csv after `generation`; the names that MLflow has them under."""

MAPS_KEPT = 96  # training's, validation's and the held-out ones, and some


class Maps:
    """Builds maps, each once, and ahead of their use in a thread; keeps the latest."""

    def __init__(self, scenario: str, config: SimConfig):
        self._scenario, self._config = scenario, config
        self._built: dict[int, Future[Scenario]] = {}
        self._lock = threading.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="maps")

    def ahead(self, seeds: list[int]) -> None:
        """Begin to build maps that will be needed, in this order."""
        with self._lock:
            for seed in seeds:
                if seed not in self._built:
                    self._built[seed] = self._thread.submit(build, self._scenario, seed, self._config)

    def get(self, seed: int) -> Scenario:
        """The map of a seed."""
        self.ahead([seed])
        with self._lock:
            future = self._built.pop(seed)
            self._built[seed] = future  # the latest used is last
            while len(self._built) > MAPS_KEPT:
                del self._built[next(iter(self._built))]
        return future.result()

    def build(self, scenario: str, seed: int) -> Scenario:
        """As pools ask for it."""
        if scenario != self._scenario:
            raise ValueError(f"a run on {self._scenario} has no map of {scenario}")
        return self.get(seed)

    def close(self) -> None:
        """Forget what is not yet begun."""
        self._thread.shutdown(wait=False, cancel_futures=True)


@dataclass
class Champion:
    """The best member found so far, by validation.

    Attributes:
        genome: float32 [genes].
        score: of all validation episodes (`Curriculum.validation_score`).
        success_rate: of the same.
        distance_m: its mean distance there.
        generation: in which it was found.
    """

    genome: np.ndarray
    score: float = 0.0
    success_rate: float = 0.0
    distance_m: float = 0.0
    generation: int = -1


@dataclass
class Evolution:
    """One run of the genetic algorithm, between pool and files.

    Attributes:
        settings: what the run was asked to do.
        pool: who evaluates.
        maps: who builds maps.
    """

    settings: EvolveSettings
    pool: WorkerPool
    maps: Maps
    initial: np.ndarray | None = None  # a genome to start from, float32 [genes]
    score: Callable[[np.ndarray, np.ndarray | float], np.ndarray] = fitness.scalar  # (RESULT [n, e], targets m) -> [n]
    champion: Champion | None = None
    solved: bool = False
    history: list[dict[str, float]] = field(default_factory=list)
    elites: list[np.ndarray] = field(default_factory=list)
    car_steps: int = 0
    wall_before_s: float = 0.0
    started: float = 0.0  # time.perf_counter() of this process's start
    on_progress: Callable[[str, int, int], None] | None = None
    meanwhile: Callable[[], None] | None = None  # called in each generation when the workers are busy

    def __post_init__(self) -> None:
        s = self.settings
        self.sim = SimConfig()
        self.spec = PolicySpec.parse(s.policy)
        self.genetic = Genetic(
            self.spec,
            GeneticConfig(s.population, s.elites, s.tournament, s.parents, s.crossover),
            s.seed,
            random_search=s.search == "random",
        )
        episode = self.sim.episode
        self.curriculum = Curriculum(
            s.curriculum(),
            s.seed,
            self.maps.get,
            episode.target,
            episode.time_limit,
            episode.control_period,
            s.traffic,
        )
        if self.initial is not None:
            self.genetic.seed_with(self.initial)
        none = np.zeros((0, self.spec.size), dtype=np.float32)
        self.trials = Trials(none, none)
        self.outcomes: list[Outcome] = []  # of the last generation, for statistics

    # ------------------------------------------------------------------------------------------------- evaluating

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

    def _evaluate(
        self, stage: str, parents: np.ndarray, recipes: np.ndarray, key: int, episodes: Episodes, limits: Limits,
        rewind: int = 0, asked: Sequence[Chunk] | None = None, meanwhile: Callable[[], None] | None = None,
    ) -> np.ndarray:  # fmt: skip
        task = Task(
            policy=self.settings.policy,
            parents=parents,
            key=key,
            mutation=self._mutation(),
            episodes=episodes.rows,
            worlds=episodes.worlds,
            maps=tuple((self.settings.scenario, map_of(self.settings.scenario, seed)) for seed in episodes.maps),
            limits=limits,
            config=self.sim,
            rewind=rewind,
        )
        progress = self.on_progress
        tell = (lambda k, n: progress(stage, k, n)) if progress else None
        outcome = self.pool.evaluate(task, recipes, tell, asked, meanwhile)
        self.outcomes.append(outcome)
        self.car_steps += int(outcome.results["steps"].sum())
        return outcome.results

    def drive(self, stage: str, genomes: np.ndarray, episodes: Episodes, limits: Limits, rewind: int = 0) -> np.ndarray:
        """Results RESULT [n, e] of given genomes [n, genes]: recipes that are plain copies."""
        return self._evaluate(stage, genomes, copies(len(genomes)), 0, episodes, limits, rewind)

    # ------------------------------------------------------------------------------------------------ a generation

    @property
    def generation(self) -> int:
        """Generations that are done."""
        return self.genetic.generation

    def done(self) -> bool:
        """Whether there is nothing left to evolve."""
        limit = self.settings.car_steps
        return self.solved or self.generation >= self.settings.generations or 0 < limit <= self.car_steps

    def _is_last(self, generation: int) -> bool:
        """Whether an unsolved run ends with this generation."""
        limit = self.settings.car_steps
        return generation + 1 >= self.settings.generations or 0 < limit <= self.car_steps

    def step(self) -> dict[str, float]:
        """Evolve one generation. Returns its row of the history (COLUMNS), without the wall clock's columns."""
        s, curriculum = self.settings, self.curriculum
        self.outcomes.clear()
        generation, limits = self.generation, curriculum.limits()
        episodes = curriculum.episodes(generation)
        self.maps.ahead(curriculum.map_seeds[: generation + 4])
        results = self._evaluate_all(episodes, limits)
        goals = targets(episodes.rows, limits)
        score = self._score(results, goals)
        rank = fitness.pareto(fitness.elements(results, goals)) if s.ranking == "pareto" else score

        # The generation's best race on more episodes; who raced comes before who did not.
        best = np.argsort(-np.nan_to_num(rank, nan=-np.inf), kind="stable")[: curriculum.config.racers]
        race = curriculum.race(generation)
        racers = self.genetic.genomes(best)
        race_limits = curriculum.race_limits()
        raced = self.drive("race", racers, race, race_limits, curriculum.config.rewind)
        n, m = len(episodes.rows), len(race.rows)
        race_score = (n * score[best] + m * self._score(raced, race_limits.target)) / (n + m)
        order = np.argsort(-race_score, kind="stable")
        total = rank - rank.max() - 1.0  # below 0
        total[best[order]] = np.arange(len(order), 0, -1)
        race_success = float(success_rate(raced)[order[:8]].mean())
        curriculum.raced(order, raced, race)
        self.genetic.tell(total)
        if self.champion is not None:
            self.genetic.readmit(self.champion.genome)

        last = self._is_last(generation)
        if limits.target >= curriculum.config.validation_target or last:
            self.trials.enter(racers[order[: curriculum.config.contenders]], generation)
        while last and len(self.trials):
            self._validate()
        self.elites.append(racers[order[0]])
        top = order[0]
        seconds = results["steps"] * self.sim.episode.control_period
        speed = results["distance"].sum(axis=1) / np.maximum(seconds.sum(axis=1), 1e-9)
        row = {
            "fitness/best": float(race_score[top]),
            "fitness/mean": float(score.mean()),
            "fitness/std": float(score.std()),
            "distance_m/best": float(raced["distance"][top].mean()),
            "distance_m/mean": float(results["distance"].mean()),
            "speed_mps/best": _speed(raced[top], self.sim.episode.control_period),
            "speed_mps/mean": float(speed.mean()),
            "target_m": limits.target,
            "race/success_rate": race_success,
            "validation/success_rate": self.champion.success_rate if self.champion else 0.0,
            "car_steps": float(self.car_steps),
        }
        self.history.append(row)
        return row

    def _evaluate_all(self, episodes: Episodes, limits: Limits) -> np.ndarray:
        """Results RESULT [population, e] of a generation; who is on trial drives beside it."""
        recipes, key = self.genetic.ask(self._mutation())
        parents, n, e = self.genetic.parents, len(recipes), len(episodes.rows)
        if not len(self.trials):
            return self._evaluate("evolve", parents, recipes, key, episodes, limits, meanwhile=self.meanwhile)
        trial, asked = self._trial()
        both = episodes.and_then(trial)
        asked = [
            Chunk(slice(n + rows.start, n + rows.stop), slice(e + columns.start, e + columns.stop))
            for rows, columns in asked
        ]
        results = self._evaluate(
            "evolve",
            np.concatenate([parents, self.trials.first, self.trials.last]),
            np.concatenate([recipes, copies(len(self.trials), len(parents))]),
            key,
            both,
            limits,
            asked=[*asked, Chunk(slice(0, n), slice(0, e))],  # the longest first
            meanwhile=self.meanwhile,
        )
        self._judge(results[n:, e:])
        return results[:n, :e]

    def _trial(self) -> tuple[Episodes, list[Chunk]]:
        """Validation's episodes, and who of `trials` drives which of them."""
        episodes = self.curriculum.validation().within(self.curriculum.goal_limits())
        stage, k = self.curriculum.config.first_validation, len(self.trials.first)
        parts = [
            Chunk(slice(k, len(self.trials)), slice(stage, len(episodes.rows))),
            Chunk(slice(0, k), slice(0, stage)),
        ]
        return episodes, [part for part in parts if part.rows.stop > part.rows.start]

    def _validate(self) -> None:
        """Go on with the trials, with nothing beside them."""
        episodes, asked = self._trial()
        genomes = np.concatenate([self.trials.first, self.trials.last])
        recipes, limits = copies(len(genomes)), self.curriculum.goal_limits()
        self._judge(self._evaluate("validate", genomes, recipes, 0, episodes, limits, asked=asked))

    def _judge(self, results: np.ndarray) -> None:
        """Find out whether `trials.last` beats the champion, and who of `trials.first` is tried next.

        Args: RESULT [members, validation], zero where a member's stage has no such episode.
        """
        trials, score = self.trials, self.curriculum.validation_score
        stage, k = self.curriculum.config.first_validation, len(self.trials.first)
        if len(trials.last):
            whole = results[k:, stage:]
            total, distance = float(score(whole)[0]), float(whole["distance"].mean())
            if self.champion is None or (total, distance) > (self.champion.score, self.champion.distance_m):
                rate = float(success_rate(whole)[0])
                self.champion = Champion(trials.last[0].copy(), total, rate, distance, trials.last_generation)
            self.solved = self.champion.score >= self.settings.until
        trials.last = trials.first[:0]
        if k:
            first = results[:k, :stage]
            scores = score(first)
            best = int(np.lexsort((first["distance"].mean(axis=1), scores))[-1])
            if self.champion is None or scores[best] >= self.champion.score - 0.02:
                trials.last, trials.last_generation = trials.first[best : best + 1], trials.first_generation
        trials.first = trials.first[:0]

    def timed(self, row: dict[str, float], wall_s: float, previous: dict[str, float] | None) -> None:
        """Add the wall clock's columns to a row."""
        row["wall_s"] = wall_s
        steps, seconds = row["car_steps"], wall_s
        if previous is not None:
            steps, seconds = steps - previous["car_steps"], wall_s - previous["wall_s"]
        row["car_steps_per_s"] = steps / max(seconds, 1e-9)

    def held_out(self) -> dict[str, float]:
        """The champion on roads nobody was trained or chosen on: the same 64 episodes for every run of a scenario."""
        assert self.champion is not None
        before = self.car_steps
        episodes = held_out_episodes(self.maps, self.settings.traffic)
        results = self.drive("held out", self.champion.genome[None], episodes, self.curriculum.goal_limits())
        self.car_steps = before  # not part of learning
        return summarise(results[0], self.sim.episode.control_period)

    # ------------------------------------------------------------------------------------------------------- state

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All that an exact resume needs: arrays and plain numbers."""
        genes = self.spec.size
        rows = [[row[name] for name in COLUMNS] for row in self.history]
        champion = self.champion
        arrays = {
            "parents": self.genetic.parents,
            "crashes": _plain(self.curriculum.crashes),
            "crash_worlds": self.curriculum.crash_worlds,
            "history": np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS)),
            "elites": np.array(self.elites, dtype=np.float32).reshape(-1, genes),
            "trials_first": self.trials.first,
            "trials_last": self.trials.last,
            "trials_tried": self.trials.tried,
            "champion": champion.genome if champion else np.zeros(0, dtype=np.float32),
        }
        meta = {
            "generation": self.generation,
            "elite_rows": self.genetic.elites,
            "target_m": self.curriculum.target,
            "car_steps": self.car_steps,
            "solved": self.solved,
            "columns": list(COLUMNS),
            "trials": [self.trials.first_generation, self.trials.last_generation],
            "champion": [champion.score, champion.success_rate, champion.distance_m, champion.generation]
            if champion
            else [],
        }
        return arrays, meta

    def restore(self, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
        """Take up a state. Raises CheckpointError with one line where it does not fit this run."""
        s, genes = self.settings, self.spec.size
        try:
            history, parents, elites = arrays["history"], arrays["parents"], arrays["elites"]
            generation, crashes, worlds = int(meta["generation"]), arrays["crashes"], arrays["crash_worlds"]
            first, last, tried = arrays["trials_first"], arrays["trials_last"], arrays["trials_tried"]
            champion, elite_rows = arrays["champion"], int(meta["elite_rows"])
            least = min(self.curriculum.config.first_target, self.curriculum.goal)
            fits = (
                meta["columns"] == list(COLUMNS)
                and history.shape == (generation, len(COLUMNS))
                and elites.shape == (generation, genes)
                and elites.dtype == np.float32
                and parents.ndim == 2
                and parents.shape[1] == genes
                and parents.dtype == np.float32
                and len(parents) <= s.elites + s.parents
                and 0 <= elite_rows <= min(s.elites, max(len(parents) - 1, 0))
                and crashes.ndim == 2
                and crashes.shape[1] == 6
                and worlds.shape == (len(crashes), *self.curriculum.crash_worlds.shape[1:])
                and worlds.dtype == np.float32
                and champion.shape == (genes if meta["champion"] else 0,)
                and champion.dtype == np.float32
                and np.isfinite(meta["champion"]).all()
                and all(genomes.shape[1:] == (genes,) and genomes.dtype == np.float32 for genomes in (first, last))
                and len(first) <= self.curriculum.config.contenders
                and len(last) <= 1
                and tried.ndim == 1
                and len(tried) <= TRIED_KEPT
                and tried.dtype == np.uint64
            )
            if (
                not fits
                or not np.isfinite(history).all()
                or not least <= float(meta["target_m"]) <= self.curriculum.goal
            ):
                raise ValueError("its parts do not fit each other")
            maps = np.arange(len(self.curriculum.map_seeds))
            if not np.isfinite(crashes).all() or not np.isin(crashes[:, 0], maps).all():
                raise ValueError("a crash is nowhere on its maps")
            check_worlds(worlds)  # and against its map when one is driven (`Curriculum.episodes`)
            self.genetic.generation, self.genetic.elites = generation, elite_rows
            self.genetic.parents = parents
            self.curriculum.target = float(meta["target_m"])
            self.curriculum.crashes, self.curriculum.crash_worlds = _crashes(crashes), worlds
            self.car_steps, self.solved = int(meta["car_steps"]), bool(meta["solved"])
            self.history = [dict(zip(COLUMNS, row.tolist(), strict=True)) for row in history]
            self.elites = list(elites)
            first_generation, last_generation = (int(k) for k in meta["trials"])
            self.trials = Trials(first, last, first_generation, last_generation, tried)
            if meta["champion"]:
                score, rate, distance, found = meta["champion"]
                self.champion = Champion(champion, float(score), float(rate), float(distance), int(found))
            if self.done() and self.champion is None:
                raise ValueError("it is done, and has no champion; go on with more --generations")
            self.wall_before_s = self.history[-1]["wall_s"] if self.history else 0.0
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise CheckpointError(f"the checkpoint does not belong to this run: {error}") from error

    def history_csv(self) -> bytes:
        """history.csv: a row a generation."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["generation", *COLUMNS])
        for k, row in enumerate(self.history):
            writer.writerow([k, *(repr(row[name]) for name in COLUMNS)])
        return text.getvalue().encode()


def copies(n: int, first: int = 0) -> np.ndarray:
    """Recipes [n] that are plain copies of the parents from `first` on."""
    recipes = np.zeros(n, dtype=RECIPE)
    recipes["a"] = recipes["b"] = np.arange(first, first + n)
    return recipes


def held_out_episodes(maps: Maps, traffic: int) -> Episodes:
    """The 64 episodes that are reported on and never chosen on."""
    return spread_starts(maps.get, HELD_OUT_SEED, HELD_OUT_MAPS, HELD_OUT_EPISODES, traffic)


def summarise(results: np.ndarray, period_s: float) -> dict[str, float]:
    """Means over the episodes of one member: RESULT [e]."""
    return {
        "episodes": len(results),
        "success_rate": float((results["end"] == End.SUCCESS).mean()),
        "distance_m": float(results["distance"].mean()),
        "speed_mps": _speed(results, period_s),
        "collision_rate": float((results["end"] == End.COLLISION).mean()),
    }


def _speed(results: np.ndarray, period_s: float) -> float:
    """Mean over episodes of the speed made good: new ground over time, in m/s."""
    seconds = np.maximum(results["steps"].astype(np.float64), 1.0) * period_s
    return float((results["distance"] / seconds).mean())


def _plain(episodes: np.ndarray) -> np.ndarray:
    """EPISODE [n] as float64 [n, 6]."""
    return np.concatenate([episodes["map"][:, None].astype(np.float64), episodes["start"]], axis=1)


def _crashes(plain: np.ndarray) -> np.ndarray:
    episodes = np.zeros(len(plain), dtype=EPISODE)
    episodes["map"], episodes["start"] = plain[:, 0], plain[:, 1:]
    return episodes


def now() -> float:
    """The clock that durations are taken with; nothing is decided by it."""
    return time.perf_counter()
