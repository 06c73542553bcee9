"""The house rules: who may import whom, what sits behind one file, how large a file and a folder may be."""

import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from commands import finish

# Imports run downwards only: cluster -> evolution -> gridsim.
RANK = {"gridsim": 0, "evolution": 1, "cluster": 2}
# The only files that may import these, anywhere in them.
BEHIND = {
    "ray": {"cluster/workers/ray_pool.py", "cluster/workers/ray_session.py"},
    "mlflow": {
        "cluster/tracking/logged.py",
        "cluster/tracking/database.py",
        "cluster/tracking/sync.py",
    },
    "pygame": {"gridsim/view/render.py", "gridsim/view/drive.py"},
}
# What a package knows nothing of.
NOT_IN = {"gridsim": {"ray", "mlflow", "torch", "tyro", "rich"}, "evolution": {"ray", "mlflow", "tyro", "rich"}}
# Elsewhere torch is imported inside functions only: it costs seconds, and 200 MB in each worker.
TORCH_AT_IMPORT = {"evolution/dqn/learner.py"}

MOST_MODULES, MOST_LINES = 14, 500  # of a folder, and of a file


def imports(node: ast.AST, when: str = "at import") -> Iterator[tuple[str, int, str]]:
    """Yield each module, and each of its names, that is imported, the line, and when: also later, or only for types."""
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        when = "for types"
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and when == "at import":
        when = "later"
    elif isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.name, node.lineno, when
    elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
        for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
            yield name, node.lineno, when
    elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
        for argument in node.args[:1]:
            if isinstance(argument, ast.Constant):
                yield str(argument.value), node.lineno, when
    for inner in ast.iter_child_nodes(node):
        yield from imports(inner, when)


def breaches(file: str, source: str) -> Iterator[str]:
    """Yield what in a file (its path from the root) breaks a rule, a line each."""
    package = file.partition("/")[0]
    tree = ast.parse(source, filename=file)
    for module, line, when in sorted({(name.partition(".")[0], line, when) for name, line, when in imports(tree)}):
        if RANK.get(module, 0) > RANK[package]:
            yield f"{file}:{line}: {package} imports {module}, upwards"
        elif module in NOT_IN.get(package, ()):
            yield f"{file}:{line}: {package} knows no {module}"
        elif module in BEHIND and file not in BEHIND[module]:
            yield f"{file}:{line}: {module} belongs behind {', '.join(sorted(BEHIND[module]))}"
        elif module == "torch" and when == "at import" and file not in TORCH_AT_IMPORT:
            yield f"{file}:{line}: torch at import time outside {', '.join(sorted(TORCH_AT_IMPORT))}"


@pytest.mark.parametrize("package", RANK)
def test_package_keeps_the_rules_and_its_files_and_folders_stay_small(root: Path, package: str) -> None:
    sources = {f.relative_to(root): f.read_text(encoding="utf-8") for f in (root / package).rglob("*.py")}
    assert sources, f"{package}/ is missing or empty"
    assert [breach for file, source in sources.items() for breach in breaches(file.as_posix(), source)] == []
    assert [file for file, source in sources.items() if len(source.splitlines()) > MOST_LINES] == []
    modules = Counter(file.parent for file in sources if file.name != "__init__.py")
    assert [folder for folder, count in modules.items() if count > MOST_MODULES] == []


@pytest.mark.parametrize("parts", [99, 2], ids=["files", "rooms"])
def test_none_import_each_other_in_a_circle(root: Path, parts: int) -> None:
    """Neither at once nor later, nor for types; rooms are a package's folders and the files beside them."""
    files = [f for package in RANK for f in (root / package).rglob("*.py")]
    names = {".".join(f.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): f for f in files}
    found: dict[str, set[str]] = {}
    for name, file in names.items():
        if name in RANK and parts == 2:
            continue  # a package's own file may offer names from anywhere
        asked = {other for other, _, _ in imports(ast.parse(file.read_text(encoding="utf-8")))} & names.keys()
        own = ".".join(name.split(".")[:parts])
        found.setdefault(own, set()).update({".".join(other.split(".")[:parts]) for other in asked} - {own, *RANK})
    TopologicalSorter(found).prepare()  # raises CycleError, which names them


def test_every_package_that_is_imported_is_declared(root: Path) -> None:
    """Stable-Baselines3, which `gridsim.envs.sb3` adapts to, is the user's own."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {re.split(r"[^\w.-]", line)[0].replace("_", "-") for line in project["dependencies"]}
    trees = [ast.parse(f.read_text(encoding="utf-8")) for package in RANK for f in (root / package).rglob("*.py")]
    tops = {name.partition(".")[0] for tree in trees for name, _, _ in imports(tree)} - sys.stdlib_module_names
    projects = packages_distributions()
    found = {top: {name.replace("_", "-").lower() for name in projects.get(top, ())} for top in tops - set(RANK)}
    assert {top for top, names in found.items() if not names & declared} == {"stable_baselines3"}


@pytest.mark.parametrize(
    ("module", "banned"),
    [
        ("cluster.workers.worker", {"ray", "torch", "mlflow", "pygame", "matplotlib", "tyro", "rich"}),
        ("cluster.workers.ray_pool", {"torch", "mlflow", "pygame", "matplotlib"}),
        ("cluster.commands.cli", {"torch", "mlflow", "pygame"}),
    ],
)
def test_a_fresh_process_loads_no_more_than_it_needs(root: Path, module: str, banned: set[str]) -> None:
    code = f"import sys, {module}; print(*sorted({banned!r} & set(sys.modules)))"
    assert finish("python", "-c", code, cwd=root).stdout.split() == []
