"""A training run, new or resumed, from its start to its end.

A step is a generation, or an evaluation of the DQN. Steps are saved while the workers are busy, generations once a
second at most: first their records (`store/steps.py`), then the checkpoint that counts them, then history.csv, from
which MLflow gets its rows. Whatever kills the process, the folder holds the state after a whole step, either the
previous one or one of about a second ago, and a resumed run gives the same champion.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from cluster import stopping
from cluster.learn.evolution import Evolution
from cluster.learn.learning import Event, Learning, State, finish
from cluster.learn.maps import Maps
from cluster.redaction import redacted
from cluster.settings import DqnSettings, EvolveSettings, RunSettings
from cluster.store import checkpoint
from cluster.store.champion import Champion
from cluster.store.checkpoint import CHAMPION, CHECKPOINT, CONFIG, STEPS, SUMMARY
from cluster.store.folder import ONNX, RunError, RunFolder, lock
from cluster.store.steps import Steps, write_elites
from cluster.text import as_argument
from cluster.tracking.description import read_run
from cluster.tracking.tracking import Status, Tracking, saved_run_id, sync
from cluster.workers import kernels
from cluster.workers.open import open_pool
from cluster.workers.pool import WorkerPool
from evolution.episodes.curriculum import HELD_OUT_EPISODES, HELD_OUT_SEEDS, VALIDATION_SEEDS, spread_starts
from evolution.episodes.figures import summarise
from gridsim.maps.parts import held_out_place, roads_of, seeds_on
from gridsim.maps.scenarios import label

WAIT_FOR_MLFLOW_S = 30.0  # longest wait for MLflow's id of the run, which summary.json is to hold


@dataclass(frozen=True)
class Place:
    """Where a run is computed and logged; no champion depends on it, unless `wall_limit_s` ends the run."""

    workers: int = 0  # Ray workers; 0: threads of this process, or with an address a worker for each free CPU
    address: str | None = None  # of a Ray cluster, host:port or auto; None: this machine
    patience_s: float = 0.0  # how long to wait for a silent worker, or for any worker at all; 0: see `open_pool`
    uri: str = ""  # MLflow's address; "": MLflow gets nothing
    experiment: str = ""
    wall_limit_s: float = math.inf  # wall-clock budget of learning, also before a resume; at least one step is done


def train(
    run: RunFolder, place: Place, on_event: Callable[[Event], None] = lambda event: None,
    on_row: Callable[[int, dict[str, float]], None] = lambda steps, row: None,
    *, initial: np.ndarray | None = None, started: float | None = None,
) -> Session:  # fmt: skip
    """Train a run to its end, finish it, and send it to MLflow.

    Args:
        on_event: called with what is being done, and with warnings.
        on_row: called after each step, with the number of steps done and the latest one's row of the history.
        initial: a genome to start from, float32 [genes].
        started: time.perf_counter() of the process's start, from which the run's time counts; None: now.

    Raises: GridSimError, Stopped, and whatever else ends a run; the last whole step is saved. If there is none, the
    run's folder is left empty.
    """
    started, settings = perf_counter() if started is None else started, run.settings
    lock(run.path)
    maps, tracking = (
        Maps(settings.scenario, settings.simulator()),
        Tracking(run.path, place.uri, place.experiment, read_run),
    )
    pool: WorkerPool | None = None
    status: Status = "KILLED"
    try:
        run.write_config()
        if place.uri:
            tracking.start()
        if not kernels.is_compiled(settings):
            on_event(Event("compiling the simulator for runs of this kind, once (some 20 s)"))
            kernels.compile_ahead(settings)
        if place.workers or place.address:
            on_event(Event("starting the workers"))
        pool = open_pool(place.workers, place.address, place.patience_s, maps.build)
        tracking.listen()  # no thread may read the environment while the pool sets Ray's variables
        session = Session(run, pool, maps, tracking, on_event, on_row, started, place.wall_limit_s, initial)
        session.learn()
        session.finish()
        status = "FINISHED"
        return session
    except Exception:
        status = "FAILED"
        raise
    finally:
        if status == "KILLED":
            with contextlib.suppress(OSError, SystemExit):  # rich raises these if the reader of our output has ended
                on_event(Event("stopping; a moment ..."))
        if pool:
            pool.close()
        maps.close()
        if unsent := tracking.close(status):
            again = f"; send it later with: {settings.command} --resume {as_argument(run.path)}"
            on_event(Event(unsent + (again if status == "FINISHED" else ""), warning=True))
        if not (run.path / CHECKPOINT).is_file():
            with contextlib.suppress(OSError):
                for name in (CONFIG, STEPS):
                    (run.path / name).unlink(missing_ok=True)


def send(run: RunFolder, uri: str, experiment: str = "") -> tuple[str, str | None]:
    """Send to MLflow what it lacks of a finished run; arguments and result as of `tracking.sync`."""
    sent, unsent = sync(run.path, uri, experiment, read_run)
    if sent:  # if MLflow was away as the run ended, the summary lacks the id
        summary = json.loads((run.path / SUMMARY).read_bytes())
        checkpoint.write_json(run.path / SUMMARY, summary | {"mlflow_run_id": saved_run_id(run.path)})
    return sent, unsent


def new_learning(settings: RunSettings, pool: WorkerPool, maps: Maps, initial: np.ndarray | None = None) -> Learning:
    """The learner that these settings ask for."""
    if isinstance(settings, EvolveSettings):
        return Evolution(settings, pool, maps, initial)
    assert isinstance(settings, DqnSettings)
    from cluster.learn.dqn import Dqn  # imports PyTorch, which evolution does not need

    return Dqn(settings, pool, maps, initial)


@dataclass
class Session:
    """Runs a training run in this process, from its start or checkpoint to the end."""

    run: RunFolder
    pool: WorkerPool
    maps: Maps
    tracking: Tracking
    on_event: Callable[[Event], None]
    on_row: Callable[[int, dict[str, float]], None]
    # `perf_counter` at the run's start (with a limit: when learning starts), minus the s that a resumed run took before
    started: float
    wall_limit_s: float
    initial: np.ndarray | None
    summary: dict[str, Any] = field(default_factory=dict)  # what summary.json holds; empty until `finish`

    def __post_init__(self) -> None:
        settings, run = self.run.settings, self.run
        self.learning = learning = new_learning(settings, self.pool, self.maps, self.initial)
        self._digest = run.digest()
        self._steps = Steps(run.path, settings.step_name, learning.columns, learning.spec.size)
        if run.saved is not None:
            arrays, meta = run.saved
            rows = self._steps.resume(meta)
            try:
                learning.restore(arrays, meta, rows)
            except (KeyError, IndexError, TypeError, ValueError) as error:
                path = run.path / CHECKPOINT
                raise RunError(f"{path} was written by another version of GridSim; start a new run") from error
            self.started -= learning.history[-1]["wall_s"] if learning.history else 0.0
            self._steps.write_history(rows)
        self._state: State | None = None  # the learner's state after the last step; None if that is saved
        self._saved_at = -math.inf
        self._away = False  # whether an outage of MLflow was reported, and its end was not
        self._roads = roads_of(settings.scenario)
        self.maps.ahead([*learning.curriculum.map_seeds[:3], *seeds_on(VALIDATION_SEEDS, len(self._roads))])

    def wall_s(self) -> float:
        """Seconds that the run has taken, in this process and before."""
        return perf_counter() - self.started

    def learn(self) -> None:
        """Learn to the end. Steps are saved while a later one waits for the workers, and at the end.

        Generations are saved once a second at most, each evaluation of the DQN at once.
        """
        learning = self.learning
        if math.isfinite(self.wall_limit_s):  # a limit is for learning alone, so that a slow start takes none of it
            self.started = perf_counter() - (learning.history[-1]["wall_s"] if learning.history else 0.0)
        learning.deadline = self.started + self.wall_limit_s
        if not learning.done():
            (self.run.path / SUMMARY).unlink(missing_ok=True)  # a run that is extended is unfinished again
        try:
            while not learning.done() and not (learning.steps and learning.out_of_time()):
                for event in learning.step():
                    self.on_event(event)
                    if perf_counter() - self._saved_at >= learning.save_every_s:
                        self.save()
                learning.add_wall_clock(self.wall_s())
                self._state = learning.state()
                self.on_row(learning.steps, learning.history[-1])
                self._report_outage()
                stopping.check()
        finally:
            self.save()

    def save(self) -> None:
        """Save the steps done since the last save, if any. Raises: CheckpointError; the old files are kept."""
        if self._state is None:
            return
        (arrays, meta), self._state = self._state, None
        learning, first = self.learning, self._steps.number
        table = learning.table(first)
        self._steps.append(table, [learning.elites.pop(k) for k in range(first, learning.steps)])
        meta |= {"digest": self._digest, "init_sha256": self.run.init_sha256, "steps": learning.steps}
        checkpoint.save(self.run.path / CHECKPOINT, arrays, meta)
        self._steps.write_history(table)
        self._saved_at = perf_counter()

    def _report_outage(self) -> None:
        """Warn once when MLflow cannot be reached, and once when it is back."""
        error, where = self.tracking.error, redacted(self.tracking.uri)
        if error and not self._away:
            text = f"MLflow at {where} cannot be used: {error}; the run continues and sends its rows later"
            self.on_event(Event(text, warning=True))
        elif self._away and not error:
            self.on_event(Event(f"MLflow at {where} is back, and has all rows", warning=True))
        self._away = bool(error)

    def finish(self) -> None:
        """Choose the champion, measure it on held-out drives, and write the remaining files."""
        from cluster.report.report import write_report

        learning, path, settings = self.learning, self.run.path, self.run.settings
        self.maps.ahead(seeds_on(HELD_OUT_SEEDS, len(self._roads)))
        finish(learning.choose_champion(), self.on_event)
        best, car_steps, sim = learning.champion, learning.car_steps, learning.sim
        assert best is not None
        champion = Champion(best.genome, settings.policy, settings.scenario, sim, settings.traffic)
        champion.save(path / CHAMPION)
        champion.export_onnx(path / ONNX)
        episodes = spread_starts(self.maps.get, HELD_OUT_SEEDS, HELD_OUT_EPISODES, settings.crowds, sim)
        driving = learning.drive("held-out drives", best.genome[None], episodes)
        self.on_event(next(driving))  # the workers drive while the report is written
        write_report(self.run, champion, learning.history, write_elites(path, settings.policy), self.maps.get, episodes)
        driven = finish(driving, self.on_event)
        row, wall, period, roads = learning.history[best.step], self.wall_s(), sim.episode.control_period, self._roads
        on_each = driven.results[0].reshape(len(roads), -1)
        self.summary = {
            "name": self.run.name,
            "mlflow_run_id": self.tracking.wait_id(WAIT_FOR_MLFLOW_S),
            "scenario": settings.scenario,
            "seed": settings.seed,
            "workers": self.pool.workers,
            f"{settings.step_name}s": learning.steps,
            **{name: number for name, number in learning.counts().items() if name != settings.step_name},
            "car_steps": car_steps,
            "wall_s": round(wall, 3),
            "car_steps_per_s": round(car_steps / wall, 1),
            "champion_sha256": champion.sha256,
            f"champion_{settings.step_name}": best.step,
            "validation_success_rate": best.success_rate,
            "solved": learning.solved,
            "training_s": learning.history[-1]["wall_s"],
            **{f"best_{name}": row[name] for name in ("car_steps", "wall_s")},
            "held_out_place": held_out_place(settings.scenario, self.maps.get(HELD_OUT_SEEDS.start)),
            "held_out": summarise(driven.results[0], period),
            "held_out_by_road": {label(road): summarise(own, period) for road, own in zip(roads, on_each, strict=True)},
        }
        checkpoint.write_json(path / SUMMARY, self.summary)
