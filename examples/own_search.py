"""GridSim's search on a problem of your own: ask for genomes, tell their scores.

    python examples/own_search.py

Here a genome's score is its squared distance from a hidden point, negated: the sphere function.
"""

from __future__ import annotations

import numpy as np

from evolution.search.base import SearchConfig
from evolution.search.recombination import Recombination  # `two_parents.TwoParents` is told in the same way
from evolution.search.space import Space

GENES, GENERATIONS = 30, 100


def main() -> None:
    """Search, and print how far from the point the best genome of a generation is."""
    hidden = np.random.default_rng(0).normal(size=GENES)
    config = SearchConfig(population=64, groups=1)  # groups: members are compared with those of their group alone
    search = Recombination(Space(GENES, scales=np.ones(GENES)), config, seed=0)
    for generation in range(1, GENERATIONS + 1):
        search.ask()
        scores = -((search.genomes() - hidden) ** 2).sum(axis=1)  # more is better
        search.tell(scores)
        if generation % 10 == 0:
            print(f"generation {generation}: {np.sqrt(-scores.max()):.4f}")
    print(search.leader())  # the best genome known


if __name__ == "__main__":
    main()
