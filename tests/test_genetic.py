"""Ask and tell: elites, tournaments, and what a generation is made of."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evolution.breeding import FRESH, RECIPE, Mutation, breed
from evolution.genetic import Genetic, GeneticConfig, tournaments
from evolution.policy import PolicySpec

F = np.float32
SPEC = PolicySpec.parse("mlp:3")
CONFIG = GeneticConfig(population=40, elites=4, tournament=3, parents=10, crossover=0.5)
MUTATION = Mutation()
EVERYONE = np.arange(CONFIG.population)


def told(genetic, score):
    """One generation: asked for, and told `score(genomes)`; returns the genomes."""
    genetic.ask(MUTATION)
    genomes = genetic.genomes(np.arange(genetic.config.population))
    genetic.tell(score(genomes))
    return genomes


def first_gene(genomes):
    return genomes[:, 0].astype(float)


# --- Elites ----------------------------------------------------------------------------------------------------------


def test_elites_go_on_bit_identical_best_first():
    genetic = Genetic(SPEC, CONFIG, seed=1)
    before = told(genetic, first_gene)
    for _ in range(5):
        best = np.argsort(-first_gene(before), kind="stable")[: CONFIG.elites]
        recipes, key = genetic.ask(MUTATION)
        assert (recipes["seed"][: CONFIG.elites] == 0).all()
        now = breed(genetic.parents, recipes, key, SPEC, MUTATION)
        assert now[: CONFIG.elites].tobytes() == before[best].tobytes()
        genetic.tell(first_gene(now))
        before = now
    assert first_gene(before).max() > 0.0


def test_the_best_is_never_lost():
    genetic = Genetic(SPEC, CONFIG, seed=2)
    bests = [first_gene(told(genetic, first_gene)).max() for _ in range(12)]
    assert (np.diff(bests) >= 0).all()
    assert bests[-1] > bests[0] + 0.5  # and it does evolve


def test_without_elites_nobody_is_copied():
    config = GeneticConfig(population=30, elites=0, tournament=2, parents=5)
    genetic = Genetic(SPEC, config, seed=3)
    told(genetic, first_gene)
    recipes, _ = genetic.ask(MUTATION)
    assert (recipes["seed"] > 0).all()
    assert len(genetic.parents) == 5


# --- A generation ----------------------------------------------------------------------------------------------------


def test_the_first_generation_is_new():
    recipes, key = Genetic(SPEC, CONFIG, seed=4).ask(MUTATION)
    assert recipes.dtype == RECIPE
    assert (recipes["a"] == FRESH).all()
    assert len(set(recipes["seed"].tolist())) == CONFIG.population
    assert 0 <= key < 2**63


def test_parents_come_from_the_pool_and_about_half_have_two():
    config = GeneticConfig(population=4000, elites=3, tournament=2, parents=50, crossover=0.5)
    genetic = Genetic(SPEC, config, seed=5)
    told(genetic, first_gene)
    assert len(genetic.parents) == 53
    recipes, _ = genetic.ask(MUTATION)
    children = recipes[3:]
    for side in ("a", "b"):
        assert set(children[side].tolist()) == set(range(3, 53))
    two = (children["a"] != children["b"]).mean()
    assert two == pytest.approx(0.5 * 49 / 50, abs=0.04)
    assert len(set(recipes["seed"][3:].tolist())) == len(children)


@pytest.mark.parametrize(("crossover", "share"), [(0.0, 0.0), (1.0, 0.9)])
def test_crossover_is_a_share(crossover, share):
    config = GeneticConfig(population=1000, elites=1, tournament=2, parents=10, crossover=crossover)
    genetic = Genetic(SPEC, config, seed=6)
    told(genetic, first_gene)
    recipes, _ = genetic.ask(MUTATION)
    assert (recipes["a"] != recipes["b"]).mean() == pytest.approx(share, abs=0.05)


def test_the_pool_is_what_tournaments_won():
    """Every parent is a member of the generation, and fitter ones are there more often."""
    config = GeneticConfig(population=200, elites=0, tournament=4, parents=100)
    genetic = Genetic(SPEC, config, seed=7)
    members = told(genetic, first_gene)
    rank = {m.tobytes(): r for r, m in enumerate(members[np.argsort(-first_gene(members))])}
    ranks = [rank[p.tobytes()] for p in genetic.parents]
    assert np.mean(ranks) == pytest.approx(200 / 5, abs=12)  # the best of four of n is on average the n / 5th


# --- Tournaments -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "k"), [(20, 1), (20, 2), (20, 3), (12, 8), (2, 2)])
def test_tournament_pressure_is_its_closed_form(n, k):
    """Of n members, k drawn with replacement: rank i (1 is best) wins ((n - i + 1)^k - (n - i)^k) / n^k of them."""
    rng = np.random.default_rng(100 * n + k)
    score = rng.permutation(n).astype(float)
    count = 60_000
    winners = tournaments(score, k, count, rng)
    assert winners.shape == (count,)
    rank = (n - score[winners]).astype(int)  # scores are 0 to n - 1
    i = np.arange(1, n + 1)
    expected = ((n - i + 1.0) ** k - (n - i) ** k) / float(n) ** k * count
    seen = np.bincount(rank, minlength=n + 1)[1:]
    likely = expected >= 5
    seen = np.append(seen[likely], seen[~likely].sum())
    expected = np.append(expected[likely], expected[~likely].sum())
    assert stats.chisquare(seen[expected > 0], expected[expected > 0]).pvalue > 1e-3


def test_equal_scores_win_equally():
    winners = tournaments(np.zeros(10), 5, 50_000, np.random.default_rng(1))
    assert stats.chisquare(np.bincount(winners, minlength=10)).pvalue > 1e-3


# --- Scores ----------------------------------------------------------------------------------------------------------


@settings(max_examples=40, derandomize=True)
@given(bad=st.sets(st.integers(0, 39), max_size=35), seed=st.integers(0, 1000))
def test_a_score_that_is_not_a_number_loses(bad, seed):
    genetic = Genetic(SPEC, CONFIG, seed=seed)
    genetic.ask(MUTATION)
    members = genetic.genomes(EVERYONE)
    score = np.random.default_rng(seed).normal(size=40) - 1e6
    score[list(bad)] = np.nan
    genetic.tell(score)
    spoilt = {members[i].tobytes() for i in bad}
    elites = [p.tobytes() for p in genetic.parents[: CONFIG.elites]]
    assert not spoilt & set(elites)
    # A tournament of bad ones alone has to be won by one; no other is.
    winners = [p.tobytes() in spoilt for p in genetic.parents[CONFIG.elites :]]
    if len(bad) <= 4:
        assert sum(winners) <= 1
    best = members[np.nanargmax(score)]
    assert elites[0] == best.tobytes()


def test_a_generation_of_nothing_but_not_a_number_goes_on():
    genetic = Genetic(SPEC, CONFIG, seed=8)
    told(genetic, lambda genomes: np.full(len(genomes), np.nan))
    assert genetic.generation == 1
    assert len(told(genetic, first_gene)) == CONFIG.population


# --- Order, and what a resume needs ----------------------------------------------------------------------------------


def test_out_of_order_raises():
    genetic = Genetic(SPEC, CONFIG, seed=9)
    with pytest.raises(RuntimeError, match="without ask"):
        genetic.tell(np.zeros(40))
    with pytest.raises(RuntimeError, match="asked for"):
        genetic.genomes(EVERYONE)
    genetic.ask(MUTATION)
    with pytest.raises(RuntimeError, match="twice"):
        genetic.ask(MUTATION)
    with pytest.raises(ValueError, match="40 members"):
        genetic.tell(np.zeros(39))
    with pytest.raises(ValueError, match="40 members"):
        genetic.tell(np.zeros((40, 1)))
    genetic.tell(np.zeros(40))  # what was refused has changed nothing
    assert genetic.generation == 1
    with pytest.raises(RuntimeError, match="without ask"):
        genetic.tell(np.zeros(40))


def test_the_same_seed_is_the_same_run_and_another_is_not():
    runs = []
    for seed in (1, 1, 2):
        genetic = Genetic(SPEC, CONFIG, seed=seed)
        runs.append(b"".join(told(genetic, first_gene).tobytes() for _ in range(4)))
    assert runs[0] == runs[1] != runs[2]


def test_parents_and_the_generations_number_are_all_the_state_there_is():
    genetic = Genetic(SPEC, CONFIG, seed=10)
    for _ in range(3):
        told(genetic, first_gene)
    again = Genetic(SPEC, CONFIG, seed=10)
    again.parents, again.elites, again.generation = genetic.parents.copy(), genetic.elites, genetic.generation
    for _ in range(3):
        assert told(genetic, first_gene).tobytes() == told(again, first_gene).tobytes()


def test_random_search_learns_nothing_but_keeps_its_best():
    genetic = Genetic(SPEC, CONFIG, seed=11, random_search=True)
    before = told(genetic, first_gene)
    for _ in range(3):
        recipes, key = genetic.ask(MUTATION)
        assert (recipes["a"][CONFIG.elites :] == FRESH).all()
        now = genetic.genomes(EVERYONE)
        best = np.argsort(-first_gene(before), kind="stable")[: CONFIG.elites]
        assert now[: CONFIG.elites].tobytes() == before[best].tobytes()
        fresh = breed(np.zeros((0, SPEC.size), dtype=F), recipes[CONFIG.elites :], key, SPEC, MUTATION)
        assert now[CONFIG.elites :].tobytes() == fresh.tobytes()
        assert not {g.tobytes() for g in fresh} & {g.tobytes() for g in before}
        genetic.tell(first_gene(now))
        before = now


def test_the_mean_is_that_of_the_pool_alone():
    genetic = Genetic(SPEC, CONFIG, seed=12)
    assert genetic.mean().shape == (0, SPEC.size)
    told(genetic, first_gene)
    mean = genetic.mean()
    assert mean.shape == (1, SPEC.size)
    assert mean.dtype == F
    wanted = [float(np.mean([float(parent[i]) for parent in genetic.parents[-CONFIG.parents :]])) for i in range(5)]
    np.testing.assert_allclose(mean[0, :5], wanted, rtol=1e-6)
    search = Genetic(SPEC, CONFIG, seed=12, random_search=True)
    told(search, first_gene)
    assert search.mean().shape == (0, SPEC.size), "random search averages nothing"


def test_the_mean_takes_the_places_of_the_last_but_one():
    config = GeneticConfig(population=40, elites=4, tournament=3, parents=5)
    genetic = Genetic(SPEC, config, seed=12)
    told(genetic, first_gene)
    before, mean = genetic.parents.copy(), genetic.mean()[0]
    genetic.admit_mean()
    changed = np.flatnonzero((genetic.parents != before).any(axis=1))
    assert changed.tolist() == [2, 7]
    assert genetic.parents[2].tobytes() == genetic.parents[7].tobytes() == mean.tobytes()
    genetic.ask(MUTATION)
    assert genetic.genomes(np.array([2]))[0].tobytes() == mean.tobytes(), "it is driven as it is"


@pytest.mark.parametrize(("elites", "parents", "rows"), [(3, 4, [5]), (0, 4, [2]), (4, 3, [])])
def test_few_elites_and_parents_stay_for_the_mean(elites, parents, rows):
    genetic = Genetic(SPEC, GeneticConfig(population=40, elites=elites, tournament=3, parents=parents), seed=12)
    genetic.admit_mean()  # of nobody
    told(genetic, first_gene)
    before = genetic.parents.copy()
    genetic.admit_mean()
    assert np.flatnonzero((genetic.parents != before).any(axis=1)).tolist() == rows


def test_a_run_may_begin_with_a_genome():
    genome = np.random.default_rng(1).normal(size=SPEC.size).astype(F)
    genetic = Genetic(SPEC, CONFIG, seed=12)
    genetic.seed_with(genome)
    genetic.ask(MUTATION)
    members = genetic.genomes(EVERYONE)
    assert members[0].tobytes() == genome.tobytes()
    assert (members == genome).mean() > 0.8  # the others are its children
    assert len({m.tobytes() for m in members}) > 10
    with pytest.raises(ValueError, match="genes"):
        genetic.seed_with(genome[1:])


@pytest.mark.parametrize(
    "wrong",
    [
        {"population": 1},
        {"population": 0},
        {"population": 8, "elites": 8},
        {"elites": -1},
        {"tournament": 0},
        {"parents": 0},
        {"parents": 65_535},
    ],
)
def test_parameters_that_do_not_fit_are_refused_in_one_line(wrong):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        Genetic(SPEC, GeneticConfig(**wrong), seed=1)
