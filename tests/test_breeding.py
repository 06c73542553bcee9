"""Children from recipes: what is inherited, what is changed, and that a recipe is its child."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evolution.breeding import FRESH, RECIPE, Mutation, breed
from evolution.policy import PolicySpec, gene_scales

F = np.float32
SPEC = PolicySpec.parse("mlp:6,7")
STILL = Mutation(rate=0.0, sigma=0.0, bump_rate=0.0)
RAYS = SPEC.inputs - 1
UNITS = SPEC.hidden[0]


def recipes(*rows):
    return np.array(list(rows), dtype=RECIPE)


def many(a, b, n, first_seed=1):
    made = np.zeros(n, dtype=RECIPE)
    made["a"], made["b"], made["seed"] = a, b, np.arange(first_seed, first_seed + n)
    return made


@pytest.fixture(scope="module")
def parents():
    return np.random.default_rng(0).normal(size=(5, SPEC.size)).astype(F)


# --- What stays as it was --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mutation",
    [
        STILL,
        Mutation(rate=0.5, sigma=0.0, bump_rate=1.0),  # sigma 0 is the height of noise and bumps
        Mutation(rate=0.0, sigma=2.0, bump_rate=0.0),
    ],
)
def test_without_mutation_a_child_of_one_parent_is_that_parent(parents, mutation):
    children = breed(parents, many(3, 3, 50), 123, SPEC, mutation)
    assert all(child.tobytes() == parents[3].tobytes() for child in children)


def test_a_copy_is_bit_identical_whatever_is_mutated(parents):
    odd = parents.copy()
    odd[2, :4] = [-0.0, np.inf, 1e-42, -np.inf]
    odd[2, 4] = np.array([0x7FC12345], dtype=np.uint32).view(F)[0]  # a not-a-number of its own
    children = breed(odd, recipes((2, 2, 0), (0, 0, 0), (2, 2, 0)), 9, SPEC, Mutation(rate=1.0, bump_rate=1.0))
    assert children[0].tobytes() == children[2].tobytes() == odd[2].tobytes()
    assert children[1].tobytes() == odd[0].tobytes()


def test_parents_and_recipes_are_left_alone(parents):
    before, made = parents.copy(), many(0, 1, 20)
    kept = made.copy()
    breed(parents, made, 5, SPEC, Mutation(rate=1.0))
    assert parents.tobytes() == before.tobytes()
    assert made.tobytes() == kept.tobytes()


# --- Crossover -------------------------------------------------------------------------------------------------------


def test_a_child_of_two_has_each_gene_of_one_of_both(parents):
    children = breed(parents, many(1, 4, 2000), 77, SPEC, STILL)
    from_a, from_b = children == parents[1], children == parents[4]
    assert (from_a ^ from_b).all()
    share = from_b.mean()
    n = from_b.size
    assert abs(share - 0.5) < 4 * 0.5 / np.sqrt(n)
    # Every gene and every child has about half of each; neighbouring genes are inherited independently.
    assert np.abs(from_b.mean(axis=0) - 0.5).max() < 5 * 0.5 / np.sqrt(2000)
    assert np.abs(from_b.mean(axis=1) - 0.5).max() < 5 * 0.5 / np.sqrt(SPEC.size)
    together = (from_b[:, 1:] == from_b[:, :-1]).mean()
    assert abs(together - 0.5) < 4 * 0.5 / np.sqrt(n)


# --- Mutation --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "sigma"), [(0.03, 0.5), (0.2, 2.0), (1.0, 1.0)])
def test_mutation_is_gaussian_at_its_rate(rate, sigma):
    zero = np.zeros((1, SPEC.size), dtype=F)
    children = breed(zero, many(0, 0, 2000), 4, SPEC, Mutation(rate=rate, sigma=sigma, bump_rate=0.0))
    changed = children != 0.0
    n = changed.size
    assert abs(changed.mean() - rate) < 4 * np.sqrt(rate * (1 - rate) / n) + 1e-6
    assert np.abs(changed.mean(axis=0) - rate).max() < 5 * np.sqrt(rate * (1 - rate) / 2000) + 1e-6
    noise = children[changed][:20_000].astype(float)
    assert stats.kstest(noise / sigma, "norm").pvalue > 1e-3


def test_mutation_adds_to_the_crossed_gene(parents):
    children = breed(parents, many(0, 1, 500), 4, SPEC, Mutation(rate=0.1, sigma=1e-3, bump_rate=0.0))
    away = np.minimum(np.abs(children - parents[0]), np.abs(children - parents[1]))
    assert away.max() < 6e-3
    assert 0.08 < (away > 0).mean() < 0.12


def test_a_bump_is_smooth_over_neighbouring_rays_of_one_unit():
    zero = np.zeros((1, SPEC.size), dtype=F)
    mutation = Mutation(rate=0.0, sigma=0.5, bump_rate=0.3, bump_width=4.0)
    children = breed(zero, many(0, 0, 4000), 8, SPEC, mutation).astype(float)
    bumped = (children != 0).any(axis=1)
    assert abs(bumped.mean() - 0.3) < 4 * np.sqrt(0.3 * 0.7 / 4000)
    assert (children[:, RAYS * UNITS :] == 0).all()  # neither the speed's weights, nor biases, nor later layers
    first = children[bumped, : RAYS * UNITS].reshape(-1, RAYS, UNITS)
    units = (first != 0).any(axis=1)
    assert (units.sum(axis=1) == 1).all()
    assert units.sum(axis=0).min() > 0.5 * bumped.sum() / UNITS
    profiles = first[np.arange(len(first)), :, units.argmax(axis=1)]
    heights, widths = [], []
    for profile in profiles:
        size = np.abs(profile)
        assert (np.sign(profile[size > 1e-9]) == np.sign(profile[size.argmax()])).all()
        # A Gaussian's logarithm is a parabola: its second difference is -1 / width^2 everywhere.
        clear = np.flatnonzero(size > 1e-6 * size.max())
        if len(clear) >= 3 and size.max() > 1e-3:
            bend = np.diff(np.log(size[clear]), 2)
            assert np.ptp(bend) < 0.01 * np.abs(bend).max() + 2e-3
            widths.append(1 / np.sqrt(-bend.mean()))
        heights.append(profile[size.argmax()])
    assert 0.65 < min(widths) < 1.2
    assert 3.5 < max(widths) < 4.1
    assert abs(np.mean(heights)) < 0.1
    assert 0.4 < np.std(heights) < 0.55


# --- New genomes -----------------------------------------------------------------------------------------------------


def test_new_genomes():
    nobody = np.zeros((0, SPEC.size), dtype=F)
    children = breed(nobody, many(FRESH, FRESH, 3000), 1, SPEC, Mutation()).astype(float)
    assert np.isfinite(children).all()
    assert len({child.tobytes() for child in children}) == 3000
    first = children[:, : RAYS * UNITS].reshape(-1, RAYS, UNITS)
    # Smooth across rays: neighbours are alike, rays far apart are not.
    near = np.corrcoef(first[:, 10].ravel(), first[:, 11].ravel())[0, 1]
    far = np.corrcoef(first[:, 3].ravel(), first[:, 27].ravel())[0, 1]
    assert near > 0.85
    assert abs(far) < 0.3
    assert np.abs(first.mean(axis=(0, 2))).max() < 0.05
    # The second layer's genes are normal with variance 1 / inputs.
    at = (SPEC.inputs + 1) * UNITS
    second = children[:, at : at + (UNITS + 1) * SPEC.hidden[1]]
    assert stats.kstest(second.ravel()[:20_000] * np.sqrt(UNITS), "norm").pvalue > 1e-3


def test_new_genomes_grow_with_their_scale():
    nobody = np.zeros((0, SPEC.size), dtype=F)
    one, two = (
        breed(nobody, many(FRESH, FRESH, 50), 1, SPEC, Mutation(first_scale=scale)).astype(float)
        for scale in (1.0, 2.0)
    )
    assert two == pytest.approx(2 * one, rel=1e-4, abs=1e-6)


# --- Convolutional networks ------------------------------------------------------------------------------------------

CNN = PolicySpec.parse("cnn:8,8,16@1")
EDGES = np.cumsum([0, *((n + 1) * m for n, m in CNN.shapes())])


def test_new_convolutional_genomes_are_as_large_as_genes_are():
    children = breed(np.zeros((0, CNN.size), dtype=F), many(FRESH, FRESH, 300), 1, CNN, Mutation()).astype(float)
    assert len({child.tobytes() for child in children}) == 300
    scaled = children / gene_scales(CNN)
    for first, last in itertools.pairwise(EDGES):
        assert scaled[:, first:last].mean() == pytest.approx(0.0, abs=0.05)
        assert scaled[:, first:last].std() == pytest.approx(1.0, abs=0.05)
    assert stats.kstest(scaled[:, ::20].ravel(), "norm").pvalue > 1e-3


@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_a_mutation_is_as_large_as_its_gene(sigma):
    zero = np.zeros((1, CNN.size), dtype=F)
    children = breed(zero, many(0, 0, 200), 4, CNN, Mutation(rate=0.2, sigma=sigma, bump_rate=0.0)).astype(float)
    changed = children != 0
    assert changed.mean() == pytest.approx(0.2, abs=0.01)
    noise = (children / gene_scales(CNN))[changed]
    assert stats.kstest(noise[:20_000] / sigma, "norm").pvalue > 1e-3


def test_bumps_are_for_rays_alone():
    zero = np.zeros((1, CNN.size), dtype=F)
    assert (breed(zero, many(0, 0, 50), 8, CNN, Mutation(rate=0.0, bump_rate=1.0)) == 0.0).all()


def test_convolutional_children_are_their_recipes():
    parents = np.random.default_rng(5).normal(size=(4, CNN.size)).astype(F)
    made = np.concatenate([many(1, 2, 6), many(FRESH, FRESH, 3), recipes((0, 0, 0), (3, 3, 7))])
    whole = breed(parents, made, 11, CNN, Mutation(bump_rate=0.5))
    assert whole[9].tobytes() == parents[0].tobytes()
    for chosen in ([3], [10, 0, 7], [8, 8, 2]):
        assert breed(parents, made[chosen], 11, CNN, Mutation(bump_rate=0.5)).tobytes() == whole[chosen].tobytes()
    still = breed(parents, many(1, 2, 200), 3, CNN, STILL)
    assert ((still == parents[1]) | (still == parents[2])).all()
    assert (still == parents[2]).mean() == pytest.approx(0.5, abs=0.01)


# --- A recipe is its child -------------------------------------------------------------------------------------------


@settings(max_examples=30, derandomize=True)
@given(data=st.data())
def test_the_same_recipe_is_the_same_child_in_any_chunk(parents, data):
    made = np.concatenate([many(1, 2, 12), many(FRESH, FRESH, 4), recipes((0, 0, 0), (3, 3, 7))])
    key = data.draw(st.integers(0, 2**63 - 1))
    mutation = Mutation(rate=0.1, bump_rate=0.5)
    whole = breed(parents, made, key, SPEC, mutation)
    chosen = data.draw(st.lists(st.integers(0, len(made) - 1), min_size=1, max_size=20))
    assert breed(parents, made[chosen], key, SPEC, mutation).tobytes() == whole[chosen].tobytes()


def test_key_and_seed_make_the_child(parents):
    mutation = Mutation(rate=0.5)
    made = recipes((0, 1, 1), (0, 1, 2), (0, 1, 1), (FRESH, FRESH, 1), (FRESH, FRESH, 2))
    one, other = breed(parents, made, 1, SPEC, mutation), breed(parents, made, 2, SPEC, mutation)
    assert one[0].tobytes() == one[2].tobytes()
    assert one[0].tobytes() != one[1].tobytes()
    assert one[3].tobytes() != one[4].tobytes()
    assert all(a.tobytes() != b.tobytes() for a, b in zip(one, other, strict=True))
    assert breed(parents, made, 1, SPEC, mutation).tobytes() == one.tobytes()


def test_keys_of_63_bits_are_told_apart(parents):
    keys = [0, 1, 2**31, 2**32, 2**53, 2**53 + 1, 2**63 - 1]
    children = [breed(parents, many(0, 0, 1), key, SPEC, Mutation(rate=1.0)).tobytes() for key in keys]
    assert len(set(children)) == len(keys)


# --- Wrong use -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", [(5, 0, 1), (0, 5, 1), (5, 5, 0), (65_534, 0, 1)])
def test_a_parent_that_is_not_there_is_refused(parents, row):
    with pytest.raises(ValueError, match="parent"):
        breed(parents, recipes((0, 0, 1), row), 1, SPEC, STILL)


@pytest.mark.parametrize("shape", [(5, SPEC.size - 1), (SPEC.size,), (5, SPEC.size, 1)])
def test_parents_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match="parents of mlp:6,7"):
        breed(np.zeros(shape, dtype=F), recipes((0, 0, 1)), 1, SPEC, STILL)


def test_no_recipes_no_children(parents):
    assert breed(parents, recipes(), 1, SPEC, STILL).shape == (0, SPEC.size)


def test_a_recipe_is_eight_bytes():
    assert RECIPE.itemsize == 8
