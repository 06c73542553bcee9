"""The notebook of docs/ runs as it is, and so do commands in notebooks."""

import os
from pathlib import Path

import nbformat
import pytest
from commands import BIN
from nbclient import NotebookClient

COMMAND = "!gridsim-evolve --scenario curved --population 16 --generations 2 --tracking-uri sqlite:///runs.db"


def printed(cell: nbformat.NotebookNode) -> str:
    return "".join(output.get("text", "") for output in cell.outputs)


@pytest.mark.e2e
def test_the_notebook_runs_and_commands_print_plain_lines_there(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(BIN), prepend=os.pathsep)
    notebook = nbformat.read(root / "docs/first_driver.ipynb", as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(COMMAND))
    NotebookClient(notebook, timeout=400, resources={"metadata": {"path": str(tmp_path)}}).execute()
    install, *cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert install.outputs == [], "nothing is installed where GridSim is"
    shown = {kind for cell in cells for output in cell.outputs for kind in output.get("data", ())}
    assert {"image/png", "text/html", "text/plain"} <= shown
    assert not [output for cell in cells for output in cell.outputs if output.get("name") == "stderr"]
    evaluated = next(cell for cell in cells if cell.source.startswith("!gridsim-evaluate"))
    assert "success" in printed(evaluated)
    assert "\n2/2 generations" in printed(cells[-1])
    assert "\x1b" not in printed(evaluated) + printed(cells[-1])
