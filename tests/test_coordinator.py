"""The generation loop among traffic: what it remembers of crashes survives a checkpoint, and changes nothing."""

import dataclasses
import math
import time
from typing import ClassVar

import numpy as np
import pytest

from cluster.checkpoint import CheckpointError, load, save
from cluster.coordinator import Evolution
from cluster.learning import Maps
from cluster.pool import PoolError, SerialPool
from cluster.run import RunError, RunFolder, Session, make_tracker, open_run, read_history
from cluster.settings import EvolveSettings
from evolution.breeding import breed
from evolution.curriculum import CrashError
from evolution.episodes import Episodes
from evolution.policy import PolicySpec
from gridsim.config import SimConfig
from gridsim.world import ALONG, FIELDS, LANE, NEXT, PAST, SPEED

SETTINGS = EvolveSettings(traffic=3, population=32, generations=2, elites=2, parents=8, seed=9)
GENES = PolicySpec.parse(SETTINGS.policy).size

CROWD = 6  # cars in training


@pytest.fixture(scope="module")
def maps():
    maps = Maps(SETTINGS.scenario, SimConfig())
    yield maps
    maps.close()


def begin(maps, settings=SETTINGS):
    """A run with a short validation."""
    evolution = Evolution(settings, SerialPool(maps.build), maps)
    curriculum = evolution.curriculum
    curriculum.config = dataclasses.replace(curriculum.config, validation=8, first_validation=4, contenders=2)
    return evolution


def go_on(evolution):
    """One generation more, at a second each."""
    evolution.timed(evolution.step(), float(evolution.generation), None)


@pytest.fixture(scope="module")
def halfway(maps, tmp_path_factory):
    """The file of a run after the first of two generations."""
    evolution = begin(maps)
    go_on(evolution)
    path = tmp_path_factory.mktemp("run") / "checkpoint.npz"
    save(path, *evolution.state())
    return path


def test_maps_are_begun_before_they_are_needed():
    class Watched(Maps):
        begun: ClassVar[set[int]] = set()

        def ahead(self, seeds, later=False):
            self.begun.update(seeds)
            super().ahead(seeds, later)

    maps = Watched("seamless", SimConfig())
    try:
        evolution = begin(maps)
        curriculum = evolution.curriculum
        for generation in range(2):
            go_on(evolution)
            assert set(curriculum.map_seeds[: curriculum.maps_in_use(generation + 2)]) <= maps.begun
        assert set(range(1_000_000, 1_000_008)) <= maps.begun  # some of validation's
    finally:
        maps.close()


def test_a_run_among_traffic_goes_on_exactly(maps, halfway):
    straight = begin(maps)
    go_on(straight)
    go_on(straight)
    resumed = begin(maps)
    resumed.restore(*load(halfway))
    go_on(resumed)
    arrays, meta = straight.state()
    again, same = resumed.state()
    assert same == meta
    for name, array in arrays.items():
        assert again[name].tobytes() == array.tobytes()
    for run in (straight, resumed):
        assert run.champion is None  # nobody drives far enough yet to be tried ...
        run.conclude()  # ... but at the end there is one
    assert resumed.champion.genome.tobytes() == straight.champion.genome.tobytes()
    assert resumed.champion.score == straight.champion.score
    latest = {genome.tobytes() for genome in straight.latest()}
    assert len(latest) == 2
    assert straight.champion.genome.tobytes() in latest


def test_what_ends_a_run_does_not_change_how_it_would_have_gone_on(maps, halfway):
    concluded, straight = begin(maps), begin(maps)
    for run in (concluded, straight):
        run.restore(*load(halfway))
    before = concluded.state()
    concluded.conclude()
    extended = begin(maps)
    extended.restore(*before)
    for run in (extended, straight):
        go_on(run)
    arrays, again = straight.state()[0], extended.state()[0]
    for name, array in arrays.items():
        assert again[name].tobytes() == array.tobytes()


def test_crashes_are_remembered_with_the_traffic_around_them(maps, halfway):
    arrays, _ = load(halfway)
    worlds = arrays["crash_worlds0"]
    assert len(worlds) == len(arrays["crashes0"]) > 0
    assert worlds.shape[1:] == (CROWD, FIELDS)
    assert (worlds[..., LANE] >= 0).any()
    evolution = begin(maps)
    evolution.restore(*load(halfway))
    episodes = evolution.curriculum.episodes(1)
    starts = evolution.curriculum.config.crash_starts
    remembered = {world.tobytes() for world in worlds}
    config = evolution.curriculum.config
    of_group = [world.tobytes() in remembered for world in episodes.worlds]
    assert of_group == ([False] * config.starts + [True] * starts) * config.groups
    assert len(episodes.worlds) == len(episodes.rows)


def test_each_group_meets_its_own_episodes_and_its_members_results_are_theirs(maps):
    """Who drives in the first generations, also beside validation, is told the same as somebody who drives alone."""
    evolution = begin(maps, dataclasses.replace(SETTINGS, population=50))
    config = evolution.curriculum.config = dataclasses.replace(evolution.curriculum.config, groups=3)
    for generation in range(2):
        if generation:  # half as many episodes again, and two are on trial
            go_on(evolution)
            evolution.trials.enter(evolution.genetic.parents[:2], 0)
        episodes = evolution.curriculum.episodes(generation)
        limits = evolution.curriculum.limits()
        e = len(episodes.rows) // config.groups
        assert e == config.starts + generation * config.crash_starts
        assert len({row.tobytes() for row in episodes.rows}) > 2 * config.groups
        results, lost = evolution._evaluate_all(episodes, limits)
        assert results.shape == (50, e)
        assert not lost.any()
        for member in (0, 1, 2, 17, 48, 49):
            g = member % config.groups
            own = Episodes(episodes.maps, episodes.rows[g * e : g * e + e], episodes.worlds[g * e : g * e + e])
            alone = evolution.drive("alone", evolution.genetic.genomes(np.array([member])), own, limits)
            assert alone.results[0].tobytes() == results[member].tobytes()
        assert len({row.tobytes() for row in results}) > 25
        evolution.genetic._asked = None
        assert not len(evolution.trials.first)


def test_champions_are_looked_for_every_second_generation(maps):
    evolution = begin(maps)
    evolution.curriculum.target = evolution.curriculum.config.validation_target
    tried = []
    for _ in range(4):
        go_on(evolution)
        tried.append(len(evolution.trials.first))
    assert tried[0] > 0
    assert tried[2] > 0
    assert tried[1] == tried[3] == 0


def test_the_parents_mean_is_on_trial_beside_the_best(maps):
    evolution = begin(maps)
    go_on(evolution)
    go_on(evolution)
    evolution.curriculum.target = evolution.curriculum.config.validation_target
    mean = evolution.genetic.mean()
    go_on(evolution)
    assert len(evolution.trials.first) == evolution.curriculum.config.contenders == 2
    assert evolution.trials.first[0].tobytes() == mean[0].tobytes()
    assert evolution.trials.first[1].tobytes() == evolution.elites[-1].tobytes()


def test_training_is_among_more_cars_than_validation(maps):
    """Twice as many as were asked for; champions are chosen, and measured, among those that were."""
    curriculum = begin(maps).curriculum
    for episodes in (curriculum.episodes(0), curriculum.race(0)):
        assert episodes.worlds.shape[1:] == (CROWD, FIELDS)
        assert (episodes.worlds[..., LANE] >= 0).mean() > 0.95
    there = curriculum.validation().worlds[..., LANE] >= 0
    assert there.shape[1] == CROWD  # it is driven beside training's
    assert (there.sum(axis=1) <= SETTINGS.traffic).all()
    assert there[:, : SETTINGS.traffic].mean() > 0.95


@pytest.mark.parametrize(
    "spoil",
    [lambda w: w[:-1], lambda w: w[:, :2], lambda w: w[..., :-1], lambda w: w.astype(np.float64), lambda w: w[0]],
)
def test_crash_worlds_that_do_not_fit_are_refused(maps, halfway, spoil):
    arrays, meta = load(halfway)
    arrays["crash_worlds0"] = spoil(arrays["crash_worlds0"])
    with pytest.raises(CheckpointError, match="does not belong to this run"):
        begin(maps).restore(arrays, meta)


@pytest.mark.parametrize(
    ("name", "field", "number"),
    [
        ("crash_worlds0", LANE, -2.0),
        ("crash_worlds0", LANE, 0.5),
        ("crash_worlds0", NEXT, -1.0),
        ("crash_worlds0", ALONG, -1.0),
        ("crash_worlds0", SPEED, 1e9),
        ("crash_worlds0", FIELDS - 1, np.nan),
        ("crashes0", 0, 16.0),
        ("crashes0", 0, -1.0),
        ("crashes0", 0, 0.5),
        ("crashes0", 1, np.inf),
    ],
)
def test_crashes_on_no_road_are_refused(maps, halfway, name, field, number):
    arrays, meta = load(halfway)
    there = arrays["crash_worlds0"][..., LANE] >= 0
    arrays[name] = arrays[name].copy()
    arrays[name][there if name == "crash_worlds0" else ..., field] = number
    with pytest.raises(CheckpointError, match="does not belong to this run") as error:
        begin(maps).restore(arrays, meta)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("field", "number"), [(LANE, 1e6), (NEXT, 1e6), (PAST, 1e6), (ALONG, 1e4)])
def test_a_crash_that_does_not_fit_its_map_is_refused_when_it_is_to_be_driven(maps, halfway, field, number):
    arrays, meta = load(halfway)
    arrays["crash_worlds0"] = arrays["crash_worlds0"].copy()
    arrays["crash_worlds0"][arrays["crash_worlds0"][..., LANE] >= 0, field] = number
    evolution = begin(maps)
    evolution.restore(arrays, meta)
    with pytest.raises(CrashError, match=r"a crash in the checkpoint does not fit map \d+: traffic's ") as error:
        evolution.step()
    assert "\n" not in str(error.value)


def test_a_checkpoint_of_another_traffic_is_refused(maps, halfway):
    with pytest.raises(CheckpointError, match="does not belong to this run"):
        begin(maps, dataclasses.replace(SETTINGS, traffic=4)).restore(*load(halfway))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("trials_first", lambda a: np.zeros((3, GENES), np.float32)),  # contenders are two
        ("trials_first", lambda a: np.zeros(GENES, np.float32)),
        ("trials_last", lambda a: np.zeros((2, GENES), np.float32)),
        ("trials_tried", lambda a: np.zeros(257, np.uint64)),
        ("trials_tried", lambda a: np.zeros(2, np.int64)),
        ("parents0", lambda a: np.zeros((11, GENES), np.float32)),  # 2 elites and 8
        ("parents0", lambda a: a[:2]),  # elites alone
        ("champion", lambda a: np.zeros(GENES, np.float32)),  # of which nothing is known
        ("trials", lambda m: [math.inf, 1]),
        ("trials", lambda m: [1]),
        ("generation", lambda m: math.inf),
        ("car_steps", lambda m: math.inf),
        ("populations", lambda m: [[3, m[0][1]]]),
        ("populations", lambda m: [[m[0][0], 5e-324]]),
        ("champion", lambda m: [0.5, 0.5, 100.0, 0]),  # of which there are no genes
        ("solved", lambda m: True),  # without a champion
    ],
)
def test_states_that_no_run_has_are_refused(maps, halfway, name, change):
    arrays, meta = load(halfway)
    part = meta if name in meta and (name != "champion" or isinstance(change(arrays[name]), list)) else arrays
    part[name] = change(part[name])
    with pytest.raises(CheckpointError, match="does not belong to this run") as error:
        begin(maps).restore(arrays, meta)
    assert "\n" not in str(error.value)


def run_folder(halfway, path, **changed):
    """A run that was stopped after the first of two generations."""
    run = RunFolder(path, SETTINGS)
    run.write_config()
    arrays, meta = load(halfway)
    meta |= {"digest": run.digest(), "tracking": {"uri": "sqlite:///m.db", "run_id": None, "key": "k"}, **changed}
    save(path / "checkpoint.npz", arrays, meta)
    return path


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("generation", math.inf),
        ("car_steps", None),
        ("solved", "no"),
        ("tracking", []),
        ("tracking", {"uri": 1, "run_id": None, "key": "k"}),
    ],
)
def test_a_checkpoint_with_other_parts_is_refused_in_one_line(halfway, tmp_path, name, value):
    path = run_folder(halfway, tmp_path, **{name: value})
    with pytest.raises(RunError, match="not those of a run") as error:
        open_run(path)
    assert "\n" not in str(error.value)


class InterruptedOnce(Session):
    """Ctrl-C comes while its first save is on its way."""

    interrupted = False

    def save(self) -> None:
        if not self.interrupted:
            self.interrupted = True
            raise KeyboardInterrupt
        super().save()


def go_on_in(path, maps, session=Session):
    """A stopped run, to be continued from its folder, with a short validation."""
    run = open_run(path)
    tracker = make_tracker(run, f"sqlite:///{path}/m.db", "test")
    resumed = session(run, SerialPool(maps.build), maps, tracker, time.perf_counter())
    curriculum = resumed.learning.curriculum
    curriculum.config = dataclasses.replace(curriculum.config, validation=8, first_validation=4, contenders=2)
    return resumed


def test_an_interrupt_while_the_last_generation_is_saved_does_not_lose_it(maps, halfway, tmp_path):
    resumed = go_on_in(run_folder(halfway, tmp_path), maps, InterruptedOnce)
    with pytest.raises(KeyboardInterrupt):
        resumed.learn()
    assert resumed.interrupted
    assert load(tmp_path / "checkpoint.npz")[1]["generation"] == 2
    assert len(read_history(tmp_path / "history.csv")) == 2


def test_a_history_without_its_last_row_is_mended(maps, halfway, tmp_path):
    """As a kill between the last checkpoint and its history leaves it, when nothing is left to evolve."""
    resumed = go_on_in(run_folder(halfway, tmp_path), maps)
    resumed.learn()
    whole = (tmp_path / "history.csv").read_bytes()
    (tmp_path / "history.csv").write_bytes(b"".join(whole.splitlines(keepends=True)[:-1]))
    go_on_in(tmp_path, maps).learn()
    assert (tmp_path / "history.csv").read_bytes() == whole


class Losing(SerialPool):
    """Loses the members in some rows of some calls, as where each of those killed its workers."""

    def __init__(self, maps, **rows):
        super().__init__(maps.build)
        self.rows = rows  # by the call's kind: evolve, race or validate
        self.genomes = np.zeros((0, GENES), dtype=np.float32)  # of who was lost

    def evaluate(self, task, recipes, on_progress=None, asked=None, meanwhile=None):
        outcome = super().evaluate(task, recipes, on_progress, asked, meanwhile)
        kind = "race" if task.rewind else "evolve" if recipes["seed"].any() else "validate"
        rows = np.arange(len(recipes))[self.rows.get(kind, slice(0, 0))]
        outcome.lost[rows] = True
        outcome.results[rows] = np.zeros((), outcome.results.dtype)
        outcome.warnings = [f"member {row} is lost" for row in rows]
        lost = breed(task.parents, recipes[rows], task.key, PolicySpec.parse(task.policy), task.mutation)
        self.genomes = np.concatenate([self.genomes, lost])
        return outcome


def losing(maps, **rows):
    evolution = begin(maps)
    evolution.pool = Losing(maps, **rows)
    evolution.score = lambda results, target: -results["distance"].sum(axis=1)  # who drives nowhere is the best
    evolution.warn = lambda text: None
    return evolution


def test_who_was_lost_cannot_win_whatever_the_fitness(maps):
    """Neither in the generation nor in its race: not an elite, not a parent, not tried."""
    evolution = losing(maps, evolve=slice(3, 24), race=slice(0, 2))
    go_on(evolution)
    kept = np.concatenate([evolution.genetic.parents, evolution.elites, evolution.trials.first])
    assert len(evolution.pool.genomes) == 23 == evolution.lost_chunks
    assert not {genome.tobytes() for genome in evolution.pool.genomes} & {genome.tobytes() for genome in kept}
    assert np.isfinite(list(evolution.history[0].values())).all()
    arrays, meta = evolution.state()
    resumed = begin(maps)
    resumed.restore(arrays, meta)
    assert resumed.lost_chunks == 23


@pytest.mark.parametrize(("kind", "stage"), [("evolve", "evolve"), ("race", "race")])
def test_where_all_are_lost_the_run_stops(maps, kind, stage):
    with pytest.raises(PoolError, match=rf"^{stage}: nothing is left, all \d+ that were tried killed their workers"):
        losing(maps, **{kind: slice(0, None)}).step()


def test_who_was_lost_in_validation_is_no_champion(maps):
    evolution = losing(maps, validate=slice(0, None))
    go_on(evolution)
    with pytest.raises(PoolError, match="there is no champion: each network that was to be validated killed"):
        evolution.conclude()
    assert evolution.champion is None
