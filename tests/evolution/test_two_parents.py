"""The classic genetic algorithm: elites, the mating pool, what a generation is made of; and random search."""

import numpy as np
import pytest
from searching import first_gene, new_genomes, told

from evolution.networks.policy import PolicySpec
from evolution.search.base import SearchConfig, ranks
from evolution.search.breeding import Kind, Mutation
from evolution.search.two_parents import PARENTS, TwoParents

SPEC = PolicySpec.parse("mlp:3")
CONFIG = SearchConfig(population=40, groups=1, tournament=3, sigma=0.5, elites=4)
EVERYONE = np.arange(CONFIG.population)


@pytest.mark.parametrize(("random", "kind"), [(False, Kind.CROSS), (True, Kind.NEW)])
def test_elites_go_on_bit_identical_best_first(random, kind):
    search = TwoParents(SPEC, CONFIG, seed=1, random=random)
    before = told(search, first_gene)
    for _ in range(5):
        best = np.argsort(-first_gene(before), kind="stable")[: CONFIG.elites]
        asked = search.ask()
        assert (asked.recipes["kind"][: CONFIG.elites] == Kind.COPY).all()
        assert (asked.recipes["kind"][CONFIG.elites :] == kind).all()
        now = search.genomes(EVERYONE)
        assert now[: CONFIG.elites].tobytes() == before[best].tobytes()
        assert np.asarray(search.leader()).tobytes() == now[0].tobytes()
        search.tell(first_gene(now))
        before = now


def test_elites_are_the_best_of_their_groups():
    """A group that met easier episodes has no more of them."""
    search = TwoParents(SPEC, SearchConfig(population=40, groups=4, tournament=3, elites=8), seed=1)
    asked = search.ask()
    members = search.genomes(EVERYONE)
    scores = first_gene(members) + 100.0 * np.repeat(np.arange(4), 10)
    search.tell(scores)
    best = np.argsort(-ranks(scores, asked.groups), kind="stable")[:8]
    assert sorted(best // 10) == [0, 0, 1, 1, 2, 2, 3, 3]
    assert search.parents[:8].tobytes() == members[best].tobytes()


def test_both_parents_come_from_the_pool_and_mutation_is_as_asked_for():
    config = SearchConfig(population=4000, groups=1, tournament=2, elites=3, sigma=0.7, mutation_rate=0.2)
    search = TwoParents(SPEC, config, seed=5)
    told(search, first_gene)
    assert len(search.parents) == PARENTS + 3
    asked = search.ask()
    assert asked.mutation == Mutation(rate=0.2, sigma=0.7)
    children = asked.recipes[3:]
    for side in ("a", "b"):
        assert set(children[side].tolist()) == set(range(3, PARENTS + 3))
    assert (children["a"] != children["b"]).mean() == pytest.approx(1.0 - 1.0 / PARENTS, abs=0.01)
    assert len(set(children["seed"].tolist())) == len(children)


@pytest.mark.parametrize("elites", [0, 4])
def test_a_search_that_starts_from_a_genome_breeds_from_it(elites):
    search = TwoParents(SPEC, SearchConfig(population=40, elites=elites, mutation_rate=0.0), seed=1)
    genome = new_genomes(SPEC)[0]
    search.start_from(genome)
    search.ask()
    assert (search.genomes(EVERYONE) == genome).all()
