"""Files of a run: saved whole or not at all, loaded as saved or refused; what a kill leaves, and the end."""

import errno
import json
import os
import resource
import zipfile
from dataclasses import replace
from hashlib import sha256

import numpy as np
import pytest
from commands import rows
from learners import session

from cluster.learn.evolution import Evolution
from cluster.settings import EvolveSettings
from cluster.store import checkpoint
from cluster.store.checkpoint import CHECKPOINT, ELITES, STEPS, SUMMARY, CheckpointError, load, save
from cluster.store.folder import is_finished, new_run, open_run
from cluster.store.steps import Steps, read_elites
from gridsim.errors import GridSimError

META = {"generation": 7, "history": [{"fitness/best": 0.1 + 0.2, "mean": float("-inf")}], "name": "Straße"}
RECIPE = np.dtype([("a", "<u2"), ("b", "<u2"), ("seed", "<u4")])
ARRAYS: dict[str, np.ndarray] = {
    "genome": np.random.default_rng(1).normal(size=31).astype(np.float32),
    "recipes": np.array([(1, 2, 3), (4, 5, 4_000_000_000)], RECIPE),
    "turned": np.arange(6.0).reshape(2, 3).T,
    "none": np.zeros((0, 4)),
    "flags": np.array(True),
}


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "checkpoint.npz"
    save(path, ARRAYS, META)
    return path


def refused(path):
    """Load `path`, which has to be refused with one line that names it; returns the line."""
    with pytest.raises(CheckpointError) as caught:
        load(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert len(text) < len(str(path)) + 200
    return text


def test_numpy_reads_it_too(saved):
    with np.load(saved, allow_pickle=False) as arrays:
        assert set(arrays.files) == {*ARRAYS, "meta"}
        np.testing.assert_array_equal(arrays["genome"], ARRAYS["genome"])
        assert json.loads(arrays["meta"].tobytes())["meta"] == META
    save(saved.with_name("again.npz"), ARRAYS, META)
    assert saved.with_name("again.npz").read_bytes() == saved.read_bytes()


def test_what_is_saved_comes_back_bit_by_bit_as_numba_wants_it(saved):
    """It would compile a second time for arrays that are not contiguous, aligned and writable."""
    loaded, meta = load(saved)
    assert meta == META
    for name, array in ARRAYS.items():
        assert (loaded[name].shape, loaded[name].dtype) == (array.shape, array.dtype)
        assert loaded[name].tobytes() == array.tobytes()
        assert loaded[name].flags.carray


def test_truncated_or_edited_at_any_byte(saved):
    content = saved.read_bytes()
    for place in range(len(content)):
        saved.write_bytes(content[:place])
        refused(saved)
        flip = (0x01, 0x80, 0xFF)[place % 3]
        saved.write_bytes(content[:place] + bytes([content[place] ^ flip]) + content[place + 1 :])
        refused(saved)


def test_what_is_no_checkpoint(tmp_path):
    assert "No such file" in refused(tmp_path / "missing" / "checkpoint.npz")
    assert "Is a directory" in refused(tmp_path)
    (tmp_path / "text").write_text("generation,fitness\n")
    assert "not a GridSim file" in refused(tmp_path / "text")
    np.savez(tmp_path / "foreign.npz", genome=np.zeros(3))
    assert "not a GridSim file" in refused(tmp_path / "foreign.npz")


def test_a_pickle_is_refused_and_not_run(tmp_path):
    """Also with the checksum that makes it look like one of ours."""

    class Payload:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "was-run"),)

    path, payload = tmp_path / "a.npz", np.array([Payload()], object)
    np.savez(path, x=payload)
    with zipfile.ZipFile(path, "a") as archive:
        archive.comment = b"sha256:" + b"0" * 64
    body = path.read_bytes()[:-64]
    path.write_bytes(body + sha256(body).hexdigest().encode())
    assert "not a GridSim file" in refused(path)
    assert not (tmp_path / "was-run").exists()


def test_a_full_disk_keeps_the_previous_file(tmp_path):
    path = tmp_path / "checkpoint.npz"
    save(path, {"x": np.arange(1000)}, {"generation": 1})
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(CheckpointError, match=rf"cannot be written: {os.strerror(errno.EFBIG)}$"):
            save(path, {"x": np.zeros(300_000, np.uint8)}, {"generation": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == [path.name]


# --- While a run goes on ---------------------------------------------------------------------------------------------

SETTINGS = EvolveSettings("curved", policy="mlp:4", population=16, generations=3, seed=3)
CLOCK = ("wall_s", "car_steps_per_s")
EAGER = {"promising": 0.0, "latest": 0, "validation_share": 1.0}  # a candidate is validated in every generation


class Killed(BaseException):
    """Nothing of the process is left."""


def found(session):
    """All that a run has found, but for the clock."""
    arrays, meta = session.learning.state()
    history = [{name: row[name] for name in Evolution.columns if name not in CLOCK} for row in session.learning.history]
    state = {name: array.tobytes() for name, array in arrays.items()}
    return history, state, meta, read_elites(session.run.path, SETTINGS.policy).tobytes()


@pytest.fixture(scope="module")
def straight(curved, tmp_path_factory):
    """A run that nothing happened to."""
    made = session(new_run(tmp_path_factory.mktemp("runs"), "straight", SETTINGS), curved, **EAGER)
    made.learn()
    return made


@pytest.fixture
def ended(curved, tmp_path):
    """A run of which one generation is left out."""
    made = session(new_run(tmp_path, "ended", replace(SETTINGS, generations=2)), curved, **EAGER)
    made.learn()
    return made


@pytest.mark.parametrize("counted", [False, True], ids=["before the checkpoint", "after it"])
def test_a_kill_behind_the_appended_steps_changes_nothing(curved, straight, tmp_path, monkeypatch, counted):
    monkeypatch.setattr(Evolution, "save_every_s", 0.0)
    killed = session(new_run(tmp_path, "killed", SETTINGS), curved, **EAGER)
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
    resumed = session(open_run(path), curved, **EAGER)
    assert resumed.learning.steps == len(rows(path)) == 1 + counted
    resumed.learn()
    assert found(resumed) == found(straight)
    assert (path / STEPS).stat().st_size == whole
    assert len(rows(path)) == 3


def test_a_finished_run_can_be_extended_and_is_then_no_longer_finished(curved, ended, straight):
    path = ended.run.path
    assert not is_finished(open_run(path)), "its champion is not measured"
    ended.finish()
    assert is_finished(open_run(path))
    assert load(path / ELITES)[0]["genomes"].tobytes() == read_elites(path, SETTINGS.policy).tobytes()
    run = open_run(path)
    run.settings = SETTINGS
    assert not is_finished(run)
    longer = session(run, curved, **EAGER)
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


def test_steps_that_are_missing_or_cannot_be_written_are_told_in_one_line(curved, ended):
    path = ended.run.path
    steps = path / STEPS
    steps.write_bytes(steps.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=r"^[^\n]*steps.bin: damaged or edited[^\n]*$"):
        session(open_run(path), curved)
    steps.unlink()
    with pytest.raises(CheckpointError, match=r"steps.bin: cannot be read: No such file or directory$"):
        read_elites(path, SETTINGS.policy)
    with pytest.raises(CheckpointError, match=r"cannot be written: No such file or directory$"):
        Steps(path / "gone", "generation", ["x", "y"], 3).append(np.zeros((1, 2)), [np.zeros(3)])


def test_a_checkpoint_without_a_part_is_refused_in_one_line(curved, ended):
    path = ended.run.path / CHECKPOINT
    arrays, meta = load(path)
    del arrays["search_path"]
    save(path, arrays, meta)
    with pytest.raises(GridSimError, match=r"^[^\n]*another version[^\n]*$"):
        session(open_run(ended.run.path), curved)
