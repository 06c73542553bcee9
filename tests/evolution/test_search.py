"""Searches: children from recipes, ranks, tournaments, the (CSA-)ES beside CMA-ES, the genetic algorithm."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from searching import first_gene, new_genomes, state_of, told

from evolution.networks.policy import PolicySpec
from evolution.networks.symmetry import space
from evolution.search.base import SearchConfig, ranks, split, tournament_weights, tournaments
from evolution.search.breeding import QUANTILES, RECIPE, Kind, Mutation, breed, noise_sum
from evolution.search.recombination import Recombination
from evolution.search.space import Space, Symmetry
from evolution.search.two_parents import PARENTS, TwoParents
from gridsim.errors import GridSimError

F = np.float32
GENES = 49
SPACE = Space(GENES, np.ones(GENES))
SEARCHES = [Recombination, TwoParents]
few = st.integers(0, 4)  # scores that are often equal


@settings(max_examples=60, derandomize=True)
@given(scores=st.lists(few | st.just(-np.inf), min_size=2, max_size=40).map(np.array), data=st.data())
def test_a_rank_is_the_share_of_its_group_with_lower_scores_equals_by_half(scores, data):
    cuts = sorted(data.draw(st.sets(st.integers(1, len(scores) - 1), max_size=4)))
    groups = [slice(a, b) for a, b in itertools.pairwise([0, *cuts, len(scores)])]
    standing = ranks(scores, groups)
    for group in groups:
        for own, score in zip(standing[group], scores[group], strict=True):
            lower, equal = (scores[group] < score).sum(), (scores[group] == score).sum()
            assert own == pytest.approx((lower + equal / 2) / len(scores[group]))
    assert ((standing > 0.0) & (standing < 1.0)).all()


@given(scores=st.lists(few, min_size=1, max_size=5), size=st.integers(1, 4))
def test_weights_are_what_all_tournaments_come_to(scores, size):
    """Every tournament that can be, its equal winners sharing it."""
    scores, wins = np.array(scores), np.zeros(len(scores))
    for drawn in itertools.product(range(len(scores)), repeat=size):
        best = [k for k in drawn if scores[k] == scores[list(drawn)].max()]
        for k in best:
            wins[k] += 1.0 / len(best)
    np.testing.assert_allclose(tournament_weights(scores, size), wins / len(scores) ** size, atol=1e-12)


@pytest.mark.parametrize(("n", "size"), [(20, 1), (20, 3), (2, 2)])
def test_tournaments_are_won_at_their_weights(n, size):
    rng = np.random.default_rng(100 * n + size)
    scores, count = rng.permutation(n).astype(float), 60_000
    seen = np.bincount(tournaments(scores, size, count, rng), minlength=n)
    assert stats.chisquare(seen, count * tournament_weights(scores, size)).pvalue > 1e-3


@pytest.mark.parametrize(
    ("scales", "mirror"),
    [
        (np.ones(2), None),
        (np.array([1.0, 0.0, 1.0]), None),
        (np.array([1.0, np.nan, 1.0]), None),
        (np.ones(3), Symmetry(*map(np.array, ([0, 1], [1], [0], [1.0])))),  # gene 2 is missing
        (np.ones(3), Symmetry(*map(np.array, ([0, 1], [2], [3], [1.0])))),
        (np.ones(3), Symmetry(*map(np.array, ([0, 1], [2], [0], [1.0, 1.0])))),
    ],
)
def test_a_space_that_does_not_fit_its_size_is_refused(scales, mirror):
    with pytest.raises(GridSimError, match=r"^[^\n]*a space of 3 genes[^\n]*$"):
        Space(3, scales, mirror)


@given(data=st.data())
def test_pairs_stay_together_in_groups_of_about_as_many(data):
    members = data.draw(st.integers(4, 300))
    first = data.draw(st.integers(0, 2))
    groups = data.draw(st.integers(1, (members - first + 1) // 2))
    parts = split(members, groups, first)
    assert len(parts) == groups
    assert all(part.start < part.stop for part in parts)
    assert [k for part in parts for k in range(part.start, part.stop)] == list(range(members))
    assert all((part.start - first) % 2 == 0 for part in parts[1:])  # no pair is cut
    sizes = np.array([part.stop - part.start for part in parts])
    sizes[0] -= first
    assert np.ptp((sizes + 1) // 2) <= 1


def test_a_population_too_small_for_its_groups_is_refused():
    assert len(split(17, 8, 2)) == 8
    with pytest.raises(GridSimError, match=r"^8 groups need a population of 17 or more, not 16$"):
        split(16, 8, 2)


@pytest.mark.parametrize("kind", SEARCHES)
def test_the_first_generation_is_new_and_each_has_a_key_of_its_own(kind):
    search, other = (kind(SPACE, SearchConfig(population=41, groups=3), seed) for seed in (4, 5))
    assert search.leader() is None
    asked = search.ask()
    assert asked.groups == split(41, 3)
    assert len({genome.tobytes() for genome in search.genomes(np.arange(41))}) == 41
    keys = {other.ask().key, asked.key}
    for _ in range(49):
        search.tell(np.arange(41.0))
        keys.add(search.ask().key)
    assert len(keys) == 51


@pytest.mark.parametrize("kind", SEARCHES)
def test_a_score_that_is_not_a_number_loses(kind):
    states = []
    for spoilt in (np.nan, -np.inf, -1e300):
        search = kind(SPACE, SearchConfig(population=16, groups=2, tournament=4), seed=6)
        for generation in range(4):
            search.ask()
            scores = np.random.default_rng(generation).normal(size=16)
            scores[[2, 3, 11]] = spoilt
            search.tell(scores)
        states.append(state_of(search))
    assert states[0] == states[1] == states[2]


# --- The default search ----------------------------------------------------------------------------------------------


def begun(config, seed=1):
    search = Recombination(SPACE, config, seed)
    search.start_from(np.random.default_rng(seed).normal(size=GENES).astype(F))
    return search


def test_the_first_centre_is_the_best_of_a_random_generation():
    search = Recombination(SPACE, SearchConfig(population=40, groups=4), seed=1)
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


def squared_distances(settled):
    """Of centre and average from the best point of a sphere whose scores are mostly noise: means of 200 generations."""
    search, rng, late = begun(SearchConfig(population=33, groups=1, settled=settled)), np.random.default_rng(7), []
    for generation in range(600):
        told(search, lambda genomes: rng.normal(0.0, 30.0, len(genomes)) - (genomes.astype(float) ** 2).sum(axis=1))
        if generation >= 400:
            late.append([(search.centre**2).sum(), (search.average**2).sum()])
    return np.mean(late, axis=0)


def test_where_chance_decides_settling_brings_centre_and_average_nearer():
    assert (squared_distances(settled=20) < 0.6 * squared_distances(settled=0)).all()


# --- Two parents, and random search ----------------------------------------------------------------------------------

CONFIG = SearchConfig(population=40, groups=1, tournament=3, sigma=0.5, elites=4)
EVERYONE = np.arange(CONFIG.population)


@pytest.mark.parametrize(("random", "kind"), [(False, Kind.CROSS), (True, Kind.NEW)])
def test_elites_go_on_bit_identical_best_first(random, kind):
    search = TwoParents(SPACE, CONFIG, seed=1, random=random)
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
    search = TwoParents(SPACE, SearchConfig(population=40, groups=4, tournament=3, elites=8), seed=1)
    asked = search.ask()
    members = search.genomes(EVERYONE)
    scores = first_gene(members) + 100.0 * np.repeat(np.arange(4), 10)
    search.tell(scores)
    best = np.argsort(-ranks(scores, asked.groups), kind="stable")[:8]
    assert sorted(best // 10) == [0, 0, 1, 1, 2, 2, 3, 3]
    assert search.parents[:8].tobytes() == members[best].tobytes()


def test_both_parents_come_from_the_pool_and_mutation_is_as_asked_for():
    config = SearchConfig(population=4000, groups=1, tournament=2, elites=3, sigma=0.7, mutation_rate=0.2)
    search = TwoParents(SPACE, config, seed=5)
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
    search = TwoParents(SPACE, SearchConfig(population=40, elites=elites, mutation_rate=0.0), seed=1)
    genome = np.random.default_rng(1).normal(size=GENES).astype(F)
    search.start_from(genome)
    search.ask()
    assert (search.genomes(EVERYONE) == genome).all()


# --- Breeding --------------------------------------------------------------------------------------------------------


MLP, CNN = PolicySpec.parse("mlp:6,7"), PolicySpec.parse("cnn:8,8,16@1")
FREE = space(MLP).symmetry.free  # genes with noise of their own
STILL = Mutation(rate=0.0, sigma=0.0)


def many(kind, a, b, n):
    made = np.zeros(n, dtype=RECIPE)
    made["kind"], made["a"], made["b"], made["seed"] = kind, a, b, np.arange(n)
    return made


@pytest.fixture(scope="module")
def parents():
    return np.random.default_rng(0).normal(size=(5, MLP.size)).astype(F)


def is_normal(noise):
    """Whether numbers may be of N(0, 1), by Kolmogorov and Smirnov; one of 4,096 levels is as near as they come."""
    return stats.kstest(np.ravel(noise), "norm").statistic < 1.95 / np.sqrt(np.size(noise)) + 1.0 / len(QUANTILES)


def test_a_copy_is_bit_identical(parents):
    odd = parents.copy()
    odd[2, :4] = [-0.0, np.inf, 1e-42, -np.inf]
    odd[2, 4] = np.array([0x7FC12345], dtype=np.uint32).view(F)[0]  # a not-a-number of its own
    children = breed(odd, np.array([(0, 2, 1, 0), (0, 0, 2, 9)], dtype=RECIPE), 9, space(MLP), Mutation(rate=1.0))
    assert children.tobytes() == odd[[2, 0]].tobytes()


@pytest.mark.parametrize("spec", [MLP, CNN, PolicySpec.parse("mlp:3+motion")], ids=str)
def test_new_genomes_are_normal_and_as_large_as_genes_are(spec):
    n = 600
    noise = new_genomes(spec, n, seed=1) / space(spec).scales.astype(float)
    for part in np.array_split(np.arange(spec.size), 8):
        assert noise[:, part].mean() == pytest.approx(0.0, abs=5.0 / np.sqrt(n * len(part)))
        assert noise[:, part].std() == pytest.approx(1.0, abs=4.0 / np.sqrt(n * len(part)))
    assert is_normal(noise[:, :: max(spec.size // 100, 1)])


def test_neighbouring_genes_seeds_and_keys_have_noise_of_their_own():
    noise, other = (new_genomes(MLP, 2000, key)[:, FREE].astype(float) for key in (3, 4))
    for gap in range(1, 9):  # four numbers are drawn at a time
        assert abs((noise[:, gap:] * noise[:, :-gap]).mean()) < 5.0 / np.sqrt(noise.size)
    assert abs((noise[1:] * noise[:-1]).mean()) < 5.0 / np.sqrt(noise.size)
    assert abs((noise * other).mean()) < 5.0 / np.sqrt(noise.size)


@pytest.mark.parametrize("spec", [MLP, PolicySpec.parse("mlp:4"), CNN], ids=str)  # blocks of four numbers, and not
def test_a_step_is_the_centre_and_its_seed_s_noise_at_the_scale_of_each_gene(spec):
    rng = np.random.default_rng(4)
    centre, made, weights = rng.normal(size=(1, spec.size)).astype(F), many(Kind.STEP, 0, 0, 30), rng.normal(size=30)
    made["seed"] = rng.integers(1 << 32, size=30)
    weights[[3, 5]] = 0.0
    z = breed(np.zeros_like(centre), made, 99, space(spec), Mutation(sigma=1.0)).astype(float)
    assert is_normal((z / space(spec).scales)[:, space(spec).symmetry.free])
    np.testing.assert_allclose(breed(centre, made, 99, space(spec), Mutation(sigma=0.25)), centre + 0.25 * z, atol=1e-6)
    np.testing.assert_allclose(noise_sum(made["seed"], weights, 99, space(spec)), weights @ z, atol=3e-5)
    made["kind"] = Kind.MIRRORED
    np.testing.assert_allclose(breed(centre, made, 99, space(spec), Mutation(sigma=0.25)), centre - 0.25 * z, atol=1e-6)


def test_a_child_of_two_has_each_gene_of_one_of_both(parents):
    children = breed(parents, many(Kind.CROSS, 1, 4, 2000), 77, space(MLP), STILL)
    from_a, from_b = children == parents[1], children == parents[4]
    assert (from_a ^ from_b).all()
    from_b = from_b[:, FREE]  # the other genes come from where these do
    assert abs(from_b.mean() - 0.5) < 4 * 0.5 / np.sqrt(from_b.size)
    # Every gene and every child has about half of each; neighbouring genes are inherited independently.
    assert np.abs(from_b.mean(axis=0) - 0.5).max() < 5 * 0.5 / np.sqrt(2000)
    assert np.abs(from_b.mean(axis=1) - 0.5).max() < 5 * 0.5 / np.sqrt(len(FREE))
    assert abs((from_b[:, 1:] == from_b[:, :-1]).mean() - 0.5) < 4 * 0.5 / np.sqrt(from_b.size)


@pytest.mark.parametrize(("rate", "sigma"), [(0.03, 0.5), (0.2, 2.0), (1.0, 1.0)])
def test_mutation_is_gaussian_at_its_rate(rate, sigma):
    zero = np.zeros((1, MLP.size), dtype=F)
    children = breed(zero, many(Kind.CROSS, 0, 0, 2000), 4, space(MLP), Mutation(rate=rate, sigma=sigma))[:, FREE]
    changed = children != 0.0
    assert abs(changed.mean() - rate) < 4 * np.sqrt(rate * (1 - rate) / changed.size) + 1e-6
    assert np.abs(changed.mean(axis=0) - rate).max() < 5 * np.sqrt(rate * (1 - rate) / 2000) + 1e-6
    assert is_normal(children[changed][:20_000].astype(float) / sigma)


def test_children_of_symmetric_parents_are_symmetric():
    """Bit for bit; the steering angle's weights have the other sign, or are 0 in a middle unit."""
    spec = PolicySpec.parse("mlp:7+steering")
    bound, source, factor = space(spec).symmetry[1:]
    children = breed(new_genomes(spec, 5), many(Kind.CROSS, 1, 4, 500), 3, space(spec), Mutation(rate=0.1))
    assert {*factor} == {1.0, -1.0, 0.0}
    assert (children[:, bound] == factor * children[:, source]).all()
    assert len(np.unique(children, axis=0)) == 500


@settings(max_examples=30, derandomize=True)
@given(data=st.data())
def test_the_same_recipe_is_the_same_child_in_any_chunk_and_order(parents, data):
    made = np.concatenate([
        many(Kind.CROSS, 1, 2, 12), many(Kind.NEW, 0, 0, 4), many(Kind.STEP, 3, 0, 5), many(Kind.MIRRORED, 3, 0, 5),
        many(Kind.COPY, 0, 0, 2),
    ])  # fmt: skip
    key = data.draw(st.integers(0, 2**63 - 1))
    whole = breed(parents, made, key, space(MLP), Mutation(rate=0.1))
    chosen = data.draw(st.lists(st.integers(0, len(made) - 1), min_size=1, max_size=20))
    assert breed(parents, made[chosen], key, space(MLP), Mutation(rate=0.1)).tobytes() == whole[chosen].tobytes()
