"""A run's folder: how it is made, locked and opened, and what its config.json says."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import json
import os
import re
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cluster import fitness
from cluster.redaction import one_line
from cluster.settings import SETTINGS, EvolveSettings, RunSettings, from_dict
from cluster.store import checkpoint
from cluster.store.checkpoint import CHAMPION, CHECKPOINT, CONFIG, ELITES, HISTORY, MLFLOW, STEPS, SUMMARY
from cluster.text import as_argument, file_name
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import label, map_digest
from gridsim.packages import DISTRIBUTION

CURVES, TRAJECTORY, PAGE, ONNX = "curves.png", "trajectory.png", "drive.html", "champion.onnx"
FILES = (CHAMPION, CHECKPOINT, CONFIG, CURVES, ELITES, HISTORY, ONNX, PAGE, STEPS, SUMMARY, TRAJECTORY)
"""Files of a finished run that MLflow gets. Others in its folder, such as the user's own, are not sent."""
BEGUN = {CONFIG, STEPS, MLFLOW}
"""Files that a run's folder may hold before the run's first step is saved."""
CONFIG_FORMAT = 3


class RunError(GridSimError):
    """A run's folder that cannot be made, read or resumed; the message is one line for the user."""


@dataclass
class RunFolder:
    """Where a run is kept, and what it was asked to do."""

    path: Path
    settings: RunSettings  # these, and the genome of `init` if there is one, decide its champion
    init: str = ""  # path of the champion it started from; "": it started from random networks
    init_sha256: str = ""  # digest of that champion's genome
    saved: tuple[dict[str, np.ndarray], dict[str, Any]] | None = None  # its checkpoint, if it is resumed

    @property
    def name(self) -> str:
        return self.path.name

    def config(self) -> dict[str, Any]:
        """What config.json holds: enough to repeat the run."""
        return {
            "format": CONFIG_FORMAT,
            "command": self.settings.command,
            "gridsim": version(DISTRIBUTION),
            "settings": dataclasses.asdict(self.settings),
            "curriculum": dataclasses.asdict(self.settings.curriculum()),
            "simulator": dataclasses.asdict(self.settings.simulator()),
            "init": self.init,
            "init_sha256": self.init_sha256,
            **_sources(self.settings),
        }

    def digest(self) -> str:
        """Digest of all that must be the same when a run is resumed."""
        parts = self.config()
        for name in self.settings.extendable:
            parts["settings"].pop(name)
        for name in ("gridsim", "init"):
            parts.pop(name)
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def write_config(self) -> None:
        """Write config.json."""
        checkpoint.write_json(self.path / CONFIG, self.config())


def read_config(path: Path) -> tuple[RunSettings, str]:
    """A run's settings, and the path of its initial champion or "", from its config.json, which is `path`.

    Raises: RunError if the file is not usable, or if maps or the simulator's parameters have changed since.
    """
    try:
        config = json.loads(path.read_bytes())
        if config["format"] != CONFIG_FORMAT:
            raise RunError(f"{path} is of another GridSim, whose runs this one cannot continue; start a new run")
        settings = from_dict(SETTINGS[config["command"]], config["settings"])
        if config.get("map_sha256") != _sources(settings).get("map_sha256"):
            raise RunError(f"{settings.scenario} is not what it was for {path}; put it back, or start a new run")
        if "sim" in config["settings"] and SimConfig.of(config["simulator"]) != settings.simulator():
            raise RunError(f"--sim {settings.sim} is not what it was for {path}; put it back, or start a new run")
        return settings, str(config.get("init", ""))
    except RunError:
        raise
    except GridSimError as error:
        raise RunError(f"{path}: {error}") from error
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise RunError(f"{path}: not a run's {CONFIG} ({one_line(error):.120})") from error


def _sources(settings: RunSettings) -> dict[str, str]:
    """Digests of the user's files that a run depends on, if any: maps and a fitness function. Raises GridSimError."""
    found = {}
    if digest := map_digest(settings.scenario):
        found["map_sha256"] = digest
    if isinstance(settings, EvolveSettings) and settings.fitness:
        found["fitness_sha256"] = fitness.digest(settings.fitness)
    return found


_locked = set[tuple[int, int]]()  # folders that this process has locked, by device and inode


def lock(path: Path) -> None:
    """Make the folder of a run or a comparison and lock it until this process ends. Raises RunError.

    Locking it again does nothing, whatever it is called then.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        folder = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise RunError(f"--output: {path} cannot be made: {error.strerror}; choose another folder") from error
    found = os.fstat(folder)
    if (found.st_dev, found.st_ino) in _locked:
        os.close(folder)
        return
    with contextlib.suppress(OSError):  # NFS cannot lock folders
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(folder)
            raise RunError(f"{path}: another process is at work on it; wait for it, or stop it") from None
    _locked.add((found.st_dev, found.st_ino))


def open_run(folder: Path) -> RunFolder:
    """Lock the folder of a run that is to be resumed, then read and check its checkpoint. Raises RunError."""
    if not (folder / CONFIG).is_file():
        raise RunError(f"{folder} is not a run's folder: it has no {CONFIG}")
    path = folder.resolve()
    lock(path)
    run = RunFolder(path, *read_config(folder / CONFIG))
    anew = f"start it anew with --config {as_argument(folder / CONFIG)}"
    if not (folder / CHECKPOINT).is_file():
        raise RunError(f"{folder} has no {CHECKPOINT} to resume from; {anew}")
    try:
        run.saved = checkpoint.load(folder / CHECKPOINT)
    except checkpoint.CheckpointError as error:
        raise RunError(f"{error}; {anew}") from error
    meta = run.saved[1]
    if _sources(run.settings).get("fitness_sha256") != json.loads((folder / CONFIG).read_bytes()).get("fitness_sha256"):
        source = vars(run.settings)["fitness"]
        raise RunError(f"{source} is not what it was as {folder} began; put it back, or start a new run")
    run.init_sha256 = str(meta.get("init_sha256", ""))
    if meta.get("digest") != run.digest():
        raise RunError(
            f"{folder}: {CONFIG} and {CHECKPOINT} do not belong together: one of them was edited, or another "
            "version of GridSim wrote them; start a new run"
        )
    return run


def new_run(
    output: Path, name: str, settings: RunSettings, init: str = "", init_sha256: str = "", may_exist: bool = False
) -> RunFolder:
    """A new run's folder, checked but not yet made. Raises RunError.

    Args: `may_exist`: whether the folder may be that of a run which was stopped before its first step was saved.
    """
    kind = file_name(f"{label(settings.scenario)}-{settings.algorithm}-s{settings.seed}")
    return RunFolder(new_folder(output, name, kind, may_exist), settings, init, init_sha256)


def new_folder(output: Path, name: str, kind: str, may_exist: bool = False) -> Path:
    """The folder of a new run or comparison, checked but not yet made; it may be there if it is empty.

    Args: `name`, "" to name it by `kind` and time; `may_exist` as for `new_run`. Raises: RunError.
    """
    if not name:
        name = f"{kind}-{time.strftime('%Y%m%d-%H%M%S')}"
    if not re.fullmatch(r"[\w][\w.+=@-]{0,199}", name):
        raise RunError(f"--name {name!r}: begin with a letter, digit or _, then also . + - = @; at most 200 of them")
    path = output / name
    allowed = BEGUN if may_exist else set[str]()
    if path.exists() and not (path.is_dir() and {p.name for p in path.glob("[!.]*")} <= allowed):
        again = f"continue it with --resume {as_argument(path)}"
        raise RunError(f"{path} exists already; choose another --name, or {again}")
    return path.absolute()


def is_finished(run: RunFolder) -> bool:
    """Whether nothing is left to do: learning has ended by the run's settings, and champion and summary are there."""
    there = all((run.path / name).is_file() for name in (SUMMARY, CHAMPION))
    return run.saved is not None and there and run.settings.ended(run.saved[1])
