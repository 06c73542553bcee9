"""The DQN: experience in fixed point, the replay by an oracle, targets by hand, gradients, exact resume."""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evolution.dqn.experience import NO_ACTION, UNITS, Experience, ages, empty, join, store_grid, to_fixed_point, unpack
from evolution.dqn.learner import RANDOM_SHARE, DqnConfig, DqnLearner, QNetwork, exploration, tanh
from evolution.dqn.replay import Batch, Replay
from evolution.networks import convnet
from evolution.networks.policy import CnnSpec, PolicySpec
from gridsim.sensing.grid import CELLS, FREE, OCCUPIED, UNKNOWN
from gridsim.sensing.observation import SPEED_SCALE
from gridsim.state import End

F = np.float32
AREA = CELLS * CELLS


@given(st.floats(-20.0, 20.0, width=32))
def test_fixed_point_is_the_nearest_and_clipped(value: float) -> None:
    code = int(to_fixed_point(F(value)))
    assert -32768 <= code <= 32767
    assert abs(code / 4096 - min(max(value, -8.0), 32767 / 4096)) <= 0.5 / 4096 + 1e-6


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("turn", [0, 4])
def test_frames_are_stacked_as_the_network_stacks_them(frames: int, turn: int) -> None:
    """Against `convnet.push`, over three episodes; also in a ring that begins within the last of them."""
    spec = CnnSpec((8, 8, 8), frames=frames)
    rng = np.random.default_rng(3)
    speeds = rng.uniform(0.0, 25.0, 12).astype(F)
    x, wanted, room = empty(spec, 12), [], convnet.scratch(spec)
    begun = True
    for row, speed in enumerate(speeds):
        grid = rng.choice(np.array([UNKNOWN, FREE, OCCUPIED]), AREA)
        store_grid(grid, speed, x.observations[row])
        convnet.push(grid, begun, room)
        wanted.append(room.frames.copy())
        begun = row in (5, 7, 11)  # it was an episode's last
        x.actions[row] = NO_ACTION if begun else 0
    rows = rng.permutation(12)
    seen = unpack(spec, np.roll(x.observations, turn, axis=0), (rows + turn) % 12, ages(x)[rows])
    assert seen.shape == (12, frames * AREA + 1)
    assert (seen[:, :-1] == np.array(wanted)[rows]).all()
    assert np.abs(seen[:, -1] - (speeds[rows] / SPEED_SCALE - 1)).max() <= 0.5 / UNITS + 1e-6


# --- The replay ------------------------------------------------------------------------------------------------------

RAYS, GRID, FRAME = (PolicySpec.parse(text) for text in ("mlp:3", "cnn:8,8,8@4", "cnn:8,8,8@1"))
TERMINAL = (End.COLLISION, End.IDLE)  # as in the environment (test_env.py)


def episode(rewards, end, first=0, spec=RAYS):
    """An episode whose row t has the observation `first + t`, by which a row is known again, and the action t % 8."""
    steps = len(rewards)
    number = np.arange(first, first + steps + 1)
    observations = empty(spec, steps + 1).observations
    observations[:] = 0
    if spec is RAYS:
        observations[:, 0] = number
    else:
        observations[:, 0], observations[:, 1] = number % 3, number // 3 % 3  # in the first cells of each frame
        observations[:, -2:] = number.astype("<i2").view(np.uint8).reshape(-1, 2)
    actions = np.append(np.arange(steps) % 8, NO_ACTION).astype(np.uint8)
    ends = np.zeros(steps + 1, dtype=np.uint8)
    ends[steps - 1] = end
    return Experience(observations, actions, np.append(rewards, 0).astype(np.float32), ends)


def numbers(observations, spec=RAYS):
    """What `episode` numbered the rows."""
    return np.rint(observations[:, 0 if spec is RAYS else -1] * 4096).astype(int)


REWARDS = st.lists(st.integers(-9, 9), min_size=1, max_size=12)
EPISODES = st.lists(st.tuples(REWARDS, st.sampled_from([*TERMINAL, End.SUCCESS, End.TIME])), min_size=1, max_size=4)


def expected(parts, capacity, frames):
    """Textbook: {number of a row: (reward, factor of the next value)} of what can be drawn."""
    rows = sum(len(part.actions) for part in parts)
    found, first = {}, 0
    for part in parts:
        steps = len(part.actions) - 1
        for t in range(steps):
            if first + max(t - frames + 1, 0) >= rows - capacity:
                over = t == steps - 1 and part.ends[t] in TERMINAL
                found[first + t] = float(part.rewards[t]), 0.0 if over else 0.9
        first += steps + 1
    return found


def stacked(spec, row, starts):
    """The first and the fifth cell of each frame of a row's observation, as the network sees them."""
    start = starts[np.searchsorted(starts, row, side="right") - 1]
    seen = np.array([max(row - back, start) for back in range(spec.frames)[::-1]])
    codes = np.array([0, 127, 255]) / 255
    return np.stack([codes[seen % 3], codes[seen // 3 % 3]], axis=1)


@settings(max_examples=60)
@given(st.lists(EPISODES, min_size=1, max_size=6), st.integers(2, 40), st.sampled_from([RAYS, GRID, FRAME]))
def test_after_every_add_it_holds_what_the_textbook_holds(adds, capacity, spec):
    replay = Replay(spec, capacity, 0.9)
    parts, first = [], 0
    with pytest.raises(ValueError, match="no transition yet"):
        replay.sample(0, 4)
    for added in adds:
        new = []
        for rewards, end in added:
            new.append(episode(rewards, end, first, spec))
            first += len(rewards) + 1
        replay.add(join(new))
        parts += new
        known = expected(parts, capacity, getattr(spec, "frames", 1))
        assert len(replay) == min(first, capacity)
        assert replay.transitions == len(known)
        if not known:
            continue
        batch = replay.sample(first, 64)
        where = numbers(batch.observations, spec)
        assert np.array_equal(batch.actions, np.concatenate([part.actions for part in parts])[where])
        oracle = [known[number] for number in where]  # a KeyError: what was drawn should not be
        assert batch.rewards.tolist() == [reward for reward, _ in oracle]
        assert batch.discounts == pytest.approx([discount for _, discount in oracle])
        assert (numbers(batch.next_observations, spec) == where + 1).all()
        if spec is not RAYS:
            starts = np.cumsum([0] + [len(part.actions) for part in parts])
            for observations, rows in ((batch.observations, where), (batch.next_observations, where + 1)):
                for inputs, row in zip(observations, rows, strict=True):
                    assert inputs[:-1].reshape(-1, 6400)[:, [0, 4]] == pytest.approx(stacked(spec, row, starts))
        # What is restored draws the same, and goes on as the first does.
        again, goes_on = Replay(spec, capacity, 0.9), copy.deepcopy(replay)
        again.restore(replay.state())
        for _ in range(2):
            np.testing.assert_equal(goes_on.sample(7, 32), again.sample(7, 32))
            for replica in (goes_on, again):
                replica.add(episode([3, 1, 4, 1, 5, 9], End.SUCCESS, first, spec))
            if not again.transitions:
                break


def test_draws_are_uniform_and_each_key_has_its_own():
    """Of a ring that has gone round: rows of four episodes, the oldest cut."""
    replay, first = Replay(RAYS, 64, 0.9), 0
    for steps in (29, 1, 2, 54):
        replay.add(episode(np.arange(steps) % 5, End.TIME, first))
        first += steps + 1
    counts = np.unique(numbers(replay.sample(11, 60_000).observations), return_counts=True)[1]
    assert len(counts) == replay.transitions < replay.capacity
    assert stats.chisquare(counts).pvalue > 0.001
    drawn = [numbers(replay.sample(key, 16).observations).tolist() for key in (0, 1, 2, 1, 2**64 - 1)]
    assert drawn[1] == drawn[3]
    assert len({tuple(rows) for rows in drawn}) == 4


# --- The learner -----------------------------------------------------------------------------------------------------

SPEC = PolicySpec.parse("mlp:5")


def learner_of(**config):
    return DqnLearner(SPEC, DqnConfig(**config), seed=1)


def random_batch(seed):
    rng = np.random.default_rng(seed)
    observations, following = rng.uniform(-1, 1, (2, 32, SPEC.inputs)).astype(F)
    rewards, discounts = rng.normal(size=32).astype(F), rng.uniform(0, 1, 32).astype(F)
    return Batch(observations, rng.integers(0, 8, 32), rewards, following, discounts)


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


def test_it_works_in_one_thread_and_the_processs_own_number_stays(monkeypatch):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        learner = learner_of()
        monkeypatch.setattr(learner, "update", lambda batch: (float(torch.get_num_threads()),) * 2)
        monkeypatch.setattr(learner, "online", lambda x: torch.tensor(torch.get_num_threads()))
        replay = Replay(SPEC, 10, 0.9)
        columns = (np.array([0, NO_ACTION], dtype=np.uint8), np.zeros(2, dtype=F), np.array([End.IDLE, 0], np.uint8))
        replay.add(Experience(np.zeros((2, 32), dtype=np.int16), *columns))
        assert learner.q_values(np.zeros((1, 32), dtype=F)) == 1
        assert learner.train(replay, 2) == (1.0, 1.0)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


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
    whole, parts, resumed = (learner_of(**config) for _ in range(3))
    rng, replay = np.random.default_rng(0), Replay(RAYS, 400, 0.98)
    for steps in rng.integers(1, 20, 60):
        replay.add(episode(rng.normal(size=steps), rng.integers(1, 5), rng.integers(4000)))
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


def test_exploration_declines_and_then_stays():
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
