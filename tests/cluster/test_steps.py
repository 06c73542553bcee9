"""The file of a run's steps: what a kill leaves, what a checkpoint costs, what is left when the run ends."""

from dataclasses import replace

import numpy as np
import pytest

from cluster import run as train
from cluster.learn.evolution import Evolution
from cluster.learn.learning import Maps
from cluster.settings import EvolveSettings
from cluster.store import checkpoint, steps
from cluster.store.checkpoint import CHAMPION, CHECKPOINT, STEPS, CheckpointError, load, save
from cluster.store.folder import ELITES, is_finished, new_run, open_run
from cluster.store.steps import read_elites
from cluster.tracking.address import check_uri
from cluster.workers.pool import SerialPool
from gridsim.config import SimConfig

SETTINGS = EvolveSettings("curved", policy="mlp:4", population=16, generations=3, seed=3)
CLOCK = ("wall_s", "car_steps_per_s")


class Killed(BaseException):
    """Nothing of the process is left."""


@pytest.fixture(autouse=True)
def _without_mlflow(monkeypatch):
    monkeypatch.setattr(train, "log_rows", lambda *_: None)


@pytest.fixture(scope="module")
def maps():
    kept = Maps("curved", SimConfig())
    yield kept
    kept.close()


def session(run, maps, uri=""):
    """A run that validates a candidate in every generation, in few episodes."""
    run.path.mkdir(parents=True, exist_ok=True)
    run.write_config()
    made = train.Session(run, SerialPool(maps.build), maps, uri or f"sqlite:///{run.path.parent}/m.db", "test")
    curriculum = made.learning.curriculum
    curriculum.config = replace(curriculum.config, validation=8, promising=0.0, latest=0, validation_share=1.0)
    return made


def found(session):
    """All that a run has found, but for the clock."""
    arrays, meta = session.learning.state()
    rows = [{name: row[name] for name in Evolution.columns if name not in CLOCK} for row in session.learning.history]
    state = {name: array.tobytes() for name, array in arrays.items() if name != "history"}
    return rows, state, meta, read_elites(session.run.path, SETTINGS.policy).tobytes()


@pytest.fixture
def straight(maps, tmp_path):
    """A run that nothing happened to."""
    made = session(new_run(tmp_path, "straight", SETTINGS), maps)
    made.learn()
    return made


@pytest.mark.parametrize("counted", [False, True], ids=["before the checkpoint", "after it"])
def test_a_kill_behind_the_appended_steps_changes_nothing(maps, straight, tmp_path, monkeypatch, counted):
    monkeypatch.setattr(Evolution, "save_every_s", 0.0)
    killed = session(new_run(tmp_path, "killed", SETTINGS), maps)
    path, whole = killed.run.path, (straight.run.path / STEPS).stat().st_size

    def kill_at_the_second(place, arrays, meta):
        if meta["steps"] == 1 or counted:
            save(place, arrays, meta)
        if meta["steps"] == 2:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", kill_at_the_second)
        with pytest.raises(Killed):
            killed.learn()
    assert (path / STEPS).stat().st_size == whole / 3 * 2  # also where it was tried a second time
    with open(path / STEPS, "ab") as file:
        file.write(b"what was written of the next ones" * 1000)
    assert len(read_elites(path, SETTINGS.policy)) == 1 + counted
    resumed = session(open_run(path), maps)
    assert resumed.learning.steps == 1 + counted
    resumed.learn()
    assert found(resumed) == found(straight)
    assert (path / STEPS).stat().st_size == whole


def test_a_checkpoint_is_as_small_after_many_steps(maps, tmp_path):
    settings = replace(SETTINGS, policy="mlp:64,64", generations=400)
    made = session(new_run(tmp_path, "long", settings), maps)
    learning, genome = made.learning, np.zeros(made.learning.spec.size, dtype=np.float32)
    sizes = []

    def step():
        if learning.steps in (20, 399):
            made.save()
            sizes.append((made.run.path / CHECKPOINT).stat().st_size)
            assert not learning.elites, "those that are saved are not kept in memory"
        learning.elites[learning.steps] = genome + learning.steps
        learning.search.generation += 1
        learning.history.append(dict.fromkeys(Evolution.columns, 0.1 + learning.steps))
        return learning.history[-1]

    learning.step = step
    made.learn()
    assert sizes[1] < sizes[0] + 100  # some numbers have more digits
    assert read_elites(made.run.path, "mlp:64,64")[:, 0].tolist() == list(range(400))
    assert (made.run.path / "history.csv").read_text().splitlines()[-1].startswith("399,399.1,")


def test_no_file_holds_the_password_of_mlflow(maps, tmp_path, monkeypatch):
    made = session(new_run(tmp_path, "secret", SETTINGS), maps, "http://someone:s3cret@127.0.0.1:1")
    made.learn()
    saved = load(made.run.path / CHECKPOINT)[1]["tracking"]["uri"]
    assert saved == "http://127.0.0.1:1"
    assert check_uri(begun_with=saved) == saved
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://someone:s3cret@127.0.0.1:1/")
    assert check_uri(begun_with=saved) == "http://someone:s3cret@127.0.0.1:1"
    assert check_uri(begun_with="http://127.0.0.1:2") == "http://127.0.0.1:2"


def test_an_ended_run_has_its_elites_once_and_can_be_extended(maps, straight, tmp_path):
    ended = session(new_run(tmp_path, "ended", replace(SETTINGS, generations=2)), maps)
    path = ended.run.path
    ended.learn()
    save(path / ELITES, {"genomes": read_elites(path, SETTINGS.policy)}, {})
    ended._conclude()
    assert not (path / STEPS).exists()
    assert len(read_elites(path, SETTINGS.policy)) == len(load(path / CHECKPOINT)[0]["history"]) == 2
    assert not is_finished(open_run(path)), "it has no champion.npz"
    (path / CHAMPION).touch()
    assert is_finished(open_run(path))
    run = open_run(path)
    run.settings = SETTINGS
    longer = session(run, maps)
    longer.learn()
    assert found(longer) == found(straight)
    assert not is_finished(open_run(path)), "what is made at the end is of the shorter run"


def test_a_champion_has_cost_what_was_spent_up_to_its_step(straight, monkeypatch):
    learning = straight.learning
    learning.solved = True  # so that the last candidate does not take its place
    monkeypatch.setattr(straight.tracker, "log_model", lambda *_: None)
    monkeypatch.setattr(train, "log_end", lambda *_: None)
    straight.finish(0)
    own, last = learning.history[learning.champion.step], learning.history[-1]
    for name in ("car_steps", "wall_s"):
        assert straight.summary[f"best_{name}"] == own[name] < last[name]
    assert straight.summary["car_steps"] == last["car_steps"], "drives that measure the champion do not count"


def test_elites_that_are_not_those_of_an_ended_run_are_refused(maps, straight):
    path = straight.run.path
    save(path / ELITES, {"genomes": read_elites(path, SETTINGS.policy) + np.float32(1.0)}, {})
    straight._conclude()
    with pytest.raises(CheckpointError, match="do not belong together"):
        session(open_run(path), maps)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[::-1]), "steps.part: damaged or edited"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "steps.part: damaged or edited"),
        (lambda path: path.unlink(), "steps.part: cannot be read: No such file|elites.npz: no such file"),
    ],
)
def test_damaged_steps_are_refused_in_one_line(maps, straight, damage, said):
    path = straight.run.path
    damage(path / STEPS)
    for use in (lambda: session(open_run(path), maps), lambda: read_elites(path, SETTINGS.policy)):
        with pytest.raises(CheckpointError, match=said) as error:
            use()
        assert "\n" not in str(error.value)


def test_steps_that_cannot_be_written_are_told_in_one_line(tmp_path):
    new = steps.records(np.zeros((1, 2)), np.zeros((1, 3), dtype=np.float32))
    with pytest.raises(CheckpointError, match=r"steps.part: cannot be written: No such file or directory$"):
        steps.append(tmp_path / "gone" / STEPS, 0, new)
