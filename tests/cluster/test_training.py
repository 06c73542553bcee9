"""The learners' loops: episodes, champions, resuming, the user's fitness; when a DQN learns, converges and diverges."""

import copy
import dataclasses
from typing import Any

import numpy as np
import pytest
from learners import pool_of, step

from cluster.learn import dqn as dqn_loop
from cluster.learn.dqn import Dqn
from cluster.learn.evolution import Evolution
from cluster.learn.learning import Champion, finish
from cluster.learn.maps import Maps
from cluster.settings import DqnSettings, EvolveSettings
from cluster.store.checkpoint import load, save
from cluster.workers.pool import Outcome
from evolution.episodes.curriculum import FINAL_SEEDS, HELD_OUT_SEEDS
from evolution.episodes.starts import Episodes
from evolution.networks.policy import PolicySpec
from evolution.search.recombination import Recombination
from evolution.search.two_parents import TwoParents
from gridsim.config import SimConfig
from gridsim.state import LANE, TRAFFIC_FIELDS, End

SETTINGS = EvolveSettings(traffic=3, population=32, generations=3, policy="mlp:6,7", seed=9)
TWO = dataclasses.replace(SETTINGS, recombination="two", sigma=0.5, elites=2)
RANDOM = dataclasses.replace(SETTINGS, search="random")
GENES = PolicySpec.parse(SETTINGS.policy).size
# A candidate is validated in every generation, and the target doubles in each that has a leader.
EAGER = {"promising": 0.0, "latest": 0, "validation_share": 1.0, "growth": 0.0}


@pytest.fixture(scope="module")
def maps():
    maps = Maps(SETTINGS.scenario, SimConfig())
    yield maps
    maps.close()


def begin(maps, settings=SETTINGS, **changes):
    """A run with a short validation, and changes of its curriculum."""
    return changed(Evolution(settings, pool_of(maps), maps), **changes)


def changed(evolution, **changes):
    evolution.curriculum.config = dataclasses.replace(evolution.curriculum.config, validation=8, **changes)
    return evolution


@pytest.mark.parametrize("settings", [SETTINGS, TWO, RANDOM], ids=["all", "two", "random"])
def test_a_run_among_traffic_goes_on_exactly(maps, tmp_path, settings):
    """From each generation of three, also with candidates validated, and as if it had never been concluded."""
    straight, tables = begin(maps, settings, **EAGER), []
    for generation in range(3):
        save(tmp_path / f"{generation}.npz", *straight.state())
        tables.append(straight.table())
        step(straight)
    assert straight.champion is not None
    for generation in range(3):
        resumed = begin(maps, settings, **EAGER)
        resumed.restore(*load(tmp_path / f"{generation}.npz"), tables[generation])
        assert resumed.steps == generation
        while resumed.steps < 3:
            step(resumed)
        np.testing.assert_equal(resumed.state(), straight.state())
        assert resumed.validation_steps == straight.validation_steps > 0
        for k, elite in resumed.elites.items():
            assert elite.tobytes() == straight.elites[k].tobytes()
    finish(straight.choose_champion())
    finish(resumed.choose_champion())
    ended, other = straight.champion, resumed.champion
    assert (ended.genome.tobytes(), ended.score) == (other.genome.tobytes(), other.score)


def test_crashes_of_an_older_form_are_refused_at_once(maps):
    """And not in the first generation that begins at one of them."""
    learning = begin(maps)
    arrays, meta = learning.state()
    older = np.dtype([("map", "<i4"), ("start", "<f4", 5), ("target", "<f4"), ("steps", "<i4"), ("rewind", "<i4")])
    with pytest.raises(ValueError, match="crashes of another form"):
        learning.restore({**arrays, "crashes": np.zeros(0, dtype=older)}, meta, learning.table())


def test_a_search_is_what_was_asked_for(maps):
    for settings, kind in ((SETTINGS, Recombination), (TWO, TwoParents), (RANDOM, TwoParents)):
        search = begin(maps, settings).search
        assert type(search) is kind
        assert getattr(search, "random", False) == (settings is RANDOM)
        assert (search.config, search.seed) == (settings.search_config(), settings.seed)
        assert len(search.ask().groups) == 2


@pytest.mark.parametrize(("settings", "after"), [(SETTINGS, 0), (SETTINGS, 2), (TWO, 2)])
def test_each_group_meets_its_own_episodes_and_its_members_results_are_theirs(maps, settings, after):
    """Also with the leader beside them: results are those of each driving alone."""
    evolution = begin(maps, dataclasses.replace(settings, population=50))
    for _ in range(after):
        step(evolution)
    changed(evolution, **EAGER)
    told: list[np.ndarray] = []
    driven: list[Outcome] = []
    begin_call = evolution.pool.start

    def start(call):
        driven.append(call)
        return begin_call(call)

    evolution.search.tell, evolution.pool.start = told.append, start
    curriculum, config, leader = evolution.curriculum, evolution.curriculum.config, evolution.search.leader()
    episodes, followed = curriculum.episodes(after), curriculum.leader_episodes(after)
    row = step(evolution)
    outcome, groups = driven[0], evolution.search.asked.groups
    e = len(episodes.rows) // len(groups)
    assert len(groups) == config.groups == 3
    genomes = evolution.search.genomes(np.arange(50))
    score = np.zeros(50)
    for g, group in enumerate(groups):
        own = Episodes(episodes.maps, episodes.rows[g * e : g * e + e], episodes.worlds[g * e : g * e + e])
        alone = finish(evolution.drive("alone", genomes[group], own))
        assert alone.results.tobytes() == outcome.results[group, g * e : g * e + e].tobytes()
        score[group] = evolution._score(alone.results, own.rows["target"].astype(np.float64))
    assert told[0].tobytes() == score.tobytes()
    if leader is None:
        assert evolution.elites[after].tobytes() == genomes[score.argmax()].tobytes()
        assert row["fitness/best"] == score.max()
    else:
        its = slice(len(episodes.rows), len(episodes.rows) + config.leader_episodes)
        alone = finish(evolution.drive("alone", leader[None], followed))
        for name in ("rewound", "worlds"):
            assert getattr(alone, name).tobytes() == getattr(outcome, name)[its].tobytes()
        assert evolution.elites[after].tobytes() == leader.tobytes()
        assert row["distance_m/best"] == alone.results["distance"].mean()
        validation = finish(evolution.drive("alone", leader[None], curriculum.validation()))
        assert validation.results[0].tobytes() == outcome.results[50, its.stop :].tobytes()
        assert evolution.champion.success_rate == (validation.results["end"] == End.SUCCESS).mean()


def test_a_run_that_ends_chooses_between_champion_and_last_candidate_on_other_maps(maps):
    evolution = begin(maps)
    step(evolution)
    two = np.stack([evolution.candidate(), np.zeros(GENES, np.float32)])
    curriculum = evolution.curriculum
    finals = curriculum.validation(FINAL_SEEDS)
    assert not set(finals.maps) & {*curriculum.validation().maps, *HELD_OUT_SEEDS}
    metres = finish(evolution.drive("alone", two, finals)).results["distance"].mean(axis=1)
    assert metres[0] != metres[1]
    before = evolution.car_steps
    for champion, candidate in (two, two[::-1]):
        evolution.champion = Champion(champion, 0.9, 0.9, 1000.0, 0)
        evolution.candidate = lambda candidate=candidate: candidate
        finish(evolution.choose_champion())
        assert evolution.car_steps == before
        assert evolution.champion.genome.tobytes() == two[metres.argmax()].tobytes()
        assert (evolution.champion.score, evolution.champion.tie_break) == (0.0, metres.max())


def test_training_is_among_more_cars_than_validation(maps):
    """Twice as many as were asked for; champions are chosen, and measured, among those that were."""
    curriculum = begin(maps).curriculum
    for episodes in (curriculum.episodes(0), curriculum.leader_episodes(0)):
        assert episodes.worlds.shape[1:] == (2 * SETTINGS.traffic, TRAFFIC_FIELDS)
        assert (episodes.worlds[..., LANE] >= 0).mean() > 0.95
    there = curriculum.validation().worlds[..., LANE] >= 0
    assert there.shape[1] == 2 * SETTINGS.traffic  # it is driven beside training's
    assert (there.sum(axis=1) <= SETTINGS.traffic).all()
    assert there[:, : SETTINGS.traffic].mean() > 0.95


# --- The DQN's loop --------------------------------------------------------------------------------------------------


@pytest.fixture
def loop(curved, monkeypatch):
    """Makes a small run, its batches smaller than they are."""
    monkeypatch.setattr(dqn_loop, "BATCH_STEPS", 2048)
    monkeypatch.setattr(dqn_loop, "WARM_UP", 3000)

    def make(**changes):
        small: dict[str, Any] = {"policy": "mlp:4", "replay": 4000, "evaluate_every": 1000, "batch": 32}
        return Dqn(DqnSettings("curved", **small | changes), pool_of(curved), curved)

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
