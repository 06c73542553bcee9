"""A comparison's page: its tables, its picture and a row for each run, with a link to its drive, in one HTML file."""

from __future__ import annotations

import base64
import dataclasses
import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from cluster.compare.plan import Plan
from cluster.compare.results import Run
from cluster.compare.tables import DRIVING, ERRORS, Group, introduction, notes, table
from cluster.store.folder import PAGE

STYLE = """\
body { font: 16px system-ui, sans-serif; margin: 2em auto; max-width: 90em; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1.5em 0 }
th, td { border-bottom: 1px solid #ddd; padding: 0.3em 0.8em; text-align: right; white-space: nowrap }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left }
td:has(a) { white-space: normal; overflow-wrap: anywhere; min-width: 12em }
img { max-width: 100% }"""


def page(folder: Path, groups: Sequence[Group], plan: Plan | None, picture: Path) -> bytes:
    """The page as HTML, with the picture embedded; its links are relative to `folder`."""
    title = f"GridSim: {escape(folder.name)}"
    parts = [f"<h1>{title}</h1>", f"<p>{escape(introduction(plan))}</p>"]
    for columns in (DRIVING, ERRORS):
        head, *rows = [[escape(cell) for cell in row] for row in table(groups, columns)]
        parts.append(_table(head, rows))
    parts.append("<ul>" + "".join(f"<li>{escape(note)}" for note in notes(groups)) + "</ul>")
    data = base64.b64encode(picture.read_bytes()).decode()
    parts.append(f'<p><img alt="success, errors and training times" src="data:image/png;base64,{data}"></p>')
    columns = {name: cell for name, cell in DRIVING.items() if name != "seeds"}
    runs = []
    for group in groups:
        for run in group.runs:
            figures = [cell(dataclasses.replace(group, runs=(run,))) for cell in columns.values()]
            runs.append([escape(group.road), escape(group.name), _link(folder, run), f"{run.settings.seed}", *figures])
    parts += ["<h2>Runs, with their champions' drives</h2>", _table(["road", "learner", "run", "seed", *columns], runs)]
    top = f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>{title}</title><style>\n{STYLE}\n</style>'
    return "\n".join([top, *parts, ""]).encode(errors="surrogateescape")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as HTML, from cells that are HTML."""
    lines = ["".join(f"<th>{cell}" for cell in head), *("".join(f"<td>{cell}" for cell in row) for row in rows)]
    return "<table>\n" + "\n".join(f"<tr>{line}" for line in lines) + "\n</table>"


def _link(folder: Path, run: Run) -> str:
    """A run's name, linked to its drive if there is one."""
    name, drive = escape(run.folder.resolve().name), run.folder / PAGE
    path = quote(os.fsencode(os.path.relpath(drive, folder)))
    return f'<a href="{escape(path)}">{name}</a>' if drive.is_file() else name
