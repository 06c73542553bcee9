"""Policies in PyTorch against the kernels that drive them; those on the grid are in test_convnet.py."""

import numpy as np
import pytest
import torch

from evolution.networks.export import example, to_torch
from evolution.networks.policy import PolicySpec, act_on
from gridsim.config import SensorConfig, SimConfig, VehicleConfig
from gridsim.sensing.grid import FREE

F = np.float32
OTHER = SimConfig(VehicleConfig(speed_limit=20.0, steering_limit=20.0), SensorConfig(range=30.0))


@pytest.mark.parametrize("config", [SimConfig(), OTHER], ids=["usual", "other"])
@pytest.mark.parametrize("text", ["mlp:9", "mlp:6,7+steering", "mlp:12,9,5+motion", "mlp:6,7+motion+steering"])
def test_the_module_acts_as_the_kernel_does(text, config):
    spec, rng = PolicySpec.parse(text), np.random.default_rng(5)
    genome = rng.standard_normal(spec.size).astype(F)
    observations = rng.uniform(-1.0, 1.0, (300, spec.inputs)).astype(F)
    observations[:, :31] = np.abs(observations[:, :31])
    actions = np.asarray(act_on(spec, genome, observations, config))
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


@pytest.mark.parametrize("genome", [np.zeros(312, dtype=F), np.zeros(311), np.zeros((1, 311), dtype=F)])
def test_another_genome_is_refused(genome):
    with pytest.raises(ValueError, match=r"a genome of mlp:6,7 is float32 \[311\], not float"):
        to_torch(PolicySpec.parse("mlp:6,7"), genome, SimConfig())


def test_the_example_sees_nothing_at_standstill_and_at_10_mps():
    shown = example(PolicySpec.parse("mlp:3+motion+steering"), OTHER)
    assert shown == pytest.approx(np.array([[1.0] * 31 + [0.0] * 31 + [share, 0.0] for share in (0.0, 10.0 / 20.0)]))
    shown = example(PolicySpec.parse("cnn:8,8,8@2"), OTHER)
    assert (shown[:, :-1] == FREE).all()
    assert shown[:, -1].tolist() == [0.0, 10.0]
    assert shown.dtype == F
