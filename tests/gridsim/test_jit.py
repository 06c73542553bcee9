"""Compiled kernels: never stale after an edit anywhere."""

import json
import re
import shutil
import tempfile
from pathlib import Path

import pytest
from commands import finish

from gridsim import jit

# `collides` is in one file, `clearance`, which it calls, and the constant in there are in another.
CALLER = """
import json
import numpy as np
from gridsim import jit
from gridsim.car import ego
from gridsim.maps import roads
from gridsim.config import SimConfig, constants
u, f = np.uint32, np.float32
byte = 150  # of clearance at every node: 2.69 m above the floor of -2 m
word = byte * 0x01010101
road = roads.Road(roads.freeze(np.full(64, word, dtype=u)), u(8), u(8), f(4), f(4), f(5), f(12), f(1))
hit = ego.collides(road, constants(SimConfig()), f(1), f(1), f(1), f(0))
hits = sum(ego.collides.stats.cache_hits.values())
print(json.dumps({"file": roads.__file__, "folder": str(jit.CACHE_FOLDER), "hit": bool(hit), "from_cache": hits}))
"""


@pytest.fixture
def copy(root, tmp_path):
    """A copy of the packages that hold kernels, to be edited."""
    folder = tmp_path / "copy"
    for package in jit.KERNEL_PACKAGES:
        shutil.copytree(root / package, folder / package, ignore=shutil.ignore_patterns("__pycache__", "*.nb?"))
    return folder


def python(code, folder, cache):
    """Run a script in a process of its own; its last line is JSON."""
    done = finish("python", "-c", code, cwd=folder, GRIDSIM_CACHE_DIR=str(cache), PYTHONDONTWRITEBYTECODE="1")
    return json.loads(done.stdout.splitlines()[-1])


def test_an_edited_kernel_is_compiled_anew_and_a_copy_elsewhere_is_not(copy, tmp_path):
    cache = tmp_path / "cache"
    first = python(CALLER, copy, cache)
    assert Path(first["file"]).is_relative_to(copy)
    assert Path(first["folder"]).is_relative_to(cache)
    assert (first["hit"], first["from_cache"]) == (False, 0)

    elsewhere = tmp_path / "shipped" / "unpacked"
    shutil.copytree(copy, elsewhere)
    again = python(CALLER, elsewhere, cache)
    assert Path(again["file"]).is_relative_to(elsewhere)
    assert again["folder"] == first["folder"]
    assert (again["hit"], again["from_cache"]) == (False, 1)

    roads = copy / "gridsim" / "maps" / "roads.py"
    text, edits = re.subn(r"(?m)^FIELD_FLOOR = -2\.0\b", "FIELD_FLOOR = -9.0", roads.read_text())
    assert edits == 1
    roads.write_text(text)
    edited = python(CALLER, copy, cache)
    assert edited["folder"] != first["folder"]
    assert (edited["hit"], edited["from_cache"]) == (True, 0)


def test_the_cache_folder_is_the_users_choice_or_temporary(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert jit.cache_folder().is_relative_to(tmp_path / "xdg")
    monkeypatch.setenv("GRIDSIM_CACHE_DIR", str(tmp_path / "mine"))
    assert jit.cache_folder().is_relative_to(tmp_path / "mine")
    assert jit.cache_folder().name.endswith(jit.kernel_digest())
    (tmp_path / "file").touch()  # nothing can be written below it
    monkeypatch.setenv("GRIDSIM_CACHE_DIR", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    assert jit.cache_folder().is_relative_to(tmp_path / "temporary")
    assert jit.cache_folder().is_dir()
