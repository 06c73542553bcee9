"""Commands in notebooks. `make docs` runs docs/first_driver.ipynb itself."""

import os
from pathlib import Path

import nbformat
import pytest
from commands import BIN
from nbclient import NotebookClient

COMMAND = "!gridsim-evolve --scenario curved --population 16 --generations 2 --tracking-uri sqlite:///runs.db"


@pytest.mark.e2e
def test_commands_print_plain_lines_in_a_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(BIN), prepend=os.pathsep)
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(COMMAND)])
    NotebookClient(notebook, timeout=400, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(output.get("text", "") for output in notebook.cells[0].outputs)
    assert "\n2/2 generations" in printed
    assert "success" in printed
    assert "\x1b" not in printed
