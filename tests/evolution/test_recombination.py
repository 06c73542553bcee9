"""The default search: the centre, mirrored pairs, elites, and how fast it is beside CMA-ES."""

import numpy as np
import pytest
from searching import first_gene, state_of, told

from evolution.networks.policy import PolicySpec
from evolution.search.base import SearchConfig, ranks, tournament_weights
from evolution.search.breeding import Kind
from evolution.search.recombination import Recombination

F = np.float32
SPEC = PolicySpec.parse("mlp:1")
GENES = SPEC.size  # 49


def begun(config, seed=1):
    """A search about a random genome."""
    search = Recombination(SPEC, config, seed)
    search.start_from(np.random.default_rng(seed).normal(size=GENES).astype(F))
    return search


def test_the_first_centre_is_the_best_of_a_random_generation():
    search = Recombination(SPEC, SearchConfig(population=40, groups=4), seed=1)
    members = told(search, first_gene)
    assert np.asarray(search.leader()).tobytes() == members[first_gene(members).argmax()].tobytes()
    assert search.sigma == search.config.sigma


def test_the_champion_is_the_second_member_bit_for_bit():
    search = begun(SearchConfig(population=16, groups=2))
    champion = np.random.default_rng(3).normal(size=GENES).astype(F)
    champion[:2] = -0.0, 1e-42
    search.champion = champion
    asked = search.ask()
    members = search.genomes(np.arange(16))
    assert members[0].tobytes() == search.centre.astype(F).tobytes()
    assert members[1].tobytes() == champion.tobytes()
    assert asked.recipes["kind"].tolist() == [Kind.COPY] * 2 + [Kind.STEP, Kind.MIRRORED] * 7
    assert asked.recipes["seed"][2:].tolist() == [k // 2 for k in range(14)]
    assert asked.groups == [slice(0, 10), slice(10, 16)]  # which cut no pair
    search.tell(np.arange(16) == 1.0)  # who alone wins is the next centre, but for those it ties with by chance
    moved, way = search.centre - members[0], champion - members[0]
    assert moved @ way / np.linalg.norm(moved) / np.linalg.norm(way) > 0.95


@pytest.mark.parametrize("champion", [False, True])
def test_the_centre_moves_twice_as_far_as_to_the_weighted_mean_of_the_members_and_its_average_follows(champion):
    search = begun(SearchConfig(population=40, groups=4, tournament=3))
    if champion:
        search.champion = np.random.default_rng(4).normal(size=GENES).astype(F)
    asked = search.ask()
    members, scores = search.genomes(np.arange(40)).astype(float), np.random.default_rng(5).random(40)
    before, average = search.centre, search.average
    search.tell(scores)
    mean = tournament_weights(ranks(scores, asked.groups), 3) @ members
    np.testing.assert_allclose(search.centre, before + 2.0 * (mean - before), rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(search.average, 0.9 * average + 0.1 * search.centre)


def test_equal_scores_move_nothing():
    search = begun(SearchConfig(population=41, groups=2))
    before = state_of(search)
    for score in (0.0, -np.inf, np.nan):
        told(search, lambda genomes: np.full(len(genomes), score))  # noqa: B023
        after = state_of(search)
        assert all(after[name] == before[name] for name in ("centre", "path", "sigma"))


@pytest.mark.parametrize(("population", "groups", "tournament"), [(17, 1, 8), (65, 2, 8), (64, 4, 2)])
def test_where_chance_decides_sigma_does_not_drift(population, groups, tournament):
    """The path is N(0, 1) in each gene; the step size does as a random walk does."""
    squares, ends = [], []
    for seed in range(24):
        search = begun(SearchConfig(population=population, groups=groups, tournament=tournament), seed)
        rng = np.random.default_rng(seed)
        for _ in range(150):
            told(search, lambda genomes: rng.random(len(genomes)))  # noqa: B023
            squares.append((search.path**2).mean())
            assert 0.05 < search.sigma < 5.0
        ends.append(np.log(search.sigma / search.config.sigma))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.08)
    assert abs(np.mean(ends)) < 0.5


def test_on_a_slope_sigma_grows_to_twice_its_size():
    way = np.random.default_rng(2).normal(size=GENES)
    search, sizes = begun(SearchConfig(population=33, groups=1)), []
    for _ in range(120):
        told(search, lambda genomes: genomes @ way)
        sizes.append(search.sigma)
    assert max(sizes) == 2.0 * search.config.sigma
    assert np.mean(sizes[-20:]) > 1.5 * search.config.sigma
    assert search.centre @ way / np.linalg.norm(way) > 50.0


# Median of 7 runs of pycma 4.5.0, CMAEvolutionStrategy(x0, 1.0, {"CMA_diagonal": True, "popsize": 33}): evaluations
# of 49 genes from N(0, 1) until the sum of their squares is 1e-9 of what it is at the start.
REFERENCE = 7_821


@pytest.mark.parametrize("tournament", [4, 8])
def test_on_a_sphere_it_is_about_as_fast_as_cma_es(tournament):
    needed = []
    for seed in range(1, 6):
        search = begun(SearchConfig(population=33, groups=1, tournament=tournament), seed)
        goal = 1e-9 * (search.centre**2).sum()
        while (search.centre**2).sum() > goal and search.generation < 1000:
            told(search, lambda genomes: -(genomes.astype(float) ** 2).sum(axis=1))
        needed.append(33 * search.generation)
    assert np.median(needed) < 2.0 * REFERENCE
