"""The classic genetic algorithm: tournaments, elitism, uniform crossover of two parents, Gaussian mutation.

Also random search, the baseline that every search must beat: only the elites are kept; all others are random.
"""

from __future__ import annotations

import numpy as np

from evolution.search.base import Generation, Search, SearchConfig, ranks, recipes, split, tournaments
from evolution.search.breeding import Kind, Mutation
from evolution.search.space import Space

PARENTS = 64  # size of the mating pool; it bounds how many genomes each worker is sent


class TwoParents(Search):
    """Elites are kept unmodified. Both parents of each other member are drawn from the winners of tournaments.

    These other members are random instead in the first generation, unless `start_from` was called, and in all
    generations if `random`.
    """

    kept = ("parents", "elites")

    def __init__(self, space: Space, config: SearchConfig, seed: int, random: bool = False):
        super().__init__(space, config, seed)
        self.random = random
        self.parents = np.zeros((0, space.size), dtype=np.float32)  # elites, the best first, then the mating pool
        self.elites = 0  # number of rows of `parents` that are elites

    def start_from(self, genome: np.ndarray) -> None:
        self.elites = min(1, self.config.elites)
        self.parents = np.stack([genome] * (self.elites + 1)).astype(np.float32)

    def leader(self) -> np.ndarray | None:
        return self.parents[0] if len(self.parents) else None

    def _ask(self, key: int) -> Generation:
        config, rng = self.config, self._rng(1)
        n, pool = config.population, np.arange(self.elites, len(self.parents))
        made = recipes(n)
        if self.random or not len(pool):
            made["kind"] = Kind.NEW
        else:
            made["kind"] = Kind.CROSS
            made["a"], made["b"] = rng.choice(pool, n), rng.choice(pool, n)
        for name, values in (("kind", Kind.COPY), ("a", np.arange(self.elites)), ("b", 0)):
            made[name][: self.elites] = values
        groups = split(n, config.groups)
        return Generation(self.parents, made, key, Mutation(config.mutation_rate, config.sigma), groups)

    def _tell(self, asked: Generation, scores: np.ndarray) -> None:
        standing = np.where(np.isneginf(scores), -1.0, ranks(scores, asked.groups))
        best = np.argsort(-standing, kind="stable")[: self.config.elites]
        winners = tournaments(standing, self.config.tournament, PARENTS, self._rng(2))
        self.parents = self.genomes(np.concatenate([best, winners]))
        self.elites = len(best)
