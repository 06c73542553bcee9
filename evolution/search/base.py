"""The base class of searches: ask for a generation's recipes, tell their scores. Also tournament selection."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from evolution.search.breeding import RECIPE, Kind, Mutation, breed
from evolution.search.space import Space
from gridsim.errors import GridSimError


@dataclass(frozen=True)
class SearchConfig:
    """Parameters of a search; `elites` and `mutation_rate` are for `two_parents`, `settled` is for `recombination`."""

    population: int = 256  # members of a generation
    groups: int = 8  # of members; each group has its own episodes
    tournament: int = 4  # members of a tournament
    sigma: float = Mutation.sigma  # standard deviation of mutation at the beginning, in units of the space's scales
    # From this generation on, the centre's steps shrink with the square root of the generation, and the average of
    # centres spans more generations; 0: never. For tasks in which chance would otherwise undo what was learned.
    settled: int = 0
    elites: int = 8  # best members, kept unmodified
    mutation_rate: float = Mutation.rate  # share of genes that mutate


class Generation(NamedTuple):
    """Members to evaluate, as recipes: a generation of a search, or copies of given genomes."""

    parents: np.ndarray  # float32 [p, genes], the rows that recipes refer to
    recipes: np.ndarray  # RECIPE [population]
    key: int = 0  # 64 bits, seed of the generation's random numbers
    mutation: Mutation = Mutation()
    groups: Sequence[slice] = ()  # the members of each group, which are consecutive

    def and_copies(self, genomes: np.ndarray) -> Generation:
        """These members, followed by copies of genomes float32 [k, genes], which are in no group."""
        copies = recipes(len(genomes))
        copies["kind"], copies["a"] = Kind.COPY, np.arange(len(self.parents), len(self.parents) + len(genomes))
        return self._replace(
            parents=np.concatenate([self.parents, genomes]), recipes=np.concatenate([self.recipes, copies])
        )


class Search(ABC):
    """A search by ask and tell. Random numbers depend on (seed, generation); the state is a few arrays and numbers."""

    kept: ClassVar[tuple[str, ...]]  # attributes that make up the `state`

    def __init__(self, space: Space, config: SearchConfig, seed: int):
        self.space, self.config, self.seed = space, config, seed
        self.generation = 0  # completed generations
        self.asked: Generation  # the current generation
        # The run's champion so far, float32 [genes]. The caller sets it; some searches keep it as an elite.
        self.champion: np.ndarray | None = None

    @abstractmethod
    def start_from(self, genome: np.ndarray) -> None:
        """Start from a genome float32 [genes] in place of random ones."""

    @abstractmethod
    def leader(self) -> np.ndarray | None:
        """The best genome known so far, float32 [genes], also the candidate for champion; None if there is none yet."""

    def state(self) -> dict[str, np.ndarray]:
        """What an exact resume needs, besides `generation` and `champion`, which the caller keeps."""
        return {name: np.asarray(getattr(self, name)) for name in self.kept}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore a `state`; the caller then sets `generation` and `champion`."""
        for name in self.kept:
            setattr(self, name, arrays[name] if arrays[name].ndim else arrays[name].item())

    @abstractmethod
    def _ask(self, key: int) -> Generation: ...

    @abstractmethod
    def _tell(self, asked: Generation, scores: np.ndarray) -> None: ...

    def ask(self) -> Generation:
        """The generation to evaluate now; it stays the same until `tell` is called."""
        self.asked = self._ask(int(self._rng(0).integers(1 << 63)))
        return self.asked

    def tell(self, scores: np.ndarray) -> None:
        """Take the scores float64 [population], which are compared within groups; higher is better, NaN the worst."""
        self._tell(self.asked, np.where(np.isnan(scores), -np.inf, scores))
        self.generation += 1

    def genomes(self, members: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Genomes float32 [k, genes] of members [k] of the current generation, by default of all."""
        asked = self.asked
        return breed(asked.parents, asked.recipes[members], asked.key, self.space, asked.mutation)

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.seed, self.generation, purpose]))


def split(members: int, groups: int, first: int = 0) -> list[slice]:
    """Split members into groups of about equal size, without splitting pairs; pairs begin after the `first` members.

    The `first` members are in the first group; an odd last member counts as a pair.
    Raises: GridSimError if a group would have no pair.
    """
    pairs = (members - first + 1) // 2
    if pairs < groups:
        raise GridSimError(f"{groups} groups need a population of {first + 2 * groups - 1} or more, not {members}")
    bounds = first + 2 * np.round(np.linspace(0, pairs, groups + 1)).astype(int)
    bounds[0], bounds[-1] = 0, members
    return [slice(a, b) for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)]


def ranks(scores: np.ndarray, groups: Sequence[slice]) -> np.ndarray:
    """Rank of each member in its group, float64 [n] in (0, 1), the best highest.

    It is the share of lower scores plus half the share of equal scores, which include the member's own.
    """
    standing = np.empty(len(scores))
    for group in groups:
        _, place, count = np.unique(scores[group], return_inverse=True, return_counts=True)
        standing[group] = ((np.cumsum(count) - count / 2) / count.sum())[place]
    return standing


def tournament_weights(scores: np.ndarray, size: int) -> np.ndarray:
    """Share float64 [n] of all n ** size tournaments (drawn with replacement) that each member wins.

    The k worst of n members together win (k / n) ** size of them; members with equal scores share equally.
    """
    _, place, count = np.unique(scores, return_inverse=True, return_counts=True)
    upto = np.cumsum(count)
    won = (upto / len(scores)) ** size - ((upto - count) / len(scores)) ** size
    return (won / count)[place]


def tournaments(scores: np.ndarray, size: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Winners [count] of tournaments among `size` members drawn with replacement; the first drawn wins ties."""
    drawn = rng.integers(len(scores), size=(count, size))
    return drawn[np.arange(count), scores[drawn].argmax(axis=1)]


def recipes(n: int) -> np.ndarray:
    """Recipes RECIPE [n] with seeds 0 to n - 1 and all other fields 0."""
    made = np.zeros(n, dtype=RECIPE)
    made["seed"] = np.arange(n)
    return made
