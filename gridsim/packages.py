"""What may be missing beside the simulator: extras, and GridSim's other packages, which a user's file may hide."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from gridsim.errors import GridSimError

#: The name of what pip installs; on PyPI, `gridsim` is another program.
DISTRIBUTION = "gridsim-driving"
#: The modules that GridSim imports from each extra of pyproject.toml.
_EXTRAS = {
    "evolve": "docstring_parser imageio_ffmpeg matplotlib mlflow onnx onnxruntime pygame ray rich torch tyro",
    "roads": "osmium sumo",
    "view": "pygame",
}
#: A file in each package, by which it is told from a user's file or folder of the same name.
_FILES = {"cluster": "api.py", "evolution": "episodes/rollout.py"}


def package_folder(name: str) -> Path:
    """The folder of GridSim's package `cluster` or `evolution`, found without importing the package.

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


def missing(extra: str) -> list[str]:
    """The modules of an extra that are not installed."""
    found = {module: find_spec(module) for module in _EXTRAS[extra].split()}
    return [
        module for module, spec in found.items() if not (spec and spec.origin)
    ]  # a spec without an origin is a mere folder


def check_extra(extra: str) -> None:
    """Raise GridSimError if an extra is not installed."""
    if names := missing(extra):
        raise GridSimError(f'pip install "{DISTRIBUTION}[{extra}]" installs what is missing: {", ".join(names)}')


def check_packages() -> None:
    """Raise GridSimError if `cluster`, `evolution` or the extra `evolve` is missing, or if a user's file hides one."""
    for name in _FILES:
        package_folder(name)
    check_extra("evolve")
