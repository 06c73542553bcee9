"""The generation loop among traffic: its episodes, the champion, resuming, lost members, the user's fitness."""

import dataclasses
import shutil

import numpy as np
import pytest
from commands import rows

from cluster.learn.evolution import Evolution
from cluster.learn.learning import Champion, Maps
from cluster.run import Session
from cluster.settings import EvolveSettings
from cluster.store import checkpoint
from cluster.store.checkpoint import load, save
from cluster.store.folder import new_run, open_run
from cluster.workers.pool import Outcome, PoolError, SerialPool
from evolution.episodes.curriculum import FINAL_SEEDS, HELD_OUT_SEEDS
from evolution.episodes.starts import Episodes
from evolution.networks.policy import PolicySpec
from evolution.search.breeding import Kind, breed
from evolution.search.recombination import Recombination
from evolution.search.two_parents import TwoParents
from gridsim.car.ego import End
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.traffic.world import FIELDS, LANE

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
    return changed(Evolution(settings, SerialPool(maps.build), maps), **changes)


def changed(evolution, **changes):
    evolution.curriculum.config = dataclasses.replace(evolution.curriculum.config, validation=8, **changes)
    return evolution


def go_on(evolution):
    """One generation more, at a second each."""
    evolution.step()
    evolution.add_wall_clock(float(evolution.steps))


@pytest.fixture(scope="module")
def halfway(maps, tmp_path_factory):
    """The folder of a run that has done two of three generations: there is a leader from the second on."""
    run = new_run(tmp_path_factory.mktemp("runs"), "halfway", dataclasses.replace(SETTINGS, generations=2))
    run.path.mkdir()
    in_folder(run, maps).learn()
    run.settings = SETTINGS
    run.write_config()
    return run.path


@pytest.fixture
def stopped(halfway, tmp_path):
    """The folder of such a run, to be changed."""
    return shutil.copytree(halfway, tmp_path / "run")


@pytest.mark.parametrize("settings", [SETTINGS, TWO, RANDOM], ids=["all", "two", "random"])
def test_a_run_among_traffic_goes_on_exactly(maps, tmp_path, settings):
    """From each generation of three, also with candidates validated, and as if it had never been concluded."""
    straight = begin(maps, settings, **EAGER)
    for generation in range(3):
        save(tmp_path / f"{generation}.npz", *straight.state())
        go_on(straight)
    assert straight.champion is not None
    for generation in range(3):
        resumed = begin(maps, settings, **EAGER)
        resumed.restore(*load(tmp_path / f"{generation}.npz"))
        assert resumed.steps == generation
        while resumed.steps < 3:
            go_on(resumed)
        np.testing.assert_equal(resumed.state(), straight.state())
        assert resumed.validation_steps == straight.validation_steps > 0
        for step, elite in resumed.elites.items():
            assert elite.tobytes() == straight.elites[step].tobytes()
    ended, other = straight.choose_champion(), resumed.choose_champion()
    assert (ended.genome.tobytes(), ended.score) == (other.genome.tobytes(), other.score)


def test_a_search_is_what_was_asked_for(maps):
    for settings, kind in ((SETTINGS, Recombination), (TWO, TwoParents), (RANDOM, TwoParents)):
        search = begin(maps, settings).search
        assert type(search) is kind
        assert getattr(search, "random", False) == (settings is RANDOM)
        assert (search.config, search.seed) == (settings.search_config(), settings.seed)
        assert len(search.ask().groups) == 2


def test_a_run_may_begin_with_a_champion(maps):
    genome = np.random.default_rng(3).normal(size=GENES).astype(np.float32)
    for settings in (SETTINGS, TWO):
        evolution = Evolution(settings, SerialPool(maps.build), maps, genome)
        go_on(evolution)
        assert evolution.elites[0].tobytes() == genome.tobytes()


@pytest.mark.parametrize("settings", [SETTINGS, TWO, RANDOM], ids=["all", "two", "random"])
@pytest.mark.parametrize("after", [0, 1, 2])
def test_each_group_meets_its_own_episodes_and_its_members_results_are_theirs(maps, settings, after):
    """Also with leader and candidate beside them: results are those of each driving alone."""
    evolution = begin(maps, dataclasses.replace(settings, population=50))
    for _ in range(after):
        go_on(evolution)
    changed(evolution, **EAGER)
    candidate = evolution.candidate()
    told: list[np.ndarray] = []
    driven: list[Outcome] = []
    evolution.search.tell, evolution._report = told.append, lambda stage, outcome: driven.append(outcome)
    curriculum, config, leader = evolution.curriculum, evolution.curriculum.config, evolution.search.leader()
    episodes, followed = curriculum.episodes(after), curriculum.leader_episodes(after)
    row = evolution.step()
    outcome, groups = driven[0], evolution.search.asked.groups
    e = len(episodes.rows) // len(groups)
    assert len(groups) == config.groups == 3
    assert e == config.starts + (after == 2) * config.crash_starts  # nobody led the first
    fresh = [row for k, row in enumerate(episodes.rows) if k % e < config.starts]  # crashes are drawn with repetition
    assert len({row.tobytes() for row in fresh}) == len(fresh) == config.starts * len(groups)
    genomes = evolution.search.genomes(np.arange(50))
    score = np.zeros(50)
    for g, group in enumerate(groups):
        own = Episodes(episodes.maps, episodes.rows[g * e : g * e + e], episodes.worlds[g * e : g * e + e])
        alone = evolution.drive("alone", genomes[group], own)
        assert alone.results.tobytes() == outcome.results[group, g * e : g * e + e].tobytes()
        score[group] = evolution._score(alone.results, own.rows["target"].astype(np.float64))
    assert told[0].tobytes() == score.tobytes()
    assert not outcome.results[groups[0], e : len(episodes.rows)]["steps"].any()  # nor anybody else's
    if leader is None:
        assert len(outcome.recipes) == 50
        assert evolution.elites[after].tobytes() == genomes[score.argmax()].tobytes()
        assert row["fitness/best"] == score.max()
    else:
        first = len(episodes.rows)
        alone = evolution.drive("alone", leader[None], followed)
        led = outcome.results[50, first : first + len(followed.rows)]
        assert len(led) == config.leader_episodes
        assert alone.results[0].tobytes() == led.tobytes()
        assert alone.rewound.tobytes() == outcome.rewound[first : first + len(led)].tobytes()
        assert alone.worlds.tobytes() == outcome.worlds[first : first + len(led)].tobytes()
        assert evolution.elites[after].tobytes() == leader.tobytes()
        assert row["distance_m/best"] == led["distance"].mean()
        assert row["fitness/best"] == evolution._score(alone.results, float(followed.rows["target"][0]))[0]
        assert row["fitness/mean"] == score.mean()
        assert len(outcome.recipes) == 52
        validation = evolution.drive("alone", candidate[None], curriculum.validation())
        assert validation.results[0].tobytes() == outcome.results[51, -config.validation :].tobytes()
        assert evolution.champion.success_rate == (validation.results["end"] == End.SUCCESS).mean()


def test_a_candidate_is_validated_when_the_leader_does_well(maps, monkeypatch):
    evolution = begin(maps)
    go_on(evolution)
    config = evolution.curriculum.config
    evolution.history = [{"leader/success_rate": config.promising}] * config.latest
    evolution.car_steps = 1000
    for name, value in (
        ("validation_steps", 251),
        ("history", [*evolution.history, {"leader/success_rate": config.promising - 0.01}]),
        ("history", evolution.history[1:]),  # not in enough generations yet
        ("champion", Champion(np.zeros(GENES, np.float32), 0.6, success_rate=config.promising + 0.1)),
        ("tried", evolution.candidate()),
    ):
        assert evolution._promising()
        with monkeypatch.context() as patch:
            patch.setattr(evolution, name, value)
            assert not evolution._promising()


def test_a_run_that_ends_chooses_between_champion_and_last_candidate_on_other_maps(maps):
    evolution = begin(maps)
    go_on(evolution)
    two = np.stack([evolution.candidate(), np.zeros(GENES, np.float32)])
    curriculum = evolution.curriculum
    finals = curriculum.validation(FINAL_SEEDS)
    assert not set(finals.maps) & {*curriculum.validation().maps, *HELD_OUT_SEEDS}
    metres = evolution.drive("alone", two, finals).results["distance"].mean(axis=1)
    assert metres[0] != metres[1]
    before = evolution.car_steps
    for champion, candidate in (two, two[::-1]):
        evolution.champion = Champion(champion, 0.9, 0.9, 1000.0, 0)
        evolution.candidate = lambda candidate=candidate: candidate
        evolution.choose_champion()
        assert evolution.car_steps == before
        assert evolution.champion.genome.tobytes() == two[metres.argmax()].tobytes()
        assert (evolution.champion.score, evolution.champion.distance_m) == (0.0, metres.max())


def test_training_is_among_more_cars_than_validation(maps):
    """Twice as many as were asked for; champions are chosen, and measured, among those that were."""
    curriculum = begin(maps).curriculum
    for episodes in (curriculum.episodes(0), curriculum.leader_episodes(0)):
        assert episodes.worlds.shape[1:] == (2 * SETTINGS.traffic, FIELDS)
        assert (episodes.worlds[..., LANE] >= 0).mean() > 0.95
    there = curriculum.validation().worlds[..., LANE] >= 0
    assert there.shape[1] == 2 * SETTINGS.traffic  # it is driven beside training's
    assert (there.sum(axis=1) <= SETTINGS.traffic).all()
    assert there[:, : SETTINGS.traffic].mean() > 0.95


@pytest.mark.parametrize("name", ["steps_sha256", "search_path", "crashes", "tried", "generation", "champion"])
def test_a_checkpoint_without_a_part_is_refused_in_one_line(maps, stopped, name):
    arrays, meta = load(stopped / "checkpoint.npz")
    arrays.pop(name, None)
    meta.pop(name, None)
    save(stopped / "checkpoint.npz", arrays, meta)
    with pytest.raises(GridSimError, match=r"another version|not those of a run|it lacks steps") as error:
        in_folder(open_run(stopped), maps)
    assert "\n" not in str(error.value)


def in_folder(run, maps):
    """A run in its folder, with a short validation."""
    made = Session(run, SerialPool(maps.build), maps, f"sqlite:///{run.path.parent}/m.db", "test")
    changed(made.learning)
    return made


def test_an_interrupt_while_the_last_generation_is_saved_does_not_lose_it(maps, stopped, monkeypatch):
    resumed, save = in_folder(open_run(stopped), maps), Session.save

    def interrupted(session):
        if session.learning.steps < 3:
            return save(session)
        monkeypatch.setattr(Session, "save", save)
        raise KeyboardInterrupt

    monkeypatch.setattr(Session, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        resumed.learn()
    assert load(stopped / "checkpoint.npz")[1]["generation"] == 3
    assert len(rows(stopped)) == 3


def test_an_interrupt_between_history_and_tracker_loses_no_row(maps, stopped, monkeypatch):
    resumed, write = in_folder(open_run(stopped), maps), checkpoint.write_atomic

    def interrupted(path, content, durable=True):
        write(path, content, durable)
        if path.name == "history.csv" and content.count(b"\n") == 4:
            monkeypatch.setattr(checkpoint, "write_atomic", write)
            raise KeyboardInterrupt

    logged: list[int] = []
    monkeypatch.setattr(resumed.tracker, "log_row", lambda step, *_: logged.append(step))
    monkeypatch.setattr(checkpoint, "write_atomic", interrupted)
    with pytest.raises(KeyboardInterrupt):
        resumed.learn()
    assert logged == [0, 1, 2]


def test_a_history_without_its_last_row_is_mended(maps, stopped):
    """As a kill between the last checkpoint and its history leaves it, when nothing is left to evolve."""
    in_folder(open_run(stopped), maps).learn()
    whole = (stopped / "history.csv").read_bytes()
    (stopped / "history.csv").write_bytes(b"".join(whole.splitlines(keepends=True)[:-1]))
    in_folder(open_run(stopped), maps).learn()
    assert (stopped / "history.csv").read_bytes() == whole


class Losing(SerialPool):
    """Loses the members in some rows of some calls, as where each of those killed its workers."""

    def __init__(self, maps, **rows):
        super().__init__(maps.build)
        self.rows = rows  # by the call's kind: evolve or validate
        self.genomes = np.zeros((0, GENES), dtype=np.float32)  # of who was lost

    def evaluate(self, task, recipes, on_progress=None, asked=None, meanwhile=None):
        outcome = super().evaluate(task, recipes, on_progress, asked, meanwhile)
        kind = "evolve" if (recipes["kind"] != Kind.COPY).any() else "validate"
        rows = np.arange(len(recipes))[self.rows.get(kind, slice(0, 0))]
        outcome.lost[rows] = True
        outcome.results[rows] = np.zeros((), outcome.results.dtype)
        outcome.warnings = ["a worker is replaced", *(f"member {row} is lost" for row in rows)]
        lost = breed(task.parents, recipes[rows], task.key, PolicySpec.parse(task.policy), task.mutation)
        self.genomes = np.concatenate([self.genomes, lost])
        return outcome


def losing(maps, settings=SETTINGS, **rows):
    evolution = begin(maps, settings)
    evolution.pool = Losing(maps, **rows)
    evolution.score = lambda results, target: -results["distance"].sum(axis=1)  # who drives nowhere is the best
    evolution.warn = lambda text: None
    return evolution


@pytest.mark.parametrize(("settings", "last"), [(SETTINGS, 24), (TWO, 9)], ids=["all", "two"])
def test_lost_members_cannot_win_whatever_the_fitness(maps, settings, last):
    """They are no elites, no parents (where tournaments of lost ones alone are rare) and no candidates."""
    evolution = losing(maps, settings, evolve=slice(3, last))
    go_on(evolution)
    kept = [evolution.candidate(), *evolution.elites.values(), *getattr(evolution.search, "parents", [])]
    assert len(evolution.pool.genomes) == last - 3 == evolution.lost_chunks
    assert not {genome.tobytes() for genome in evolution.pool.genomes} & {genome.tobytes() for genome in kept}
    assert np.isfinite(list(evolution.history[0].values())).all()
    resumed = begin(maps, settings)
    resumed.restore(*evolution.state())
    assert resumed.lost_chunks == last - 3


def test_a_leader_that_was_lost_does_not_end_a_run(maps):
    evolution = losing(maps)
    go_on(evolution)
    evolution.pool.rows = {"evolve": slice(32, 33)}  # the leader, beside the members
    go_on(evolution)
    assert evolution.lost_chunks == 1
    assert evolution.history[1]["leader/success_rate"] == 0.0
    assert np.isfinite(list(evolution.history[1].values())).all()


def test_where_all_are_lost_the_run_stops(maps):
    with pytest.raises(PoolError, match=r"^evolve: nothing is left, all 32 that were tried killed their workers"):
        losing(maps, evolve=slice(0, None)).step()


def test_a_candidate_lost_in_validation_is_no_champion(maps):
    evolution = losing(maps, validate=slice(0, None))
    go_on(evolution)
    with pytest.raises(PoolError, match="there is no champion: each network that was to be validated killed"):
        evolution.choose_champion()
    assert evolution.champion is None
