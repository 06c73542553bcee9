"""A training run, new or resumed, from its start to its end, for commands and comparisons alike.

A step is a generation or an evaluation. Steps are saved while the workers are busy, generations once a second: first
their elites and rows of the history (`store/steps.py`), then the checkpoint that counts them, history.csv and MLflow's
rows. Whatever kills the process, the folder holds a whole step, the previous one or one of a second ago, and a resumed
run gives the same champion.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import signal
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from time import perf_counter, time
from typing import Any

import numpy as np

from cluster.learn.evolution import Evolution
from cluster.learn.learning import Learning, Maps, State
from cluster.redaction import redacted
from cluster.settings import DqnSettings, EvolveSettings, RunSettings
from cluster.store import checkpoint, steps
from cluster.store.champion import Champion, load_champion
from cluster.store.checkpoint import CHAMPION, CHECKPOINT, STEPS, CheckpointError
from cluster.store.folder import (
    CURVES,
    ELITES,
    FILES,
    HISTORY,
    PAGE,
    SUMMARY,
    TRAJECTORY,
    RunError,
    RunFolder,
    lock,
    write_summary,
)
from cluster.text import as_argument, count
from cluster.tracking import description
from cluster.tracking.address import TrackingError, check_uri, with_password
from cluster.tracking.mlflow_run import Identity, Status, quiet
from cluster.tracking.tracker import Tracker
from cluster.workers import kernels
from cluster.workers.pool import SerialPool, WorkerPool
from evolution.episodes.curriculum import HELD_OUT_SEEDS, VALIDATION_SEEDS
from gridsim.car.ego import DISTANCE
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.map import Map
from gridsim.maps.scenarios import is_map_file, label

ELITES_SHOWN = 24  # on the page beside the champion, at most; most of them early ones, which show the learning
NOT_LOGGED = ("target_m",)  # columns of the history that are not metrics


class Reporter:
    """Shows how a run goes; this one shows only warnings. `resume` is the command that goes on with the run."""

    resume = ""

    def warn(self, text: str) -> None:
        """One line."""
        warnings.warn(text, stacklevel=2)

    def compiling(self) -> AbstractContextManager[object]:
        """While the simulator is being compiled."""
        return nullcontext()

    def learning(self, session: Session) -> AbstractContextManager[object]:
        """From the first step until the champion is measured."""
        return nullcontext()

    def row(self, steps: int, row: dict[str, float]) -> None:
        """The number of steps that are done, and the last one's row."""

    def members(self, stage: str, done: int, total: int) -> None:
        """Part of a step is done."""

    def note(self, text: str) -> None:
        """What is being done after the last step."""

    def stopping(self) -> None:
        """A run that was interrupted is being closed."""


@dataclass
class Workers:
    """The worker pool of a run, or of several one after another, opened for the first one."""

    number: int  # 0 evaluates in this process
    address: str | None  # of a Ray cluster
    patience_s: float  # without any worker, after which a run stops
    _pool: WorkerPool | None = None
    _maps: Maps | None = None

    def prepare(self) -> None:
        """Set what libraries read from the environment; to be called before there are threads."""
        quiet()
        if self.number:
            from cluster.workers import ray_session

            ray_session.prepare(self.address)

    def open(self, maps: Maps) -> WorkerPool:
        """The pool, which gets its maps from `maps`."""
        self._maps = maps
        if self._pool is None and self.number:
            from cluster.workers.ray_pool import RayPool

            here = self.address is None  # a cluster's hosts may be of another type, and then give other bits
            self._pool = RayPool(self.number, self._build, self.address, patience_s=self.patience_s, begin_here=here)
        return self._pool or SerialPool(self._build)

    def close(self) -> None:
        """Stop the workers; the next run starts new ones."""
        if self._pool:
            self._pool.close()
            self._pool = None

    def _build(self, scenario: str, seed: int) -> Map:
        assert self._maps is not None
        return self._maps.build(scenario, seed)


def train(
    run: RunFolder, workers: Workers, uri: str, experiment: str, reporter: Reporter, started: float | None = None,
    *, initial: np.ndarray | None = None, parent_id: str = "", wall_limit_s: float = math.inf,
) -> Session:  # fmt: skip
    """Train a run to its end, finish it, and send it to MLflow.

    Args: `started` is time.perf_counter() of the process's start; None: time counts from the first step on. For the
    others see `Session`. The workers stay open.
    Raises: GridSimError, and whatever else stops a run; the last whole step is saved.
    """
    settings = run.settings
    status: Status = "KILLED"
    session: Session | None = None
    quiet()
    maps = Maps(settings.scenario, SimConfig())
    warming = kernels.Warming(settings)
    try:
        if workers.address:
            workers.open(maps)  # its hosts start, and compile for themselves
        warming.start()
        if warming.processes:
            with reporter.compiling():
                warming.wait()
        session = Session(
            run, workers.open(maps), maps, uri, experiment, reporter, perf_counter() if started is None else started,
            initial, parent_id, wall_limit_s,
        )  # fmt: skip
        warming.reap()
        maps.ahead(session.learning.curriculum.map_seeds[:3])
        maps.ahead(VALIDATION_SEEDS, later=True)
        kernels.compile_kernels(settings.policy, settings.traffic, settings.command)
        lock(run.path)
        run.write_config()
        if started is None:
            session.started = perf_counter()
        with reporter.learning(session):
            session.learn()
            session.finish(workers.number)
        status = "FINISHED"
        return session
    except SystemError as error:  # what Ray turns a signal into while it waits
        raise error.__cause__ or error from None
    except Exception:
        status = "FAILED"
        raise
    finally:
        with undisturbed():
            if status == "KILLED":
                with contextlib.suppress(OSError, SystemExit):  # by rich, if what reads the output has ended, too
                    reporter.stopping()
            warming.stop()
            maps.close()
            if session:
                if lost := session.tracker.close(status):
                    later = f"; send it later with: {reporter.resume}" if status == "FINISHED" else ""
                    reporter.warn(lost + later)
                else:
                    session.report_outage()


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore the signals that stop a run, which must not cut short saving and closing."""
    before = [(s, signal.signal(s, signal.SIG_IGN)) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def new_learning(settings: RunSettings, pool: WorkerPool, maps: Maps, initial: np.ndarray | None = None) -> Learning:
    """The learner that these settings ask for."""
    if isinstance(settings, EvolveSettings):
        return Evolution(settings, pool, maps, initial)
    assert isinstance(settings, DqnSettings)
    from cluster.learn.dqn import Dqn  # imports PyTorch, which evolution does not need

    return Dqn(settings, pool, maps, initial)


@dataclass
class Session:
    """One process's share of a run, from start or resume to its end."""

    run: RunFolder
    pool: WorkerPool
    maps: Maps
    uri: str  # MLflow's address
    experiment: str
    reporter: Reporter = field(default_factory=Reporter)
    started: float = field(default_factory=perf_counter)  # from which the run's time counts
    initial: np.ndarray | None = None  # a genome to start from, float32 [genes]
    parent_id: str = ""  # MLflow's run that this one belongs to
    wall_limit_s: float = math.inf  # of learning, also before it was resumed, after which only a first step begins
    summary: dict[str, Any] = field(default_factory=dict)  # what summary.json holds, once it is finished
    learning: Learning = field(init=False)
    tracker: Tracker = field(init=False)
    _state: State = field(init=False)  # after the last whole step, with the unsaved rows of the history
    _saved_steps: int = 0  # steps that are in the checkpoint
    _logged_steps: int = 0  # steps that are in history.csv, and handed to the tracker
    _sha256: Any = field(default_factory=hashlib.sha256)  # of their records
    _saved_at: float = -math.inf
    _away: bool = False  # whether an outage of MLflow was reported

    def __post_init__(self) -> None:
        self.learning = learning = new_learning(self.run.settings, self.pool, self.maps, self.initial)
        learning.warn, learning.on_progress = self.reporter.warn, self.reporter.members
        learning.meanwhile, learning.out_of_time = self._save_now_and_then, self._out_of_time
        self._digest = self.run.digest()
        if self.run.saved is not None:
            arrays, meta = self.run.saved
            try:
                saved = steps.resume(self.run.path, arrays, meta, learning.spec.size)
                learning.restore(arrays | {"history": saved["row"]}, meta)
            except CheckpointError:
                raise
            except (KeyError, IndexError, TypeError, ValueError) as error:
                path = self.run.path / CHECKPOINT
                raise RunError(f"{path} was written by another version of GridSim; start a new run") from error
            self._sha256.update(saved.tobytes())
        self.tracker = make_tracker(
            self.run, self.uri, self.experiment, self.parent_id, started=time() - self._wall_s()
        )

    def learn(self) -> None:
        """Learn to the end, saving once a second and at the end."""
        learning = self.learning
        self._saved_steps = learning.steps
        self._state = learning.state(self._saved_steps)
        self.save()  # history.csv may lack the last row: it is written after the checkpoint
        try:
            while not learning.done() and not (learning.steps and self._out_of_time()):
                row = learning.step()
                self.maps.ahead(HELD_OUT_SEEDS, later=True)  # `finish` needs them
                learning.add_wall_clock(self._wall_s())
                self._state = learning.state(self._saved_steps)
                self.reporter.row(learning.steps, row)
                self.report_outage()
            self.save()
        except BaseException:
            with undisturbed():
                self.save()
            raise

    def report_outage(self) -> None:
        """Warn once when MLflow cannot be reached, and once when it is back."""
        error, where = self.tracker.error, redacted(self.tracker.uri)
        if error and not self._away:
            self.reporter.warn(f"MLflow at {where} cannot be used: {error}; the run continues and sends its rows later")
        elif self._away and not error:
            self.reporter.warn(f"MLflow at {where} is back, and has all rows")
        self._away = bool(error)

    def _wall_s(self) -> float:
        """Seconds that the run has taken, in this process and before."""
        return self.learning.wall_before_s + perf_counter() - self.started

    def _out_of_time(self) -> bool:
        return self._wall_s() >= self.wall_limit_s

    def _save_now_and_then(self) -> None:
        if self._saved_steps < self.learning.steps and perf_counter() - self._saved_at >= self.learning.save_every_s:
            self.save()

    def save(self) -> None:
        """Write the last whole step's checkpoint, then history.csv, and log the new rows, unless that is done.

        If it is interrupted, it can be called again. Raises: CheckpointError; the previous files are kept.
        """
        learning, (arrays, meta), saved = self.learning, self._state, self._saved_steps
        done, path = meta[self.run.settings.step_name], self.run.path
        if done > saved:
            new = steps.records(arrays["history"], [learning.elites[k] for k in range(saved, done)])
            steps.append(path / STEPS, saved, new)
            sha256 = self._sha256.copy()
            sha256.update(new.tobytes())
            # MLflow gets the checkpoint, so it must not hold a password.
            tracking = {"uri": redacted(self.tracker.uri), "run_id": self.tracker.run_id, "key": self.run.tracking_key}
            meta |= {"digest": self._digest, "init_sha256": self.run.init_sha256, "tracking": tracking}
            meta |= {"steps": done, "steps_sha256": sha256.hexdigest()}
            checkpoint.save(path / CHECKPOINT, {k: v for k, v in arrays.items() if k != "history"}, meta)
            self._saved_steps, self._sha256, self._saved_at = done, sha256, perf_counter()
            for k in range(saved, done):
                del learning.elites[k]
        if done > self._logged_steps:
            checkpoint.write_atomic(path / HISTORY, learning.history_csv(done), durable=False)
            log_rows(self.tracker, learning.history[self._logged_steps : done], self._logged_steps)
            self._logged_steps = done

    def finish(self, workers: int) -> None:
        """Measure the champion on held-out drives, write the remaining files, and hand all of them to the tracker."""
        from cluster.report import film, page, pictures

        self.reporter.note("measuring the champion on held-out drives")
        learning, path, settings = self.learning, self.run.path, self.run.settings
        best = learning.choose_champion()
        champion = Champion(best.genome, settings.policy, settings.scenario, learning.sim, settings.traffic)
        champion.save(path / CHAMPION)
        elites = steps.read_elites(path, settings.policy)
        checkpoint.save(path / ELITES, {"genomes": elites}, {"policy": settings.policy})
        episodes, figures = learning.held_out()
        self.tracker.log_model(path, description.torch_model(champion, settings, figures))  # meanwhile, in its thread
        seed = episodes.maps[int(episodes.rows[0]["map"])]
        road_map, start, world = self.maps.get(seed), episodes.rows[0]["start"], episodes.worlds[0]
        pictures.curves(learning.history, path / CURVES, settings.step_name)
        drive = film.record(champion, road_map, start, learning.sim.episode.time_limit, world)
        where = "" if is_map_file(settings.scenario) else f", held-out map {road_map.seed:,}"
        title = f"{label(settings.scenario)}{where}: {drive.cars[-1, DISTANCE]:,.0f} m"
        pictures.trajectory(road_map, drive.cars, path / TRAJECTORY, title)
        shown = [page.Shown("champion", "champion", drive)]
        for k in (np.unique(np.geomspace(1, learning.steps, ELITES_SHOWN).round().astype(int))[::-1] - 1).tolist():
            elite = dataclasses.replace(champion, genome=elites[k])
            drive = film.record(elite, road_map, start, learning.sim.episode.time_limit, world)
            shown.insert(0, page.Shown(f"elite of {settings.step_name} {k}", str(k), drive, stride=2))
        page.write_page(path / PAGE, f"GridSim: {self.run.name}, {title}", shown, learning.sim)
        wall = self._wall_s()
        row = learning.history[best.step]
        self.summary = {
            "name": self.run.name,
            "mlflow_run_id": self.tracker.run_id or "",
            "scenario": settings.scenario,
            "seed": settings.seed,
            "workers": workers,
            f"{settings.step_name}s": learning.steps,
            **{name: number for name, number in learning.counts().items() if name != settings.step_name},
            "wall_s": round(wall, 3),
            "car_steps_per_s": round(learning.car_steps / wall, 1),
            "champion_sha256": champion.sha256,
            f"champion_{settings.step_name}": best.step,
            "validation_success_rate": best.success_rate,
            "solved": learning.solved,
            "lost_chunks": learning.lost_chunks,
            "training_s": learning.history[-1]["wall_s"],
            **{f"best_{name}": row[name] for name in ("car_steps", "wall_s")},
            "held_out": figures,
        }
        self._conclude()
        self.reporter.note("logging to MLflow")
        log_end(self.tracker, self.run, learning.steps - 1, self.summary, description.describe(self.run, self.summary))

    def _conclude(self) -> None:
        """Mark the run as finished. Its checkpoint gets the history, and loses a DQN's replay, which is most of it.

        So steps.part, whose elites are in elites.npz by now, is no longer needed.
        """
        path = self.run.path
        arrays, meta = checkpoint.load(path / CHECKPOINT)
        kept = {name: array for name, array in arrays.items() if not name.startswith("replay_")}
        checkpoint.save(path / CHECKPOINT, kept | {"history": self.learning.table()}, meta)
        write_summary(path, self.summary)
        (path / STEPS).unlink(missing_ok=True)


def make_tracker(run: RunFolder, uri: str, experiment: str, parent_id: str = "", **more: Any) -> Tracker:
    """The run's tracker; `parent_id` is MLflow's run that it belongs to. `more` is for its `Identity`."""
    saved = run.saved[1]["tracking"] if run.saved else {}
    tags = description.tags(run.settings) | ({"mlflow.parentRunId": parent_id} if parent_id else {})
    return Tracker(Identity(
        uri, experiment, run.name, description.params(run.settings), tags,
        note=description.describe(run), key=run.tracking_key, run_id=str(saved.get("run_id") or ""), **more,
    ))  # fmt: skip


def log_rows(tracker: Tracker, rows: list[dict[str, float]], first: int = 0) -> None:
    """Log rows of a history, from step `first` on."""
    for step, row in enumerate(rows, first):
        tracker.log_row(step, {name: row[name] for name in row if name not in NOT_LOGGED}, row["wall_s"])


def log_end(tracker: Tracker, run: RunFolder, step: int, summary: dict[str, Any], note: str) -> None:
    """Log what a finished run has besides rows and model; its summary gets the id of MLflow's run."""
    tracker.log_row(step, description.held_out_metrics(summary["held_out"]), summary["wall_s"])
    final = {"validation/success_rate": summary["validation_success_rate"]}  # the last candidate is tried after the end
    tracker.log_row(step + 1, final, summary["wall_s"])
    if not summary.get("mlflow_run_id"):
        with contextlib.suppress(TrackingError):  # the tracker reports what is missing when it closes
            summary["mlflow_run_id"] = tracker.wait_ready(30.0)
            write_summary(run.path, summary)
    tracker.note = note
    tracker.log_files(run.path / name for name in FILES if (run.path / name).is_file())


def send_missing(run: RunFolder, uri: str, experiment: str) -> tuple[str, str | None]:
    """Send to MLflow what it lacks of a finished run, with the original times; what MLflow has stays as it is.

    Args: the run, opened; the tracking address, or "" for the run's own; the experiment.
    Returns: what was sent, in a few words, and one line about what could not be, or None.
    """
    assert run.saved is not None
    arrays, meta = run.saved
    path = run.path / SUMMARY
    try:
        summary, ended = json.loads(path.read_bytes()), path.stat().st_mtime
        history = [dict(zip(meta["columns"], row, strict=True)) for row in arrays["history"].tolist()]
        model = description.torch_model(load_champion(run.path), run.settings, summary["held_out"])
        note, started = description.describe(run, summary), ended - summary["wall_s"]
        meta["tracking"]["run_id"] = meta["tracking"].get("run_id") or summary.get("mlflow_run_id")
        uri = check_uri(uri or with_password(meta["tracking"]["uri"]))
    except GridSimError as error:
        return "", f"what MLflow lacks is not sent: {error}"
    except (OSError, LookupError, TypeError, ValueError, StopIteration) as error:  # edited by hand
        again = f"delete it, and make it again with --resume {as_argument(run.path)}"
        return "", f"what MLflow lacks is not sent: {path} is damaged ({type(error).__name__}); {again}"
    tracker = make_tracker(run, uri, experiment, finished=True, started=started)
    log_rows(tracker, history)
    tracker.log_model(run.path, model)
    log_end(tracker, run, len(history) - 1, summary, note)
    lost = tracker.close("FINISHED")
    return ", ".join(count(number, noun) for noun, number in tracker.sent.items() if number), lost
