"""Measure the tables of docs/results.md: python benchmarks/results.py [TABLE ...] [--output DIR] [--quick] [--write]

Each command is run as a user would run it and timed from start to exit; then its champion drives 1,024 held-out
drives. A row is one command, or one with several seeds: their median, and the worst of them in brackets. Results are
kept in DIR, one JSON file per command; they are measured again only after a change of gridsim, evolution or cluster. So
an interrupted measurement goes on where it stopped. --write puts all complete tables into docs/results.md, with the
commit. Nothing else should run on the machine.

Tables: seeds, roads, compute, compute16, all, other, speed, learners, ppo, comparison, pace; all by default, in
some five hours on two cores.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
import shlex
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "results.md"
PRODUCT = ("gridsim", "evolution", "cluster")
BIN = Path(sys.executable).parent
EPISODES = 1024  # held-out drives of each champion
SEEDS, SEEDS_IN_TRAFFIC = 5, 3
BUDGETS = ("--car-steps 15e6", "--compute 1", "--compute 4")
GOOD = 0.95  # of validation
NO_FAILURES = 0.5  # a run without failures is drawn at this height of the logarithmic axis
ROADS = (
    ("highway", 0), ("curved", 0), ("roundabout", 0), ("city", 0),
    ("highway", 8),
)  # fmt: skip
CROWDED = {"seamless": 6, "curved": 6, "roundabout": 4, "city": 6}  # roads on which failures are not rare
PACES = {"highway": 20, "curved": 10, "seamless": 9, "roundabout": 7, "city": 6}  # m/s, nearer to the reference driver


def over_seeds(command: str, seeds: int) -> dict[str, list[str]]:
    """A row of several seeds."""
    return {command: [f"{command} --seed {seed}" for seed in range(seeds)]}


def alone(*commands: str) -> dict[str, list[str]]:
    """A row for each command."""
    return {command: [command] for command in commands}


# Tables, their rows, and the commands of which a row is the median.
TABLES: dict[str, dict[str, list[str]]] = {
    "seeds": alone(*(f"gridsim-evolve --seed {seed}" for seed in range(SEEDS))),
    "roads": {
        label: commands
        for road, cars in ROADS
        for label, commands in over_seeds(
            f"gridsim-evolve --scenario {road} --traffic {cars}", SEEDS_IN_TRAFFIC if cars else SEEDS
        ).items()
    },
    "compute": {
        label: commands
        for road, cars in CROWDED.items()
        for budget in BUDGETS
        for label, commands in over_seeds(
            f"gridsim-evolve --scenario {road} --traffic {cars} --until 2 {budget}", SEEDS_IN_TRAFFIC
        ).items()
    },
    "compute16": alone("gridsim-evolve --scenario seamless --traffic 6 --until 2 --compute 16"),
    "all": over_seeds("gridsim-evolve --scenario all --wall-time 300", SEEDS_IN_TRAFFIC),
    "other": {
        **over_seeds("gridsim-evolve --policy mlp:6,7", 5),
        **alone("gridsim-evolve --recombination two", "gridsim-evolve --scenario curved --observation grid"),
    },
    "speed": alone("benchmarks/throughput.py --json", "benchmarks/scaling.py --json"),
    "learners": alone("benchmarks/learners.py --json"),
    "ppo": alone("benchmarks/learners.py --roads --json"),
    "comparison": alone("gridsim-compare --seeds 5"),
    "pace": {
        "gridsim-compare": [
            f"gridsim-compare --scenarios {road} --learners evolution --grid pace={pace} --seeds 5"
            for road, pace in PACES.items()
        ]
    },
}
HEAD = (
    "| command | seeds | car-steps, million | to 95 % of validation | total time, s | success, % | km per collision "
    "| speed, m/s |\n"
    "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)
HEAD_OF_ROADS = "| road | seeds | success, % | km per collision | speed, m/s |\n| --- | ---: | ---: | ---: | ---: |"


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
        """What was measured for a command at this commit."""
        path = self._path(command)
        measured = json.loads(path.read_text()) if path.exists() else {}
        return measured if measured.get("commit") == self.commit else None

    def keep(self, command: str, measured: dict[str, Any]) -> None:
        """Save what was measured for a command."""
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


def begin(command: str, store: Store, *more: str) -> Path:
    """Run a learner; returns its folder."""
    name = f"{name_of(command)}-{int(time.time())}"
    store.folder.mkdir(parents=True, exist_ok=True)
    log = f"sqlite:///{store.folder / 'mlflow.db'}"
    call(command, "--output", str(store.folder), "--name", name, "--tracking-uri", log, *more)
    return store.folder / name


def drive(run: Path) -> dict[str, float]:
    """The figures of a run's champion in held-out drives."""
    return json.loads(call("gridsim-evaluate", str(run), "--episodes", str(EPISODES), "--json"))


def measure_run(command: str, store: Store) -> dict[str, Any]:
    """Run a learner, and drive its champion."""
    started = time.perf_counter()
    run = begin(command, store)
    seconds = time.perf_counter() - started
    held_out, summary = drive(run), json.loads((run / "summary.json").read_text())
    return {
        "seconds": seconds,
        "car_steps": summary["car_steps"],
        "car_steps_to_good": car_steps_to_good(run),
        "held_out": held_out,
    }


def car_steps_to_good(run: Path) -> float:
    """Car-steps until a champion succeeded in GOOD of the validation drives; infinite if none did."""
    with (run / "history.csv").open(newline="") as file:
        good = (
            float(row["car_steps"]) for row in csv.DictReader(file) if float(row["validation/success_rate"]) >= GOOD
        )
        return next(good, math.inf)


def measure(command: str, store: Store) -> dict[str, Any]:
    """Measure a command."""
    if command.startswith("benchmarks"):
        return {"figures": json.loads(call(command))}
    if command.startswith("gridsim-compare"):
        return {"comparison": str(compare(command, store))}
    return measure_run(command, store)


def compare(command: str, store: Store) -> Path:
    """Run a comparison, or resume this commit's; returns its folder."""
    folder = store.folder / f"{name_of(command)}-{store.commit}"
    if folder.exists():
        call("gridsim-compare", "--resume", str(folder))
    else:
        call(command, "--output", str(store.folder), "--name", folder.name)
    return folder


def table_of(comparisons: Sequence[str]) -> str:
    """The table of a comparison, or of several together."""
    if len(comparisons) == 1:
        return (Path(comparisons[0]) / "table.md").read_text().strip()
    with tempfile.TemporaryDirectory() as folder:
        call("gridsim-compare", *comparisons, "--output", folder, "--name", "all")
        return (Path(folder) / "all" / "table.md").read_text().strip()


def render(rows: Mapping[str, Sequence[str]], store: Store) -> str | None:
    """A table as Markdown; None while it lacks a measurement."""
    measured = {label: [store.kept(command) for command in commands] for label, commands in rows.items()}
    whole = {label: [run for run in runs if run is not None] for label, runs in measured.items()}
    if any(len(whole[label]) < len(measured[label]) for label in rows):
        return None
    firsts = [runs[0] for runs in whole.values()]
    if "comparison" in firsts[0]:
        return table_of([row["comparison"] for runs in whole.values() for row in runs])
    if "figures" in firsts[0]:
        figures = {name: value for row in firsts for name, value in row["figures"].items()}
        return "\n".join(
            [
                "| figure | value |",
                "| --- | ---: |",
                *(f"| `{k}` | {v:,.{3 if v < 1.0 else 2}f} |" for k, v in figures.items()),
            ]
        )
    if "by_road" in firsts[0]["held_out"]:
        return "\n".join([HEAD_OF_ROADS, *(row for runs in whole.values() for row in rows_of_roads(runs))])
    return "\n".join([HEAD, *(row_of(label, runs) for label, runs in whole.items())])


def cell(values: Iterable[float], worst: Callable[[list[float]], float] | None, digits: int) -> str:
    """One value, or the median and the worst of several."""
    values = list(values)
    median = f"{statistics.median(values):,.{digits}f}"
    return median if len(values) == 1 or worst is None else f"{median} ({worst(values):,.{digits}f})"


def rows_of_roads(runs: Sequence[dict[str, Any]]) -> Iterable[str]:
    """A row for each road of runs on several, and one for all."""
    for road in (*runs[0]["held_out"]["by_road"], "all"):
        driven = [run["held_out"]["by_road"].get(road, run["held_out"]) for run in runs]
        yield (
            f"| {road} | {len(runs)} | {cell((100 * each['success_rate'] for each in driven), min, 1)} | "
            f"{cell((each['km_per_collision'] for each in driven), min, 0)} | "
            f"{cell((each['speed_mps'] for each in driven), None, 1)} |"
        )


def draw_compute(rows: Mapping[str, Sequence[str]], store: Store, path: Path) -> None:
    """Draw failures against car-steps: a point for each run, and a line through the medians of each road."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for k, road in enumerate(CROWDED):
        medians = []
        for commands in (commands for label, commands in rows.items() if f"--scenario {road} " in label):
            runs = [measured for command in commands if (measured := store.kept(command))]
            if not runs:
                continue
            million = [run["car_steps"] / 1e6 for run in runs]
            failures = [EPISODES * (1.0 - run["held_out"]["success_rate"]) or NO_FAILURES for run in runs]
            axes.plot(million, failures, ".", color=f"C{k}")
            medians.append((statistics.median(million), statistics.median(failures)))
        axes.plot(*zip(*medians, strict=True), color=f"C{k}", label=road)
    axes.set(xscale="log", yscale="log", xlabel="million car-steps", ylabel=f"failures of {EPISODES:,} held-out drives")
    axes.set_xticks([15, 60, 240, 960], ["15", "60", "240", "960"])
    axes.minorticks_off()
    axes.set_yticks([NO_FAILURES, *(ticks := (1, 2, 5, 10, 20, 50, 100, 200, 500))], ["none", *map(str, ticks)])
    axes.grid(alpha=0.25)
    axes.legend()
    figure.savefig(path, dpi=110)


def row_of(label: str, runs: Sequence[dict[str, Any]]) -> str:
    """A row: values of one run, or medians and the worst of several."""
    held_out = [run["held_out"] for run in runs]
    return (
        f"| `{label}` | {len(runs)} | {cell((run['car_steps'] / 1e6 for run in runs), max, 1)} | "
        f"{cell((run['car_steps_to_good'] / 1e6 for run in runs), max, 1)} | "
        f"{cell((run['seconds'] for run in runs), max, 0)} | "
        f"{cell((100 * drives['success_rate'] for drives in held_out), min, 1)} | "
        f"{cell((drives['km_per_collision'] for drives in held_out), min, 0)} | "
        f"{cell((drives['speed_mps'] for drives in held_out), None, 1)} |"
    )


def write(store: Store) -> None:
    """Put the complete tables, and the commit, into the page, each between its two marks."""
    page = PAGE.read_text()
    for table in TABLES:
        text = render(TABLES[table], store)
        if text is not None:
            marks = f"<!-- {table} -->", f"<!-- end of {table} -->"
            text = f"{text}\n\nMeasured at commit {store.commit}."
            page = re.sub(f"(?s){marks[0]}.*{marks[1]}", lambda _: f"{marks[0]}\n{text}\n{marks[1]}", page)  # noqa: B023
    PAGE.write_text(page)
    if render(TABLES["compute"], store):
        draw_compute(TABLES["compute"] | TABLES["compute16"], store, PAGE.parent / "compute.png")
    for command in TABLES["comparison"]:
        if kept := store.kept(command):
            shutil.copy(Path(kept["comparison"]) / "comparison.png", PAGE.parent)


def commit() -> str:
    """The last commit that changed the product, and whether there are changes after it."""
    log, diff = ["log", "-1", "--format=%h", "--"], ["diff", "--quiet", "HEAD", "--"]
    git = ["git", "-C", str(ROOT)]
    last = subprocess.run([*git, *log, *PRODUCT], check=True, capture_output=True, text=True).stdout.strip()
    return f"{last}+changes" if subprocess.run([*git, *diff, *PRODUCT]).returncode else last


def quick() -> dict[str, dict[str, list[str]]]:
    """The first command of each table, on a small scale."""
    small = {"benchmarks/throughput.py": "--runs 1", "gridsim-evolve": "--car-steps 1000"}
    firsts = {table: next(iter(rows.values()))[0] for table, rows in TABLES.items()}
    return {table: alone(f"{first} {small.get(first.split()[0], '--quick')}") for table, first in firsts.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", choices=[[], *TABLES], metavar="TABLE", help="which ones; all by default")
    parser.add_argument(
        "--output", type=Path, default=ROOT / "runs" / "results", help="where runs and results are kept"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a row of each, on a small scale; the figures mean nothing"
    )
    parser.add_argument("--write", action="store_true", help="write the tables into docs/results.md")
    options = parser.parse_args()
    store = Store(options.output.resolve(), commit())
    tables = quick() if options.quick else TABLES
    if not options.quick:
        compiled = [sys.executable, "-m", "cluster.workers.kernels", "everything"]
        subprocess.run(compiled, check=True, stdout=subprocess.DEVNULL)
    for table in options.tables or tables:
        commands = [command for row in tables[table].values() for command in row]
        for k, command in enumerate(commands):
            if store.kept(command) is None:
                print(f"{table} {k + 1}/{len(commands)}: {command}", file=sys.stderr, flush=True)
                store.keep(command, measure(command, store))
        print(f"\n{table}, commit {store.commit}\n\n{render(tables[table], store)}", flush=True)
    if options.write:
        write(store)


if __name__ == "__main__":
    main()
