"""What is installed is what pyproject.toml says, and the commands and make's targets are there."""

import re
import subprocess
import tomllib
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

PROJECT: dict[str, Any] = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
SCRIPTS: dict[str, str] = PROJECT["project"]["scripts"]


def test_installed_commands_are_the_declared_ones() -> None:
    installed = distribution("gridsim").entry_points.select(group="console_scripts")
    assert {entry.name: entry.value for entry in installed} == SCRIPTS


def test_every_folder_is_a_package_and_typed_and_files_that_are_no_python_are_packaged(root: Path) -> None:
    tops = {pattern.removesuffix("*") for pattern in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]}
    assert tops == {"cluster", "evolution", "gridsim"}
    folders = {path.parent for top in tops for path in (root / top).rglob("*.py")}
    assert [folder for folder in sorted(folders) if not (folder / "__init__.py").is_file()] == []
    assert [top for top in sorted(tops) if not (root / top / "py.typed").is_file()] == []
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["cluster"]
    packaged = {path.name for pattern in patterns for path in (root / "cluster").glob(pattern)}
    assert packaged == {"aws.yaml", "gcp.yaml", "kuberay.yaml", "local.yaml", "drive.html"}


def test_make_installs_the_test_tools_for_tests_alone(root: Path, tmp_path: Path) -> None:
    def said(target: str) -> str:
        command = ["make", "--dry-run", target, f"VENV={tmp_path}"]
        return subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout

    def installs(target: str) -> list[str]:
        return re.findall(r'--editable "(.*)"', said(target))

    for target in ("install", "evolve", "dqn", "compare", "ui", "bench", "pictures"):
        assert installs(target) == ["."]
    for target in ("develop", "test", "lint", "format"):
        assert installs(target) == [".[dev]"]
    assert f"touch {tmp_path}/.installed {tmp_path}/.installed-dev" in said("test")  # it has what a user needs, too
    (tmp_path / ".installed").touch()
    assert (installs("evolve"), installs("test")) == ([], [".[dev]"])
    (tmp_path / ".installed-dev").touch()
    assert (installs("evolve"), installs("test")) == ([], [])


def test_make_help_names_every_target(root: Path) -> None:
    done = subprocess.run(["make", "help"], cwd=root, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    (targets,) = re.findall(r"^\.PHONY:(.*)$", (root / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    described = dict(re.findall(r"^  ([a-z-]+) +(\S.*)$", done.stdout, flags=re.MULTILINE))
    assert set(described) == set(targets.split())
