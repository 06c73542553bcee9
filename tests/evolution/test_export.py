"""Champions outside GridSim, in ONNX, against the kernels that drive them."""

import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest

from evolution.networks import convnet
from evolution.networks.export import to_onnx
from evolution.networks.policy import RAYS, CnnSpec, MlpSpec, PolicySpec, act_on, outputs_of
from gridsim.config import SensorConfig, SimConfig, VehicleConfig
from gridsim.sensing.grid import CELLS

F = np.float32
OTHER = SimConfig(VehicleConfig(speed_limit=20.0, steering_limit=20.0), SensorConfig(range=30.0))
CONFIGS = pytest.mark.parametrize("config", [SimConfig(), OTHER], ids=["usual", "other"])


def run(file, observations):
    """Outputs of an ONNX file."""
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    return session.run(["outputs"], {"observation": observations})[0]


def rays(spec):
    """A genome, and 300 observations."""
    rng = np.random.default_rng(5)
    genome = rng.standard_normal(spec.size).astype(F)
    observations = rng.uniform(-1.0, 1.0, (300, spec.inputs)).astype(F)
    observations[:, :RAYS] = np.abs(observations[:, :RAYS])
    return genome, observations


@CONFIGS
@pytest.mark.parametrize("text", ["mlp:9", "mlp:6,7+steering", "mlp:12,9,5+motion", "mlp:6,7+motion+steering"])
def test_perceptrons_give_the_kernels_outputs(text, config):
    spec = PolicySpec.parse(text)
    assert isinstance(spec, MlpSpec)
    genome, observations = rays(spec)
    expected = outputs_of(spec, genome, observations, config)
    close = {"rtol": 0.0, "atol": 5e-6 * np.abs(expected).max()}
    found = run(to_onnx(spec, genome, config), observations)
    assert (found.shape, found.dtype) == ((300, 8), F)
    np.testing.assert_allclose(found, expected, **close)
    np.testing.assert_allclose(run(to_onnx(spec, genome, config), observations[:1]), expected[:1], **close)
    actions = np.asarray(act_on(spec, genome, observations, config))
    assert len(set(actions.tolist())) > 1
    assert (expected.argmax(axis=1) == actions).all()


@CONFIGS
@pytest.mark.parametrize("text", ["cnn:8,16,8@1", "cnn:8,8,24@3"])
def test_convolutional_networks_give_the_kernels_outputs(text, config):
    spec, rng = PolicySpec.parse(text), np.random.default_rng(6)
    assert isinstance(spec, CnnSpec)
    genome = (0.1 * rng.standard_normal(spec.size)).astype(F)
    cells, speeds = rng.choice([0, 127, 255], (5, spec.inputs - 1)).astype(F), rng.uniform(0.0, 20.0, 5).astype(F)
    observations = np.column_stack([cells, speeds])
    found = run(to_onnx(spec, genome, config), observations)
    for n in range(5):
        scratch = convnet.scratch(spec)
        for frame in cells[n].astype(np.uint8).reshape(spec.frames, CELLS * CELLS):
            convnet.push(frame, False, scratch)
        convnet.forward(genome, spec.layers, speeds[n], scratch)
        np.testing.assert_allclose(found[n], scratch.outputs, rtol=0.0, atol=1e-5 * np.abs(scratch.outputs).max())


@pytest.mark.parametrize("text", ["mlp:6,7+motion+steering", "cnn:8,8,8@2"])
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
