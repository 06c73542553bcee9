"""Networks against NumPy in float64, and what a policy's text may be."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evolution.networks import policy
from evolution.networks.policy import CnnSpec, MlpSpec, PolicySpec, gene_scales, squash
from gridsim.config import SimConfig, constants
from gridsim.sensing.observation import encode

F = np.float32
K = constants(SimConfig())
WIDTHS = [1, 6, 7, 8, 9, 15, 16, 17, 31, 64, 65, 80]
TEXTS = ["mlp:17,5,3,11", "mlp:64,80,65", "mlp:128,8", *(f"mlp:{a},{b}" for a, b in itertools.pairwise(WIDTHS))]


def kernel_outputs(spec, genome, inputs, junk=0.0):
    packed = policy.pack(genome, spec.layers)
    scratch = np.full(policy.scratch_size(spec.layers), junk, dtype=F)
    scratch[: spec.inputs] = inputs
    again = scratch.copy()
    at = int(policy.forward(packed, spec.layers, scratch))
    return scratch[at : at + spec.outputs], policy.decide(packed, spec.layers, again)


def reference(spec, genome, inputs):
    """The textbook: for each layer weights [inputs, outputs], then biases [outputs]; float64."""
    genome, x = genome.astype(float), inputs.astype(float)
    sizes = [spec.inputs, *spec.hidden, spec.outputs]
    for k, (n, m) in enumerate(itertools.pairwise(sizes)):
        weights, biases, genome = genome[: n * m].reshape(n, m), genome[n * m : n * m + m], genome[n * m + m :]
        x = x @ weights + biases
        if k < len(spec.hidden):
            x = np.array([squash(F(each)) for each in x], dtype=float)
    assert genome.size == 0
    return x


@pytest.mark.parametrize("text", TEXTS)
def test_forward_is_numpys(text):
    spec = PolicySpec.parse(text)
    rng = np.random.default_rng(1)
    for _ in range(50):
        genome, inputs = rng.normal(size=spec.size).astype(F), rng.uniform(-1, 1, 32).astype(F)
        outputs, action = kernel_outputs(spec, genome, inputs)
        spoilt = kernel_outputs(spec, genome, inputs, junk=math.nan)  # in memory, of the member before
        assert (spoilt[0].tobytes(), spoilt[1]) == (outputs.tobytes(), action)
        expected = reference(spec, genome, inputs)
        assert outputs == pytest.approx(expected, abs=3e-5 * max(1.0, np.sqrt(max(spec.hidden) / 16)))
        assert action == int(outputs.argmax())


def test_a_gene_that_is_not_a_number_is_no_action():
    spec, rng = PolicySpec.parse("mlp:9,1,20"), np.random.default_rng(3)
    genome, inputs = rng.normal(size=spec.size).astype(F), rng.uniform(0.1, 1, 32).astype(F)
    for gene in range(spec.size):
        spoilt = genome.copy()
        spoilt[gene] = math.nan
        assert kernel_outputs(spec, spoilt, inputs)[1] == -1, gene


def test_squash_is_nearly_tanh_never_falls_and_keeps_what_is_not_a_number():
    x = np.arange(-6.0, 6.0, 1 / 256).astype(F)
    y = np.array([squash(each) for each in x], dtype=float)
    assert y == pytest.approx(np.tanh(x.astype(float)), abs=2e-4)
    assert np.diff(y).min() > -2e-7
    assert (y[1:] == -y[:0:-1]).all()
    assert squash(F(math.inf)) == -squash(F(-math.inf)) == y[-1]
    assert math.isnan(squash(F(math.nan)))


def test_what_the_network_sees():
    inputs, ranges = np.zeros(33, dtype=F), np.linspace(0, 50, 31)
    encode(K, ranges.astype(F), None, F(12.5), F(-0.1), inputs)
    assert inputs == pytest.approx([*ranges / 50, 12.5 / 30, -0.1 / math.radians(27)], abs=1e-6)
    policy.normalise(K, 31, inputs)
    assert inputs[:31] == pytest.approx(2 * ranges / (ranges + 8) - 1, abs=1e-6)
    assert inputs[31] == pytest.approx(0.25, abs=1e-6)
    assert inputs[32] == pytest.approx(-0.2, abs=1e-6)  # the wheels' angle, which only some networks see
    assert inputs.min() == -1.0


@given(hidden=st.lists(st.integers(1, 40), min_size=1, max_size=4), motion=st.booleans(), steering=st.booleans())
def test_text_and_back(hidden, motion, steering):
    text = f"mlp:{','.join(map(str, hidden))}{'+motion' * motion}{'+steering' * steering}"
    spec = PolicySpec.parse(text)
    assert str(spec) == text
    assert spec == MlpSpec(tuple(hidden), motion=motion, steering=steering)
    sizes = [32 + 31 * motion + steering, *hidden, 8]
    assert spec.layers.tolist() == sizes
    assert spec.size == sum((n + 1) * m for n, m in itertools.pairwise(sizes))


WRONG = "mlp mlp:0 mlp:6,0 mlp:6, mlp:6.5 MLP:6 mlp:99999,99999 cnn:16,32 cnn:8,12,16 cnn:0,8,8 cnn:8,8,8@0 cnn:8,8,8@9"


@pytest.mark.parametrize("text", [*WRONG.split(), "", "mlp:6,7\n", "cnn:16,64,1024", "cnn@1", " mlp:6"])
def test_other_texts_are_refused_in_one_line(text):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        PolicySpec.parse(text)


def test_cnn_alone_is_the_papers_network():
    spec = PolicySpec.parse("cnn")
    assert spec == CnnSpec() == PolicySpec.parse("cnn:16,32,256") == PolicySpec.parse("cnn:16,32,256@4")
    # Weights and biases: 8 x 8 x 4 to 16, 4 x 4 x 16 to 32, 8 x 8 x 32 and the speed to 256, 256 to 8.
    assert spec.size == (256 + 1) * 16 + (256 + 1) * 32 + (2049 + 1) * 256 + (256 + 1) * 8
    assert (spec.observation, PolicySpec.parse("mlp:6,7").observation) == ("grid", "rays")


def test_genes_are_as_large_as_he_et_al_have_them():
    """sqrt(2 / inputs) in hidden layers, sqrt(1 / inputs) in the last one, and 1 for the speed's weights."""
    genes, inputs = [65 * 8, 129 * 16, 1024 * 32, 32, 32, 33 * 8], [64, 128, 1024, 2, 1024, 64]
    expected = np.repeat(np.sqrt(2.0 / np.array(inputs)), genes)
    assert gene_scales(PolicySpec.parse("cnn:8,16,32@1")) == pytest.approx(expected)
    assert (gene_scales(PolicySpec.parse("mlp:6,7")) == 1.0).all()
