"""What a comparison leaves: its tables, its picture and its page, and what MLflow gets of it."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from cluster.compare import picture
from cluster.compare.plan import COMPARISON, Plan, open_comparison
from cluster.compare.tables import DRIVING, ERRORS, Groups, introduction, notes, table, table_csv, table_md
from cluster.store import checkpoint
from cluster.store.checkpoint import SUMMARY
from cluster.store.folder import PAGE
from cluster.tracking.content import Content

REPORT, TABLE, ROWS, PICTURE = "comparison.html", "table.md", "table.csv", "comparison.png"
STYLE = """\
body { font: 16px system-ui, sans-serif; margin: 2em auto; max-width: 90em; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1.5em 0 }
th, td { border-bottom: 1px solid #ddd; padding: 0.3em 0.8em; text-align: right; white-space: nowrap }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left }
td:has(a) { white-space: normal; overflow-wrap: anywhere; min-width: 12em }
img { max-width: 100% }"""


def write_tables(folder: Path, groups: Groups, plan: Plan | None) -> None:
    """Write table.md and table.csv."""
    checkpoint.write_atomic(folder / TABLE, table_md(groups, plan), durable=False)
    checkpoint.write_atomic(folder / ROWS, table_csv(groups, folder), durable=False)


def write(folder: Path, groups: Groups, plan: Plan | None) -> None:
    """Write tables, the picture and the page."""
    write_tables(folder, groups, plan)
    picture.comparison(groups, folder / PICTURE)
    checkpoint.write_atomic(folder / REPORT, page(folder, groups, plan, (folder / PICTURE).read_bytes()))


def page(folder: Path, groups: Groups, plan: Plan | None, drawn: bytes) -> bytes:
    """The page as HTML, with the picture embedded; its links are relative to `folder`."""
    title = f"GridSim: {escape(folder.name)}"
    runs: list[list[str]] = []
    for names, rows in groups.items():
        for row in (row for row in rows if "run" in row):
            head, line = ([escape(cell) for cell in line] for line in table({names: [row]}, DRIVING))
            head[2:3], line[2:3] = ["run", "seed"], [_link(folder, row["run"]), f"{row['seed']}"]
            runs += [line] if runs else [head, line]
    parts = [
        '<!doctype html>\n<html lang="en"><meta charset="utf-8">',
        f"<title>{title}</title><style>\n{STYLE}\n</style><h1>{title}</h1>",
        f"<p>{escape(introduction(plan))}</p>",
        *(
            _table([[escape(cell) for cell in line] for line in table(groups, columns)])
            for columns in (DRIVING, ERRORS)
        ),
        "<ul>" + "".join(f"<li>{escape(note)}" for note in notes(groups)) + "</ul>",
        '<p><img alt="success, errors and training times" '
        f'src="data:image/png;base64,{base64.b64encode(drawn).decode()}"></p>',
        f"<h2>Runs, with their champions' drives</h2>{_table(runs)}\n",
    ]
    return "\n".join(parts).encode(errors="surrogateescape")


def _table(lines: Sequence[Sequence[str]]) -> str:
    """A table as HTML, from cells that are HTML; the first line is its header."""
    rows = ["".join(f"<{'td' if k else 'th'}>{cell}" for cell in line) for k, line in enumerate(lines)]
    return "<table>\n" + "\n".join(f"<tr>{row}" for row in rows) + "\n</table>"


def _link(folder: Path, run: Path) -> str:
    """A run's name, linked to its drive if there is one."""
    name, drive = escape(run.resolve().name), run / PAGE
    path = quote(os.fsencode(os.path.relpath(drive, folder)))
    return f'<a href="{escape(path)}">{name}</a>' if drive.is_file() else name


def read_comparison(folder: Path) -> Content:
    """What MLflow gets of a comparison, from its folder: the plan, the files, and how many runs were done by when."""
    comparison = open_comparison(folder)
    planned = comparison.planned()
    ended = sorted((run.path / SUMMARY).stat().st_mtime for run in planned if run.finished())
    times = [max(time - comparison.started, 0.0) for time in ended]
    params = {name: " ".join(v) if isinstance(v, tuple) else str(v) for name, v in vars(comparison.plan).items()}
    files = [folder / name for name in (COMPARISON, REPORT, TABLE, ROWS, PICTURE)]
    return Content(
        name=folder.name, params=params, tags={"algorithm": "comparison"},
        rows=[(done, {"runs_done": float(done)}, wall_s) for done, wall_s in enumerate(times, 1)],
        files=[path for path in files if path.is_file()],
        finished=len(ended) == len(planned), wall_s=max(times, default=0.0),
    )  # fmt: skip
