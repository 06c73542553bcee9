"""Commands in notebooks. `make docs` runs docs/first_driver.ipynb itself."""

import os
from pathlib import Path

import nbformat
import pytest
from commands import BIN
from nbclient import NotebookClient

EVOLVE = "!gridsim-evolve --scenario curved --population 16 --generations 2 --name r --tracking-uri sqlite:///runs.db"
EVALUATE = "!gridsim-evaluate runs/r --episodes 4"


@pytest.mark.e2e
def test_commands_print_plain_lines_in_a_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(BIN), prepend=os.pathsep)
    notebook = nbformat.v4.new_notebook(cells=[*map(nbformat.v4.new_code_cell, (EVOLVE, EVALUATE))])
    NotebookClient(notebook, timeout=400, resources={"metadata": {"path": str(tmp_path)}}).execute()
    evolved, evaluated = ("".join(output.get("text", "") for output in cell.outputs) for cell in notebook.cells)
    assert "\n2/2 generations" in evolved
    assert "success" in evaluated
    assert "\x1b" not in evolved + evaluated
