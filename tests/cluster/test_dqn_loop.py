"""The DQN's loop in this process: when it learns, converges, diverges and ends."""

import copy
from typing import Any

import numpy as np
import pytest

from cluster.learn import dqn as dqn_loop
from cluster.learn.dqn import Dqn
from cluster.learn.learning import Maps
from cluster.settings import DqnSettings
from cluster.workers.pool import Chunk, PoolError, SerialPool, finish
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
        return Dqn(DqnSettings("curved", **small | changes), SerialPool(maps.build), maps)

    return make


def test_a_replay_smaller_than_the_warm_up_is_learned_from(loop):
    learning = loop(replay=1000)
    learning.step()
    learning.step()
    assert learning.learner.updates > 0


def test_a_network_that_learned_nothing_is_evaluated_again_and_has_not_converged(loop):
    learning = loop(updates=1e-6)
    evaluated = [learning.step() for _ in range(dqn_loop.CALM + 2)]
    assert learning.learner.updates == 0
    assert len({row["distance_m/best"] for row in evaluated}) == 1  # the network's own figures, each time
    assert not learning.converged
    assert not learning.done()


def test_values_that_stand_still_while_they_are_trained_have_converged(loop):
    learning = loop(learning_rate=1e-12)
    trained = 0
    while trained < dqn_loop.CALM:
        assert not learning.converged
        before = learning.learner.updates
        learning.step()
        learning.add_wall_clock(1.0)
        trained += learning.steps > 1 and learning.learner.updates > before
    assert learning.converged
    assert learning.done()
    resumed = loop(learning_rate=1e-12)
    resumed.restore(*learning.state())
    assert resumed.done()
    learning.probe_q += 1.0  # they change once more
    learning.step()
    assert learning.calm == 0
    assert not learning.converged


def test_a_run_goes_on_exactly(loop, monkeypatch):
    monkeypatch.setattr(dqn_loop, "EPISODES", (1, 2048))  # so that the size of a batch follows from those before

    def go_on(learning):
        learning.step()
        learning.add_wall_clock(1.0)

    straight, resumed = loop(), loop()
    go_on(straight)
    go_on(straight)
    resumed.restore(*copy.deepcopy(straight.state()))
    for learning in (straight, resumed):
        go_on(learning)
    np.testing.assert_equal(resumed.state(), straight.state())


def test_large_values_can_be_saved_and_taken_up_again(loop):
    learning = loop(learning_rate=1e30)
    for _ in range(4):
        learning.step()
        learning.add_wall_clock(1.0)
    assert learning.history[-1]["q/mean"] != 0.0
    assert np.isfinite([list(row.values()) for row in learning.history]).all()
    again = loop(learning_rate=1e30)
    again.restore(*learning.state())
    assert again.counts() == learning.counts()


def test_a_network_that_diverged_ends_the_run_before_it_is_saved(loop):
    learning = loop()
    learning.step()
    learning.learner.online.genome.data[3] = np.nan
    with pytest.raises(FloatingPointError, match=r"^the Q network diverged at update \d+: try a lower learning rate$"):
        learning.step()
    assert len(learning.history) == 1


def test_a_step_ends_early_when_time_is_up(loop):
    learning = loop(evaluate_every=10**9)
    learning.out_of_time = lambda: True
    learning.step()
    assert learning.batches == 1


@pytest.mark.parametrize(("name", "most"), [("car_steps", 5000), ("episodes", 200)])
def test_no_batch_is_begun_beyond_a_bound(loop, name, most):
    learning = loop(evaluate_every=10**9, **{name: most})
    begun: list[int] = []
    collect = learning._collect

    def count():
        begun.append(learning.counts()[name])
        return collect()

    learning._collect = count
    learning.step()
    assert learning.done()
    assert len(begun) > 1
    assert max(begun) < most


class Losing(SerialPool):
    """Loses every `one_in`-th episode, as where each of those killed its workers."""

    one_in = 3

    def _work(self, call, on_progress, meanwhile):
        maps = [self._build_map(*name) for name in call.task.maps]
        for k in range(len(call.task.episodes)):
            chunk = Chunk(slice(k, k + 1), slice(0, 1))
            if k % self.one_in:
                call.add(0, chunk, *self._worker.answer(call.task, maps, *call.work(chunk)))
            else:
                call.lose(chunk)
                call.warnings.append(f"episode {k} is lost")
        finish(meanwhile)


def test_lost_episodes_are_in_no_replay_and_in_no_mean(loop, maps):
    learning = loop()
    learning.pool = Losing(maps.build)
    said: list[str] = []
    learning.warn = said.append
    results, rewards = learning._collect()
    asked = len(said) + len(results)
    assert len(said) == learning.lost_chunks == -(-asked // 3)
    assert said[1] == "evaluation 0, collect: episode 3 is lost"
    assert (results["steps"] > 0).all()
    assert learning.replay.added == learning.car_steps + len(results)
    assert learning.episodes == len(results)
    assert learning.mean_steps == learning.car_steps / len(results)
    assert np.isfinite(rewards)
    learning.pool.one_in = 1
    with pytest.raises(PoolError, match=r"^collect: nothing is left, all \d+ that were tried killed their workers"):
        learning._collect()
