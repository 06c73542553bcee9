"""A run's folder and its life: prepare or resume, learn, save after every step, close.

A step is a generation or an evaluation. The order of saving after each: the checkpoint (which holds the history),
history.csv made from it, the MLflow row. It is saved while the workers are busy with the next one. Whatever kills the
process, the folder holds a whole step, the last or the one before, and a resumed run gives the same champion.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import json
import math
import os
import re
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cluster.runs import checkpoint
from cluster.runs.champion import Champion, load_champion
from cluster.runs.checkpoint import CHAMPION, CHECKPOINT, CONFIG, CheckpointError
from cluster.runs.settings import SETTINGS, DqnSettings, EvolveSettings, RunSettings, SettingsError, from_dict, to_dict
from cluster.tracking import description
from cluster.tracking.address import TrackingError, check_uri
from cluster.tracking.tracker import Tracker
from cluster.training.evolution import Evolution
from cluster.training.trainer import Learning, Maps, held_out_episodes, now
from cluster.workers.pool import WorkerPool
from evolution.episodes.curriculum import HELD_OUT_SEEDS
from evolution.episodes.rollout import trajectory as drive_trajectory
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.files import map_digest, short_lap
from gridsim.maps.scenarios import is_map_file, label

HISTORY, ELITES, SUMMARY, VIDEO = "history.csv", "elites.npz", "summary.json", "champion.mp4"
CONFIG_FORMAT = 2
OLD_FORMATS = (1,)  # GridSim 0.1: other searches, other parameters
NOT_LOGGED = ("target_m",)  # columns of the history that are no metric


class RunError(GridSimError):
    """A run's folder that cannot be made, read or resumed; the message is one line for the user."""


@dataclass
class RunFolder:
    """Where a run is kept, and what it was asked to do.

    Attributes:
        path: the folder.
        settings: what decides its champion.
        init: path of the champion it started from, or "".
        init_sha256: digest of that genome, or "".
        map_sha256: digest of the map's file, or "".
        saved: arrays and meta of its checkpoint, where it is resumed.
        tracking_key: by which MLflow's run is found again, even if a process was killed before it knew the run's id.
    """

    path: Path
    settings: RunSettings
    init: str = ""
    init_sha256: str = ""
    map_sha256: str = ""
    saved: tuple[dict[str, np.ndarray], dict[str, Any]] | None = None
    tracking_key: str = field(default_factory=lambda: uuid.uuid4().hex)

    @property
    def name(self) -> str:
        return self.path.name

    def config(self) -> dict[str, Any]:
        """What config.json holds: enough to repeat the run."""
        return {
            "format": CONFIG_FORMAT,
            "command": self.settings.command,
            "gridsim": version("gridsim"),
            "settings": to_dict(self.settings),
            "curriculum": dataclasses.asdict(self.settings.curriculum()),
            "simulator": dataclasses.asdict(SimConfig()),
            "init": self.init,
            "init_sha256": self.init_sha256,
            **({"map_sha256": self.map_sha256} if self.map_sha256 else {}),
        }

    def digest(self) -> str:
        """Of what must not differ between a run and its resumption."""
        parts = self.config()
        for name in self.settings.unbound:
            parts["settings"].pop(name)
        for name in ("gridsim", "init"):
            parts.pop(name)
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def write_config(self) -> None:
        """Write config.json."""
        checkpoint.write_atomic(self.path / CONFIG, (json.dumps(self.config(), indent=2) + "\n").encode())


def read_config(path: Path) -> tuple[RunSettings, str]:
    """Settings of either learner and the initial champion's path from a run's config.json. Raises RunError."""
    try:
        if path.stat().st_size > 1 << 20:
            raise RunError(f"{path}: too large for a run's {CONFIG}")
        config = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(config, dict) and config.get("format") in OLD_FORMATS:
            raise RunError(f"{path} is of a run of GridSim 0.1, which this version cannot go on with; start a new run")
        if not isinstance(config, dict) or config.get("format") != CONFIG_FORMAT:
            raise RunError(f"{path}: not a {CONFIG} of this GridSim")
        settings = from_dict(SETTINGS[config["command"]], dict(config["settings"]))
        if config.get("map_sha256", "") != _map_sha256(settings):
            raise RunError(f"{settings.scenario} is not what it was for {path}; put it back, or start a new run")
        return settings, str(config.get("init", ""))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error
    except SettingsError as error:
        raise RunError(f"{path}: {error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path}: not a run's {CONFIG}: {type(error).__name__}") from error


def _map_sha256(settings: RunSettings) -> str:
    """Digest of the map's file, or "". Raises SettingsError."""
    try:
        return map_digest(settings.scenario) if is_map_file(settings.scenario) else ""
    except ValueError as error:
        raise SettingsError(str(error)) from error


@functools.cache  # a process may ask again
def lock(path: Path) -> None:
    """Make the folder of a run or a comparison and lock it until this process ends. Raises RunError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        folder = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise RunError(f"{path} cannot be made: {error.strerror}; choose another --output") from error
    with contextlib.suppress(OSError):  # NFS cannot lock folders
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"{path}: another process is at work on it; wait for it, or stop it") from None


def open_run(folder: Path) -> RunFolder:
    """A run's folder to be resumed, locked, its checkpoint read and checked. Raises RunError."""
    if not (folder / CONFIG).is_file():
        raise RunError(f"{folder} is no run's folder: it has no {CONFIG}")
    lock(folder.resolve())
    settings, init = read_config(folder / CONFIG)
    run = RunFolder(folder.resolve(), settings, init, map_sha256=_map_sha256(settings))
    if not (folder / CHECKPOINT).is_file():
        raise RunError(f"{folder} has no {CHECKPOINT} to resume from; start it anew with --config {folder / CONFIG}")
    try:
        run.saved = checkpoint.load(folder / CHECKPOINT)
    except CheckpointError as error:
        raise RunError(str(error)) from error
    meta = run.saved[1]
    run.init_sha256 = str(meta.get("init_sha256", ""))
    if meta.get("digest") != run.digest():
        raise RunError(f"{folder}: {CONFIG} and {CHECKPOINT} do not belong together; one of them was edited")
    tracking = meta["tracking"] if isinstance(meta.get("tracking"), dict) else {}
    fits = (
        all(type(meta.get(name)) is int for name in settings.counts)
        and type(meta.get("solved")) is bool
        and all(isinstance(tracking.get(name), str) for name in ("uri", "key"))
        and isinstance(tracking.get("run_id"), str | None)
    )
    if not fits:
        raise RunError(f"{folder / CHECKPOINT}: its parts are not those of a run")
    run.tracking_key = tracking["key"]
    return run


def new_run(output: Path, name: str, settings: RunSettings, init: str = "", init_sha256: str = "") -> RunFolder:
    """A new run's folder, checked but not yet made. Raises RunError."""
    if not name:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        name = f"{description.what(settings)}-{stamp}"
        if (output / name).exists():
            name += f"-{os.getpid()}"
    if not re.fullmatch(r"[\w][\w.+=@-]{0,199}", name):
        raise RunError(f"--name {name!r}: use letters, digits, '.', '_' and '-' only")
    path = output / name
    if path.exists():
        raise RunError(f"{path} exists already; choose another --name, or continue it with --resume {path}")
    parent = output
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise RunError(f"--output {output}: cannot be written; choose another folder")
    return RunFolder(path.absolute(), settings, init, init_sha256, _map_sha256(settings))


def is_finished(run: RunFolder) -> bool:
    """Whether there is nothing left to do: learned to the end, and all files are there."""
    return run.saved is not None and (run.path / SUMMARY).is_file() and run.settings.ended(run.saved[1])


def new_learning(
    settings: RunSettings,
    pool: WorkerPool,
    maps: Maps,
    initial: np.ndarray | None = None,
    on_progress: Callable[[str, int, int], None] | None = None,
) -> Learning:
    """The learner that such settings ask for."""
    if isinstance(settings, EvolveSettings):
        return Evolution(settings, pool, maps, initial, on_progress=on_progress)
    assert isinstance(settings, DqnSettings)
    from cluster.training.dqn import Dqn  # and PyTorch, which evolution does not need

    return Dqn(settings, pool, maps, initial, on_progress=on_progress)


@dataclass
class Session:
    """One process's share of a run, from start or resume to its end.

    Attributes:
        run: the folder.
        pool: who evaluates.
        maps: who builds maps.
        tracker: who logs to MLflow.
        process_started: time.perf_counter() of the process's start.
        on_row: told how many steps are done, and the last one's row.
        film: whether the champion is filmed.
        wall_limit_s: seconds of learning, with those before a resumption, after which no step but the first is begun.
        lost: one line about what could not be written, beside what matters.
    """

    run: RunFolder
    pool: WorkerPool
    maps: Maps
    tracker: Tracker
    process_started: float
    initial: np.ndarray | None = None
    on_row: Callable[[int, dict[str, float]], None] | None = None
    on_progress: Callable[[str, int, int], None] | None = None
    film: bool = True
    wall_limit_s: float = math.inf
    lost: str = ""
    learning: Learning = field(init=False)
    _unsaved: bool = False  # whether the last step is in memory alone

    def __post_init__(self) -> None:
        self.learning = new_learning(self.run.settings, self.pool, self.maps, self.initial, self.on_progress)
        self._digest = self.run.digest()
        if self.run.saved is not None:
            try:
                self.learning.restore(*self.run.saved)
            except (KeyError, IndexError, TypeError, ValueError) as error:
                path = self.run.path / CHECKPOINT
                raise RunError(f"{path} was written by another version of GridSim; start a new run") from error

    def learn(self) -> None:
        """Learn to the end, saving after every step."""
        learning, scenario = self.learning, self.run.settings.scenario
        if is_map_file(scenario) and (problem := short_lap(scenario, learning.sim)):
            learning.warn(problem)
        log_rows(self.tracker, learning.history)
        if learning.history:
            self._write_history()  # it may lack the last row: it is written after the checkpoint
        learning.meanwhile, learning.out_of_time = self._save_last, self._out_of_time
        try:
            while not learning.done() and not (learning.steps and self._out_of_time()):
                row = learning.step()
                self.maps.ahead(HELD_OUT_SEEDS, later=True)  # `finish` needs them
                learning.timed(row, self._wall_s(), learning.history[-2] if len(learning.history) > 1 else None)
                self._unsaved = True
                if self.on_row:
                    self.on_row(learning.steps, row)
            self._save_last()
        except CheckpointError:
            raise
        except BaseException:
            self._save_last()  # the state is whole until the next step changes it
            raise

    def _wall_s(self) -> float:
        """Seconds that the run has taken, in this process and before."""
        return self.learning.wall_before_s + now() - self.process_started

    def _out_of_time(self) -> bool:
        return self._wall_s() >= self.wall_limit_s

    def _save_last(self) -> None:
        """Save and log the last step, if that was not done."""
        if self._unsaved:
            learning = self.learning
            self.save()
            self._unsaved = False
            log_rows(self.tracker, learning.history[-1:], learning.steps - 1)

    def save(self) -> None:
        """Write the checkpoint, then history.csv from it. Raises CheckpointError; the ones before are kept."""
        arrays, meta = self.learning.state()
        meta |= {
            "digest": self._digest,
            "init_sha256": self.run.init_sha256,
            "tracking": {"uri": self.tracker.uri, "run_id": self.tracker.run_id, "key": self.run.tracking_key},
        }
        checkpoint.save(self.run.path / CHECKPOINT, arrays, meta)
        self._write_history()

    def _write_history(self) -> None:
        checkpoint.write_atomic(self.run.path / HISTORY, self.learning.history_csv(), durable=False)

    def finish(self, workers: int) -> dict[str, Any]:
        """Measure the champion on held-out drives and write what is left: champion, elites, summary, pictures.

        Returns: the summary.
        """
        from cluster.report import pictures

        learning, path = self.learning, self.run.path
        learning.conclude()
        assert learning.champion is not None
        settings = self.run.settings
        champion = Champion(
            learning.champion.genome, settings.policy, settings.scenario, learning.sim, settings.traffic
        )
        champion.save(path / CHAMPION)
        checkpoint.save(path / ELITES, {"genomes": np.array(learning.elites)}, {"policy": self.run.settings.policy})
        episodes = held_out_episodes(self.maps, settings.traffic)
        seed = episodes.maps[int(episodes.rows[0]["map"])]
        scenario, start, world = self.maps.get(seed), episodes.rows[0]["start"], episodes.worlds[0]
        with self._filmed(seed, start, world, f"{champion.scenario}, held-out map {scenario.seed:,}"):
            figures = learning.held_out()
            self.tracker.log_model(path, description.torch_model(champion, settings, figures))  # while it is drawn
            pictures.curves(learning.history, path / "curves.png", learning.step_name)
            result, states, _ = drive_trajectory(
                learning.spec, champion.genome, scenario, start, learning.curriculum.goal_limits(), learning.sim, world
            )
            pictures.trajectory(
                scenario, states, path / "trajectory.png",
                f"{label(settings.scenario)}, held-out map {scenario.seed}: {float(result['distance']):,.0f} m",
            )  # fmt: skip
        self.tracker.wall_s = wall = self._wall_s()
        best = learning.history[learning.champion.step]
        summary = {
            "name": self.run.name,
            "mlflow_run_id": self.tracker.run_id or "",
            "scenario": self.run.settings.scenario,
            "seed": self.run.settings.seed,
            "workers": workers,
            **learning.summary(),
            "car_steps": learning.car_steps,
            "wall_s": round(wall, 3),
            "car_steps_per_s": round(learning.car_steps / wall, 1),
            "champion_sha256": champion.sha256,
            f"champion_{learning.step_name}": learning.champion.step,
            "validation_success_rate": learning.champion.success_rate,
            "solved": learning.solved,
            "lost_chunks": learning.lost_chunks,
            "training_s": learning.history[-1]["wall_s"],
            **{f"best_{name}": best[name] for name in ("car_steps", "wall_s")},
            "held_out": figures,
        }
        self.tracker.log_summary(description.held_out_metrics(figures))
        write_summary(self.run.path, summary)
        return summary

    def complete(self, workers: int, note: Callable[[str], None]) -> dict[str, Any]:
        """`finish`, and hand all that there is to MLflow; `note` is told what is going on. Returns the summary."""
        note(f"measuring {'and filming ' if self.film else ''}the champion on held-out drives")
        summary = self.finish(workers)
        self._drop_replay()
        note("logging to MLflow")
        log_end(self.tracker, self.run, summary, description.describe(self.run, summary))
        return summary

    def _drop_replay(self) -> None:
        """Take a DQN's replay, most of its checkpoint, out of what is kept of a run that has ended."""
        path = self.run.path / CHECKPOINT
        with contextlib.suppress(CheckpointError):  # then it stays
            arrays, meta = checkpoint.load(path)
            if meta.pop("replay", None):
                kept = {name: array for name, array in arrays.items() if not name.startswith("replay_")}
                checkpoint.save(path, kept, meta)

    @contextlib.contextmanager
    def _filmed(self, seed: int, start: np.ndarray, world: np.ndarray, title: str) -> Iterator[None]:
        """Film the champion's drive meanwhile. A film is no reason to lose a run: why there is none is in `lost`."""
        if not self.film:
            yield
            return
        from cluster.report.film import Filming, VideoError

        path = self.run.path
        film = Filming(path / CHAMPION, seed, start, world, path / VIDEO, title)
        try:
            yield
            film.wait(self.learning.on_progress)
        except VideoError as error:
            (path / VIDEO).unlink(missing_ok=True)
            self.lost = f"no {VIDEO}: {error}"
        finally:
            film.stop()


def make_tracker(run: RunFolder, uri: str, experiment: str, parent_id: str = "", **more: Any) -> Tracker:
    """The run's tracker, not yet started; `parent_id` is MLflow's run that it belongs to. `more` is the Tracker's."""
    known = run.saved[1]["tracking"] if run.saved else {}
    tags = description.tags(run.settings) | ({"mlflow.parentRunId": parent_id} if parent_id else {})
    return Tracker(
        uri, experiment, description.title(run.name, run.settings), description.params(run.settings), tags,
        run_id=known.get("run_id") if known.get("uri") == uri else None,
        key=run.tracking_key, start=False, note=description.describe(run), **more,
    )  # fmt: skip


def log_rows(tracker: Tracker, rows: list[dict[str, float]], first: int = 0, ago_s: float = 0.0) -> None:
    """Log rows of a history, of step `first` and those after it, the last one of so many seconds ago."""
    for step, row in enumerate(rows, first):
        metrics = {name: value for name, value in row.items() if name not in NOT_LOGGED}
        tracker.log_row(step, metrics, ago_s + rows[-1]["wall_s"] - row["wall_s"])
        tracker.wall_s = row["wall_s"]


def log_end(tracker: Tracker, run: RunFolder, summary: dict[str, Any], note: str) -> None:
    """Log the description and the files of a finished run; its summary gets the id of MLflow's run."""
    if not summary.get("mlflow_run_id"):
        with contextlib.suppress(TrackingError):  # what is missing there is said when the tracker closes
            summary["mlflow_run_id"] = tracker.wait_ready(30.0)
            write_summary(run.path, summary)
    tracker.describe(note)
    tracker.log_artifacts(run.path)


def log_missing(run: RunFolder, uri: str, experiment: str) -> tuple[str, str | None]:
    """Log what MLflow lacks of a finished run, with the times of then; what MLflow has is not touched.

    Args: the run, opened; the tracking address, or "" for the one that the run has; the experiment.
    Returns: what was logged, in a few words, and one line about what could not be, or None.
    """
    assert run.saved is not None
    arrays, meta = run.saved
    path = run.path / SUMMARY
    try:
        summary, ended = json.loads(path.read_bytes()), path.stat().st_mtime
        model = description.torch_model(load_champion(run.path / CHAMPION), run.settings, summary["held_out"])
        figures, note = description.held_out_metrics(summary["held_out"]), description.describe(run, summary)
        uri = check_uri(uri or meta["tracking"]["uri"] or None)
        tracker = make_tracker(run, uri, experiment, late=True, started=ended - summary["wall_s"])
    except (CheckpointError, TrackingError) as error:
        return "", f"what MLflow lacks is not sent: {error}"
    except (OSError, LookupError, TypeError, ValueError, StopIteration) as error:  # edited
        reason = f"{run.path} has not the files of a finished run ({type(error).__name__})"
        return "", f"what MLflow lacks is not sent: {reason}"
    ago_s = time.time() - ended
    log_rows(tracker, [dict(zip(meta["columns"], row, strict=True)) for row in arrays["history"].tolist()], 0, ago_s)
    tracker.log_summary(figures, ago_s=ago_s)
    tracker.wall_s = summary["wall_s"]
    tracker.log_model(run.path, model)
    log_end(tracker, run, summary, note)
    lost = tracker.close("FINISHED", timeout_s=60.0)
    return str(tracker.sent), lost


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Write summary.json, the mark of a finished run."""
    checkpoint.write_atomic(folder / SUMMARY, (json.dumps(summary, indent=2) + "\n").encode())
