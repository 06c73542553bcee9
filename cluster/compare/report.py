"""What a comparison leaves: its tables, its picture and its page, and what MLflow gets of it."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from cluster.compare import picture
from cluster.compare.plan import COMPARISON, Plan, has_summary, read_plan
from cluster.compare.tables import DRIVING, ERRORS, Groups, introduction, notes, table, table_csv, table_md
from cluster.store import checkpoint
from cluster.store.checkpoint import CONFIG, SUMMARY
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


def write(folder: Path, groups: Groups, plan: Plan | None) -> None:
    """Write the tables, the picture and the page."""
    checkpoint.write_atomic(folder / TABLE, table_md(groups, plan))
    checkpoint.write_atomic(folder / ROWS, table_csv(groups, folder))
    picture.comparison(groups, folder / PICTURE)
    checkpoint.write_atomic(folder / REPORT, page(folder, groups, plan, (folder / PICTURE).read_bytes()))


def page(folder: Path, groups: Groups, plan: Plan | None, drawn: bytes) -> bytes:
    """The page as HTML, with the picture embedded; its links are relative to `folder`."""
    title = f"GridSim: {escape(folder.name)}"
    runs = [(names, run) for names, runs in groups.items() for run in runs if run.figures]
    lines = [table({names: [run]}, DRIVING)[-1] for names, run in runs]
    links = [(_link(folder, run.folder), str(run.settings.seed)) for _, run in runs]
    return f"""\
<!doctype html>
<html lang="en"><meta charset="utf-8">
<title>{title}</title><style>
{STYLE}
</style><h1>{title}</h1>
<p>{escape(introduction(plan))}</p>
{_table(table(groups, DRIVING))}
{_table(table(groups, ERRORS))}
<ul>{"".join(f"<li>{escape(note)}" for note in notes(groups))}</ul>
<p><img alt="success, errors and training times" src="data:image/png;base64,{base64.b64encode(drawn).decode()}"></p>
<h2>Runs, with their champions' drives</h2>
{_table([*table({}, DRIVING), *lines], [("run", "seed"), *links])}
""".encode(errors="surrogateescape")


def _table(lines: Sequence[Sequence[str]], runs: Sequence[Sequence[str]] = ()) -> str:
    """A table as HTML; its first line is the header.

    Args: `runs`, for each line the cells, already HTML, that replace its third cell (seeds).
    """
    rows = []
    for k, line in enumerate(lines):
        cells = [escape(cell) for cell in line]
        cells[2:3] = runs[k] if runs else cells[2:3]
        rows.append("<tr>" + "".join(f"<{'td' if k else 'th'}>{cell}" for cell in cells))
    return "\n".join(["<table>", *rows, "</table>"])


def _link(folder: Path, run: Path) -> str:
    """A run's name, linked to its drive if there is one."""
    name, drive = escape(run.resolve().name), run / PAGE
    path = quote(os.fsencode(os.path.relpath(drive, folder)))
    return f'<a href="{path}">{name}</a>' if drive.is_file() else name


def read_comparison(folder: Path) -> Content:
    """What MLflow gets of a comparison, from its folder: the plan, the files, and the number of runs done over time."""
    plan = read_plan(folder)
    planned = plan.planned(folder)
    done = [run.path for run in planned if has_summary(run)]
    started = min(((path / CONFIG).stat().st_mtime for path in done), default=0.0)
    times = sorted((path / SUMMARY).stat().st_mtime - started for path in done)
    files = [folder / name for name in (COMPARISON, REPORT, TABLE, ROWS, PICTURE)]
    return Content(
        name=folder.name, tags={"algorithm": "comparison"},
        params={name: " ".join(v) if isinstance(v, tuple) else str(v) for name, v in vars(plan).items()},
        rows=[(done, {"runs_done": float(done)}, wall_s) for done, wall_s in enumerate(times, 1)],
        files=[path for path in files if path.is_file()],
        finished=len(done) == len(planned), wall_s=max(times, default=0.0),
    )  # fmt: skip
