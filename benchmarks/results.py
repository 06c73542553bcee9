"""Measure the tables of docs/results.md: python benchmarks/results.py [TABLE ...] [--output DIR] [--quick] [--write]

Each row is a command, run as a user would run it and timed from start to exit, and then the success of its champion on
512 held-out drives. What is measured is kept in DIR as a JSON file for each command; it is measured again only after a
change of gridsim, evolution or cluster. So an interrupted measurement goes on where it was. --write puts the tables of
which all rows are there into docs/results.md, with the commit. Nothing else should run on the machine.

Tables: seeds, roads, other, speed, comparison; all by default, in an hour on two cores.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "results.md"
PRODUCT = ("gridsim", "evolution", "cluster")
BIN = Path(sys.executable).parent
EPISODES = 512  # held-out drives of each champion
ROADS = (
    ("highway", 0), ("curved", 0), ("roundabout", 0), ("city", 0),
    ("highway", 8), ("curved", 6), ("seamless", 6), ("roundabout", 4), ("city", 6),
)  # fmt: skip
COMMANDS = {
    "seeds": [f"gridsim-evolve --seed {seed}" for seed in range(5)],
    "roads": [f"gridsim-evolve --scenario {road} --traffic {cars}" for road, cars in ROADS],
    "other": [
        *(f"gridsim-evolve --policy mlp:6,7 --seed {seed}" for seed in range(3)),
        "gridsim-evolve --recombination two",
        "gridsim-evolve --scenario curved --observation grid",
    ],
    "speed": ["benchmarks/throughput.py --json", "benchmarks/scaling.py --json"],
    "comparison": ["gridsim-compare --learners evolution dqn --seeds 5"],
}
HEAD = (
    "| command | car-steps, million | to its end, s | success, % | collisions, % | speed, m/s |\n"
    "| --- | ---: | ---: | ---: | ---: | ---: |"
)


@dataclass(frozen=True)
class Store:
    """What has been measured, in one folder.

    Attributes:
        folder: of the runs and of the JSON files.
        commit: the last one that changed the product.
    """

    folder: Path
    commit: str

    def kept(self, command: str) -> dict[str, Any] | None:
        """What was measured of a command at this commit."""
        path = self._path(command)
        measured = json.loads(path.read_text()) if path.exists() else {}
        return measured if measured.get("commit") == self.commit else None

    def keep(self, command: str, measured: dict[str, Any]) -> None:
        """Write it down."""
        self.folder.mkdir(parents=True, exist_ok=True)
        whole = {"command": command, "commit": self.commit, **measured}
        self._path(command).write_text(json.dumps(whole, indent=2) + "\n")

    def _path(self, command: str) -> Path:
        return self.folder / f"{name_of(command)}.json"


def name_of(command: str) -> str:
    """A file's name for a command."""
    return re.sub(r"[^a-z0-9]+", "-", command.lower()).strip("-")


def call(command: str, *more: str) -> str:
    """Run a console script or a benchmark; returns what it prints."""
    program, *flags = shlex.split(command)
    begin = [sys.executable, str(ROOT / program)] if program.endswith(".py") else [str(BIN / program)]
    return subprocess.run([*begin, *flags, *more], check=True, stdout=subprocess.PIPE, text=True).stdout


def measure_run(command: str, store: Store) -> dict[str, Any]:
    """Run a learner, and drive its champion."""
    name = f"{name_of(command)}-{int(time.time())}"
    store.folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    call(
        command, "--workers", "2", "--output", str(store.folder), "--name", name,
        "--tracking-uri", f"sqlite:///{store.folder / 'mlflow.db'}",
    )  # fmt: skip
    seconds = time.perf_counter() - started
    run = store.folder / name
    held_out = json.loads(call("gridsim-evaluate", str(run), "--episodes", str(EPISODES), "--json"))
    summary = json.loads((run / "summary.json").read_text())
    return {"seconds": seconds, "car_steps": summary["car_steps"], "held_out": held_out}


def measure(command: str, store: Store) -> dict[str, Any]:
    """Measure a command."""
    if command.startswith("benchmarks"):
        return {"figures": json.loads(call(command))}
    if command.startswith("gridsim-compare"):
        return {"table": compare(command, store)}
    return measure_run(command, store)


def compare(command: str, store: Store) -> str:
    """Run the comparison, or go on with one of this commit; returns its table."""
    folder = store.folder / f"comparison-{store.commit}"
    if folder.exists():
        call("gridsim-compare", "--resume", str(folder))
    else:
        call(command, "--output", str(store.folder), "--name", folder.name)
    return (folder / "table.md").read_text()


def render(commands: Sequence[str], store: Store) -> str | None:
    """A table as Markdown; None while it lacks a row."""
    measured = [store.kept(command) for command in commands]
    rows = [row for row in measured if row is not None]
    if len(rows) < len(measured):
        return None
    if "table" in rows[0]:
        return str(rows[0]["table"]).strip()
    if "figures" in rows[0]:
        figures = {name: value for row in rows for name, value in row["figures"].items()}
        return "\n".join(
            ["| figure | value |", "| --- | ---: |", *(f"| `{k}` | {v:,.2f} |" for k, v in figures.items())]
        )
    return "\n".join([HEAD, *map(row_of, rows)])


def row_of(measured: dict[str, Any]) -> str:
    """A run's row."""
    held_out = measured["held_out"]
    return (
        f"| `{measured['command']}` | {measured['car_steps'] / 1e6:.1f} | {measured['seconds']:.0f} | "
        f"{100 * held_out['success_rate']:.1f} | {100 * held_out['collision_rate']:.1f} | {held_out['speed_mps']:.1f} |"
    )


def write(store: Store) -> None:
    """Put the whole tables, and the commit, into the page, each between its two marks."""
    page = PAGE.read_text()
    for table in COMMANDS:
        text = render(COMMANDS[table], store)
        if text is not None:
            marks = f"<!-- {table} -->", f"<!-- end of {table} -->"
            text = f"{text}\n\nMeasured at commit {store.commit}."
            page = re.sub(f"(?s){marks[0]}.*{marks[1]}", lambda _: f"{marks[0]}\n{text}\n{marks[1]}", page)  # noqa: B023
    PAGE.write_text(page)


def commit() -> str:
    """The last commit that changed the product, and whether there are changes after it."""
    log, diff = ["log", "-1", "--format=%h", "--"], ["diff", "--quiet", "HEAD", "--"]
    git = ["git", "-C", str(ROOT)]
    last = subprocess.run([*git, *log, *PRODUCT], check=True, capture_output=True, text=True).stdout.strip()
    return f"{last}+changes" if subprocess.run([*git, *diff, *PRODUCT]).returncode else last


def quick() -> dict[str, list[str]]:
    """The first command of each table, on a small scale."""
    small = {"gridsim-evolve": "--car-steps 1000", "gridsim-compare": "--quick"}
    firsts = {table: commands[0] for table, commands in COMMANDS.items()}
    return {table: [f"{first} {small.get(first.split()[0], '--runs 1')}"] for table, first in firsts.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "tables", nargs="*", choices=[[], *COMMANDS], metavar="TABLE", help="which ones; all by default"
    )
    parser.add_argument(
        "--output", type=Path, default=ROOT / "runs" / "results", help="where runs and results are kept"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a row of each, on a small scale; the figures mean nothing"
    )
    parser.add_argument("--write", action="store_true", help="write the tables into docs/results.md")
    options = parser.parse_args()
    store = Store(options.output.resolve(), commit())
    commands = quick() if options.quick else COMMANDS
    subprocess.run(
        [sys.executable, "-m", "cluster.workers.kernels", "everything"], check=True, stdout=subprocess.DEVNULL
    )
    for table in options.tables or commands:
        for k, command in enumerate(commands[table]):
            if store.kept(command) is None:
                print(f"{table} {k + 1}/{len(commands[table])}: {command}", file=sys.stderr, flush=True)
                store.keep(command, measure(command, store))
        print(f"\n{table}, commit {store.commit}\n\n{render(commands[table], store)}", flush=True)
    if options.write:
        write(store)


if __name__ == "__main__":
    main()
