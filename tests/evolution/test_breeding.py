"""Children from recipes: what is inherited, what is changed, and that a recipe is its child."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from searching import new_genomes

from evolution.networks.policy import PolicySpec, gene_scales
from evolution.networks.symmetry import symmetry
from evolution.search.breeding import QUANTILES, RECIPE, Kind, Mutation, breed, noise_sum

F = np.float32
SPEC, CNN = PolicySpec.parse("mlp:6,7"), PolicySpec.parse("cnn:8,8,16@1")
FREE = symmetry(SPEC).free  # genes with noise of their own
STILL = Mutation(rate=0.0, sigma=0.0)


def many(kind, a, b, n):
    made = np.zeros(n, dtype=RECIPE)
    made["kind"], made["a"], made["b"], made["seed"] = kind, a, b, np.arange(n)
    return made


@pytest.fixture(scope="module")
def parents():
    return np.random.default_rng(0).normal(size=(5, SPEC.size)).astype(F)


def is_normal(noise):
    """Whether numbers may be of N(0, 1), by Kolmogorov and Smirnov; one of 4,096 levels is as near as they come."""
    distance = stats.kstest(np.ravel(noise), "norm").statistic
    return distance < 1.95 / np.sqrt(np.size(noise)) + 1.0 / len(QUANTILES)


def test_a_copy_is_bit_identical(parents):
    odd = parents.copy()
    odd[2, :4] = [-0.0, np.inf, 1e-42, -np.inf]
    odd[2, 4] = np.array([0x7FC12345], dtype=np.uint32).view(F)[0]  # a not-a-number of its own
    children = breed(odd, np.array([(0, 2, 1, 0), (0, 0, 2, 9)], dtype=RECIPE), 9, SPEC, Mutation(rate=1.0))
    assert children.tobytes() == odd[[2, 0]].tobytes()


@pytest.mark.parametrize("spec", [SPEC, CNN, PolicySpec.parse("mlp:3+motion")], ids=str)
def test_new_genomes_are_normal_and_as_large_as_genes_are(spec):
    n = 600
    noise = new_genomes(spec, n, seed=1) / gene_scales(spec).astype(float)
    for part in np.array_split(np.arange(spec.size), 8):
        assert noise[:, part].mean() == pytest.approx(0.0, abs=5.0 / np.sqrt(n * len(part)))
        assert noise[:, part].std() == pytest.approx(1.0, abs=4.0 / np.sqrt(n * len(part)))
    assert is_normal(noise[:, :: max(spec.size // 100, 1)])


def test_neighbouring_genes_seeds_and_keys_have_noise_of_their_own():
    noise, other = (new_genomes(SPEC, 2000, key)[:, FREE].astype(float) for key in (3, 4))
    for gap in range(1, 9):  # four numbers are drawn at a time
        assert abs((noise[:, gap:] * noise[:, :-gap]).mean()) < 5.0 / np.sqrt(noise.size)
    assert abs((noise[1:] * noise[:-1]).mean()) < 5.0 / np.sqrt(noise.size)
    assert abs((noise * other).mean()) < 5.0 / np.sqrt(noise.size)


@pytest.mark.parametrize("spec", [SPEC, PolicySpec.parse("mlp:4"), CNN], ids=str)  # blocks of four numbers, and not
def test_a_step_is_the_centre_and_its_seed_s_noise_at_the_scale_of_each_gene(spec):
    rng = np.random.default_rng(4)
    centre, made, weights = rng.normal(size=(1, spec.size)).astype(F), many(Kind.STEP, 0, 0, 30), rng.normal(size=30)
    made["seed"] = rng.integers(1 << 32, size=30)
    weights[[3, 5]] = 0.0
    z = breed(np.zeros_like(centre), made, 99, spec, Mutation(sigma=1.0)).astype(float)
    assert is_normal((z / gene_scales(spec))[:, symmetry(spec).free])
    np.testing.assert_allclose(breed(centre, made, 99, spec, Mutation(sigma=0.25)), centre + 0.25 * z, atol=1e-6)
    np.testing.assert_allclose(noise_sum(made["seed"], weights, 99, spec), weights @ z, atol=3e-5)
    made["kind"] = Kind.MIRRORED
    np.testing.assert_allclose(breed(centre, made, 99, spec, Mutation(sigma=0.25)), centre - 0.25 * z, atol=1e-6)


def test_a_child_of_two_has_each_gene_of_one_of_both(parents):
    children = breed(parents, many(Kind.CROSS, 1, 4, 2000), 77, SPEC, STILL)
    from_a, from_b = children == parents[1], children == parents[4]
    assert (from_a ^ from_b).all()
    assert abs(from_b.mean() - 0.5) < 4 * 0.5 / np.sqrt(from_b.size)
    # Every gene and every child has about half of each; neighbouring genes are inherited independently.
    assert np.abs(from_b.mean(axis=0) - 0.5).max() < 5 * 0.5 / np.sqrt(2000)
    assert np.abs(from_b.mean(axis=1) - 0.5).max() < 5 * 0.5 / np.sqrt(SPEC.size)
    assert abs((from_b[:, 1:] == from_b[:, :-1]).mean() - 0.5) < 4 * 0.5 / np.sqrt(from_b.size)


@pytest.mark.parametrize(("rate", "sigma"), [(0.03, 0.5), (0.2, 2.0), (1.0, 1.0)])
def test_mutation_is_gaussian_at_its_rate(rate, sigma):
    zero = np.zeros((1, SPEC.size), dtype=F)
    children = breed(zero, many(Kind.CROSS, 0, 0, 2000), 4, SPEC, Mutation(rate=rate, sigma=sigma))
    changed = children != 0.0
    assert abs(changed.mean() - rate) < 4 * np.sqrt(rate * (1 - rate) / changed.size) + 1e-6
    assert np.abs(changed.mean(axis=0) - rate).max() < 5 * np.sqrt(rate * (1 - rate) / 2000) + 1e-6
    assert is_normal(children[changed][:20_000].astype(float) / sigma)


@settings(max_examples=30, derandomize=True)
@given(data=st.data())
def test_the_same_recipe_is_the_same_child_in_any_chunk_and_order(parents, data):
    made = np.concatenate([
        many(Kind.CROSS, 1, 2, 12), many(Kind.NEW, 0, 0, 4), many(Kind.STEP, 3, 0, 5), many(Kind.MIRRORED, 3, 0, 5),
        many(Kind.COPY, 0, 0, 2),
    ])  # fmt: skip
    key = data.draw(st.integers(0, 2**63 - 1))
    whole = breed(parents, made, key, SPEC, Mutation(rate=0.1))
    chosen = data.draw(st.lists(st.integers(0, len(made) - 1), min_size=1, max_size=20))
    assert breed(parents, made[chosen], key, SPEC, Mutation(rate=0.1)).tobytes() == whole[chosen].tobytes()
