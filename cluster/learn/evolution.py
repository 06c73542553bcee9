"""The generation loop of the searches: ask, evaluate, tell, with one call of the pool per generation.

Besides the members, the leader (the best genome known before the generation) drives longer episodes of its own and, if
recent leaders did well, as a candidate for champion, the validation episodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cluster import fitness as own
from cluster.learn.learning import Learning, Progress, State, named
from cluster.settings import EvolveSettings
from cluster.workers.pool import Chunk
from evolution.episodes import fitness
from evolution.episodes.curriculum import success_rate
from evolution.episodes.figures import mean_speed
from evolution.networks.symmetry import space
from evolution.search.base import Search
from evolution.search.recombination import Recombination
from evolution.search.two_parents import TwoParents

CRASHES = ("crashes", "crash_worlds", "failures")  # the curriculum's arrays in a checkpoint
AHEAD = 8  # training maps are built for so many generations ahead


@dataclass
class Evolution(Learning):
    """One run of a search."""

    columns: ClassVar[tuple[str, ...]] = (  # `best` is the leader's, or without one the best member's
        "fitness/best", "fitness/mean", "fitness/std", "distance_m/best", "distance_m/mean", "speed_mps/best",
        "speed_mps/mean", "target_m", "leader/success_rate", "validation/success_rate", "car_steps", "wall_s",
        "car_steps_per_s",
    )  # fmt: skip
    save_every_s: ClassVar[float] = 1.0

    settings: EvolveSettings

    def __post_init__(self) -> None:
        super().__post_init__()
        s = self.settings
        self._fitness = own.load(s.fitness) if s.fitness else fitness.scalar
        self.search: Search
        if s.search == "random" or s.recombination == "two":
            self.search = TwoParents(space(self.spec), s.search_config(), s.seed, random=s.search == "random")
        else:
            self.search = Recombination(space(self.spec), s.search_config(), s.seed)
        if self.initial is not None:
            self.search.start_from(self.initial)

    @property
    def comfort(self) -> bool:
        return bool(self.settings.fitness)  # a fitness of the user's own may need these figures

    def _score(self, results: np.ndarray, target: np.ndarray | float) -> np.ndarray:
        """Scores float64 [n] of RESULT [n, e]; any that is not finite becomes -inf, the worst."""
        score = self._fitness(results, target)
        return np.where(np.isfinite(score), score, -np.inf)

    def _standing(self, results: np.ndarray) -> tuple[float, float]:
        score, tie_break = super()._standing(results)
        if self.settings.fitness:
            return min(score, self.settings.until), float(self._score(results, self.curriculum.goal)[0])
        return score, tie_break

    def _judge(self, candidate: np.ndarray, results: np.ndarray, step: int) -> None:
        super()._judge(candidate, results, step)
        # With a fitness of the user's own, a champion that always succeeds may still become better.
        self.solved = self.solved and not self.settings.fitness

    def step(self) -> Progress:
        """Evolve one generation."""
        curriculum, period = self.curriculum, self.sim.episode.control_period
        leader = self.search.leader()
        promising = self._promising()
        self.search.champion = self.champion.genome if self.champion else None
        asked, episodes = self.search.ask(), curriculum.episodes(self.steps)
        e = len(episodes.rows) // len(asked.groups)
        goals = episodes.rows["target"][:e].astype(np.float64)  # the same in each group
        groups = [Chunk(group, slice(g * e, (g + 1) * e)) for g, group in enumerate(asked.groups)]
        self.maps.ahead(curriculum.map_seeds[: curriculum.maps_in_use(self.steps + AHEAD)])

        members, alone = asked, list[Chunk]()
        if leader is not None:  # the leader drives episodes of its own and, if it is promising, those of validation
            followed = curriculum.leader_episodes(self.steps)
            members = asked.and_copies(leader[None])
            row = slice(len(asked.recipes), len(members.recipes))
            for own in (followed, curriculum.validation()) if promising else (followed,):
                first, episodes = len(episodes.rows), episodes.and_then(own)
                alone.insert(0, Chunk(row, slice(first, len(episodes.rows))))
        driven = yield from self._evaluate("evolve", members, episodes, [*alone, *groups])  # longest episodes first
        results = np.concatenate([driven.results[part] for part in groups])
        score = self._score(results, goals)
        curriculum.learn_from_members(self.steps, [driven.results[part] for part in groups])

        if leader is None:  # in a first generation of random members, the best one takes the leader's place
            best = int(score.argmax())
            self.elites[self.steps] = self.search.genomes(np.array([best]))[0]
            led, led_score = results[best], float(score[best])
        else:
            self.elites[self.steps] = leader
            led, columns = driven.results[alone[-1]][0], alone[-1].columns
            led_score = float(self._score(led[None], float(followed.rows["target"][0]))[0])
            curriculum.learn_from_leader(followed, led, driven.rewound[columns], driven.worlds[columns])
        self.search.tell(score)
        if leader is not None and promising:
            self._judge(leader, driven.results[alone[0]], self.steps - 1)
        seconds, finite = results["steps"].sum(axis=1) * period, score[np.isfinite(score)]
        self.history.append({
            "fitness/best": led_score if np.isfinite(led_score) else -1.0,
            "fitness/mean": float(finite.mean()) if finite.size else -1.0,
            "fitness/std": float(finite.std()) if finite.size else 0.0,
            "distance_m/best": float(led["distance"].mean()),
            "distance_m/mean": float(results["distance"].mean()),
            "speed_mps/best": mean_speed(led, period),
            "speed_mps/mean": float((results["distance"].sum(axis=1) / np.maximum(seconds, 1e-9)).mean()),
            "target_m": float(goals[0]),
            "leader/success_rate": float(success_rate(led[None])[0]),
            "validation/success_rate": self.champion.success_rate if self.champion else 0.0,
            "car_steps": float(self.car_steps),
        })  # fmt: skip

    def candidate(self) -> np.ndarray | None:
        return self.search.leader()

    def _promising(self) -> bool:
        """Whether to validate the candidate: it is new, recent leaders did well, and validation is within its share."""
        config, candidate = self.curriculum.config, self.candidate()
        latest = [row["leader/success_rate"] for row in self.history[-config.latest :]]
        least = max(config.promising, self.champion.success_rate if self.champion else 0.0)
        return (
            candidate is not None
            and (self.tried is None or self.tried.tobytes() != candidate.tobytes())
            and sum(latest) >= least * config.latest
            and self.validation_steps <= config.validation_share * self.car_steps
        )

    def counts(self) -> dict[str, int]:
        return {"generation": self.steps, "car_steps": self.car_steps}

    def state(self) -> State:
        arrays, meta = super().state()
        arrays |= {f"search_{name}": array for name, array in self.search.state().items()}
        arrays |= {name: getattr(self.curriculum, name) for name in CRASHES}
        return arrays, meta | {"target": self.curriculum.target}

    def restore(self, arrays: dict[str, np.ndarray], meta: dict[str, Any], rows: np.ndarray) -> None:
        super().restore(arrays, meta, rows)
        self.search.restore(named(arrays, "search_"))
        self.search.generation = meta["generation"]
        for name in CRASHES:
            here, saved = getattr(self.curriculum, name), arrays[name]
            if (here.dtype, here.shape[1:]) != (saved.dtype, saved.shape[1:]):
                raise ValueError(f"{name} of another form")
            setattr(self.curriculum, name, saved)
        self.curriculum.target = meta["target"]
