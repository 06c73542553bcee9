"""Compiled kernels: never stale after an edit anywhere, read only from folders that are ours, and not needed to run."""

import json
import os
import pickle
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from commands import finish

from gridsim import jit
from gridsim.cache import cache_folder

# `collides` is in one file, `clearance`, which it calls, and the constant in there are in another.
CALLER = """
import json
import numpy as np
from gridsim import jit
from gridsim import collision
from gridsim.maps import roads
from gridsim.config import SimConfig, constants
u, f = np.uint32, np.float32
byte = 150  # of clearance at every node: 2.69 m above the floor of -2 m
word = byte * 0x01010101
road = roads.Road(jit.freeze(np.full(64, word, dtype=u)), u(8), u(8), f(4), f(4), f(5), f(12), f(1), f(1), f(1), f(1))
hit = collision.collides(road, constants(SimConfig()), f(1), f(1), f(1), f(0))
hits = sum(collision.collides.for_python.stats.cache_hits.values())
print(json.dumps({"file": roads.__file__, "folder": str(jit.CACHE_FOLDER), "hit": bool(hit), "from_cache": hits}))
"""


# A kernel that compiles at once.
SMALL = """
import json
from gridsim import jit
@jit.njit
def twice(x):
    return 2 * x
assert twice(21) == 42
hits = sum(twice.stats.cache_hits.values())
print(json.dumps({"folder": str(jit.CACHE_FOLDER), "from_cache": hits}))
"""


@pytest.fixture
def small(tmp_path):
    """Run `SMALL` with a cache folder; `before` comes before it."""

    def run(cache, errors=r"", before="", **env):
        (tmp_path / "small.py").write_text(before + SMALL)
        done = finish("python", "small.py", cwd=tmp_path, GRIDSIM_CACHE_DIR=str(cache), **env)
        assert re.fullmatch(errors, done.stderr), done.stderr
        return json.loads(done.stdout)

    return run


def test_an_edited_kernel_is_compiled_anew_and_a_copy_elsewhere_is_not(root, tmp_path):
    copy, without = tmp_path / "copy", shutil.ignore_patterns("__pycache__", "*.nb?")
    for package in jit.KERNEL_PACKAGES:
        shutil.copytree(root / package, copy / package, ignore=without)
    cache, said = tmp_path / "cache", {"PYTHONDONTWRITEBYTECODE": "1", "GRIDSIM_CACHE_DIR": str(tmp_path / "cache")}

    def call(folder):
        return json.loads(finish("python", "-c", CALLER, cwd=folder, **said).stdout)

    first = call(copy)
    assert Path(first["file"]).is_relative_to(copy)
    assert Path(first["folder"]).is_relative_to(cache)
    assert (first["hit"], first["from_cache"]) == (False, 0)

    elsewhere = tmp_path / "shipped" / "unpacked"
    shutil.copytree(copy, elsewhere)
    again = call(elsewhere)
    assert Path(again["file"]).is_relative_to(elsewhere)
    assert again["folder"] == first["folder"]
    assert (again["hit"], again["from_cache"]) == (False, 1)

    roads = copy / "gridsim" / "maps" / "roads.py"
    text, edits = re.subn(r"(?m)^FIELD_FLOOR = -2\.0\b", "FIELD_FLOOR = -9.0", roads.read_text())
    assert edits == 1
    roads.write_text(text)
    edited = call(copy)
    assert edited["folder"] != first["folder"]
    assert (edited["hit"], edited["from_cache"]) == (True, 0)


# --- what kernels inline


def _product_less(x, y, by=jit.ONE):
    return x * y - by


@pytest.mark.parametrize("kind", [jit.leaf, jit.exact])
def test_python_gets_from_an_inlined_kernel_what_kernels_get(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    x, y = np.random.default_rng(0).uniform(1.0, 2.0, (2, 1000)).astype(np.float32)
    for _ in range(2):  # compiled, and from the cache
        inlined: Any = kind(_product_less)
        called: Any = kind(_product_less)

        @numba.njit
        def kernel(x, y, inlined=inlined):
            return inlined(x, y)

        by_python = [called(*each) for each in zip(x, y, strict=True)]
        in_kernel = [kernel(*each) for each in zip(x, y, strict=True)]
        assert by_python == in_kernel == [inlined(*each) for each in zip(x, y, strict=True)]
        # A leaf may compute x * y - by with one rounding. `exact` rounds twice, as NumPy does.
        assert (by_python == [_product_less(*each) for each in zip(x, y, strict=True)]) == (kind is jit.exact)


# --- which folder


@pytest.fixture
def places(tmp_path, monkeypatch):
    """The user's cache folder, and the one in the temporary folder, neither of which is there yet."""
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("GRIDSIM_CACHE_DIR", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / "home/.cache/gridsim", tmp_path / f"gridsim-{os.geteuid()}/gridsim"


def test_the_cache_folder_is_the_users_choice_or_temporary(places, tmp_path, monkeypatch):
    users, temporary = places
    assert jit.CACHE_FOLDER.name == f"kernels-{jit.kernel_digest()}"
    assert cache_folder("k") == users / "k"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder("k") == tmp_path / "xdg/gridsim/k"
    monkeypatch.setenv("GRIDSIM_CACHE_DIR", str(tmp_path / "mine"))
    assert cache_folder("k") == tmp_path / "mine/gridsim/k"
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o700
    (tmp_path / "file").touch()  # nothing can be written below it
    monkeypatch.setenv("GRIDSIM_CACHE_DIR", str(tmp_path / "file"))
    said = rf"^[^\n]*{tmp_path}/file: it is a link or a file[^\n]*GRIDSIM_CACHE_DIR[^\n]*$"
    with pytest.warns(UserWarning, match=said):
        assert cache_folder("k") == temporary / "k"
    assert cache_folder("k") == temporary / "k"  # of a child process, without another warning


@pytest.mark.parametrize("fault", ["no home", "a link", "others can write", "others can replace"])
def test_a_folder_that_others_can_change_or_that_cannot_be_made_is_not_used(fault, places, monkeypatch):
    users, temporary = places
    if fault == "no home":  # as for a user id that no list of users has
        monkeypatch.delenv("HOME")
        monkeypatch.setattr("pwd.getpwuid", lambda user: {}[user])
    elif fault == "a link":
        for folder in (users, users.parent / "other"):
            folder.mkdir(parents=True)
        (users / "k").symlink_to(users.parent / "other")
    else:
        (users / "k").mkdir(parents=True)
        (users / "k" if fault == "others can write" else users).chmod(0o777)
    assert cache_folder("k") == temporary / "k"
    assert not [*users.glob("k/*")]


@pytest.mark.e2e
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to make a folder of another user")
def test_what_another_user_has_put_into_the_temporary_folder_is_never_run(small, tmp_path):
    cache, temporary, marker = tmp_path / "cache", tmp_path / "tmp", tmp_path / "executed"
    small(cache)
    planted = temporary / f"gridsim-{os.geteuid()}"
    for folder in (planted, planted / "gridsim"):  # where it has been, and where it is now
        shutil.copytree(cache / "gridsim", folder)
    for index in planted.rglob("*.nbi"):
        index.write_bytes(pickle.dumps(_Touch(marker)))
    for path in (planted, *planted.rglob("*")):
        os.chown(path, 65534, 65534)
    (tmp_path / "file").touch()
    said = r"[^\n]*: UserWarning: kernels are compiled anew each time[^\n]*belongs to another user[^\n]*\n[^\n]*\n"
    ours = small(tmp_path / "file", said, TMPDIR=str(temporary))
    assert not marker.exists()
    assert Path(ours["folder"]).is_relative_to(temporary)
    assert [path.name for path in temporary.iterdir()] == [planted.name], "ours is removed in the end"


class _Touch:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


# --- without a cache


def _twice(x):
    return 2 * x


@pytest.mark.parametrize("files", ["*.nbi", "*.nbc"])
def test_a_damaged_cache_is_compiled_anew(tmp_path, monkeypatch, files):
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)

    def found():
        """Whether a new process would find it in the cache."""
        kernel: Any = jit.njit(_twice)
        assert kernel(21) == 42
        return bool(kernel.stats.cache_hits)

    assert [found(), found()] == [False, True]
    for damage in (lambda data: b"", lambda data: data[: len(data) // 2], lambda data: bytes(len(data))):
        (path,) = tmp_path.rglob(files)
        path.write_bytes(damage(path.read_bytes()))
        assert [found(), found()] == [False, True]


@pytest.mark.e2e
def test_on_a_full_disk_kernels_are_compiled_and_not_kept(small, tmp_path):
    cache = tmp_path / "cache"
    full = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
    said = rf"[^\n]*: UserWarning: compiled kernels cannot be kept in {cache}[^\n]*: File too large\n[^\n]*\n"
    assert small(cache, said, full)["from_cache"] == 0
    assert [small(cache)["from_cache"] for _ in range(2)] == [0, 1]


# --- what hides our packages


@pytest.mark.e2e
@pytest.mark.parametrize("name", ["evolution.py", "cluster.py", "evolution/__init__.py"])
def test_a_users_file_that_hides_a_package_is_named(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("print('once')\n")
    script = tmp_path / (name if name.endswith("n.py") else "script.py")
    with script.open("a") as file:
        file.write("import gridsim\ngridsim.evolve(scenario='curved')\n")
    done = finish("python", script.name, cwd=tmp_path, code=1)
    hiding = name.removesuffix("/__init__.py")
    package = hiding.removesuffix(".py")
    said = f"gridsim.errors.GridSimError: {tmp_path / hiding} hides GridSim's package {package}: rename it"
    assert done.stderr.splitlines()[-1].startswith(said)
    assert done.stdout.count("once") == (script.name == name), "it is not imported"
    if package == "evolution":
        done = finish("gridsim-evolve", "--help", cwd=tmp_path, code=2, PYTHONPATH=str(tmp_path))
        assert re.fullmatch(rf"gridsim-evolve: error: {tmp_path / hiding} hides [^\n]*\n", done.stderr)
