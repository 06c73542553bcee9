"""The genetic algorithm: tournaments, elitism and recipes, by ask and tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evolution.breeding import FRESH, MAX_PARENTS, RECIPE, Mutation, breed
from evolution.policy import PolicySpec


@dataclass(frozen=True)
class GeneticConfig:
    """The genetic algorithm's parameters."""

    population: int = 512  # members of a generation
    elites: int = 8  # members that go on unmodified
    tournament: int = 8  # members drawn for each tournament
    parents: int = 64  # size of the mating pool
    crossover: float = 1.0  # share of children with two parents

    def check(self) -> None:
        """Raises ValueError with one line for parameters that do not fit each other."""
        if self.population < 2:
            raise ValueError(f"population must be 2 or more, not {self.population}")
        if not 0 <= self.elites < self.population:
            raise ValueError(f"population {self.population} must be larger than the {self.elites} elites")
        if self.tournament < 1:
            raise ValueError(f"tournament size must be 1 or more, not {self.tournament}")
        if not 1 <= self.parents <= MAX_PARENTS - self.elites:
            raise ValueError(f"the mating pool must hold 1 to {MAX_PARENTS - self.elites} parents, not {self.parents}")


class Genetic:
    """Ask for a generation's recipes, tell their scores.

    The state is arrays only: the parents (elites first, then the mating pool) and the generation's number. All
    randomness comes from (seed, generation), so that nothing else needs to be kept for an exact resume.
    """

    def __init__(self, spec: PolicySpec, config: GeneticConfig, seed: int, random_search: bool = False):
        config.check()
        self.spec, self.config, self.seed, self.random_search = spec, config, seed, random_search
        self.generation = 0
        self.elites = 0  # rows of `parents` that are elites
        self.parents = np.zeros((0, spec.size), dtype=np.float32)
        self._asked: tuple[np.ndarray, int, Mutation] | None = None

    def seed_with(self, genome: np.ndarray) -> None:
        """Begin with the children of one genome [genes] in place of random ones.

        Raises: ValueError if its size is not the network's.
        """
        if genome.shape != (self.spec.size,):
            raise ValueError(f"a genome of {self.spec} has {self.spec.size} genes, not {genome.shape}")
        self.parents = np.stack([genome, genome]).astype(np.float32)  # an elite, and a mating pool of one
        self.elites = min(1, self.config.elites)
        self.parents = self.parents[: self.elites + 1]

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.seed, self.generation, purpose]))

    def ask(self, mutation: Mutation) -> tuple[np.ndarray, int]:
        """The generation's recipes [population] and its key; elites come first.

        Raises: RuntimeError when the last generation's scores were not told yet.
        """
        if self._asked is not None:
            raise RuntimeError("ask() was called twice; tell() the scores first")
        n = self.config.population
        rng = self._rng(0)
        recipes = np.zeros(n, dtype=RECIPE)
        recipes["seed"] = np.arange(1, n + 1)
        key = int(rng.integers(1 << 63))
        if len(self.parents) == 0 or self.random_search:
            recipes["a"] = recipes["b"] = FRESH
        else:
            pool = np.arange(self.elites, len(self.parents))
            mother, father = rng.choice(pool, n), rng.choice(pool, n)
            single = rng.random(n) >= self.config.crossover
            father[single] = mother[single]
            recipes["a"], recipes["b"] = mother, father
        if self.elites:
            recipes["a"][: self.elites] = recipes["b"][: self.elites] = np.arange(self.elites)
            recipes["seed"][: self.elites] = 0
        self._asked = recipes, key, mutation
        return recipes, key

    def mean(self) -> np.ndarray:
        """The mating pool's mean, float32 [1, genes]; [0, genes] where there is none.

        The parents share what they were selected for; what chance put into one of them averages out (genetic repair,
        Beyer 1995).
        """
        pool = self.parents[self.elites :]
        if not len(pool) or self.random_search:
            return pool[:0]
        return pool.mean(axis=0, dtype=np.float64, keepdims=True).astype(np.float32)

    def genomes(self, members: np.ndarray) -> np.ndarray:
        """Genomes [k, genes] of some members of the generation that was asked for."""
        if self._asked is None:
            raise RuntimeError("no generation was asked for")
        recipes, key, mutation = self._asked
        return breed(self.parents, recipes[members], key, self.spec, mutation)

    def tell(self, fitness: np.ndarray) -> None:
        """Take the members' scores [population], greater is better; select the next generation's parents.

        A score that is not a number counts as the worst.
        Raises: RuntimeError without an open generation; ValueError for a wrong number of scores.
        """
        if self._asked is None:
            raise RuntimeError("tell() was called without ask()")
        n = self.config.population
        if fitness.shape != (n,):
            raise ValueError(f"there are {n} members, not {fitness.shape} scores")
        score = np.where(np.isnan(fitness), -np.inf, fitness)
        rng = self._rng(1)
        best = np.argsort(-score, kind="stable")[: self.config.elites]
        pool = tournaments(score, self.config.tournament, self.config.parents, rng)
        self.parents = self.genomes(np.concatenate([best, pool]))
        self.elites = len(best)
        self.generation += 1
        self._asked = None

    def admit_mean(self) -> None:
        """Put the mating pool's mean in the place of its last parent but one, and of the last elite but one.

        So it is driven unmodified, and bred from like any other parent. Where there are four of them or more.
        """
        mean = self.mean()
        if len(mean) and len(self.parents) - self.elites >= 4:
            self.parents[-2] = mean[0]
            if self.elites >= 4:
                self.parents[self.elites - 2] = mean[0]

    def readmit(self, genome: np.ndarray) -> None:
        """Put a genome [genes] in the place of the last elite, and of the last parent of the mating pool."""
        if self.elites:
            self.parents[self.elites - 1] = genome
        self.parents[-1] = genome


def tournaments(score: np.ndarray, size: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Winners [count] of tournaments among `size` members drawn with replacement; the first drawn wins a tie."""
    drawn = rng.integers(len(score), size=(count, size))
    return drawn[np.arange(count), score[drawn].argmax(axis=1)]
