"""The house rules: who may import whom, what sits behind one file, how large files are; and what is installed."""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from commands import PROJECT, finish, requirements
from packaging.utils import canonicalize_name

from gridsim import packages

# Imports run downwards only: cluster -> evolution -> gridsim.
RANK = {"gridsim": 0, "evolution": 1, "cluster": 2}
# The only files that may import these, anywhere in them.
BEHIND = {
    "ray": {"cluster/workers/ray_pool.py", "cluster/workers/ray_session.py"},
    "mlflow": {"cluster/tracking/logged.py", "cluster/tracking/database.py", "cluster/tracking/sync.py"},
    "pygame": {"gridsim/view/render.py", "gridsim/view/drive.py"},
}
EXTRAS = {extra: set(modules.split()) for extra, modules in packages._EXTRAS.items()}
# What a package knows nothing of.
NOT_IN = {"gridsim": EXTRAS["evolve"] - EXTRAS["view"], "evolution": EXTRAS["evolve"] - {"torch", "onnx"}}
MOST_MODULES, MOST_LINES = 14, 500  # of a folder, and of a file


def imports(source: str) -> Iterator[tuple[str, int]]:
    """Yield each module, and each of its names, that is imported anywhere in a file, and the line."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield from ((name, node.lineno) for name in (node.module, *(f"{node.module}.{a.name}" for a in node.names)))
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            yield from ((str(name.value), node.lineno) for name in node.args[:1] if isinstance(name, ast.Constant))


def breaches(file: str, source: str) -> Iterator[str]:
    """Yield what in a file (its path from the root) breaks a rule, a line each."""
    package = file.partition("/")[0]
    for module, line in sorted({(name.partition(".")[0], line) for name, line in imports(source)}):
        if RANK.get(module, 0) > RANK[package]:
            yield f"{file}:{line}: {package} imports {module}, upwards"
        elif module in NOT_IN.get(package, ()):
            yield f"{file}:{line}: {package} knows no {module}"
        elif module in BEHIND and file not in BEHIND[module]:
            yield f"{file}:{line}: {module} belongs behind {', '.join(sorted(BEHIND[module]))}"


@pytest.mark.parametrize("package", RANK)
def test_package_keeps_the_rules_and_its_files_and_folders_stay_small(root: Path, package: str) -> None:
    sources = {f.relative_to(root): f.read_text(encoding="utf-8") for f in (root / package).rglob("*.py")}
    assert sources, f"{package}/ is missing or empty"
    assert [breach for file, source in sources.items() for breach in breaches(file.as_posix(), source)] == []
    assert [file for file, source in sources.items() if len(source.splitlines()) > MOST_LINES] == []
    modules = Counter(file.parent for file in sources if file.name != "__init__.py")
    assert [folder for folder, count in modules.items() if count > MOST_MODULES] == []


def test_the_page_on_architecture_names_every_file(root: Path) -> None:
    page = (root / "docs/architecture.md").read_text(encoding="utf-8")
    files = [file for package in RANK for file in (root / package).rglob("*.py") if file.name != "__init__.py"]
    names = Counter(file.name for file in files if file.parent.name != "generators")
    assert [name for name, count in names.items() if page.count(name) < count] == []


@pytest.mark.parametrize("parts", [99, 2], ids=["files", "rooms"])
def test_none_import_each_other_in_a_circle(root: Path, parts: int) -> None:
    """Neither at once nor later, nor for types; rooms are a package's folders and the files beside them."""
    files = [f for package in RANK for f in (root / package).rglob("*.py")]
    names = {".".join(f.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): f for f in files}
    found: dict[str, set[str]] = {}
    for name, file in names.items():
        if name in RANK and parts == 2:
            continue  # a package's own file may offer names from anywhere
        asked = {other for other, _ in imports(file.read_text(encoding="utf-8"))} & names.keys()
        own = ".".join(name.split(".")[:parts])
        found.setdefault(own, set()).update({".".join(other.split(".")[:parts]) for other in asked} - {own, *RANK})
    TopologicalSorter(found).prepare()  # raises CycleError, which names them


def test_what_is_imported_is_installed_or_of_an_extra_that_is_checked(root: Path) -> None:
    """Stable-Baselines3, which `gridsim.envs.sb3` adapts to, is the user's own."""

    def asked(extra: str = "") -> set[str]:
        return {canonicalize_name(item.name) for item in requirements(extra)}

    sources = [f.read_text(encoding="utf-8") for package in RANK for f in (root / package).rglob("*.py")]
    tops = {name.partition(".")[0] for source in sources for name, _ in imports(source)} - sys.stdlib_module_names
    projects = packages_distributions()
    tops -= {*RANK, "stable_baselines3"}

    def projects_of(modules: set[str]) -> set[str]:
        return {canonicalize_name(name) for module in modules for name in projects[module]}

    assert {top for top in tops if not projects_of({top}) & asked()} <= set.union(*EXTRAS.values())
    for extra, modules in EXTRAS.items():
        assert all(projects_of({module}) & asked(extra) for module in modules)
        assert asked(extra) - asked() <= projects_of(modules)


@pytest.mark.parametrize(
    ("module", "banned"),
    [
        ("gridsim", {"numba", "scipy", "PIL", *set.union(*EXTRAS.values())}),
        ("evolution.search.recombination", {"evolution.networks", "evolution.episodes", "gridsim.car", "gridsim.maps"}),
        ("evolution.search.two_parents", {"evolution.networks", "evolution.episodes", "gridsim.car", "gridsim.maps"}),
        ("cluster.workers.worker", {"ray", "torch", "mlflow", "pygame", "matplotlib", "tyro", "rich"}),
        ("cluster.workers.ray_pool", {"torch", "mlflow", "pygame", "matplotlib"}),
        ("cluster.commands.cli", {"torch", "mlflow", "pygame"}),
    ],
)
def test_a_fresh_process_loads_no_more_than_it_needs(root: Path, module: str, banned: set[str]) -> None:
    """PyTorch, which costs seconds and 200 MB in each worker, among it."""
    code = f"import sys, {module}; print(*sorted({banned!r} & set(sys.modules)))"
    assert finish("python", "-c", code, cwd=root).stdout.split() == []


# --- What is installed -----------------------------------------------------------------------------------------------


def test_every_folder_is_a_package_and_typed(root: Path) -> None:
    tops = set(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    assert tops == set(RANK)
    folders = {path.parent for top in tops for path in (root / top).rglob("*.py")}
    assert [folder for folder in sorted(folders) if not (folder / "__init__.py").is_file()] == []
    assert [top for top in sorted(tops) if not (root / top / "py.typed").is_file()] == []


def test_make_installs_the_test_tools_for_tests_alone(root: Path, tmp_path: Path) -> None:
    def said(target: str) -> str:
        command = ["make", "--dry-run", target, f"VENV={tmp_path}"]
        return subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout

    def installs(target: str) -> list[str]:
        return re.findall(r'--editable "(.*)"', said(target))

    for target in ("install", "evolve", "dqn", "compare", "ui", "bench", "pictures"):
        assert installs(target) == [".[evolve]"]
    for target in ("develop", "test", "docs", "lint", "format"):
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
    assert set(dict(re.findall(r"^  ([a-z-]+) +(\S.*)$", done.stdout, flags=re.MULTILINE))) == set(targets.split())
