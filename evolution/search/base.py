"""What every search shares: ask for a generation's recipes, tell their scores; and tournament selection in closed form.

`recombination` has the default search, `two_parents` the classic one and random search.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evolution.networks.policy import PolicySpec
from evolution.search.breeding import RECIPE, Mutation, breed

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class SearchConfig:
    """Parameters of a search; `elites` and `mutation_rate` are those of two parents alone."""

    population: int = 256  # members of a generation
    groups: int = 8  # of members, each of which meets episodes of its own
    tournament: int = 8  # members of a tournament
    sigma: float = Mutation.sigma  # standard deviation of mutation at the beginning, in units of `policy.gene_scales`
    elites: int = 8  # members that go on unmodified
    mutation_rate: float = Mutation.rate  # share of genes that mutate

    def check(self) -> None:
        """Raises: ValueError with one line for parameters that do not fit each other."""
        if self.population < 4:
            raise ValueError(f"population must be 4 or more, not {self.population}")
        if not 1 <= self.groups <= self.population // 2:
            raise ValueError(f"a population of {self.population} has no {self.groups} groups of 2 or more")
        if self.tournament < 1:
            raise ValueError(f"tournament size must be 1 or more, not {self.tournament}")
        if not 0.0 < self.sigma < np.inf:
            raise ValueError(f"sigma must be above 0, not {self.sigma}")
        if not 0.0 <= self.mutation_rate <= 1.0:
            raise ValueError(f"the mutation rate must be 0 to 1, not {self.mutation_rate}")


class Generation(NamedTuple):
    """A generation to be evaluated."""

    parents: np.ndarray  # float32 [p, genes], the rows that recipes name
    recipes: np.ndarray  # RECIPE [population]
    key: int  # 64 bits, of the generation's random numbers
    mutation: Mutation
    groups: list[slice]  # the members of each group, side by side


class Search(ABC):
    """A search by ask and tell. All randomness comes from (seed, generation); its state is a few arrays and numbers."""

    def __init__(self, spec: PolicySpec, config: SearchConfig, seed: int):
        config.check()
        self.spec, self.config, self.seed = spec, config, seed
        self.generation = 0  # generations that are done
        self.asked: Generation | None = None

    @abstractmethod
    def start_from(self, genome: np.ndarray) -> None:
        """Begin with a genome float32 [genes] in place of random ones."""

    def keep_champion(self, champion: np.ndarray) -> None:  # noqa: B027
        """Carry a champion float32 [genes] among the elites, where the search has a place for it."""

    @abstractmethod
    def leader(self) -> np.ndarray | None:
        """The best genome known before a generation, float32 [genes]; None before the first."""

    @abstractmethod
    def candidates(self) -> np.ndarray:
        """Who may become champion after a generation, float32 [k, genes]."""

    @abstractmethod
    def state(self) -> tuple[Arrays, dict[str, float]]:
        """What an exact resume needs beside the generation's number."""

    @abstractmethod
    def restore(self, arrays: Arrays, numbers: dict[str, float]) -> None:
        """The inverse of `state`. Raises: KeyError, TypeError, ValueError where it does not fit this search."""

    @abstractmethod
    def _ask(self, key: int) -> Generation: ...

    @abstractmethod
    def _tell(self, asked: Generation, scores: np.ndarray) -> None: ...

    def ask(self) -> Generation:
        """The next generation. Raises: RuntimeError when the last one's scores were not told yet."""
        if self.asked is not None:
            raise RuntimeError("ask() was called twice; tell() the scores first")
        self.asked = self._ask(int(self._rng(0).integers(1 << 63)))
        return self.asked

    def tell(self, scores: np.ndarray) -> None:
        """Take the members' scores float64 [population], greater is better; they are compared within groups alone.

        A score that is not a number counts as the worst.
        Raises: RuntimeError without an open generation; ValueError for a wrong number of scores.
        """
        if self.asked is None:
            raise RuntimeError("tell() was called without ask()")
        if scores.shape != (self.config.population,):
            raise ValueError(f"there are {self.config.population} members, not {scores.shape} scores")
        self._tell(self.asked, np.where(np.isnan(scores), -np.inf, scores))
        self.generation += 1
        self.asked = None

    def genomes(self, members: np.ndarray) -> np.ndarray:
        """Genomes float32 [k, genes] of some members of the generation that was asked for."""
        if self.asked is None:
            raise RuntimeError("no generation was asked for")
        asked = self.asked
        return breed(asked.parents, asked.recipes[members], asked.key, self.spec, asked.mutation)

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.seed, self.generation, purpose]))


def split(members: int, groups: int, first: int = 0) -> list[slice]:
    """Groups of about as many members each; after the `first` ones pairs stay together (0 and 1, 2 and 3, ...)."""
    pairs = (members - first + 1) // 2
    bounds = first + 2 * np.round(np.linspace(0, pairs, groups + 1)).astype(int)
    bounds[0], bounds[-1] = 0, members
    return [slice(a, b) for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)]


def ranks(scores: np.ndarray, groups: list[slice]) -> np.ndarray:
    """How a member stands in its group, float64 [n] in (0, 1): the share of it with lower scores, equals by half.

    So members of groups that met easier and harder episodes can be compared.
    """
    standing = np.empty(len(scores))
    for group in groups:
        _, place, count = np.unique(scores[group], return_inverse=True, return_counts=True)
        standing[group] = ((np.cumsum(count) - count / 2) / count.sum())[place]
    return standing


def tournament_weights(scores: np.ndarray, size: int) -> np.ndarray:
    """Share float64 [n] of all n ** size tournaments (members are drawn with replacement) that each member wins.

    The k worst of n win (k / n) ** size of them between them; equals share what they win together.
    """
    _, place, count = np.unique(scores, return_inverse=True, return_counts=True)
    upto = np.cumsum(count)
    won = (upto / len(scores)) ** size - ((upto - count) / len(scores)) ** size
    return (won / count)[place]


def tournaments(scores: np.ndarray, size: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Winners [count] of tournaments among `size` members drawn with replacement; the first drawn wins a tie."""
    drawn = rng.integers(len(scores), size=(count, size))
    return drawn[np.arange(count), scores[drawn].argmax(axis=1)]


def recipes(n: int) -> np.ndarray:
    """Recipes RECIPE [n] with seeds 0 to n - 1, all else 0."""
    made = np.zeros(n, dtype=RECIPE)
    made["seed"] = np.arange(n)
    return made


def checked(array: np.ndarray, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """An array from a checkpoint. Raises: ValueError where it is another or holds what is no number."""
    if array.shape != shape or array.dtype != dtype or not np.isfinite(array).all():
        raise ValueError(f"it holds {array.dtype}{list(array.shape)} in place of {np.dtype(dtype)}{list(shape)}")
    return array
