"""The files of a run while it goes on: what a kill leaves, what a checkpoint costs, what is left when the run ends."""

from dataclasses import replace

import numpy as np
import pytest
from commands import rows
from learners import session

from cluster.learn.evolution import Evolution
from cluster.learn.maps import Maps
from cluster.settings import EvolveSettings
from cluster.store import checkpoint
from cluster.store.checkpoint import CHECKPOINT, ELITES, STEPS, SUMMARY, CheckpointError, load, save
from cluster.store.folder import is_finished, new_run, open_run
from cluster.store.steps import Steps, read_elites
from gridsim.config import SimConfig
from gridsim.errors import GridSimError

SETTINGS = EvolveSettings("curved", policy="mlp:4", population=16, generations=3, seed=3)
CLOCK = ("wall_s", "car_steps_per_s")
EAGER = {"promising": 0.0, "latest": 0, "validation_share": 1.0}  # a candidate is validated in every generation


class Killed(BaseException):
    """Nothing of the process is left."""


@pytest.fixture(scope="module")
def maps():
    kept = Maps("curved", SimConfig())
    yield kept
    kept.close()


def found(session):
    """All that a run has found, but for the clock."""
    arrays, meta = session.learning.state()
    history = [{name: row[name] for name in Evolution.columns if name not in CLOCK} for row in session.learning.history]
    state = {name: array.tobytes() for name, array in arrays.items()}
    return history, state, meta, read_elites(session.run.path, SETTINGS.policy).tobytes()


@pytest.fixture(scope="module")
def straight(maps, tmp_path_factory):
    """A run that nothing happened to."""
    made = session(new_run(tmp_path_factory.mktemp("runs"), "straight", SETTINGS), maps, **EAGER)
    made.learn()
    return made


@pytest.fixture
def ended(maps, tmp_path):
    """A run of which one generation is left out."""
    made = session(new_run(tmp_path, "ended", replace(SETTINGS, generations=2)), maps, **EAGER)
    made.learn()
    return made


@pytest.mark.parametrize("counted", [False, True], ids=["before the checkpoint", "after it"])
def test_a_kill_behind_the_appended_steps_changes_nothing(maps, straight, tmp_path, monkeypatch, counted):
    monkeypatch.setattr(Evolution, "save_every_s", 0.0)
    killed = session(new_run(tmp_path, "killed", SETTINGS), maps, **EAGER)
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
    with open(path / STEPS, "ab") as file:
        file.write(b"what was written of the next ones" * 1000)
    assert len(read_elites(path, SETTINGS.policy)) == 1 + counted
    assert len(rows(path)) == 1
    resumed = session(open_run(path), maps, **EAGER)
    assert resumed.learning.steps == len(rows(path)) == 1 + counted
    resumed.learn()
    assert found(resumed) == found(straight)
    assert (path / STEPS).stat().st_size == whole
    assert len(rows(path)) == 3


def test_a_finished_run_can_be_extended_and_is_then_no_longer_finished(maps, ended, straight):
    path = ended.run.path
    assert not is_finished(open_run(path)), "its champion is not measured"
    ended.finish()
    assert is_finished(open_run(path))
    assert load(path / ELITES)[0]["genomes"].tobytes() == read_elites(path, SETTINGS.policy).tobytes()
    run = open_run(path)
    run.settings = SETTINGS
    assert not is_finished(run)
    longer = session(run, maps, **EAGER)
    longer.learn()
    assert found(longer) == found(straight)
    assert not (path / SUMMARY).exists(), "it is of the shorter run"


def test_a_champion_has_cost_what_was_spent_up_to_its_step(ended):
    learning = ended.learning
    learning.solved = True  # so that the last candidate does not take its place
    ended.finish()
    own, last = learning.history[learning.champion.step], learning.history[-1]
    for name in ("car_steps", "wall_s"):
        assert ended.summary[f"best_{name}"] == own[name]
    assert ended.summary["car_steps"] == last["car_steps"], "drives that measure the champion do not count"


def test_steps_that_are_missing_or_cannot_be_written_are_told_in_one_line(maps, ended):
    path = ended.run.path
    steps = path / STEPS
    steps.write_bytes(steps.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=r"^[^\n]*steps.bin: damaged or edited[^\n]*$"):
        session(open_run(path), maps)
    steps.unlink()
    with pytest.raises(CheckpointError, match=r"steps.bin: cannot be read: No such file or directory$"):
        read_elites(path, SETTINGS.policy)
    with pytest.raises(CheckpointError, match=r"cannot be written: No such file or directory$"):
        Steps(path / "gone", "generation", ["x", "y"], 3).append(np.zeros((1, 2)), [np.zeros(3)])


def test_a_checkpoint_without_a_part_is_refused_in_one_line(maps, ended):
    path = ended.run.path / CHECKPOINT
    arrays, meta = load(path)
    del arrays["search_path"]
    save(path, arrays, meta)
    with pytest.raises(GridSimError, match=r"^[^\n]*another version[^\n]*$"):
        session(open_run(ended.run.path), maps)
