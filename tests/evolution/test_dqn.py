"""The learner: its targets by hand, its gradients, and exact resume."""

import copy
import math

import numpy as np
import pytest
import torch

from evolution.dqn.experience import NO_ACTION, Experience
from evolution.dqn.learner import RANDOM_SHARE, DqnConfig, DqnLearner, QNetwork, exploration, tanh
from evolution.dqn.replay import Batch, Replay
from evolution.networks.policy import PolicySpec
from gridsim.state import End

F = np.float32
SPEC = PolicySpec.parse("mlp:5")


def learner_of(**config):
    return DqnLearner(SPEC, DqnConfig(**config), seed=1)


def random_batch(seed):
    rng = np.random.default_rng(seed)
    observations, following = rng.uniform(-1, 1, (2, 32, SPEC.inputs)).astype(F)
    rewards, discounts = rng.normal(size=32).astype(F), rng.uniform(0, 1, 32).astype(F)
    return Batch(observations, rng.integers(0, 8, 32), rewards, following, discounts)


def replay_of_random_episodes():
    rng, replay = np.random.default_rng(0), Replay(SPEC, 400, 0.98)
    for steps in rng.integers(1, 20, 60):
        ends = np.zeros(steps + 1, dtype=np.uint8)
        ends[steps - 1] = rng.integers(1, 5)
        observations = rng.integers(-4096, 4096, (steps + 1, SPEC.inputs)).astype(np.int16)
        actions = np.append(rng.integers(0, 8, steps), NO_ACTION).astype(np.uint8)
        replay.add(Experience(observations, actions, np.append(rng.normal(size=steps), 0).astype(F), ends))
    return replay


def test_squash_has_the_gradient_of_tanh():
    x = torch.linspace(-6, 6, 200).reshape(20, 10)
    leaf = x.clone().requires_grad_()
    y = tanh(leaf * 1.0)
    (ours,), (theirs,) = torch.autograd.grad(y, leaf, x), torch.autograd.grad(torch.tanh(leaf), leaf, x)
    assert (ours - theirs).abs().max() < 2e-3
    assert torch.equal(tanh(x * 1.0), y)


def biased(values):
    """A genome whose outputs are these, whatever it sees."""
    genome = np.zeros(SPEC.size, dtype=F)
    genome[-8:] = values
    return genome


def test_targets_by_hand():
    """Of action 2 with reward 3: the network prefers action 3, which the target values at 20; its own best is 40."""
    learner = learner_of(huber_delta=2)
    learner.load_weights(biased([1, 0, 0.5, 7, 0, 0, 0, 0]))
    learner.target.genome.copy_(torch.from_numpy(biased([10, 0, 0, 20, 0, 40, 0, 0])))
    zeros = np.zeros((3, SPEC.inputs), dtype=F)
    batch = Batch(zeros, np.full(3, 2), np.full(3, 3, dtype=F), zeros, np.array([0, 0.5, 0.25], dtype=F))
    assert learner.targets(batch).tolist() == [3, 13, 8]
    loss, q = learner.loss(batch)
    assert q.tolist() == [0.5] * 3
    assert loss.item() == pytest.approx(np.mean([2 * (size - 1) for size in (2.5, 12.5, 7.5)]))  # Huber's


def test_updates_are_those_of_pytorchs_adam_on_clipped_gradients():
    learner = learner_of(learning_rate=0.01, gradient_clip=0.05, target_period=3, learning_rate_updates=4)
    network = QNetwork(SPEC, torch.device("cpu"))
    network.genome.copy_(torch.from_numpy(learner.weights))
    adam = torch.optim.Adam([network.genome], lr=0.01, eps=learner.config.adam_epsilon)
    target = learner.weights
    for k in range(5):
        batch = random_batch(k)
        if k % 2:  # errors of a hundredth
            values = learner.q_values(batch.observations)[np.arange(32), batch.actions]
            batch = batch._replace(rewards=values + F(0.01) * batch.rewards, discounts=np.zeros(32, dtype=F))
        gradients = torch.autograd.grad(learner.loss(batch)[0], learner._leaves)
        network.genome.grad = torch.cat([part.flatten() for part in gradients])
        norm = torch.nn.utils.clip_grad_norm_([network.genome], 0.05)
        assert (norm > 0.05) == (k % 2 == 0)
        adam.param_groups[0]["lr"] = 0.01 * [1, 0.7625, 0.525, 0.2875, 0.05][k]
        adam.step()
        learner.update(batch)
        assert learner.weights == pytest.approx(network.genome.numpy(), abs=1e-6)
        target = learner.weights if k == 2 else target
        assert np.array_equal(learner.state()["target"], target)


def test_a_chain_of_two_states_is_learned():
    """State A: action 1 leads to B, all others stay. State B: action 0 ends with reward 1, all others lead back to A.

    With discount g, Q*(B, 0) = 1, Q*(A, 1) = g, Q*(B, others) = Q*(A, others) = g^2, whatever the time limit.
    """
    discount, rng = 0.8, np.random.default_rng(1)
    replay = Replay(SPEC, 10_000, discount)
    for _ in range(600):
        states, actions = [int(rng.integers(2))], []
        ends: list[int] = []
        while not ends or not ends[-1]:
            state = states[-1]
            actions.append(1 - state if rng.random() < 0.5 else int(rng.integers(8)))
            done = state == 1 and actions[-1] == 0
            states.append(int(state == 0 and actions[-1] == 1))
            ends.append(End.IDLE if done else End.TIME if len(ends) == 5 else End.RUNNING)
        observations = np.zeros((len(states), 32), dtype=np.int16)
        observations[np.arange(len(states)), states] = 4096
        rewards = np.append(np.array(ends) == End.IDLE, 0).astype(F)
        columns = (np.array([*actions, NO_ACTION], dtype=np.uint8), rewards, np.array([*ends, 0], dtype=np.uint8))
        replay.add(Experience(observations, *columns))
    rates = {"learning_rate": 0.01, "learning_rate_updates": 1_000, "final_learning_rate": 0.1}
    learner = learner_of(batch=64, target_period=40, **rates)
    learner.train(replay, 1_200)
    q = learner.q_values(np.eye(32, dtype=F)[:2])
    wanted = np.full((2, 8), discount**2)
    wanted[0, 1], wanted[1, 0] = discount, 1
    assert q == pytest.approx(wanted, abs=0.03)


def test_training_may_be_cut_and_resumed_anywhere():
    config = {"batch": 32, "target_period": 30, "learning_rate_updates": 80}
    replay, whole, parts, resumed = replay_of_random_episodes(), *(learner_of(**config) for _ in range(3))
    assert all(map(math.isfinite, whole.train(replay, 100)))
    for updates in (1, 32, 17):
        parts.train(replay, updates)
    saved = copy.deepcopy(parts.state())
    resumed.train(replay, 3)  # whatever it was before
    resumed.restore(saved)
    resumed.train(replay, 50)
    assert resumed.updates == whole.updates == 100
    np.testing.assert_equal(resumed.state(), whole.state())
    assert not np.array_equal(whole.weights, whole.state()["target"])


def test_learning_rate_and_exploration_decline_and_then_stay():
    config = DqnConfig(learning_rate=0.01, final_learning_rate=0.1, learning_rate_updates=100)
    assert [config.learning_rate_at(k) for k in (0, 50, 100, 1000)] == pytest.approx([0.01, 0.0055, 0.001, 0.001])
    for progress, first in ((0.0, 1.0), (RANDOM_SHARE / 2, 0.65), (RANDOM_SHARE, 0.3), (0.5, 0.3), (2.0, 0.3)):
        shares = exploration(0.3, progress, 8)
        assert shares[0] == pytest.approx(first)
        assert (np.diff(shares) <= 0.0).all()


def test_a_network_that_diverged_is_reported_and_left_as_it_was():
    learner, batch = learner_of(), random_batch(0)
    batch.rewards[3] = np.inf
    before = learner.weights
    with pytest.raises(FloatingPointError, match="diverged at update 0"):
        learner.update(batch)
    assert np.array_equal(learner.weights, before)
