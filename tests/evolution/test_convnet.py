"""Convolutional networks against PyTorch in float64, and grid policies in the rollout."""

import math

import numpy as np
import pytest
from searching import new_genomes

from evolution.networks import convnet
from evolution.networks.policy import CnnSpec, PolicySpec
from gridsim.config import SimConfig
from gridsim.sensing.grid import grid_table, grids

torch = pytest.importorskip("torch")

F = np.float32
TEXTS = ["cnn:8,8,8@1", "cnn:8,16,32@1", "cnn:16,24,40@2", "cnn:24,32,64@3", "cnn"]


def cnn(text):
    spec = PolicySpec.parse(text)
    assert isinstance(spec, CnnSpec)
    return spec


def in_torch(spec, genome, frames, speed):
    """The textbook: float64 in PyTorch's own layers. frames uint8 [frames, 80, 80]."""
    first, second, dense = spec.hidden
    genes = torch.from_numpy(genome.astype(np.float64))
    at = 0

    def take(*shape):
        nonlocal at
        part = genes[at : at + math.prod(shape)].reshape(shape)
        at += math.prod(shape)
        return part

    x = torch.from_numpy(frames.astype(np.float64) / 255)[None]
    weights = take(spec.frames, 8, 8, first).permute(3, 0, 1, 2)
    x = torch.relu(torch.nn.functional.conv2d(x, weights, take(first), stride=4))
    weights = take(4, 4, first, second).permute(3, 2, 0, 1)
    x = torch.relu(torch.nn.functional.conv2d(x, weights, take(second), stride=2))
    assert x.shape == (1, second, 8, 8)
    x = torch.cat([x.permute(0, 2, 3, 1).flatten(), torch.tensor([speed / 10.0 - 1.0], dtype=torch.float64)])
    weights = take(8 * 8 * second + 1, dense)
    x = torch.relu(x @ weights + take(dense))
    weights = take(dense, 8)
    x = x @ weights + take(8)
    assert at == spec.size
    return x.numpy()


@pytest.mark.parametrize("text", TEXTS)
def test_forward_is_pytorchs(text):
    spec = cnn(text)
    rng = np.random.default_rng(2)
    room = convnet.scratch(spec)
    for genome in new_genomes(spec, 4):
        ranges = np.minimum(rng.uniform(0, 70, (spec.frames, 31)), 50).astype(F)
        frames, speed = grids(grid_table(SimConfig()), ranges), rng.uniform(-3, 30)
        for frame in frames:
            convnet.push(frame.ravel(), False, room)
        convnet.forward(genome, spec.layers, F(speed), room)
        expected = in_torch(spec, genome, frames, float(F(speed)))
        assert np.abs(expected).max() > 1e-3
        assert room.outputs == pytest.approx(expected, abs=2e-5 * max(1.0, np.abs(expected).max()))
        assert convnet.decide(genome, spec.layers, F(speed), room) == int(room.outputs.argmax())


def test_a_gene_that_is_not_a_number_is_no_action():
    """Also a weight whose input is exactly 0, from a rectified unit."""
    spec, rng = cnn("cnn:8,8,16@1"), np.random.default_rng(4)
    genome, room = new_genomes(spec, 1)[0], convnet.scratch(spec)
    room.frames[:] = rng.uniform(0.1, 1, room.frames.size)
    for gene in [*range(0, spec.size, 37), *range(spec.size - 140, spec.size)]:
        spoilt = genome.copy()
        spoilt[gene] = math.nan
        assert convnet.decide(spoilt, spec.layers, F(5), room) == -1, gene
    assert convnet.decide(genome, spec.layers, F(5), room) >= 0  # and nothing of it stays


@pytest.mark.parametrize(
    ("text", "shape", "kind"),
    [
        ("cnn:8,8,8@1", (4, 80, 80, 1), np.uint8),
        ("cnn:8,8,8@4", (80, 80), np.uint8),
        ("cnn:8,8,8@4", (3, 80, 80), np.uint8),
        ("cnn:8,8,8@1", (80, 80), np.float32),
        ("cnn:8,8,8@1", (32,), np.float32),
    ],
)
def test_other_observations_are_refused(text, shape, kind):
    spec = cnn(text)
    with pytest.raises(ValueError, match=r"^cnn:8,8,8@\d sees grids uint8"):
        convnet.act_on(spec, np.zeros(spec.size, F), np.zeros(shape, kind), 1.0)
