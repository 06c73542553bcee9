"""Policies in PyTorch against the kernels that drive them."""

import numpy as np
import pytest
import torch

from cluster.runs.champion import Champion
from evolution.networks.export import example, to_torch
from evolution.networks.policy import CnnSpec, MlpSpec, PolicySpec
from gridsim.config import SensorConfig, SimConfig, VehicleConfig
from gridsim.sensing.grid import CELLS, FREE, OCCUPIED, UNKNOWN

F = np.float32
TEXTS = ["mlp:6,7", "mlp:9", "mlp:6,7+steering", "mlp:12,9,5+motion", "mlp:6,7+motion+steering", "cnn:8,16,32@1",
         "cnn:8,8,8@2"]  # fmt: skip
OTHER = SimConfig(VehicleConfig(speed_limit=20.0, steering_limit=20.0), SensorConfig(range=30.0))


def acts(champion, rng, n):
    """Observations [n, inputs] as the module takes them, and the champion's actions for them [n]."""
    spec = PolicySpec.parse(champion.policy)
    if isinstance(spec, CnnSpec):
        frames = rng.choice([UNKNOWN, FREE, OCCUPIED], (n, spec.frames, CELLS, CELLS)).astype(np.uint8)
        speeds = rng.uniform(-2.0, 20.0, n).astype(F)
        actions = champion.act(frames[:, 0] if spec.frames == 1 else frames, speeds)
        return np.concatenate([frames.reshape(n, -1).astype(F), speeds[:, None]], axis=1), actions
    observations = rng.uniform(-1.0, 1.0, (n, spec.inputs)).astype(F)
    observations[:, :31] = np.abs(observations[:, :31])
    return observations, champion.act(observations)


@pytest.mark.parametrize("config", [SimConfig(), OTHER], ids=["usual", "other"])
@pytest.mark.parametrize("text", TEXTS)
def test_the_module_acts_as_the_kernel_does(text, config):
    spec, rng = PolicySpec.parse(text), np.random.default_rng(5)
    scale = 0.1 if isinstance(spec, CnnSpec) else 1.0
    genome = (scale * rng.standard_normal(spec.size)).astype(F)
    observations, actions = acts(Champion(genome, text, "seamless", config), rng, 300)
    module = to_torch(spec, genome, config)
    outputs = module(torch.from_numpy(observations)).numpy()
    assert outputs.shape == (300, 8)
    assert outputs.dtype == F
    assert len(set(actions.tolist())) > 1
    second, first = np.sort(outputs, axis=1)[:, -2:].T
    clear = first - second > 1e-4 * np.abs(outputs).max()
    assert clear.mean() > 0.97
    assert (outputs.argmax(axis=1) == actions)[clear].all()
    assert not any(p.requires_grad for p in module.parameters())


@pytest.mark.parametrize("text", TEXTS)
def test_the_example_is_something_that_may_be_seen(text):
    spec = PolicySpec.parse(text)
    shown = example(spec, SimConfig())
    assert shown.shape == (2, spec.inputs)
    assert shown.dtype == F
    if isinstance(spec, CnnSpec):
        assert (shown[:, :-1] == FREE).all()
        assert shown[:, -1].tolist() == [0.0, 10.0]
    elif isinstance(spec, MlpSpec):
        assert (shown[:, :31] == 1.0).all()
        fast = 10.0 / SimConfig().vehicle.speed_limit
        assert shown[1, 31:] == pytest.approx([0.0] * (31 * spec.motion) + [fast] + [0.0] * spec.steering)


@pytest.mark.parametrize("genome", [np.zeros(312, dtype=F), np.zeros(311), np.zeros((1, 311), dtype=F)])
def test_another_genome_is_refused(genome):
    with pytest.raises(ValueError, match=r"a genome of mlp:6,7 is float32 \[311\], not float"):
        to_torch(PolicySpec.parse("mlp:6,7"), genome, SimConfig())
