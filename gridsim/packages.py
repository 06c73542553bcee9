"""GridSim's other packages, whose names are plain words: a user's file of such a name may hide them."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from gridsim.errors import GridSimError

#: A file in each package, by which it is told from a user's file or folder of the same name.
_FILES = {"cluster": "api.py", "evolution": "episodes/rollout.py"}


def package_folder(name: str) -> Path:
    """The folder of GridSim's package `cluster` or `evolution`, which is not imported.

    Raises: GridSimError if it is missing; if a user's file hides it, the message names that.
    """
    spec = find_spec(name)
    if spec is None:
        raise GridSimError(f"GridSim's package {name} is not installed")
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    for folder in folders:
        if (folder / _FILES[name]).is_file():
            return folder
    hiding = folders[0] if folders else spec.origin
    raise GridSimError(f"{hiding} hides GridSim's package {name}: rename it, or move it to another folder")


def check_packages() -> None:
    """Raise GridSimError if a user's file or folder hides one of GridSim's packages."""
    for name in _FILES:
        package_folder(name)
