"""The default search: tournament winners are recombined into one centre, around which the next generation is sampled.

A (mu/mu, lambda) evolution strategy (Beyer 2001) whose weights are shares of won tournaments, with cumulative step-size
adaptation (Hansen and Ostermeier 2001). Noise is symmetric (`space.Symmetry`). Children come in mirrored pairs
(Brockhoff et al. 2010), the centre plus and minus the same noise, which drive the same episodes. The elites are
the centre and the champion (at first, the average of centres). They are evaluated unmodified, and can win like others.
"""

from __future__ import annotations

import math

import numpy as np

from evolution.search.base import Generation, Search, SearchConfig, ranks, recipes, split, tournament_weights
from evolution.search.breeding import Kind, Mutation, noise_sum
from evolution.search.space import Space

_CENTRE, _OTHER = 0, 1  # rows of `Generation.parents`: the two elites
_ELITES = 2  # the centre, and the champion (until there is one, the average of centres)
_LEARNING_RATE = 2.0  # of the centre: c_m of Hansen 2016 ("The CMA Evolution Strategy: A Tutorial"), set by measurement
_KEPT = 0.9  # share of the average of centres that each generation keeps; more once steps shrink (`settled`)
# The largest step size, relative to the initial one. Saturated units hardly react to larger weights, so weights and
# step size would grow without bound.
_MAX_GROWTH = 2.0


class Recombination(Search):
    """Children are centre + sigma * scales * N(0, 1); the first generation is random unless `start_from` was called."""

    kept = ("centre", "average", "path", "sigma")

    def __init__(self, space: Space, config: SearchConfig, seed: int):
        super().__init__(space, config, seed)
        self.centre = np.zeros(0)  # float64 [genes], or [0] before the first `tell` or `start_from`
        self.average = np.zeros(0)  # exponential moving average of the centres
        self._free = space.symmetry.free
        # The evolution path starts at its stationary N(0, I), not at 0, which would shrink sigma at first.
        self.path = self._rng(1).standard_normal(len(self._free))
        self.sigma = config.sigma  # the step size

    def start_from(self, genome: np.ndarray) -> None:
        self.centre = self.average = genome.astype(np.float64)

    def leader(self) -> np.ndarray | None:
        """The average of centres, which drives better than any one of them."""
        return self.average.astype(np.float32) if len(self.average) else None

    def _ask(self, key: int) -> Generation:
        n = self.config.population
        made = recipes(n)
        if not len(self.centre):
            made["kind"] = Kind.NEW
            none = np.zeros((0, self.space.size), dtype=np.float32)
            return Generation(none, made, key, Mutation(), split(n, self.config.groups))
        other = self.average if self.champion is None else self.champion
        rows = np.stack([self.centre, other]).astype(np.float32)
        made["kind"], made["seed"] = Kind.COPY, 0
        made["a"][:_ELITES] = _CENTRE, _OTHER
        child = np.arange(n - _ELITES)
        made["kind"][_ELITES:] = np.where(child % 2, Kind.MIRRORED, Kind.STEP)
        made["a"][_ELITES:] = _CENTRE
        made["seed"][_ELITES:] = child // 2
        return Generation(rows, made, key, Mutation(sigma=self.sigma), split(n, self.config.groups, _ELITES))

    def _tell(self, asked: Generation, scores: np.ndarray) -> None:
        if not len(self.centre):  # start from the member with the best score, although groups had different episodes
            self.start_from(self.genomes(np.array([scores.argmax()]))[0])
            return
        weights = tournament_weights(ranks(scores, asked.groups), self.config.tournament)
        effective = 1.0 / float((weights**2).sum())  # mu_eff
        pairs = (len(weights) - _ELITES) // 2  # an odd last member, without a mirror image, is left out
        plus, minus = weights[_ELITES : _ELITES + 2 * pairs].reshape(pairs, 2).T
        genes, shift = len(self._free), plus - minus
        noise = noise_sum(np.arange(pairs), shift, asked.key, self.space)
        towards = self.sigma * noise + weights[1] * (asked.parents[_OTHER] - self.centre)
        age = max(1.0, self.generation / self.config.settled) if self.config.settled else 1.0
        self.centre = self.centre + _LEARNING_RATE / math.sqrt(age) * towards
        kept = 1.0 - (1.0 - _KEPT) / age
        self.average = kept * self.average + (1.0 - kept) * self.centre
        # Under random selection, noise / (norm * scales) is N(0, 1) in each gene for any weights of the pairs.
        norm = math.sqrt(float((shift**2).sum()))
        if norm > 0.0:
            rate = (effective + 2.0) / (genes + effective + 5.0)
            damping = 1.0 + 2.0 * max(0.0, math.sqrt((effective - 1.0) / (genes + 1.0)) - 1.0) + rate
            expected = math.sqrt(genes) * (1.0 - 1.0 / (4.0 * genes) + 1.0 / (21.0 * genes**2))
            step = (noise / self.space.scales)[self._free] / norm
            self.path = (1.0 - rate) * self.path + math.sqrt(rate * (2.0 - rate)) * step
            self.sigma *= math.exp(rate / damping * (float(np.linalg.norm(self.path)) / expected - 1.0))
            self.sigma = min(self.sigma, _MAX_GROWTH * self.config.sigma)
