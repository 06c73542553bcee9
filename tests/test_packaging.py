"""What is installed is what pyproject.toml says, and the commands and make's targets are there."""

import re
import shutil
import subprocess
import tomllib
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest

PROJECT: dict[str, Any] = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
SCRIPTS: dict[str, str] = PROJECT["project"]["scripts"]


def test_changelog_has_a_place_for_what_comes_next(root: Path) -> None:
    headings = re.findall(r"^## \[(.+?)\]", (root / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert headings[0] == "Unreleased"


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


@pytest.mark.parametrize(("user", "code"), [(0, 1), (1000, 0)])
def test_ci_fails_where_the_tools_of_some_tests_cannot_be_had(user: int, code: int, root: Path, tmp_path: Path) -> None:
    """An ordinary user, who may not install them, is told that those tests are skipped."""
    scripts = {"apt-get": "exit 100", "make": f"echo make $*; touch {tmp_path}/made", "id": f"echo {user}"}
    for name, body in {**scripts, "timeout": 'shift; exec "$@"', "getconf": "echo 2"}.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{body}\n")
        (tmp_path / name).chmod(0o755)
    for name in ("bash", "dirname", "sh", "touch"):
        (tmp_path / name).symlink_to(shutil.which(name) or name)
    run, ours = tmp_path / "clone/.ci/run", tmp_path / "clone/.venv/bin"
    run.parent.mkdir(parents=True)
    shutil.copy(root / ".ci/run", run)
    ours.mkdir(parents=True)
    for name in ("python", "pip", "pytest", "ruff", "mypy"):
        (ours / name).symlink_to(tmp_path / "getconf")
    done = subprocess.run(["bash", run], env={"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=60)
    assert done.returncode == code, done.stdout + done.stderr
    assert ("make test-slow" in done.stdout) == (code == 0)
    assert "display or " in done.stdout + done.stderr


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
