"""Saved whole or not at all; loaded as saved or refused with a CheckpointError."""

import errno
import json
import os
import resource
import zipfile
from hashlib import sha256

import numpy as np
import pytest

from cluster.store.checkpoint import CheckpointError, load, save

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
