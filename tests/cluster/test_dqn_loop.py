"""The DQN's loop in this process: when it learns, converges, diverges and ends."""

import copy
from typing import Any

import numpy as np
import pytest
from learners import pool_of, step

from cluster.learn import dqn as dqn_loop
from cluster.learn.dqn import Dqn
from cluster.learn.maps import Maps
from cluster.settings import DqnSettings
from gridsim.config import SimConfig

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture(scope="module")
def maps():
    kept = Maps("curved", SimConfig())
    yield kept
    kept.close()


@pytest.fixture
def loop(maps, monkeypatch):
    """Makes a small run, its batches smaller than they are."""
    monkeypatch.setattr(dqn_loop, "BATCH_STEPS", 2048)
    monkeypatch.setattr(dqn_loop, "WARM_UP", 3000)

    def make(**changes):
        small: dict[str, Any] = {"policy": "mlp:4", "replay": 4000, "evaluate_every": 1000, "batch": 32}
        return Dqn(DqnSettings("curved", **small | changes), pool_of(maps), maps)

    return make


def test_a_network_that_learned_nothing_is_evaluated_again_and_has_not_converged(loop):
    learning = loop(updates=1e-6)
    evaluated = [step(learning) for _ in range(dqn_loop.STABLE + 2)]
    assert learning.learner.updates == 0
    assert len({row["distance_m/best"] for row in evaluated}) == 1  # the network's own figures, each time
    assert not learning.converged
    assert not learning.done()


def test_values_that_stand_still_while_they_are_trained_have_converged(loop):
    learning = loop(learning_rate=1e-12)
    trained = 0
    while trained < dqn_loop.STABLE:
        assert not learning.converged
        before = learning.learner.updates
        step(learning)
        trained += learning.steps > 1 and learning.learner.updates > before
    assert learning.converged
    assert learning.done()
    resumed = loop(learning_rate=1e-12)
    resumed.restore(*learning.state(), learning.table())
    assert resumed.done()
    learning.probe_q += 1.0  # they change once more
    step(learning)
    assert learning.stable_evaluations == 0
    assert not learning.converged


def test_a_run_goes_on_exactly(loop, monkeypatch):
    monkeypatch.setattr(dqn_loop, "EPISODES", (1, 2048))  # so that the size of a batch follows from those before

    straight, resumed = loop(), loop()
    step(straight)
    step(straight)
    resumed.restore(*copy.deepcopy(straight.state()), straight.table())
    for learning in (straight, resumed):
        step(learning)
    np.testing.assert_equal(resumed.state(), straight.state())


def test_a_network_that_diverged_ends_the_run_before_it_is_saved(loop):
    learning = loop()
    step(learning)
    learning.learner.online.genome.data[3] = np.nan
    with pytest.raises(FloatingPointError, match=r"^the Q network diverged at update \d+: try a lower learning rate$"):
        step(learning)
    assert len(learning.history) == 1


@pytest.mark.parametrize(("name", "most"), [("car_steps", 5000), ("episodes", 200)])
def test_no_batch_is_begun_beyond_a_bound(loop, name, most):
    learning = loop(evaluate_every=10**9, **{name: most})
    begun: list[int] = []
    collect = learning._collect

    def count():
        begun.append(learning.counts()[name])
        return collect()

    learning._collect = count
    step(learning)
    assert learning.done()
    assert len(begun) > 1
    assert max(begun) < most
