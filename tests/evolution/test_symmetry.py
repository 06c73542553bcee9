"""Left-right symmetry: a symmetric network takes the mirrored action in a mirrored world."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from searching import new_genomes

from evolution.networks.policy import RAYS, CnnSpec, MlpSpec, PolicySpec, act_on, outputs_of
from evolution.networks.symmetry import MIRRORED_ACTIONS, symmetry
from gridsim.car.vehicle import Action
from gridsim.config import SimConfig

F = np.float32
HIDDEN = st.lists(st.integers(4, 12), min_size=1, max_size=3).map(tuple)


def in_a_mirror(spec, observations):
    """What the same car would observe if left and right were exchanged."""
    seen = observations.copy()
    seen[:, :RAYS] = observations[:, RAYS - 1 :: -1]
    if spec.motion:
        seen[:, RAYS : 2 * RAYS] = observations[:, 2 * RAYS - 1 : RAYS - 1 : -1]
    if spec.steering:
        seen[:, -1] = -observations[:, -1]
    return seen


def test_left_and_right_are_exchanged_and_nothing_else():
    for action, mirrored in zip(Action, MIRRORED_ACTIONS, strict=True):
        sides = {"LEFT": "RIGHT", "RIGHT": "LEFT"}
        assert Action(mirrored).name == "_".join(sides.get(part, part) for part in action.name.split("_"))


@settings(max_examples=40, derandomize=True)
@given(spec=st.builds(MlpSpec, HIDDEN, motion=st.booleans(), steering=st.booleans()), seed=st.integers(0, 1 << 40))
def test_in_a_mirrored_world_the_mirrored_actions_have_the_same_outputs(spec, seed):
    rng = np.random.default_rng(seed)
    observations = rng.random((60, spec.inputs)).astype(F)
    observations[:, RAYS:] = 2.0 * observations[:, RAYS:] - 1.0
    genome = new_genomes(spec, seed=seed)[0]

    one, other = (
        outputs_of(spec, genome, seen, SimConfig()) for seen in (observations, in_a_mirror(spec, observations))
    )
    assert np.abs(one).max() > 0.1
    np.testing.assert_allclose(one[:, MIRRORED_ACTIONS], other, atol=1e-4)


@pytest.mark.parametrize("policy", ["mlp:6,7", "mlp:64+steering", "mlp:3+motion+steering", "cnn:8,16,24@2"])
def test_every_gene_is_free_or_bound_to_a_free_one(policy):
    spec = PolicySpec.parse(policy)
    free, bound, source, factor = symmetry(spec)
    assert sorted([*free, *bound]) == list(range(spec.size))
    assert np.isin(source[factor != 0.0], free).all()
    assert len(free) < 0.53 * spec.size
    genomes = new_genomes(spec, 5)
    assert (genomes[:, bound] == factor * genomes[:, source]).all()
    assert len(np.unique(genomes[0, free])) > 0.4 * min(len(free), 4096)


@pytest.mark.parametrize("policy", ["mlp:1", "mlp:1,1+motion", "mlp:3,1,4+steering"])
def test_a_layer_of_one_unit_can_tell_left_from_right(policy):
    spec = PolicySpec.parse(policy)
    assert len(symmetry(spec).free) == spec.size
    observations = np.random.default_rng(1).random((300, spec.inputs)).astype(F)
    done = np.array([act_on(spec, genome, observations, SimConfig()) for genome in new_genomes(spec, 40)])
    assert {*np.unique(done)} >= {Action.LEFT, Action.RIGHT, Action.ACCELERATE_LEFT, Action.ACCELERATE_RIGHT}


def test_kernels_of_a_cnn_come_in_mirrored_pairs():
    spec = CnnSpec((8, 16, 24), frames=3)
    genome, at, layers = new_genomes(spec)[0], 0, []
    for n, m in spec.shapes():
        layers.append((genome[at : at + n * m].reshape(n, m), genome[at + n * m : at + (n + 1) * m]))
        at += (n + 1) * m
    first, second, dense, output = (weights for weights, _ in layers)
    first, second = first.reshape(3 * 8, 8, 8), second.reshape(4, 4, 8, 16)
    assert (first == first[:, ::-1, ::-1]).all()
    assert (second == second[:, ::-1, ::-1, ::-1]).all()
    seen = dense[:-1].reshape(8, 8, 16, 24)
    assert (seen == seen[:, ::-1, ::-1, ::-1]).all()
    assert (dense[-1] == dense[-1, ::-1]).all()  # of the speed
    assert (output == output[::-1][:, MIRRORED_ACTIONS]).all()
    for biases in (layer[1] for layer in layers[:3]):
        assert (biases == biases[::-1]).all()
