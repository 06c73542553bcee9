"""Networks: what a policy's text may be, kernels against NumPy, PyTorch and ONNX, and left-right symmetry."""

import itertools
import math
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from gymnasium.spaces import Dict
from gymnasium.vector.utils import batch_space
from hypothesis import given, settings
from hypothesis import strategies as st
from searching import new_genomes

from cluster.store.champion import Champion
from evolution.dqn.learner import QNetwork
from evolution.networks import convnet, policy
from evolution.networks.export import to_onnx
from evolution.networks.policy import RAYS, CnnSpec, MlpSpec, PolicySpec, act_on, gene_scales, outputs_of
from evolution.networks.symmetry import MIRRORED_ACTIONS, symmetry
from gridsim.car.vehicle import Action
from gridsim.config import SensorConfig, SimConfig, VehicleConfig
from gridsim.errors import GridSimError
from gridsim.maps.map import blank
from gridsim.sensing.grid import CELLS, grid_table, grids
from gridsim.sensing.observation import OPTIONAL, SPEED_SCALE, encoding, normalise, observe
from gridsim.state import CAR_FIELDS, SPEED, STEERING
from gridsim.step import simulations_on

F = np.float32
WIDTHS = [1, 6, 7, 8, 9, 15, 16, 17, 31, 64, 65, 80]
TEXTS = ["mlp:17,5,3,11", "mlp:64,80,65", "mlp:128,8", *(f"mlp:{a},{b}" for a, b in itertools.pairwise(WIDTHS))]


def kernel_outputs(spec, genome, inputs, junk=0.0):
    packed = policy.pack(genome, spec.layers)
    scratch = np.full(policy.scratch_size(spec.layers), junk, dtype=F)
    scratch[: spec.inputs] = inputs
    again = scratch.copy()
    at = int(policy.forward(packed, spec.layers, scratch))
    return scratch[at : at + spec.outputs], policy.decide(packed, spec.layers, again, None)


def reference(spec, genome, inputs):
    """The textbook: for each layer weights [inputs, outputs], then biases [outputs]; float64."""
    genome, x = genome.astype(float), inputs.astype(float)
    sizes = [spec.inputs, *spec.hidden, spec.outputs]
    for k, (n, m) in enumerate(itertools.pairwise(sizes)):
        weights, biases, genome = genome[: n * m].reshape(n, m), genome[n * m : n * m + m], genome[n * m + m :]
        x = x @ weights + biases
        if k < len(spec.hidden):
            x = np.array([policy.squash(F(each)) for each in x], dtype=float)
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
    y = np.array([policy.squash(each) for each in x], dtype=float)
    assert y == pytest.approx(np.tanh(x.astype(float)), abs=2e-4)
    assert np.diff(y).min() > -2e-7
    assert (y[1:] == -y[:0:-1]).all()
    assert policy.squash(F(math.inf)) == -policy.squash(F(-math.inf)) == y[-1]
    assert math.isnan(policy.squash(F(math.nan)))


def test_what_the_network_sees():
    inputs, seen, ranges, car = np.zeros(33, F), np.zeros(33, F), np.linspace(0, 50, 31), np.zeros(CAR_FIELDS, F)
    car[[SPEED, STEERING]] = 12.5, -0.1
    encoded = encoding(("steering",))
    simulation = simulations_on([blank()], SimConfig(), ("steering",))[0]
    observe(simulation, car, None, ranges.astype(F), np.zeros(31, F), seen)
    assert seen == pytest.approx([*ranges / 50, 12.5 / 30, -0.1 / math.radians(27)], abs=1e-6)
    normalise(encoded, seen, inputs)
    assert inputs[:31] == pytest.approx(2 * ranges / (ranges + 8) - 1, abs=1e-6)
    assert inputs[31] == pytest.approx(0.25, abs=1e-6)
    assert inputs[32] == pytest.approx(-0.2, abs=1e-6)
    assert inputs.min() == -1.0


ACTIONS = st.sampled_from(["discrete", "continuous"])


@given(st.lists(st.integers(1, 40), min_size=1, max_size=4), st.booleans(), st.booleans(), ACTIONS)
def test_text_and_back(hidden, motion, steering, actions):
    pedal = actions == "continuous"
    text = f"mlp:{','.join(map(str, hidden))}{'+motion' * motion}{'+steering' * steering}{'+continuous' * pedal}"
    spec = PolicySpec.parse(text)
    assert str(spec) == text
    features = ("motion",) * motion + ("steering",) * steering
    assert spec == MlpSpec(tuple(hidden), features=features, actions=actions)
    sizes = [32 + 31 * motion + steering, *hidden, 2 if pedal else 8]
    assert spec.layers.tolist() == sizes
    assert spec.size == sum((n + 1) * m for n, m in itertools.pairwise(sizes))


WRONG = "mlp mlp:0 mlp:6,0 mlp:6, mlp:6.5 MLP:6 mlp:99999,99999 cnn:16,32 cnn:8,12,16 cnn:0,8,8 cnn:8,8,8@0 cnn:8,8,8@9"


TWICE = ["mlp:6+continuous+steering", "mlp:6+continuous+continuous", "+continuous"]


@pytest.mark.parametrize("text", [*WRONG.split(), "", "mlp:6,7\n", "cnn:16,64,1024", "cnn@1", " mlp:6", *TWICE])
def test_other_texts_are_refused_in_one_line(text):
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        PolicySpec.parse(text)


def test_cnn_alone_is_the_papers_network():
    spec = PolicySpec.parse("cnn")
    assert spec == CnnSpec() == PolicySpec.parse("cnn:16,32,256") == PolicySpec.parse("cnn:16,32,256@4")
    # Weights and biases: 8 x 8 x 4 to 16, 4 x 4 x 16 to 32, 8 x 8 x 32 and the speed to 256, 256 to 8.
    assert spec.size == (256 + 1) * 16 + (256 + 1) * 32 + (2049 + 1) * 256 + (256 + 1) * 8
    assert (spec.observation, PolicySpec.parse("mlp:6,7").observation) == ("grid", "rays")
    assert str(PolicySpec.parse("cnn+continuous")) == "cnn:16,32,256@4+continuous"


def test_genes_are_as_large_as_he_et_al_have_them():
    """sqrt(2 / inputs) in hidden layers, sqrt(1 / inputs) in the last one, and 1 for the speed's weights."""
    genes, inputs = [65 * 8, 129 * 16, 1024 * 32, 32, 32, 33 * 8], [64, 128, 1024, 2, 1024, 64]
    expected = np.repeat(np.sqrt(2.0 / np.array(inputs)), genes)
    assert gene_scales(PolicySpec.parse("cnn:8,16,32@1")) == pytest.approx(expected)
    assert (gene_scales(PolicySpec.parse("mlp:6,7")) == 1.0).all()
    pedal = gene_scales(PolicySpec.parse("mlp:6,7+continuous"))
    assert pedal == pytest.approx(np.repeat([1.0, 0.5], [33 * 6 + 7 * 7, 8 * 2]))


# --- Convolutional networks ------------------------------------------------------------------------------------------

SPECS = [CnnSpec((8, 8, 8), 1), CnnSpec((8, 16, 32), 1), CnnSpec((16, 24, 40), 2), CnnSpec((24, 32, 64), 3), CnnSpec()]
SPECS.append(CnnSpec((8, 16, 24), 2, actions="continuous"))


def convolved(spec, genome, frames, speed):
    room = convnet.scratch(spec)
    for frame in frames:
        convnet.push(frame.ravel(), False, room)
    convnet.forward(genome, spec.layers, speed, room)
    return room.outputs


@pytest.mark.parametrize("spec", SPECS, ids=str)
def test_forward_is_pytorchs(spec):
    rng = np.random.default_rng(2)
    for genome in new_genomes(spec, 4):
        ranges = np.minimum(rng.uniform(0, 70, (spec.frames, 31)), 50).astype(F)
        frames, speed = grids(grid_table(SimConfig()), ranges), F(rng.uniform(-3, 30))
        outputs = convolved(spec, genome, frames, speed)
        seen = torch.from_numpy(np.append(frames / F(255.0), speed / SPEED_SCALE - 1)[None].astype(F))
        network = QNetwork(spec, torch.device("cpu"))
        network.genome.copy_(torch.from_numpy(genome))
        expected = network(seen).numpy()[0].astype(float)
        assert np.abs(expected).max() > 1e-3
        assert outputs == pytest.approx(expected, abs=2e-5 * max(1.0, np.abs(expected).max()))
        pedal = spec.actions == "continuous"
        action = [policy.squash(each) for each in outputs] if pedal else int(outputs.argmax())
        assert convnet.act_on(spec, genome, frames, float(speed)) == pytest.approx(action, abs=1e-6)


def test_a_cnns_gene_that_is_not_a_number_is_no_action():
    """Also a weight whose input is exactly 0, from a rectified unit."""
    spec, rng = CnnSpec((8, 8, 16), 1), np.random.default_rng(4)
    genome, room = new_genomes(spec)[0], convnet.scratch(spec)
    room.frames[:] = rng.uniform(0.1, 1, room.frames.size)
    for gene in [*range(0, spec.size, 37), *range(spec.size - 140, spec.size)]:
        spoilt = genome.copy()
        spoilt[gene] = math.nan
        assert convnet.decide(spoilt, spec.layers, F(5), room, None) == -1, gene
    assert convnet.decide(genome, spec.layers, F(5), room, None) >= 0  # and nothing of it stays


# --- Left-right symmetry ---------------------------------------------------------------------------------------------

HIDDEN = st.lists(st.integers(4, 12), min_size=1, max_size=3).map(tuple)
FEATURES = st.sets(st.sampled_from(OPTIONAL)).map(lambda names: tuple(name for name in OPTIONAL if name in names))


def in_a_mirror(spec, observations):
    """What the same car would observe if left and right were exchanged."""
    seen = observations.copy()
    seen[:, :RAYS] = observations[:, RAYS - 1 :: -1]
    if "motion" in spec.features:
        seen[:, RAYS : 2 * RAYS] = observations[:, 2 * RAYS - 1 : RAYS - 1 : -1]
    first = spec.inputs
    if "mirrors" in spec.features:
        seen[:, first - 2 : first] = observations[:, [-1, -2]]
        first -= 2
    first -= "limit" in spec.features
    if "route" in spec.features:  # points, how far ahead and then how far to the left
        seen[:, first - 4 : first] = -observations[:, first - 4 : first]
        first -= 8
    if "steering" in spec.features:
        seen[:, first - 1] = -observations[:, first - 1]
    return seen


def test_left_and_right_are_exchanged_and_nothing_else():
    for action, mirrored in zip(Action, MIRRORED_ACTIONS, strict=True):
        sides = {"LEFT": "RIGHT", "RIGHT": "LEFT"}
        assert Action(mirrored).name == "_".join(sides.get(part, part) for part in action.name.split("_"))


@settings(max_examples=40, derandomize=True)
@given(st.builds(MlpSpec, HIDDEN, features=FEATURES, actions=ACTIONS), st.integers(0, 1 << 40))
def test_in_a_mirrored_world_the_mirrored_actions_have_the_same_outputs(spec, seed):
    """Or the pedal is the same, and the wheel turns to the other side."""
    observations = np.random.default_rng(seed).random((60, spec.inputs)).astype(F)
    observations[:, RAYS:] = 2.0 * observations[:, RAYS:] - 1.0
    genome = new_genomes(spec, seed=seed)[0]

    both = observations, in_a_mirror(spec, observations)
    one, other = (outputs_of(spec, genome, seen, SimConfig()) for seen in both)
    assert (np.abs(one).max(axis=0) > 0.05).all()
    mirrored = one[:, MIRRORED_ACTIONS] if spec.actions == "discrete" else one * [1, -1]
    np.testing.assert_allclose(mirrored, other, atol=1e-4)


@pytest.mark.parametrize("more", ["", "+continuous"])
@pytest.mark.parametrize("policy", ["mlp:6,7", "mlp:64+steering", "mlp:3+motion+steering+route", "cnn:8,16,24@2"])
def test_every_gene_is_free_or_bound_to_a_free_one(policy, more):
    spec = PolicySpec.parse(policy + more)
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
    genome = new_genomes(spec)[0]
    layers: list[np.ndarray] = []
    for n, m in spec.shapes():
        (*weights, biases), genome = genome[: (n + 1) * m].reshape(n + 1, m), genome[(n + 1) * m :]
        assert len(layers) == 3 or (biases == biases[::-1]).all()
        layers.append(np.array(weights))
    first, second, dense, output = layers
    first, second = first.reshape(3 * 8, 8, 8), second.reshape(4, 4, 8, 16)
    assert (first == first[:, ::-1, ::-1]).all()
    assert (second == second[:, ::-1, ::-1, ::-1]).all()
    seen = dense[:-1].reshape(8, 8, 16, 24)
    assert (seen == seen[:, ::-1, ::-1, ::-1]).all()
    assert (dense[-1] == dense[-1, ::-1]).all()  # of the speed
    assert (output == output[::-1][:, MIRRORED_ACTIONS]).all()


# --- Outside GridSim, in ONNX ----------------------------------------------------------------------------------------

OTHER = SimConfig(VehicleConfig(speed_limit=20.0, steering_limit=20.0), SensorConfig(range=30.0))
CONFIGS = pytest.mark.parametrize(
    "config", [SimConfig(), OTHER, SimConfig.load("f1tenth")], ids=["usual", "other", "f1tenth"]
)


def run(file, **observations):
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    return session.run(["outputs"], observations)[0]


def rays(spec):
    """A genome, and 300 observations."""
    rng = np.random.default_rng(5)
    genome = rng.standard_normal(spec.size).astype(F)
    observations = rng.uniform(-1.0, 1.0, (300, spec.inputs)).astype(F)
    observations[:, :RAYS] = np.abs(observations[:, :RAYS])
    return genome, observations


@CONFIGS
@pytest.mark.parametrize(
    "text", ["mlp:9", "mlp:6,7+steering", "mlp:12,9,5+motion", "mlp:6,7+motion+steering+route+limit+mirrors"]
)
def test_perceptrons_give_the_kernels_outputs(text, config):
    spec = PolicySpec.parse(text)
    assert isinstance(spec, MlpSpec)
    genome, observations = rays(spec)
    expected = outputs_of(spec, genome, observations, config)
    close = {"rtol": 0.0, "atol": 1e-5 * np.abs(expected).max()}
    found = run(to_onnx(spec, genome, config), observation=observations)
    assert (found.shape, found.dtype) == ((300, 8), F)
    np.testing.assert_allclose(found, expected, **close)
    np.testing.assert_allclose(run(to_onnx(spec, genome, config), observation=observations[:1]), expected[:1], **close)


@CONFIGS
@pytest.mark.parametrize("text", ["cnn:8,16,8@1", "cnn:8,8,24@3"])
def test_convolutional_networks_give_the_kernels_outputs(text, config):
    spec, rng = PolicySpec.parse(text), np.random.default_rng(6)
    assert isinstance(spec, CnnSpec)
    genome = (0.1 * rng.standard_normal(spec.size)).astype(F)
    frames = rng.choice([0, 127, 255], (5, spec.frames, CELLS, CELLS)).astype(np.uint8)
    shares = rng.uniform(0.0, 1.0, (5, 1)).astype(F)
    found = run(to_onnx(spec, genome, config), grid=frames, speed=shares)
    for n in range(5):
        speed = shares[n, 0] * F(config.vehicle.speed_limit)
        expected = convolved(spec, genome, frames[n].reshape(spec.frames, -1), speed)
        np.testing.assert_allclose(found[n], expected, rtol=0.0, atol=1e-5 * np.abs(expected).max())


@CONFIGS
@pytest.mark.parametrize("more", ["", "+continuous"])
@pytest.mark.parametrize(
    "text", ["mlp:64+steering", "mlp:6,7+motion", "mlp:9,9+motion+steering+route+mirrors", "cnn:8,8,24@2"]
)
def test_a_champions_file_takes_what_the_environment_gives_and_acts_as_the_champion(text, more, config, tmp_path):
    text += more
    genome = np.random.default_rng(7).normal(0.0, 0.2, PolicySpec.parse(text).size).astype(F)
    champion = Champion(genome, text, "curved", config)
    champion.export_onnx(tmp_path / "champion.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "champion.onnx", providers=["CPUExecutionProvider"])
    n = 40 if text.startswith("cnn") else 1000  # a picture takes a millisecond
    batch = batch_space(champion.make_env(maps=1).observation_space, n)
    batch.seed(8)
    spaces = dict(batch) if isinstance(batch, Dict) else {"observation": batch}
    asked = {one.name: (one.type, one.shape) for one in session.get_inputs()}
    kinds = {"float32": "tensor(float)", "uint8": "tensor(uint8)"}
    assert asked == {name: (kinds[str(box.dtype)], ["n", *(box.shape or ())[1:]]) for name, box in spaces.items()}
    actions = []
    for _ in range(10):
        seen = batch.sample()
        actions += session.run(["action"], seen if isinstance(seen, dict) else {"observation": seen})[0].tolist()
        assert actions[-n:] == pytest.approx(np.asarray(champion.act(seen)), abs=1e-5 if more else 0)
    assert len(np.unique(actions, axis=0)) > 1
    assert np.ptp(actions, axis=0).min() > 0.1
    assert np.abs(actions).max() <= (1 if more else 7)
    pedals = champion.make_env(maps=1).action_space
    assert all(pedals.contains(action) for action in champion.act(seen))


def test_without_onnx_a_line_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnx", None)
    spec = PolicySpec.parse("mlp:3")
    with pytest.raises(GridSimError, match=r'^pip install "gridsim-driving\[evolve\]" [^\n]* onnx$'):
        Champion(new_genomes(spec)[0], str(spec), "curved", SimConfig()).export_onnx(tmp_path / "champion.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["mlp:6,7+motion+steering", "cnn:8,8,8@2", "mlp:3+continuous"])
def test_the_same_genome_gives_the_same_file_in_any_process_without_torch(text, tmp_path):
    script = (
        "import sys, numpy as np\n"
        "from evolution.networks.export import PolicySpec, SimConfig, to_onnx\n"
        "spec = PolicySpec.parse(sys.argv[1])\n"
        "genome = np.linspace(-1, 1, spec.size, dtype=np.float32)\n"
        "open(sys.argv[2], 'wb').write(to_onnx(spec, genome, SimConfig()))\n"
        "assert not {'torch', 'onnxruntime', 'mlflow'} & sys.modules.keys()\n"
    )
    files = [tmp_path / name for name in "ab"]
    for file in files:
        subprocess.run([sys.executable, "-c", script, text, str(file)], check=True)
    assert files[0].read_bytes() == files[1].read_bytes()
    onnx.checker.check_model(onnx.load(files[0]), full_check=True)
