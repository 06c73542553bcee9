"""The folder of compiled kernels: one that only its user can write to.

Numba's index of a cache is a pickle. So whoever can write it, or can replace a folder above it, runs code as the user.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import shutil
import stat
import tempfile
import warnings
from multiprocessing.util import Finalize
from pathlib import Path

from gridsim.errors import GridSimError

VARIABLE = "GRIDSIM_CACHE_DIR"
_REMEDY = f"set {VARIABLE} to a folder that only you can write to"


def cache_folder(name: str) -> Path:
    """The folder `name` for compiled kernels, created if it is missing.

    It lies, as `gridsim/NAME`, in the first of these where no other user can change it (`_closed`): the folder that
    `GRIDSIM_CACHE_DIR` or else `XDG_CACHE_HOME` names, by default `~/.cache`; a folder of the user in the temporary
    folder; a new folder for this process and its children, removed when the process ends. A warning is given if the
    last one is used, or if a folder that a variable names cannot be used. Raises: GridSimError if none can be used.
    """
    named = os.environ.get(VARIABLE) or os.environ.get("XDG_CACHE_HOME")
    problems: list[str] = []
    for place in (lambda: Path(named or Path.home() / ".cache"), _in_temporary, _in_private):
        try:
            parent = place().resolve()
            folder = _closed(parent / "gridsim" / name)
        except (OSError, RuntimeError) as error:  # RuntimeError: no home folder, or links in a circle
            problems.append(str(error))
            continue
        if problems and (named or place is _in_private):
            anew = place is _in_private
            kept = "kernels are compiled anew each time" if anew else f"compiled kernels are kept in {parent}"
            os.environ[VARIABLE] = str(parent)  # child processes use it without another warning
            warnings.warn(f"{kept} ({'; '.join(problems)}); {_REMEDY}", stacklevel=2)
        return folder
    raise GridSimError(f"no folder can keep compiled kernels ({'; '.join(problems)}); {_REMEDY}")


def _in_temporary() -> Path:
    return Path(tempfile.gettempdir(), f"gridsim-{os.geteuid()}")


def _in_private() -> Path:
    folder = tempfile.mkdtemp(prefix="gridsim-kernels-")
    # `atexit` would remove the folder also when a fork of this process ends, but not when a command ends: commands skip
    # `atexit`, and run the finalizers of `multiprocessing` (`cluster.commands.entry`).
    Finalize(None, shutil.rmtree, [folder], {"ignore_errors": True}, exitpriority=0)
    return Path(folder)


def _closed(folder: Path) -> Path:
    """The folder, created if it is missing.

    Raises: OSError if it or a folder above it is a link or a file, belongs to another user, or can be written by
    others, or if the user cannot write to it. Those above may belong to root, and may be sticky, like /tmp.
    """
    user = os.geteuid()
    trusted = {user, 0, os.stat("/").st_uid}  # in a container, another user may stand for root
    for path in (*reversed(folder.parents), folder):  # from the top: each is checked before the next is created
        if not os.path.lexists(path):
            with contextlib.suppress(FileExistsError):
                path.mkdir(mode=0o700)
        info = path.lstat()
        writable = info.st_mode & stat.S_IWOTH or (info.st_mode & stat.S_IWGRP and not _is_own_group(info.st_gid))
        sticky = info.st_mode & stat.S_ISVTX  # like /tmp: others can add files, but not replace those of the user
        if not stat.S_ISDIR(info.st_mode):
            raise OSError(f"{path}: it is a link or a file")
        if info.st_uid not in (trusted if path != folder else {user}):
            raise OSError(f"{path}: it belongs to another user")
        if writable and (path == folder or not sticky):
            raise OSError(f"{path}: other users can write to it")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(f"{folder}: it cannot be written")
    return folder


def _is_own_group(group: int) -> bool:
    """Whether a group has the user's name and no other members, as on systems that give each user a group."""
    try:
        user, found = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:
        return False
    return user.pw_gid == group and user.pw_name == found.gr_name and {*found.gr_mem} <= {user.pw_name}
