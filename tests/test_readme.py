"""What the pages show runs: commands of some, small ones here and others `ELSEWHERE`, and all Python examples."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from commands import BIN, finish

SMALL = "--scenario curved --traffic 0 --population 16 --car-steps 3000"
COMPARISON = "--scenarios curved --learners evolution --seeds 1 --budget 20k --population 16 --output"

# What is run here, in this order, and what is added to make it small; the last of equal flags counts.
HERE = {
    "make evolve": f"{SMALL} --name first",
    'make dqn ARGS="--seed 1"': "--scenario curved --traffic 0 --car-steps 1000 --name other",
    ".venv/bin/gridsim-evolve --resume runs/<name> --car-steps 1.2e8": "--car-steps 100000",
    ".venv/bin/gridsim-evaluate runs/<name> --scenario city --episodes 500": "--episodes 4",
    "make compare ARGS=--quick": f"{COMPARISON} quick --learners evolution dqn --jobs 2 --workers 2",
    "make compare": f"{COMPARISON} whole",
    ".venv/bin/gridsim-compare runs/<name> runs/<other>": "",
    ".venv/bin/gridsim-watch runs/<name> --output drive.mp4": "--size 160x90",
    ".venv/bin/gridsim-watch runs/<name> runs/<other> --output drive.html": "",
    ".venv/bin/gridsim-watch runs/<name> --generation 12": "--generation 0 --output elite.html",
}
TUTORIALS = {
    "docs/start.md": {
        "gridsim-evolve --scenario curved --name first": SMALL,
        "gridsim-watch runs/first --output first.mp4": "--size 160x90 --seconds 2",
        "gridsim-evaluate runs/first --episodes 256": "--episodes 4",
        "gridsim-evaluate runs/first --scenario seamless --episodes 256": "--episodes 4",
        "gridsim-evolve --name second": SMALL,
        "gridsim-evolve --name third --scenario all": "--population 16 --car-steps 3000",
    },
    "docs/paper.md": {
        "gridsim-evolve --policy mlp:6,7 --recombination two": f"{SMALL} --name paper",
        "gridsim-evolve --policy mlp:6,7": SMALL,
    },
}
ELSEWHERE = {
    "make install": "tests/test_house.py::test_make_installs_the_test_tools_for_tests_alone",  # a dry run
    "make ui": "tests/cluster/test_tracking_ui.py::test_the_link_leads_to_the_run_table_and_its_curves",
    ".venv/bin/gridsim-evolve --resume runs/<name>": "tests/cluster/test_cli.py::test_a_run_goes_on_in_any_mode",
    ".venv/bin/gridsim-evolve --name X --resume-if-exists": "tests/cluster/test_cli.py::test_start_or_continue",
    ".venv/bin/gridsim-evolve --config runs/<name>/config.json": "tests/cluster/test_cli.py::test_config_repeats_a_run",
    ".venv/bin/gridsim-evolve --init runs/<name>": "tests/cluster/test_cli.py::test_init_begins_with_a_champion",
    ".venv/bin/gridsim-watch runs/<name>": "tests/cluster/test_watch.py::test_window_is_shown_on_a_chosen_driver",
    ".venv/bin/gridsim-watch runs/<name> --follow": "tests/cluster/test_watch.py::test_any_elite_is_watched",
    ".venv/bin/gridsim-drive --scenario city --record drive.csv": "tests/gridsim/test_drive.py::test_real_keys_drive",
    ".venv/bin/gridsim-watch drive.csv": "tests/cluster/test_watch.py::test_watch_shows_a_recorded_drive",
    "ray start --head": "tests/conftest.py::head",
    "ray start --address <first>:6379": "tests/cluster/test_cluster.py::up",
    "gridsim-evolve --address auto": "tests/cluster/test_cli.py::test_a_run_goes_on_in_any_mode",
}
# What makes the Python examples of README.md and docs/ small, and names runs that are there.
IN_PYTHON = {
    "<name>": "first",
    "<other>": "other",
    "gridsim-seamless": "gridsim-curved",
    "workers=2": "workers=0",
    "generations=20": "generations=1, population=16",
    "episodes=64": "episodes=4",
    "num_envs=1024": "num_envs=8",
    "num_envs=256": "num_envs=8",
    "batch_size=4096": "batch_size=64",
    "1_000_000": "512",
    "popsize=100": "popsize=4",
    ".run(50)": ".run(1)",
}


def code(page: Path, language: str) -> str:
    """All of its blocks in a language."""
    return "\n".join(re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL))


def examples(root: Path) -> dict[str, str]:
    """Of each page with Python its blocks, as one program: later ones use earlier names."""
    pages = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    return {page.name: text for page in pages if (text := code(page, "python"))}


def run_all(commands: dict[str, str], root: Path, cwd: Path) -> None:
    """Run a page's commands, each made small."""
    make = f"make -f {root}/Makefile -o {sys.prefix}/.installed VENV={sys.prefix} "
    shell = os.environ | {"PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    for command, small in commands.items():
        line = command.replace("<name>", "first").replace("<other>", "other").replace(".venv/bin", str(BIN))
        if target := re.fullmatch(r'make (\w+)(?: ARGS="?(.*?)"?)?', line):
            line = f'{make} {target[1]} ARGS="{target[2] or ""} {small}"'
        else:
            line = f"{line} {small}"
        done = subprocess.run(line, shell=True, cwd=cwd, env=shell, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"


def test_every_command_of_the_pages_is_run_by_a_test(root: Path) -> None:
    lines = [line for page in ("README.md", *TUTORIALS) for line in code(root / page, "sh").splitlines()]
    run_here = [command for commands in (HERE, *TUTORIALS.values()) for command in commands]
    assert {line.partition("#")[0].strip() for line in lines} - {""} == {*run_here, *ELSEWHERE}
    for test in ELSEWHERE.values():
        file, name = test.split("::")
        assert re.search(rf"def {name}", (root / file).read_text(encoding="utf-8")), test


@pytest.mark.e2e
@pytest.mark.parametrize("page", TUTORIALS)
def test_the_commands_of_tutorials_run(page: str, root: Path, tmp_path: Path) -> None:
    run_all(TUTORIALS[page], root, tmp_path)


@pytest.mark.e2e
@pytest.mark.usefixtures("audited")
def test_the_commands_of_the_readme_run_and_then_the_examples_of_all_pages(root: Path, tmp_path: Path) -> None:
    run_all(HERE, root, tmp_path)
    for program in examples(root).values():
        for text, small in IN_PYTHON.items():
            program = program.replace(text, small)
        (tmp_path / "page.py").write_text(program)  # a file, which kernels come from
        finish("python", "page.py", cwd=tmp_path, timeout=300)
