"""The learner: its targets by hand, its gradients, the networks against the policies', and exact resume."""

import copy
import math

import numba
import numpy as np
import pytest
import torch

from evolution.dqn.experience import NO_ACTION, Experience
from evolution.dqn.learner import DqnConfig, DqnLearner, QNetwork, Training, device_of, new_weights, tanh
from evolution.dqn.replay import Batch, PriorityConfig, Replay
from evolution.networks import convnet, policy
from evolution.networks.policy import CnnSpec, PolicySpec
from gridsim.car.ego import End
from gridsim.maps.roads import freeze

F = np.float32
SPEC = PolicySpec.parse("mlp:5")
MLPS = ["mlp:6,7", "mlp:64,64", "mlp:3+motion+steering", "mlp:9,8,7"]
CNNS = ["cnn:8,8,8@1", "cnn:16,24,40@2"]


def random_batch(spec, n, seed=0):
    rng = np.random.default_rng(seed)
    return Batch(
        rng.uniform(-1, 1, (n, spec.inputs)).astype(F),
        rng.integers(0, 8, n),
        rng.normal(size=n).astype(F),
        rng.uniform(-1, 1, (n, spec.inputs)).astype(F),
        rng.uniform(0, 1, n).astype(F),
        np.arange(n),
        rng.uniform(0.2, 1, n).astype(F),
    )


def random_genome(spec, seed=1):
    return (np.random.default_rng(seed).normal(size=spec.size) * 0.3).astype(F)


def experience(episodes, spec=SPEC, seed=0):
    """Episodes of random length, at random."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(episodes):
        steps = int(rng.integers(1, 20))
        ends = np.zeros(steps + 1, dtype=np.uint8)
        ends[steps - 1] = rng.integers(1, 5)
        parts.append(
            Experience(
                rng.integers(-4096, 4096, (steps + 1, spec.inputs)).astype(np.int16),
                np.append(rng.integers(0, 8, steps), NO_ACTION).astype(np.uint8),
                np.append(rng.normal(size=steps), 0).astype(F),
                ends,
            )
        )
    return Experience(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def empty_replay(config):
    return Replay(SPEC, 400, 3, 0.98, config.priorities)


def replay_of(config):
    replay = empty_replay(config)
    replay.add(experience(60, SPEC))
    return replay


# --- Networks --------------------------------------------------------------------------------------------------------


@numba.njit
def mlp_outputs(genome, layers, inputs, outputs):
    packed = np.empty(policy.packed_size(layers), dtype=np.float32)
    policy.pack(genome, layers, packed)
    scratch = np.zeros(policy.scratch_size(layers), dtype=np.float32)
    for n in range(inputs.shape[0]):
        scratch[: inputs.shape[1]] = inputs[n]
        at = policy.forward(packed, layers, scratch)
        outputs[n] = scratch[at : at + outputs.shape[1]]


@numba.njit
def cnn_outputs(genome, layers, frames, speed, room):
    for k in range(frames.shape[0]):
        convnet.push(frames[k], k == 0, room)
    convnet.forward(genome, layers, speed, room)
    return room.outputs.copy()


@pytest.mark.parametrize("text", MLPS)
def test_a_perceptron_gives_what_the_policy_gives(text):
    spec = PolicySpec.parse(text)
    learner = DqnLearner(spec, DqnConfig(), seed=1)
    genome = random_genome(spec)
    learner.load_weights(genome)
    inputs = np.random.default_rng(2).uniform(-3, 3, (50, spec.inputs)).astype(F)
    outputs = np.empty((50, 8), dtype=F)
    mlp_outputs(freeze(genome.copy()), spec.layers, inputs, outputs)
    assert np.ptp(outputs) > 1
    assert learner.q_values(inputs) == pytest.approx(outputs, abs=1e-5)
    assert np.array_equal(learner.weights, genome)


@pytest.mark.parametrize("text", CNNS)
def test_a_convolutional_network_gives_what_the_policy_gives(text):
    spec = PolicySpec.parse(text)
    assert isinstance(spec, CnnSpec)
    rng = np.random.default_rng(3)
    genome = (rng.normal(size=spec.size) * policy.gene_scales(spec)).astype(F)
    learner = DqnLearner(spec, DqnConfig(), seed=1)
    learner.load_weights(genome)
    inputs, outputs = [], []
    for speed in (0.0, 7.5, 25.0):
        frames = rng.choice(np.array([0, 127, 255], dtype=np.uint8), (spec.frames, 6400))
        inputs.append(np.append(frames.ravel() / 255, speed / 10 - 1))
        outputs.append(cnn_outputs(freeze(genome.copy()), spec.layers, frames, F(speed), convnet.scratch(spec)))
    assert np.ptp(outputs) > 0.3
    assert learner.q_values(np.array(inputs, dtype=F)) == pytest.approx(np.array(outputs), abs=1e-4)
    fast = np.array(inputs, dtype=F)
    fast[:, -1] += 1
    assert np.abs(learner.q_values(fast) - outputs).max() > 0.01  # the speed is heard


def test_squash_has_the_gradient_of_tanh():
    x = torch.linspace(-6, 6, 200).reshape(20, 10)
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    y = tanh(ours * 1.0)
    y.backward(x)
    torch.tanh(theirs).backward(x)
    assert ours.grad is not None
    assert theirs.grad is not None
    assert (ours.grad - theirs.grad).abs().max() < 2e-3
    assert torch.equal(tanh(x * 1.0), y)


@pytest.mark.parametrize("text", ["mlp:6,7", "cnn:8,8,8@1"])
def test_gradients_are_those_of_finite_differences(text):
    """In the network's own precision, so by the direction of the gradient: a long step, and a small share of error."""
    spec = PolicySpec.parse(text)
    learner = DqnLearner(spec, DqnConfig(double=False, huber_delta=1e3), seed=4)
    learner.load_weights(random_genome(spec) * F(0.3))
    batch = random_batch(spec, 32)
    gradients = torch.autograd.grad(learner.loss(batch)[0], learner._leaves)
    gradient = torch.cat([part.flatten() for part in gradients])
    direction = gradient / torch.linalg.vector_norm(gradient)
    ends = []
    for side in (-1, 1):
        with torch.no_grad():
            learner.online.genome.add_(direction, alpha=side * 2e-3)
            ends.append(learner.loss(batch)[0].item())
            learner.online.genome.sub_(direction, alpha=side * 2e-3)
    slope = (ends[1] - ends[0]) / 4e-3
    assert slope == pytest.approx(torch.linalg.vector_norm(gradient).item(), rel=0.02)


# --- Targets ---------------------------------------------------------------------------------------------------------


def biased(values):
    """A genome whose outputs are these, whatever it sees."""
    genome = np.zeros(SPEC.size, dtype=F)
    genome[-8:] = values
    return genome


def fixed_batch(bootstraps, action=2, weights=1.0):
    n = len(bootstraps)
    zeros = np.zeros((n, SPEC.inputs), dtype=F)
    return Batch(
        zeros, np.full(n, action), np.full(n, 3, dtype=F), zeros, np.array(bootstraps, dtype=F), np.arange(n),
        np.full(n, weights, dtype=F),
    )  # fmt: skip


ONLINE, TARGET = [1, 0, 0.5, 7, 0, 0, 0, 0], [10, 0, 0, 20, 0, 40, 0, 0]


@pytest.mark.parametrize(("double", "ahead"), [(True, 20), (False, 40)])
def test_targets_by_hand(double, ahead):
    """The network prefers action 3, which the target values at 20; the target's own best is 40."""
    learner = DqnLearner(SPEC, DqnConfig(double=double, huber_delta=2), seed=1)
    learner.load_weights(biased(ONLINE))
    learner.target.genome.data.copy_(torch.from_numpy(biased(TARGET)))
    loss, q, errors = learner.loss(fixed_batch([0, 0.5, 0.25]))
    assert q.tolist() == [0.5] * 3
    sizes = [3 - 0.5, 3 + 0.5 * ahead - 0.5, 3 + 0.25 * ahead - 0.5]
    assert errors.tolist() == [-size for size in sizes]
    assert loss.item() == pytest.approx(np.mean([2 * (size - 1) for size in sizes]))  # Huber: delta (|e| - delta / 2)


def test_small_errors_count_by_their_square_and_weights_scale():
    learner = DqnLearner(SPEC, DqnConfig(), seed=1)
    learner.load_weights(biased([0, 0, 2.6, 0, 0, 0, 0, 0]))
    for weight in (1.0, 0.25):
        loss, _, _ = learner.loss(fixed_batch([0, 0], weights=weight))
        assert loss.item() == pytest.approx(weight * 0.4**2 / 2, rel=1e-5)


def test_truncation_and_termination_end_in_different_targets():
    """Rewards 1, 1 and a last row whose best action the target values at 10, by a replay of two episodes."""
    targets = {}
    for end in (End.TIME, End.COLLISION):
        replay = Replay(SPEC, 10, n_step=2, discount=0.5)
        replay.add(
            Experience(
                np.zeros((3, 32), dtype=np.int16),
                np.array([2, 2, NO_ACTION], dtype=np.uint8),
                np.array([1, 1, 0], dtype=F),
                np.array([0, end, 0], dtype=np.uint8),
            )
        )
        learner = DqnLearner(SPEC, DqnConfig(), seed=1)
        learner.load_weights(biased([0, 0, 0, 10, 0, 0, 0, 0]))
        batch = replay.sample(1, 50)
        _, _, errors = learner.loss(batch)
        targets[end] = {int(row): -float(error) for row, error in zip(batch.rows, errors, strict=True)}
    assert targets == {End.TIME: {0: 1.5 + 2.5, 1: 1 + 5.0}, End.COLLISION: {0: 1.5, 1: 1.0}}


# --- Gradients -------------------------------------------------------------------------------------------------------


def test_only_the_chosen_action_and_only_the_network_get_gradients():
    learner = DqnLearner(SPEC, DqnConfig(), seed=1)
    loss, _, errors = learner.loss(random_batch(SPEC, 16)._replace(actions=np.full(16, 5)))
    assert not errors.requires_grad
    assert not any(tensor.requires_grad for layer in learner.target.layers for tensor in layer)
    weights, biases = torch.autograd.grad(loss, learner._leaves)[-2:]
    chosen = np.arange(8) == 5
    assert weights.abs().sum(0)[chosen].all()
    assert biases[chosen].all()
    assert not weights[:, ~chosen].any()
    assert not biases[~chosen].any()


def test_what_comes_next_gives_no_gradient():
    """The target of each row is the network's own value of the same row: were it followed, gradients would cancel."""
    learner = DqnLearner(SPEC, DqnConfig(), seed=1)
    batch = random_batch(SPEC, 16)
    batch = batch._replace(next_observations=batch.observations, bootstraps=np.ones(16, dtype=F))
    best = learner.q_values(batch.observations).argmax(axis=1)
    batch = batch._replace(actions=best, returns=np.full(16, 0.5, dtype=F), weights=np.ones(16, dtype=F))
    gradients = torch.autograd.grad(learner.loss(batch)[0], learner._leaves)
    assert gradients[-1].sum().item() == pytest.approx(-0.5)  # of the biases: Q - y is -0.5 in each row


def test_updates_are_those_of_pytorchs_adam_on_clipped_gradients():
    config = DqnConfig(learning_rate=0.01, gradient_clip=0.05, target_period=3, learning_rate_updates=4)
    learner = DqnLearner(SPEC, config, seed=1)
    network = QNetwork(SPEC, torch.device("cpu"))
    network.genome.data.copy_(torch.from_numpy(learner.weights))
    adam = torch.optim.Adam([network.genome], lr=0.01, eps=config.adam_epsilon)
    target = learner.weights
    for k in range(5):
        batch = random_batch(SPEC, 32, seed=k)
        batch = batch._replace(weights=batch.weights * F(1 if k % 2 == 0 else 0.02))
        gradients = torch.autograd.grad(learner.loss(batch)[0], learner._leaves)
        network.genome.grad = torch.cat([part.flatten() for part in gradients])
        norm = torch.nn.utils.clip_grad_norm_([network.genome], 0.05)
        assert (norm > 0.05) == (k % 2 == 0)
        adam.param_groups[0]["lr"] = 0.01 * [1, 0.775, 0.55, 0.325, 0.1][k]
        adam.step()
        learner.update(batch)
        assert learner.weights == pytest.approx(network.genome.numpy(), abs=1e-6)
        target = learner.weights if k == 2 else target
        assert np.array_equal(learner.state()[0]["target"], target)


# --- Learning --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("priorities", [None, PriorityConfig()])
@pytest.mark.parametrize("n_step", [1, 2])
def test_a_chain_of_two_states_is_learned(n_step, priorities):
    """State A: action 1 leads to B, all others stay. State B: action 0 ends with reward 1, all others lead back to A.

    With discount g, Q*(B, 0) = 1, Q*(A, 1) = g, Q*(B, others) = Q*(A, others) = g^2, whatever the time limit. Returns
    of 2 steps hold what the second action brought, so that there all actions but an episode's first are the best.
    """
    discount = 0.8
    rng = np.random.default_rng(1)
    observations, actions, rewards, ends = [], [], [], []
    for _ in range(600):
        state = int(rng.integers(2))
        for step in range(6):
            best = 1 - state
            action = best if n_step > 1 and step else best if rng.random() < 0.5 else int(rng.integers(8))
            observations.append(state)
            actions.append(action)
            success = state == 1 and action == 0
            rewards.append(float(success))
            state = int(state == 0 and action == 1)
            end = End.SUCCESS if success else End.TIME if step == 5 else End.RUNNING
            ends.append(end)
            if end:
                break
        observations.append(state)
        actions.append(NO_ACTION)
        rewards.append(0.0)
        ends.append(End.RUNNING)
    seen = np.zeros((len(actions), 32), dtype=np.int16)
    seen[np.arange(len(actions)), observations] = 4096
    config = DqnConfig(
        batch=64, learning_rate=0.01, target_period=40, learning_rate_updates=1_000, priorities=priorities
    )
    replay = Replay(SPEC, 10_000, n_step, discount, priorities)
    replay.add(
        Experience(seen, np.array(actions, dtype=np.uint8), np.array(rewards, dtype=F), np.array(ends, dtype=np.uint8))
    )
    learner = DqnLearner(SPEC, config, seed=3)
    learner.train(replay, 1_200)
    q = learner.q_values(np.eye(32, dtype=F)[:2])
    wanted = np.full((2, 8), discount**2)
    wanted[0, 1], wanted[1, 0] = discount, 1
    assert q.argmax(axis=1).tolist() == [1, 0]
    assert q == pytest.approx(wanted, abs=0.03)


@pytest.mark.parametrize("priorities", [None, PriorityConfig(beta_updates=70)])
def test_training_may_be_cut_and_resumed_anywhere(priorities):
    config = DqnConfig(batch=32, target_period=30, learning_rate_updates=80, priorities=priorities)
    whole, replay = DqnLearner(SPEC, config, seed=5), replay_of(config)
    trained = whole.train(replay, 100)
    assert isinstance(trained, Training)
    assert all(map(math.isfinite, trained))

    parts, replay_parts = DqnLearner(SPEC, config, seed=5), replay_of(config)
    for updates in (1, 32, 0, 17):
        parts.train(replay_parts, updates)
    saved, saved_replay = copy.deepcopy(parts.state()), copy.deepcopy(replay_parts.state())
    assert parts.updates == 50
    del parts, replay_parts

    resumed = DqnLearner(SPEC, config, seed=5)
    resumed.train(replay_of(config), 3)  # whatever it was before
    resumed.restore(*saved)
    replay_resumed = empty_replay(config)
    replay_resumed.restore(*saved_replay)
    resumed.train(replay_resumed, 50)
    assert resumed.state()[1] == whole.state()[1] == {"updates": 100}
    for name, array in whole.state()[0].items():
        assert np.array_equal(array, resumed.state()[0][name]), name
    for name, array in replay.state()[0].items():
        assert np.array_equal(array, replay_resumed.state()[0][name]), name
    assert not np.array_equal(whole.weights, whole.state()[0]["target"])


def test_seeds_differ_and_repeat():
    one, same, other = (new_weights(SPEC, seed) for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    first = one[: 33 * 5]
    assert 0.9 / math.sqrt(32) < np.abs(first).max() <= 1 / math.sqrt(32)
    state = torch.random.get_rng_state()
    DqnLearner(SPEC, DqnConfig(), seed=1).train(replay_of(DqnConfig()), 2)
    assert torch.equal(state, torch.random.get_rng_state())


def test_schedules():
    config = DqnConfig(learning_rate=1.0, final_learning_rate=0.1, learning_rate_updates=10)
    assert [config.learning_rate_at(u) for u in (0, 5, 10, 99)] == pytest.approx([1, 0.55, 0.1, 0.1])
    assert config.beta_at(3) == 1
    config = DqnConfig(priorities=PriorityConfig(beta=0.4, beta_updates=10))
    assert [config.beta_at(u) for u in (0, 5, 10, 99)] == pytest.approx([0.4, 0.7, 1, 1])


# --- What is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"batch": 0}, {"learning_rate": 0.0}, {"learning_rate": math.nan}, {"final_learning_rate": 1.5},
        {"learning_rate_updates": 0}, {"adam_epsilon": -1.0}, {"target_period": 0}, {"huber_delta": 0.0},
        {"gradient_clip": math.inf},
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong)).replace("_", " ")):
        DqnLearner(SPEC, DqnConfig(**wrong), seed=1)


def test_devices():
    assert device_of("cpu").type == "cpu"
    assert device_of("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    for name in ("gpu", "cuda:x", "cuda:99", "", "cuda:-1"):
        with pytest.raises(ValueError, match=r"^[^\n]*device[^\n]*$"):
            device_of(name)
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="use --device cpu"):
            DqnLearner(SPEC, DqnConfig(), seed=1, device="cuda")


def test_a_network_that_diverged_says_so():
    learner = DqnLearner(SPEC, DqnConfig(), seed=1)
    batch = random_batch(SPEC, 8)
    batch.returns[3] = np.inf
    before = learner.weights
    with pytest.raises(FloatingPointError, match="diverged at update 0"):
        learner.update(batch)
    assert np.array_equal(learner.weights, before)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("updates", None), ("updates", True), ("updates", -1), ("updates", 1.0), ("updates", 1 << 62),
        ("weights", None), ("weights", np.zeros(3, dtype=F)), ("weights", np.zeros(SPEC.size)),
        ("target", np.full(SPEC.size, np.nan, dtype=F)), ("adam_mean", np.full(SPEC.size, np.inf, dtype=F)),
        ("adam_variance", np.full(SPEC.size, -1, dtype=F)), ("adam_variance", [0.0] * SPEC.size),
    ],
)  # fmt: skip
def test_a_hostile_state_is_refused_and_changes_nothing(name, value):
    learner = DqnLearner(SPEC, DqnConfig(), seed=1)
    before = learner.state()
    arrays, meta = DqnLearner(SPEC, DqnConfig(), seed=2).state()
    with pytest.raises(ValueError, match=r"^a saved learner's [^\n]+$"):
        learner.restore({**arrays, name: value}, {**meta, name: value})
    after = learner.state()
    assert all(np.array_equal(before[0][key], after[0][key]) for key in before[0])


def test_a_genome_of_another_network_is_refused():
    learner = DqnLearner(SPEC, DqnConfig(), seed=1)
    for wrong in (np.zeros(3, dtype=F), np.full(SPEC.size, np.nan, dtype=F)):
        with pytest.raises(ValueError, match="finite genes"):
            learner.load_weights(wrong)
