"""The generation loop of the searches: ask, evaluate, tell, in one call of the pool a generation.

Beside the members drive the leader (the best genome known before the generation) on longer episodes of its own, and who
is on trial for champion on validation's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cluster.runs.settings import EvolveSettings
from cluster.training.trainer import Bred, Learning, made_good, some_left
from cluster.workers.pool import Chunk
from evolution.episodes.curriculum import success_rate
from evolution.episodes.rollout import EPISODE, targets
from evolution.episodes.starts import Episodes
from evolution.search import fitness
from evolution.search.base import Search
from evolution.search.recombination import Recombination
from evolution.search.two_parents import TwoParents
from gridsim.traffic.world import check_worlds

COLUMNS = (
    "fitness/best", "fitness/mean", "fitness/std", "distance_m/best", "distance_m/mean", "speed_mps/best",
    "speed_mps/mean", "target_m", "leader/success_rate", "validation/success_rate", "car_steps", "wall_s",
    "car_steps_per_s",
)  # fmt: skip
"""Columns of history.csv after `generation`; the names that MLflow has them under. `best` is of the leader."""

AHEAD = 8  # generations for which training maps are built


@dataclass
class Evolution(Learning):
    """One run of a search."""

    columns: ClassVar[tuple[str, ...]] = COLUMNS
    step_name: ClassVar[str] = "generation"
    verb: ClassVar[str] = "evolving"

    settings: EvolveSettings
    score: Callable[[np.ndarray, np.ndarray | float], np.ndarray] = fitness.scalar  # (RESULT [n, e], targets m) -> [n]

    def __post_init__(self) -> None:
        super().__post_init__()
        s = self.settings
        self.search: Search
        if s.search == "random" or s.recombination == "two":
            self.search = TwoParents(self.spec, s.search_config(), s.seed, random=s.search == "random")
        else:
            self.search = Recombination(self.spec, s.search_config(), s.seed)
        if self.initial is not None:
            self.search.start_from(self.initial)

    def _score(self, results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
        """Scores float64 [n]; what is not a number loses."""
        score = np.asarray(self.score(results, target), dtype=np.float64)
        if score.shape != (len(results),):
            raise ValueError(f"a fitness returns one number a member, [{len(results)}], not {score.shape}")
        return np.where(np.isfinite(score), score, -np.inf)

    # ------------------------------------------------------------------------------------------------ a generation

    @property
    def generation(self) -> int:
        """Generations that are done."""
        return self.search.generation

    def step(self) -> dict[str, float]:
        """Evolve one generation. Returns its row of the history (COLUMNS), without the wall clock's columns."""
        self.outcomes.clear()
        curriculum, limits, period = self.curriculum, self.curriculum.limits(), self.sim.episode.control_period
        leader = self.search.leader()
        asked = self.search.ask()
        n, episodes = len(asked.recipes), curriculum.episodes(self.generation)
        e = len(episodes.rows) // len(asked.groups)
        bred = Bred(asked.parents, asked.recipes, asked.key, asked.mutation)
        groups = [Chunk(group, slice(g * e, (g + 1) * e)) for g, group in enumerate(asked.groups)]
        goals = targets(episodes.rows, limits)[:e]  # of any group
        self._build_ahead(curriculum.map_seeds[: curriculum.maps_in_use(self.generation + AHEAD)])

        # What takes longest is sent first: those on trial, then the leader.
        parts = groups
        if leader is not None:
            followed = curriculum.leader_episodes(self.generation)
            parts = [_beside(bred, episodes, Chunk(slice(0, 1), slice(0, len(followed.rows)))), *parts]
            bred, episodes = bred.and_copies(leader[None]), episodes.and_then(followed)
        on_trial = _beside(bred, episodes, Chunk(slice(0, len(self.trials)), slice(0, curriculum.config.validation)))
        if len(self.trials):
            validation, tried = self._trial()
            parts = [*(_beside(bred, episodes, part) for part in tried), *parts]
            bred = bred.and_copies(np.concatenate([self.trials.first, self.trials.last]))
            episodes = episodes.and_then(validation)
        driven = self._evaluate("evolve", bred, episodes, limits, asked=parts, meanwhile=self.meanwhile)
        some_left(driven.lost[:n], "evolve")
        results = np.concatenate([driven.results[part] for part in groups])
        score = np.where(driven.lost[:n], -np.inf, self._score(results, goals))

        if leader is None:  # of the first generation it is the best member
            best = int(score.argmax())
            self.elites.append(self.search.genomes(np.array([best]))[0])
            led, led_score = results[best], float(score[best])
        else:
            self.elites.append(leader)
            alone = slice(n, n + 1), slice(e * len(groups), e * len(groups) + len(followed.rows))
            led = driven.results[alone][0]
            led_score = float(self._score(driven.results[alone], curriculum.leader_limits().target)[0])
            curriculum.learn_from_leader(followed, led, driven.rewound[alone[1]], driven.worlds[alone[1]])
        self.search.tell(score)
        if len(self.trials):
            self._judge(driven.results[on_trial], driven.lost[on_trial.rows])
            if self.champion is not None:
                self.search.keep_champion(self.champion.genome)
        seconds, finite = results["steps"].sum(axis=1) * period, score[np.isfinite(score)]
        row = {
            "fitness/best": led_score if np.isfinite(led_score) else -1.0,
            "fitness/mean": float(finite.mean()) if finite.size else -1.0,
            "fitness/std": float(finite.std()) if finite.size else 0.0,
            "distance_m/best": float(led["distance"].mean()),
            "distance_m/mean": float(results["distance"].mean()),
            "speed_mps/best": made_good(led, period),
            "speed_mps/mean": float((results["distance"].sum(axis=1) / np.maximum(seconds, 1e-9)).mean()),
            "target_m": limits.target,
            "leader/success_rate": float(success_rate(led[None])[0]),
            "validation/success_rate": self.champion.success_rate if self.champion else 0.0,
            "car_steps": float(self.car_steps),
        }
        self.history.append(row)
        if self._promising():
            self.trials.add_candidates(self.search.candidates(), self.generation - 1)
        return row

    def _promising(self) -> bool:
        """Whether to look for a champion: the leader does well, and validation has not had more than its share."""
        config = self.curriculum.config
        latest = [row["leader/success_rate"] for row in self.history[-config.latest :]]
        least = max(config.promising, self.champion.success_rate if self.champion else 0.0)
        return (
            not len(self.trials)
            and sum(latest) >= least * config.latest
            and self.validation_steps <= config.validation_share * self.car_steps
        )

    def latest(self) -> np.ndarray:
        """The search's candidates, and the last generation's elite."""
        return np.concatenate([self.search.candidates(), self.elites[-1][None]])

    # ------------------------------------------------------------------------------------------------------- state

    def counts(self) -> dict[str, int]:
        return {"generation": self.generation, "car_steps": self.car_steps}

    def summary(self) -> dict[str, Any]:
        return {"generations": self.generation}

    def way(self) -> tuple[float, float, str]:
        s = self.settings
        if s.car_steps and not s.generations:
            return self.car_steps / 1e6, s.car_steps / 1e6, "M car-steps"
        return self.generation, s.generations, "generations"

    def describe(self, row: dict[str, float]) -> str:
        plural = "" if self.generation == 1 else "s"
        done = f"{self.generation} generation{plural}  " if self.way()[2] != "generations" else ""
        return (
            f"{done}distance {row['distance_m/best']:,.0f} m best, {row['distance_m/mean']:,.0f} mean of "
            f"{row['target_m']:,.0f}  {row['speed_mps/best']:.1f} m/s"
        )

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, meta = super().state()
        curriculum = self.curriculum
        searched, numbers = self.search.state()
        arrays |= {f"search_{name}": array for name, array in searched.items()}
        arrays |= {"crashes": _plain(curriculum.crashes), "crash_worlds": curriculum.crash_worlds}
        meta |= {"search": numbers, "target": curriculum.target}
        return arrays, meta

    def _restore(self, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
        super()._restore(arrays, meta)
        curriculum, generation, target = self.curriculum, int(meta["generation"]), float(meta["target"])
        crashes, worlds = arrays["crashes"], arrays["crash_worlds"]
        fits = (
            generation == len(self.history)
            and crashes.ndim == 2
            and crashes.shape[1] == 6
            and worlds.shape == (len(crashes), *curriculum.crash_worlds.shape[1:])
            and worlds.dtype == np.float32
            and curriculum.target <= target <= curriculum.goal
        )
        if not fits:
            raise ValueError("its parts do not fit each other")
        maps = np.arange(len(curriculum.map_seeds))
        if not np.isfinite(crashes).all() or not np.isin(crashes[:, 0], maps).all():
            raise ValueError("a crash is nowhere on its maps")
        check_worlds(worlds)  # and against its map when one is driven (`Curriculum.episodes`)
        searched = {name.removeprefix("search_"): array for name, array in arrays.items() if name.startswith("search_")}
        self.search.restore(searched, meta["search"])
        if generation and self.search.leader() is None:
            raise ValueError("it has no genomes to go on with")
        self.search.generation = generation
        if self.champion is not None:
            self.search.keep_champion(self.champion.genome)
        curriculum.crashes, curriculum.crash_worlds, curriculum.target = _crashes(crashes), worlds, target


def _beside(bred: Bred, episodes: Episodes, part: Chunk) -> Chunk:
    """A part of what is driven beside these members and episodes, in the numbers of both together."""
    n, e = len(bred.recipes), len(episodes.rows)
    rows, columns = part
    return Chunk(slice(n + rows.start, n + rows.stop), slice(e + columns.start, e + columns.stop))


def _plain(episodes: np.ndarray) -> np.ndarray:
    """EPISODE [n] as float64 [n, 6]."""
    return np.concatenate([episodes["map"][:, None].astype(np.float64), episodes["start"]], axis=1)


def _crashes(plain: np.ndarray) -> np.ndarray:
    episodes = np.zeros(len(plain), dtype=EPISODE)
    episodes["map"], episodes["start"] = plain[:, 0], plain[:, 1:]
    return episodes
