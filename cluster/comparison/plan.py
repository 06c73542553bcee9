"""The paper's comparison: scenarios x learners x seeds, each cell a training run in a folder of its own.

Cells are ordered by seed first, so that a comparison that was stopped has something of everything. A cell whose
summary.json is there is never trained again; one with a checkpoint goes on from it. What was asked is kept in
comparison.json. Who trains a cell is a function that is passed in.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

from cluster.comparison.results import LEARNERS, ExperimentError, Learner, Run, read_json, read_run
from cluster.runs import checkpoint
from cluster.runs.run import CONFIG, SUMMARY, RunError, read_config
from cluster.runs.settings import MAX_TRAFFIC
from evolution.networks.policy import Observation
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import build, check_name, default_traffic, is_map_file, label
from gridsim.view.drive import DriveError, read_drive

COMPARISON = "comparison.json"
FORMAT = 1
MAX_SEEDS, MAX_CAR_STEPS, MAX_WALL_S = 1000, 10**13, 30 * 86_400.0


class CellError(GridSimError):
    """A cell that could not be trained; the message is one line for the user."""


# ------------------------------------------------------------------------------------------------- what is asked


@dataclass(frozen=True)
class Budget:
    """What a run may use at most, either car-steps or seconds of wall time; it may stop earlier by its own rule."""

    car_steps: int = 0
    wall_s: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Budget:
        """Read `20M`, `500k` or `20,000,000` car-steps; `60s`, `5min` or `1h` of wall time. Raises ExperimentError."""
        match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,9})?)\s*(k|M|G|s|min|h)?", re.sub(r"(?<=\d)[,_](?=\d)", "", text))
        if not match:
            raise ExperimentError(
                f"--budget {text[:40]}: give car-steps, as in 20M or 500k, or wall time, as in 60s, 5min or 1h"
            )
        number, unit = float(match[1]), match[2] or ""
        if unit in ("s", "min", "h"):
            seconds = round(number * {"s": 1.0, "min": 60.0, "h": 3600.0}[unit], 3)
            if not 1.0 <= seconds <= MAX_WALL_S:
                raise ExperimentError(f"--budget {text[:40]}: wall time must be 1 s to 30 days")
            return cls(wall_s=seconds)
        steps = round(number * {"": 1, "k": 10**3, "M": 10**6, "G": 10**9}[unit])
        if not 1 <= steps <= MAX_CAR_STEPS:
            raise ExperimentError(f"--budget {text[:40]}: car-steps must be 1 to {MAX_CAR_STEPS:,}")
        return cls(car_steps=steps)

    def __str__(self) -> str:
        if self.wall_s:
            return f"{self.wall_s:.3f}".rstrip("0").rstrip(".") + "s"
        for unit, size in (("G", 10**9), ("M", 10**6), ("k", 10**3)):
            if self.car_steps % size == 0:
                return f"{self.car_steps // size}{unit}"
        return str(self.car_steps)

    def words(self) -> str:
        """For a reader."""
        if self.wall_s:
            return f"{self.wall_s:g} s of wall time"
        return f"{self.car_steps:,} car-steps"


@dataclass(frozen=True)
class Plan:
    """What a comparison was asked to do.

    Attributes:
        scenarios: names, or map files.
        learners: who is compared.
        seeds: of each; 0 is the first.
        observation: what the networks see.
        budget: of each run.
        traffic: other cars; -1: as many as each scenario has by default.
        reference: a recorded drive.csv to measure errors against, or "": the reference driver.
        population, generations: of evolution and random search; 0: as these have it.
    """

    scenarios: tuple[str, ...]
    learners: tuple[Learner, ...]
    seeds: int
    budget: Budget
    observation: Observation = "rays"
    traffic: int = -1
    reference: str = ""
    population: int = 0
    generations: int = 0

    def __post_init__(self) -> None:
        absolute = tuple(os.path.abspath(name) if is_map_file(name) else name for name in self.scenarios)
        object.__setattr__(self, "scenarios", absolute)
        if self.reference:
            object.__setattr__(self, "reference", os.path.abspath(self.reference))

    def check(self) -> None:
        """Raises ExperimentError, one line that says what to change."""
        for flag, given in (("scenarios", self.scenarios), ("learners", self.learners)):
            if not given:
                raise ExperimentError(f"--{flag}: name at least one")
            if len(set(given)) != len(given):
                raise ExperimentError(f"--{flag}: {next(n for n in given if given.count(n) > 1)} is named twice")
        try:
            for name in self.scenarios:
                check_name(name)
                if is_map_file(name):
                    build(name, 0)  # whether it is one
        except ValueError as error:
            raise ExperimentError(f"--scenarios: {error}") from error
        for learner in self.learners:
            if learner not in LEARNERS:
                raise ExperimentError(f"--learners: {learner!r:.40} is none; use {', '.join(LEARNERS)}")
        if self.observation not in get_args(Observation):
            raise ExperimentError(f"--observation: {self.observation!r:.40} is none; use rays or grid")
        if not 1 <= self.seeds <= MAX_SEEDS:
            raise ExperimentError(f"--seeds must be 1 to {MAX_SEEDS:,}, not {self.seeds}")
        if not -1 <= self.traffic <= MAX_TRAFFIC:
            raise ExperimentError(f"--traffic must be -1 to {MAX_TRAFFIC}, not {self.traffic}")
        maps = [name for name in self.scenarios if is_map_file(name)]
        if maps and self.traffic > 0:
            raise ExperimentError(f"--traffic {self.traffic}: {maps[0]} has no lanes for traffic; use --traffic 0")
        for flag in ("population", "generations"):
            if getattr(self, flag) < 0:
                raise ExperimentError(f"--{flag} must be 1 or more, not {getattr(self, flag)}")
        names = [_word(name) for name in self.scenarios]
        if len(set(names)) != len(names):
            raise ExperimentError("--scenarios: two maps have the same name; rename one")
        if self.reference:
            try:
                driven = read_drive(self.reference).scenario
            except DriveError as error:
                raise ExperimentError(f"--reference {error}") from error
            if self.scenarios != (driven,):
                raise ExperimentError(f"--reference was driven on {driven}; compare there alone: --scenarios {driven}")

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists."""
        values = dataclasses.asdict(self) | {"budget": str(self.budget)}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    @classmethod
    def from_dict(cls, values: Any) -> Plan:
        """The inverse of `to_dict`. Raises ExperimentError for names, types or values that do not fit."""
        kinds = {f.name: str(f.type) for f in dataclasses.fields(cls)}
        if not isinstance(values, dict) or set(values) != set(kinds):
            raise ExperimentError("its plan has other parts than this GridSim's")
        for name, kind in kinds.items():
            value = values[name]
            if kind.startswith("tuple"):
                fits = isinstance(value, list) and all(type(item) is str for item in value)
            else:
                fits = type(value) is (int if kind == "int" else str)
            if not fits:
                raise ExperimentError(f"its {name} cannot be {str(value)[:40]!r}")
        plan = cls(
            **values
            | {name: tuple(values[name]) for name in ("scenarios", "learners")}
            | {"budget": Budget.parse(values["budget"])}
        )
        plan.check()
        return plan

    def cells(self, folder: Path) -> list[Cell]:
        """All runs of a comparison in that folder, in the order in which they are made."""
        return [
            Cell(self, scenario, learner, seed, folder / f"{_word(scenario)}-{learner}-s{seed}")
            for seed in range(self.seeds)
            for scenario in self.scenarios
            for learner in self.learners
        ]


@dataclass(frozen=True)
class Cell:
    """One training run of a comparison.

    Attributes:
        plan: the comparison's.
        scenario, learner, seed: which run.
        folder: the run's.
    """

    plan: Plan
    scenario: str
    learner: Learner
    seed: int
    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def traffic(self) -> int:
        """Other cars on the road."""
        return default_traffic(self.scenario) if self.plan.traffic == -1 else self.plan.traffic

    def finished(self) -> bool:
        """Whether there is nothing left to do: its summary is there, the last file that a run writes."""
        return (self.folder / SUMMARY).is_file()

    def check(self) -> None:
        """Hold what is in the folder against what was asked. Raises ExperimentError."""
        if not self.folder.exists():
            return
        if not (self.folder / CONFIG).is_file():
            # Killed while it wrote its first file, a run leaves a hidden one.
            if not self.folder.is_dir() or any(not path.name.startswith(".") for path in self.folder.iterdir()):
                raise ExperimentError(f"{self.folder} is in the way and no run; move it elsewhere")
            return
        try:
            settings, _ = read_config(self.folder / CONFIG)
        except RunError as error:
            raise ExperimentError(str(error)) from error
        asked = {
            "learner": self.learner,
            "scenario": self.scenario,
            "seed": self.seed,
            "traffic": self.traffic,
            "observation": self.plan.observation,
        }
        if self.plan.population and self.learner != "dqn":
            asked["population"] = self.plan.population
        for name, value in asked.items():
            found = getattr(settings, name)
            if found != value:
                raise ExperimentError(
                    f"{self.folder}: its {name} is {found}, and {COMPARISON} asks for {value}; one of them was edited"
                )


Execute = Callable[[Cell], dict[str, Any]]
"""Trains a cell to its end, from its checkpoint if it has one, and returns its summary. Raises CellError."""


def train(
    cells: Sequence[Cell],
    execute: Execute,
    on_done: Callable[[Cell, CellError | None], None],
    on_begin: Callable[[Cell], None] = lambda cell: None,
) -> int:
    """Train what is not finished, telling of each before and after. Returns how many failed; these stop no others."""
    failed = 0
    for cell in cells:
        if cell.finished():
            continue
        on_begin(cell)
        problem: CellError | None = None
        try:
            execute(cell)
        except CellError as error:
            problem, failed = error, failed + 1
        on_done(cell, problem)
    return failed


# --------------------------------------------------------------------------------------------------- its folder


@dataclass
class ComparisonFolder:
    """Where a comparison is kept.

    Attributes:
        path: the folder.
        plan: what was asked.
        tracking_key: by which MLflow's parent run is found again.
    """

    path: Path
    plan: Plan
    tracking_key: str = field(default_factory=lambda: uuid.uuid4().hex)

    def write(self) -> None:
        """Write comparison.json. Raises CheckpointError."""
        content = {
            "format": FORMAT,
            "command": "gridsim-compare",
            "gridsim": version("gridsim"),
            "plan": self.plan.to_dict(),
            "tracking_key": self.tracking_key,
        }
        checkpoint.write_atomic(self.path / COMPARISON, (json.dumps(content, indent=2) + "\n").encode())

    def cells(self) -> list[Cell]:
        """All of its runs, checked. Raises ExperimentError."""
        cells = self.plan.cells(self.path)
        for cell in cells:
            cell.check()
        return cells

    def runs(self) -> list[Run]:
        """Those that are finished. Raises ExperimentError."""
        return [read_run(cell.folder) for cell in self.plan.cells(self.path) if cell.finished()]


def open_comparison(folder: Path) -> ComparisonFolder:
    """A comparison's folder, to be resumed or read. Raises ExperimentError."""
    path = folder / COMPARISON
    if not path.is_file():
        reason = f"it has no {COMPARISON}" if folder.is_dir() else "no such folder"
        raise ExperimentError(f"{folder} is no comparison's folder: {reason}")
    content = read_json(path)
    key = content.get("tracking_key")
    if content.get("format") != FORMAT or not isinstance(key, str) or not re.fullmatch(r"[0-9a-f]{32}", key):
        raise ExperimentError(f"{path}: not a {COMPARISON} of this GridSim")
    try:
        return ComparisonFolder(folder.resolve(), Plan.from_dict(content.get("plan")), key)
    except ExperimentError as error:
        raise ExperimentError(f"{path}: {error}") from error


def new_folder(output: Path, name: str) -> Path:
    """A comparison's folder, checked but not yet made. Raises ExperimentError."""
    if not re.fullmatch(r"\w[\w.+=@-]{0,199}", name):
        raise ExperimentError(f"--name {name!r:.40}: use letters, digits, '.', '_' and '-' only")
    path = output / name
    if path.exists():
        resumable = (path / COMPARISON).is_file()
        hint = f", or continue it with --resume {path}" if resumable else ""
        raise ExperimentError(f"{path} exists already; choose another --name{hint}")
    parent = output.absolute()
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise ExperimentError(f"--output {output}: cannot be written; choose another folder")
    return path.absolute()


def _word(scenario: str) -> str:
    """A scenario's name as part of a folder's."""
    return re.sub(r"[^\w.+=@-]", "_", label(scenario))


def read_runs(folders: Iterable[Path]) -> list[Run]:
    """Finished runs from their folders; a comparison's folder stands for its finished runs. Raises ExperimentError."""
    found: list[Run] = []
    for folder in folders:
        if (folder / COMPARISON).is_file():
            runs = open_comparison(folder).runs()
            if not runs:
                raise ExperimentError(f"{folder}: none of its runs is finished; continue it with --resume {folder}")
            found += runs
        else:
            found.append(read_run(folder))
    paths = [run.folder.resolve() for run in found]
    for path in paths:
        if paths.count(path) > 1:
            raise ExperimentError(f"{path} is named twice")
    first: dict[tuple[object, ...], Run] = {}
    for run in found:  # counted as two seeds they would make a figure look surer than it is
        other = first.setdefault((run.champion_sha256, run.learner, run.scenario, run.traffic), run)
        if other is not run:
            raise ExperimentError(f"{other.folder} and {run.folder} are the same run, made twice; leave one out")
    return found
