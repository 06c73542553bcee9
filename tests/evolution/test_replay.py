"""The replay: n-step returns by hand and by an oracle, what is drawn and how often, and what is refused."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evolution.dqn.experience import NO_ACTION, Experience, observation_dtype_and_width
from evolution.dqn.replay import Batch, PriorityConfig, Replay
from evolution.networks.policy import PolicySpec
from gridsim.car.ego import End

RAYS, GRID, FRAME = (PolicySpec.parse(text) for text in ("mlp:3", "cnn:8,8,8@4", "cnn:8,8,8@1"))
TERMINAL = (End.COLLISION, End.IDLE, End.SUCCESS)


def episode(rewards, end, first=0, spec=RAYS):
    """An episode whose row t has the observation `first + t`, by which a row is known again, and the action t % 8."""
    steps = len(rewards)
    dtype, width = observation_dtype_and_width(spec)
    number = np.arange(first, first + steps + 1)
    observations = np.zeros((steps + 1, width), dtype=dtype)
    if spec is RAYS:
        observations[:, 0], observations[:, 1] = number % 4096, number // 4096
    else:
        observations[:, 0], observations[:, 1] = number % 3, number // 3 % 3  # in the first cells of each frame
        observations[:, -2:] = number.astype("<i2").view(np.uint8).reshape(-1, 2)
    actions = np.append(np.arange(steps) % 8, NO_ACTION).astype(np.uint8)
    ends = np.zeros(steps + 1, dtype=np.uint8)
    ends[steps - 1] = end
    return Experience(observations, actions, np.append(rewards, 0).astype(np.float32), ends)


def join(parts):
    return Experience(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def numbers(observations, spec=RAYS):
    """What `episode` numbered the rows."""
    if spec is RAYS:
        return np.rint(observations[:, 0] * 4096 + observations[:, 1] * 4096 * 4096).astype(int)
    return np.rint(observations[:, -1] * 4096).astype(int)


def everything(replay):
    """Each transition that can be drawn, once, in the order of the rows' numbers."""
    draws = replay.sample(3, 64 * len(replay))
    _, first = np.unique(draws.rows, return_index=True)
    once = Batch(*(array[first] for array in draws))
    order = np.argsort(numbers(once.observations, replay.spec))
    return Batch(*(array[order] for array in once))


# --- n-step returns --------------------------------------------------------------------------------------------------


def test_returns_of_a_terminated_and_a_truncated_episode_by_hand():
    replay = Replay(RAYS, 100, n_step=3, discount=0.5)
    replay.add(join([episode([1, 2, 4, 8], End.COLLISION), episode([1, 2, 4, 8], End.TIME, first=5)]))
    batch = everything(replay)
    assert numbers(batch.observations).tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
    assert batch.actions.tolist() == [0, 1, 2, 3] * 2
    assert batch.returns.tolist() == [1 + 1 + 1, 2 + 2 + 2, 4 + 4, 8] * 2
    assert numbers(batch.next_observations).tolist() == [3, 4, 4, 4, 8, 9, 9, 9]
    # The first three steps of either episode lead to a row that the episode goes on from.
    assert batch.bootstraps.tolist() == [0.125, 0, 0, 0, 0.125, 0.125, 0.25, 0.5]
    assert batch.weights.tolist() == [1] * 8


@pytest.mark.parametrize("end", [*TERMINAL, End.TIME])
def test_only_time_bootstraps_from_the_last_row(end):
    replay = Replay(RAYS, 10, n_step=1, discount=0.9)
    replay.add(episode([1, 1], end))
    assert everything(replay).bootstraps == pytest.approx([0.9, 0.9 if end == End.TIME else 0])


EPISODES = st.lists(
    st.tuples(st.lists(st.integers(-9, 9), min_size=1, max_size=12), st.sampled_from([*TERMINAL, End.TIME])),
    min_size=1,
    max_size=4,
)


def expected(parts, capacity, n_step, discount, frames):
    """Textbook: {number of a row: (return, number of the row ahead, bootstrap)} of what can be drawn."""
    rows = sum(len(part.actions) for part in parts)
    found, first = {}, 0
    for part in parts:
        steps = len(part.actions) - 1
        for t in range(steps):
            m = min(n_step, steps - t)
            total = sum(discount**k * float(part.rewards[t + k]) for k in range(m))
            over = t + m == steps and part.ends[steps - 1] in TERMINAL
            if first + max(t - frames + 1, 0) >= rows - capacity:
                found[first + t] = total, first + t + m, 0.0 if over else discount**m
        first += steps + 1
    return found


@settings(max_examples=60)
@given(
    adds=st.lists(EPISODES, min_size=1, max_size=6),
    capacity=st.integers(2, 40),
    n_step=st.integers(1, 5),
    spec=st.sampled_from([RAYS, GRID, FRAME]),
    prioritised=st.booleans(),
)
def test_after_every_add_it_holds_what_the_textbook_holds(adds, capacity, n_step, spec, prioritised):
    replay = Replay(spec, capacity, n_step, 0.9, PriorityConfig() if prioritised else None)
    parts, first = [], 0
    for added in adds:
        new = []
        for rewards, end in added:
            new.append(episode(rewards, end, first, spec))
            first += len(rewards) + 1
        replay.add(join(new))
        parts += new
        known = expected(parts, capacity, n_step, 0.9, getattr(spec, "frames", 1))
        assert len(replay) == min(first, capacity)
        assert replay.transitions == len(known)
        if not known:
            with pytest.raises(ValueError, match="no transition yet"):
                replay.sample(0, 4)
            continue
        batch = replay.sample(first, 64)
        where = numbers(batch.observations, spec)
        assert np.array_equal(batch.actions, np.concatenate([part.actions for part in parts])[where])
        oracle = [known[number] for number in where]  # a KeyError: what was drawn should not be
        assert batch.returns == pytest.approx([one[0] for one in oracle], abs=1e-5)
        assert numbers(batch.next_observations, spec).tolist() == [one[1] for one in oracle]
        assert batch.bootstraps == pytest.approx([one[2] for one in oracle])
        if spec is not RAYS:
            starts = np.cumsum([0] + [len(part.actions) for part in parts])
            for observations, rows in ((batch.observations, where), (batch.next_observations, [o[1] for o in oracle])):
                for inputs, row in zip(observations, rows, strict=True):
                    start = starts[np.searchsorted(starts, row, side="right") - 1]
                    seen = [max(row - back, start) for back in range(spec.frames)[::-1]]
                    codes = np.array([0, 127, 255]) / 255
                    assert inputs[:-1].reshape(-1, 6400)[:, 0] == pytest.approx(codes[np.array(seen) % 3])
                    assert inputs[:-1].reshape(-1, 6400)[:, 4] == pytest.approx(codes[np.array(seen) // 3 % 3])
        # What is restored is the same to the bit, and draws the same.
        again = Replay(spec, capacity, n_step, 0.9, PriorityConfig() if prioritised else None)
        again.restore(*replay.state())
        for one, other in zip(replay.sample(7, 32), again.sample(7, 32), strict=True):
            assert np.array_equal(one, other)


# --- What is drawn ---------------------------------------------------------------------------------------------------


def filled(prioritised=None, capacity=64, rows=90):
    """A replay whose ring has gone round: rows of four episodes, the oldest cut."""
    replay = Replay(RAYS, capacity, 3, 0.9, prioritised)
    first = 0
    for steps in (rows // 3 - 1, 1, 2, rows - rows // 3 - 6):
        replay.add(episode(np.arange(steps) % 5, End.TIME, first))
        first += steps + 1
    return replay


def test_uniform_draws_are_uniform():
    replay = filled()
    counts = np.bincount(replay.sample(11, 60_000).rows, minlength=replay.capacity)
    can = replay.state()[0]["ahead"] > 0
    assert can.sum() == replay.transitions < replay.capacity
    assert not counts[~can].any()
    assert stats.chisquare(counts[can]).pvalue > 0.001


def test_other_keys_draw_others_and_the_same_key_the_same():
    replay = filled()
    drawn = [replay.sample(key, 16).rows.tolist() for key in (0, 1, 2, 1, 2**64 - 1)]
    assert drawn[1] == drawn[3]
    assert len({tuple(rows) for rows in drawn}) == 4


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_prioritised_draws_follow_their_distribution(alpha):
    config = PriorityConfig(alpha=alpha, epsilon=0.01)
    replay = filled(config)
    rows = np.flatnonzero(replay.state()[0]["ahead"])
    errors = np.random.default_rng(5).normal(size=len(rows)) * 3
    replay.update_priorities(rows, errors)
    share = (np.abs(errors) + 0.01) ** alpha
    share /= share.sum()
    # One draw a call: draws of one call are spread evenly, one from each n-th of the sum.
    counts = np.bincount([replay.sample(key, 1).rows[0] for key in range(20_000)], minlength=replay.capacity)
    assert counts.sum() == counts[rows].sum()
    assert stats.chisquare(counts[rows], share * counts.sum()).pvalue > 0.001
    many = np.bincount(replay.sample(1, 5_000).rows, minlength=replay.capacity)[rows]
    assert np.abs(many - share * 5_000).max() <= 2  # spread evenly


def test_importance_weights_take_the_bias_back():
    replay = filled(PriorityConfig(alpha=0.7, epsilon=0.01))
    rows = np.flatnonzero(replay.state()[0]["ahead"])
    replay.update_priorities(rows, np.linspace(0, 2, len(rows)))
    share = (np.linspace(0, 2, len(rows)) + 0.01) ** 0.7
    share /= share.sum()
    batch = replay.sample(2, 40, beta=0.6)
    weights = (len(rows) * share[np.searchsorted(rows, batch.rows)]) ** -0.6  # Schaul et al. 2016, section 3.4
    assert batch.weights == pytest.approx(weights / weights.max(), rel=1e-5)
    assert replay.sample(2, 40, beta=0.0).weights.tolist() == [1] * 40


def test_new_rows_get_the_greatest_priority_so_far():
    replay = Replay(RAYS, 100, 1, 0.9, PriorityConfig(alpha=1.0))
    replay.add(episode([0] * 10, End.TIME))
    assert set(replay.state()[0]["priorities"].tolist()) == {0.0, 1.0}
    replay.update_priorities(np.array([2]), np.array([-7.0]))
    replay.update_priorities(np.array([2]), np.array([0.5]))
    replay.add(episode([0] * 3, End.TIME))
    priorities = replay.state()[0]["priorities"]
    assert priorities[[2, 11, 12, 13, 14]] == pytest.approx([0.501, 7.001, 7.001, 7.001, 0])


@settings(max_examples=30)
@given(
    capacity=st.integers(2, 33),
    steps=st.lists(st.integers(1, 30), min_size=1, max_size=8),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_tree_sums_what_its_leaves_hold(capacity, steps, seed):
    rng = np.random.default_rng(seed)
    replay = Replay(GRID, capacity, 2, 0.9, PriorityConfig())
    for count in steps:
        replay.add(episode([0] * count, End.IDLE, spec=GRID))
        if replay.transitions:
            rows = replay.sample(int(rng.integers(99)), 8).rows
            replay.update_priorities(rows, rng.normal(size=8))
        tree = replay._tree
        leaves = len(tree) // 2
        for node in range(1, leaves):
            assert tree[node] == tree[2 * node] + tree[2 * node + 1]
        assert np.array_equal(tree[leaves:][:capacity] > 0, replay._ahead > 0)
        assert not tree[leaves + capacity :].any()


# --- What is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"capacity": 1}, "rows, not 1"),
        ({"n_step": 0}, "returns are of 1 to 255"),
        ({"n_step": 256}, "returns are of 1 to 255"),
        ({"discount": 1.01}, "discount"),
        ({"discount": math.nan}, "discount"),
        ({"prioritised": PriorityConfig(alpha=math.nan)}, "alpha"),
        ({"prioritised": PriorityConfig(beta=2)}, "beta"),
        ({"prioritised": PriorityConfig(beta_updates=0)}, "beta"),
        ({"prioritised": PriorityConfig(epsilon=0)}, "epsilon"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    arguments = {"capacity": 10, "n_step": 3, "discount": 0.9, "prioritised": None} | change
    with pytest.raises(ValueError, match=message):
        Replay(RAYS, **arguments)


def broken(experience, column, row, value):
    changed = Experience(*(array.copy() for array in experience))
    changed[column][row] = value
    return changed


GOOD = episode([1, 2, 3], End.TIME)
OBSERVATIONS, ACTIONS, REWARDS, ENDS = range(4)


@pytest.mark.parametrize(
    "wrong",
    [
        GOOD._replace(observations=GOOD.observations.astype(np.int32)),
        GOOD._replace(observations=GOOD.observations[:, :-1]),
        GOOD._replace(actions=GOOD.actions[:-1]),
        GOOD._replace(rewards=GOOD.rewards.astype(np.float64)),
        GOOD._replace(ends=GOOD.ends[:, None]),
        Experience(*(array[:-1] for array in GOOD)),
        Experience(*(array[-1:] for array in GOOD)),
        broken(GOOD, ACTIONS, 0, 8),
        broken(GOOD, ACTIONS, 1, NO_ACTION),
        broken(GOOD, REWARDS, 1, np.nan),
        broken(GOOD, ENDS, 0, End.TIME),
        broken(GOOD, ENDS, 2, 0),
        broken(GOOD, ENDS, 2, 5),
        broken(GOOD, ENDS, 3, End.TIME),
    ],
)
def test_what_is_no_experience_is_refused_and_changes_nothing(wrong):
    replay = filled(PriorityConfig())
    before, meta = copy.deepcopy(replay.state())
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        replay.add(wrong)
    after, meta_after = replay.state()
    assert meta == meta_after
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_read_only_experience_and_none_at_all_are_fine():
    replay = Replay(RAYS, 10, 3, 0.9)
    replay.add(Experience(*(array[:0] for array in GOOD)))
    assert len(replay) == replay.added == 0
    rewards = GOOD.rewards.copy()
    rewards.setflags(write=False)
    replay.add(GOOD._replace(rewards=rewards))
    replay.add(GOOD)
    assert GOOD.rewards.flags.writeable
    assert len(replay) == 8


def test_wrong_priorities_are_refused():
    replay = filled(PriorityConfig())
    rows = replay.sample(1, 2).rows
    hole = np.flatnonzero(replay.state()[0]["ahead"] == 0)[:1]
    for wrong_rows, errors in (
        (rows, [1.0, math.nan]),
        (rows, [1.0, math.inf]),
        (rows, [1.0]),
        ([0, -1], [1, 1]),
        ([0, 64], [1, 1]),
        (hole, [1.0]),
    ):
        with pytest.raises(ValueError, match=r"^[^\n]+$"):
            replay.update_priorities(np.array(wrong_rows), np.array(errors))
    with pytest.raises(RuntimeError, match="no priorities"):
        filled().update_priorities(rows, np.ones(2))


# --- State -----------------------------------------------------------------------------------------------------------


def test_a_restored_replay_goes_on_as_the_first_does():
    replay, again = filled(PriorityConfig()), filled(PriorityConfig(), rows=150)
    replay.update_priorities(np.flatnonzero(replay.state()[0]["ahead"])[3:9], np.arange(6.0))
    again.restore(*copy.deepcopy(replay.state()))
    for one in (replay, again):
        one.add(episode([3, 1, 4, 1, 5], End.SUCCESS, 1_000))
        drawn = one.sample(4, 8)
        one.update_priorities(drawn.rows, drawn.returns)
    for one, other in zip(replay.state()[0].values(), again.state()[0].values(), strict=True):
        assert np.array_equal(one, other)
    assert np.array_equal(replay._tree, again._tree)
    assert replay.state()[1] == again.state()[1]


def set_to(name, row, value):
    def change(arrays, meta):
        arrays[name][row] = value

    return change


def replace(name, function):
    def change(arrays, meta):
        arrays[name] = function(arrays[name])

    return change


def say(name, value):
    def change(arrays, meta):
        meta[name] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        *(replace(name, lambda array: array[:-1]) for name in ("observations", "actions", "ahead", "priorities")),
        *(replace(name, lambda array: array.astype(np.float64)) for name in ("observations", "returns", "priorities")),
        lambda arrays, meta: arrays.pop("ages"),
        replace("actions", lambda array: array.tolist()),
        *(say("rows_added", value) for value in (None, True, -1, 1e3, "9", 1 << 70, 5, 63, 65)),
        *(say("max_priority", value) for value in (None, 1, 0.0, -1.0, math.nan, math.inf, "1")),
        set_to("actions", 5, 8),
        set_to("actions", 5, NO_ACTION),
        set_to("actions", slice(None), NO_ACTION),
        set_to("actions", slice(None), 0),
        set_to("ahead", 5, 0),
        set_to("ahead", 5, 200),
        set_to("ahead", slice(None), 255),
        set_to("ages", 5, 1),
        set_to("ages", slice(None), 255),
        set_to("returns", 5, np.nan),
        set_to("bootstraps", 5, np.inf),
        set_to("bootstraps", 5, 0.5),
        set_to("bootstraps", 40, 0.0),
        set_to("priorities", 5, np.nan),
        set_to("priorities", 5, -1),
        set_to("priorities", 5, 0),
        set_to("priorities", slice(None), 1),
    ],
)
def test_a_hostile_state_is_refused_and_changes_nothing(change):
    replay = filled(PriorityConfig())
    arrays, meta = copy.deepcopy(filled(PriorityConfig(), rows=150).state())
    before = copy.deepcopy(replay.state())
    change(arrays, meta)
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        replay.restore(arrays, meta)
    after = replay.state()
    assert after[1] == before[1]
    assert all(np.array_equal(before[0][name], after[0][name]) for name in before[0])


def test_a_state_of_other_arguments_is_refused():
    arrays, meta = filled().state()
    for other in (
        Replay(RAYS, 63, 3, 0.9),
        Replay(RAYS, 64, 2, 0.9),
        Replay(RAYS, 64, 3, 0.8),
        Replay(PolicySpec.parse("mlp:3+motion"), 64, 3, 0.9),
        Replay(RAYS, 64, 3, 0.9, PriorityConfig()),
    ):
        with pytest.raises(ValueError, match=r"^a saved replay[^\n]+$"):
            other.restore(arrays, meta)
        assert len(other) == 0
