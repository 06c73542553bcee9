"""The classic genetic algorithm: elites, the mating pool, what a generation is made of; and random search."""

import numpy as np
import pytest
from searching import first_gene, leader, told

from evolution.networks.policy import PolicySpec
from evolution.search.base import SearchConfig, ranks
from evolution.search.breeding import Kind, Mutation, breed
from evolution.search.two_parents import PARENTS, TwoParents

F = np.float32
SPEC = PolicySpec.parse("mlp:3")
CONFIG = SearchConfig(population=40, groups=1, tournament=3, sigma=0.5, elites=4)
EVERYONE = np.arange(CONFIG.population)


# --- Elites ----------------------------------------------------------------------------------------------------------


def test_elites_go_on_bit_identical_best_first():
    search = TwoParents(SPEC, CONFIG, seed=1)
    before = told(search, first_gene)
    for _ in range(5):
        best = np.argsort(-first_gene(before), kind="stable")[: CONFIG.elites]
        asked = search.ask()
        assert (asked.recipes["kind"][: CONFIG.elites] == Kind.COPY).all()
        assert (asked.recipes["kind"][CONFIG.elites :] == Kind.CROSS).all()
        now = search.genomes(EVERYONE)
        assert now[: CONFIG.elites].tobytes() == before[best].tobytes()
        assert leader(search).tobytes() == search.candidates()[0].tobytes() == now[0].tobytes()
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


def test_the_best_is_never_lost():
    search = TwoParents(SPEC, CONFIG, seed=2)
    bests = [first_gene(told(search, first_gene)).max() for _ in range(12)]
    assert (np.diff(bests) >= 0).all()
    assert bests[-1] > bests[0] + 0.5  # and it does evolve


def test_without_elites_nobody_is_copied():
    search = TwoParents(SPEC, SearchConfig(population=30, groups=1, tournament=2, elites=0), seed=3)
    told(search, first_gene)
    assert (search.ask().recipes["kind"] == Kind.CROSS).all()
    assert len(search.parents) == PARENTS


# --- A generation ----------------------------------------------------------------------------------------------------


def test_both_parents_come_from_the_pool():
    search = TwoParents(SPEC, SearchConfig(population=4000, groups=1, tournament=2, elites=3), seed=5)
    told(search, first_gene)
    assert len(search.parents) == PARENTS + 3
    asked = search.ask()
    children = asked.recipes[3:]
    for side in ("a", "b"):
        assert set(children[side].tolist()) == set(range(3, PARENTS + 3))
    assert (children["a"] != children["b"]).mean() == pytest.approx(1.0 - 1.0 / PARENTS, abs=0.01)
    assert len(set(children["seed"].tolist())) == len(children)


def test_mutation_is_as_asked_for():
    search = TwoParents(SPEC, SearchConfig(population=8, groups=1, sigma=0.7, mutation_rate=0.2, elites=1), seed=5)
    assert search.ask().mutation == Mutation(rate=0.2, sigma=0.7)


def test_the_pool_is_what_tournaments_won():
    """Every parent is a member of the generation, and fitter ones are there more often."""
    standing = []
    for seed in range(8):
        search = TwoParents(SPEC, SearchConfig(population=200, groups=1, tournament=4, elites=0), seed)
        members = told(search, first_gene)
        rank = {m.tobytes(): r for r, m in enumerate(members[np.argsort(-first_gene(members))])}
        standing += [rank[p.tobytes()] for p in search.parents]
    assert np.mean(standing) == pytest.approx(200 / 5, abs=5)  # the best of four of n is on average the n / 5th


def test_the_pool_comes_from_all_groups_alike():
    search = TwoParents(SPEC, SearchConfig(population=400, groups=4, tournament=4, elites=0), seed=7)
    search.ask()
    members = search.genomes(np.arange(400))
    search.tell(first_gene(members) + 100.0 * np.repeat(np.arange(4), 100))
    of = {m.tobytes(): k // 100 for k, m in enumerate(members)}
    assert np.bincount([of[p.tobytes()] for p in search.parents]).min() >= 6  # of 64; 16 are expected


# --- Scores ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_who_has_no_score_is_neither_elite_nor_parent(bad):
    """Not even where all of its group is spoilt, and so equal."""
    search = TwoParents(SPEC, SearchConfig(population=40, groups=4, tournament=20, elites=25), seed=3)
    search.ask()
    members = search.genomes(EVERYONE)
    scores = first_gene(members)
    scores[:10] = bad
    search.tell(scores)
    assert not {m.tobytes() for m in members[:10]} & {p.tobytes() for p in search.parents}


# --- Random search ---------------------------------------------------------------------------------------------------


def test_random_search_learns_nothing_but_keeps_its_best():
    search = TwoParents(SPEC, CONFIG, seed=11, random=True)
    before = told(search, first_gene)
    for _ in range(3):
        asked = search.ask()
        assert (asked.recipes["kind"][CONFIG.elites :] == Kind.NEW).all()
        now = search.genomes(EVERYONE)
        best = np.argsort(-first_gene(before), kind="stable")[: CONFIG.elites]
        assert now[: CONFIG.elites].tobytes() == before[best].tobytes()
        nobody = np.zeros((0, SPEC.size), dtype=F)
        fresh = breed(nobody, asked.recipes[CONFIG.elites :], asked.key, SPEC, asked.mutation)
        assert now[CONFIG.elites :].tobytes() == fresh.tobytes()
        assert not {g.tobytes() for g in fresh} & {g.tobytes() for g in before}
        search.tell(first_gene(now))
        before = now


# --- Beginning and resuming ------------------------------------------------------------------------------------------


def test_a_run_may_begin_with_a_genome():
    genome = np.random.default_rng(1).normal(size=SPEC.size).astype(F)
    search = TwoParents(SPEC, CONFIG, seed=12)
    search.start_from(genome)
    assert leader(search).tobytes() == genome.tobytes()
    search.ask()
    members = search.genomes(EVERYONE)
    assert members[0].tobytes() == genome.tobytes()
    assert (members == genome).mean() > 0.9  # the others are its children
    assert len({m.tobytes() for m in members}) > 10


def test_the_same_seed_is_the_same_run_and_another_is_not():
    runs = []
    for seed in (1, 1, 2):
        search = TwoParents(SPEC, CONFIG, seed=seed)
        runs.append(b"".join(told(search, first_gene).tobytes() for _ in range(4)))
    assert runs[0] == runs[1] != runs[2]


@pytest.mark.parametrize("random", [False, True])
@pytest.mark.parametrize("generations", [0, 3])
def test_a_restored_search_goes_on_bit_for_bit(random, generations):
    search, again = (TwoParents(SPEC, CONFIG, 10, random) for _ in range(2))
    for _ in range(generations):
        told(search, first_gene)
    arrays, numbers = search.state()
    again.restore({name: array.copy() for name, array in arrays.items()}, numbers)
    again.generation = search.generation
    for _ in range(3):
        assert told(search, first_gene).tobytes() == told(again, first_gene).tobytes()


@pytest.mark.parametrize(
    ("parents", "elites"),
    [
        (np.zeros((68, SPEC.size - 1), F), 4),
        (np.zeros((68, SPEC.size), np.float64), 4),
        (np.full((68, SPEC.size), np.nan, F), 4),
        (np.zeros(SPEC.size, F), 1),
        (np.zeros((PARENTS + 5, SPEC.size), F), 4),
        (np.zeros((68, SPEC.size), F), 5),  # beyond what was asked for
        (np.zeros((4, SPEC.size), F), 4),  # elites alone
        (np.zeros((0, SPEC.size), F), 1),
        (np.zeros((68, SPEC.size), F), -1),
        (np.zeros((68, SPEC.size), F), None),
    ],
)
def test_a_state_that_does_not_fit_is_refused(parents, elites):
    search = TwoParents(SPEC, CONFIG, seed=1)
    search.restore({"parents": np.zeros((68, SPEC.size), F)}, {"elites": 4})
    with pytest.raises((KeyError, TypeError, ValueError)):
        search.restore({"parents": parents}, {"elites": elites})
    with pytest.raises(KeyError):
        search.restore({}, {"elites": 0})
    with pytest.raises(KeyError):
        search.restore({"parents": np.zeros((68, SPEC.size), F)}, {})
