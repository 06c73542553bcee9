"""Convolutional networks against PyTorch."""

import math

import numpy as np
import pytest
import torch
from searching import new_genomes

from evolution.dqn.learner import QNetwork
from evolution.networks import convnet
from evolution.networks.policy import SPEED_SCALE, CnnSpec
from gridsim.config import SimConfig
from gridsim.sensing.grid import grid_table, grids

F = np.float32
SPECS = [CnnSpec((8, 8, 8), 1), CnnSpec((8, 16, 32), 1), CnnSpec((16, 24, 40), 2), CnnSpec((24, 32, 64), 3), CnnSpec()]


@pytest.mark.parametrize("spec", SPECS, ids=str)
def test_forward_is_pytorchs(spec):
    rng = np.random.default_rng(2)
    room = convnet.scratch(spec)
    for genome in new_genomes(spec, 4):
        ranges = np.minimum(rng.uniform(0, 70, (spec.frames, 31)), 50).astype(F)
        frames, speed = grids(grid_table(SimConfig()), ranges), F(rng.uniform(-3, 30))
        for frame in frames:
            convnet.push(frame.ravel(), False, room)
        convnet.forward(genome, spec.layers, speed, room)
        seen = torch.from_numpy(np.append(frames / F(255.0), speed / SPEED_SCALE - 1)[None].astype(F))
        network = QNetwork(spec, torch.device("cpu"))
        network.genome.copy_(torch.from_numpy(genome))
        expected = network(seen).numpy()[0].astype(float)
        assert np.abs(expected).max() > 1e-3
        assert room.outputs == pytest.approx(expected, abs=2e-5 * max(1.0, np.abs(expected).max()))
        assert convnet.act_on(spec, genome, frames, float(speed)) == int(room.outputs.argmax())


def test_a_gene_that_is_not_a_number_is_no_action():
    """Also a weight whose input is exactly 0, from a rectified unit."""
    spec, rng = CnnSpec((8, 8, 16), 1), np.random.default_rng(4)
    genome, room = new_genomes(spec)[0], convnet.scratch(spec)
    room.frames[:] = rng.uniform(0.1, 1, room.frames.size)
    for gene in [*range(0, spec.size, 37), *range(spec.size - 140, spec.size)]:
        spoilt = genome.copy()
        spoilt[gene] = math.nan
        assert convnet.decide(spoilt, spec.layers, F(5), room) == -1, gene
    assert convnet.decide(genome, spec.layers, F(5), room) >= 0  # and nothing of it stays
