"""What the two learners share: maps, the champion and how it is found, its figures, the history, the state.

All decisions follow from the seed and from what the workers return; none depends on the clock or on which worker
returned what.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from cluster.settings import RunSettings
from cluster.workers.pool import Call, Chunk, Meanwhile, Outcome, PoolError, WorkerPool
from cluster.workers.worker import Task
from evolution.episodes.curriculum import (
    FINAL_SEEDS,
    HELD_OUT_EPISODES,
    HELD_OUT_SEEDS,
    VALIDATION_SEEDS,
    Curriculum,
    spread_starts,
    success_rate,
)
from evolution.episodes.figures import summarise
from evolution.episodes.starts import Episodes
from evolution.networks.policy import PolicySpec
from evolution.search.base import Generation, recipes
from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.scenarios import build, seed_of_map

State = tuple[dict[str, np.ndarray], dict[str, Any]]  # arrays and plain numbers
Names = tuple[tuple[str, int], ...]  # of maps, as pools know them


class Maps:
    """A run's maps, each of which is built once, ahead of its use, in a thread."""

    def __init__(self, scenario: str, config: SimConfig):
        self._scenario, self._config = scenario, config
        self._built: dict[int, Future[Map]] = {}
        # Two threads for later ones: while the workers wait for validation's maps, both cores build them.
        self._soon, self._later = (ThreadPoolExecutor(n, thread_name_prefix=f"maps-{n}") for n in (1, 2))

    def ahead(self, seeds: Sequence[int], later: bool = False) -> None:
        """Begin to build maps that will be needed, in this order; `later` ones do not delay the others."""
        thread = self._later if later else self._soon
        for seed in seeds:
            if seed not in self._built:
                self._built[seed] = thread.submit(build, self._scenario, seed, self._config)

    def get(self, seed: int) -> Map:
        """The map of a seed."""
        self.ahead([seed])
        return self._built[seed].result()

    def build(self, scenario: str, seed: int) -> Map:
        """The map of the run's scenario and a seed, which is how pools ask for it."""
        return self.get(seed)

    def close(self) -> None:
        """Cancel what has not begun."""
        for thread in (self._soon, self._later):
            thread.shutdown(wait=False, cancel_futures=True)


@dataclass
class Champion:
    """The best member found so far, and its figures in the validation episodes."""

    genome: np.ndarray  # float32 [genes]
    score: float = 0.0  # `Curriculum.validation_score`
    success_rate: float = 0.0
    distance_m: float = 0.0  # mean
    step: int = -1  # in which it was found


@dataclass
class Learning(ABC):
    """One run of a learner, between pool and files."""

    columns: ClassVar[tuple[str, ...]]  # of history.csv after the step's number, and their names in MLflow
    verb: ClassVar[str]  # what is done to a network
    kept: ClassVar[tuple[str, ...]] = ("solved", "car_steps", "validation_steps", "lost_chunks")  # in checkpoints
    save_every_s: ClassVar[float] = 0.0  # 0: a `state` must be saved as the next step begins, which changes it

    settings: RunSettings
    pool: WorkerPool
    maps: Maps
    initial: np.ndarray | None = None  # a genome to start from, float32 [genes]
    champion: Champion | None = None
    tried: np.ndarray | None = None  # the last candidate that was validated, float32 [genes]
    solved: bool = False
    history: list[dict[str, float]] = field(default_factory=list)  # a row of figures for each step (`columns`)
    elites: dict[int, np.ndarray] = field(default_factory=dict)  # the network of each unsaved step, float32 [genes]
    car_steps: int = 0
    validation_steps: int = 0  # how many of these validation took
    lost_chunks: int = 0  # members, and episodes of experience, that killed every worker that tried them
    wall_before_s: float = 0.0
    # Called with one line for each of the lost, and for each worker that is replaced because it is silent.
    warn: Callable[[str], None] = warnings.warn
    on_progress: Callable[[str, int, int], None] = lambda *_: None
    meanwhile: Callable[[], None] = lambda: None  # called in each step while the workers are busy
    out_of_time: Callable[[], bool] = lambda: False  # whether the wall-time budget is spent, so that a long step ends

    def __post_init__(self) -> None:
        s = self.settings
        self.sim = SimConfig()
        self.spec = PolicySpec.parse(s.policy)
        self.curriculum = Curriculum(s.curriculum(), s.seed, self.maps.get, s.traffic)
        self._lines: list[str] = []  # of history.csv

    # ------------------------------------------------------------------------------------------------------ the loop

    @abstractmethod
    def step(self) -> dict[str, float]:
        """One step. Returns its row of the history, without the wall clock's columns."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """How far it has come: the number of its steps by their name, and what the settings' `ended` asks for."""

    @abstractmethod
    def describe(self, row: dict[str, float]) -> str:
        """A row of the history in words."""

    @property
    def steps(self) -> int:
        """Steps that are done."""
        return len(self.history)

    def progress(self) -> tuple[float, float, str]:
        """How far the run is, how far it goes at most (0: unknown), and in what unit: that of its first limit."""
        settings, limits = self.settings, self.settings.unbound
        name = next((name for name in limits if getattr(settings, name)), limits[0])
        done, most = self.steps if name == "generations" else self.counts()[name], getattr(settings, name)
        return (done / 1e6, most / 1e6, "M car-steps") if name == "car_steps" else (done, most, name)

    def done(self) -> bool:
        """Whether there is nothing left to learn."""
        return self.settings.ended({"solved": self.solved, **self.counts()})

    @abstractmethod
    def candidate(self) -> np.ndarray | None:
        """The network that may become champion after the last step, float32 [genes]; None before the first."""

    def choose_champion(self) -> Champion:
        """The champion of a run that ends: if it is unsolved, it or the last candidate, by drives on maps of their own.

        A champion is the best of many on the same maps, so later candidates that drive better may not reach its score.
        This is not in the checkpoint: a run that is extended goes on as if it had never ended. Its car-steps do not
        count.
        """
        candidate, before, car_steps = self.candidate(), self.champion, self.car_steps
        if candidate is not None and not self.solved and not (before and np.array_equal(candidate, before.genome)):
            finalists = [(before.genome, before.step)] if before else []
            finalists.append((candidate, self.steps - 1))
            episodes = self.curriculum.validation(FINAL_SEEDS if before else VALIDATION_SEEDS)
            genomes = np.stack([genome for genome, _ in finalists])
            driven = self.drive("validate", genomes, episodes)
            self.champion = None
            for k, (genome, step) in enumerate(finalists):
                if not driven.lost[k]:
                    self._judge(genome, driven.results[k : k + 1], step)
            self.champion = self.champion or before
            self.car_steps, self.solved = car_steps, False
        if self.champion is None:
            raise PoolError("there is no champion: each network that was to be validated killed its workers")
        return self.champion

    def _judge(self, candidate: np.ndarray, results: np.ndarray, step: int) -> None:
        """Make a step's candidate champion if its validation, RESULT [1, episodes], is better than the champion's."""
        self.tried = candidate
        self.validation_steps += int(results["steps"].sum())
        score, distance = float(self.curriculum.validation_score(results)[0]), float(results["distance"].mean())
        if self.champion is None or (score, distance) > (self.champion.score, self.champion.distance_m):
            self.champion = Champion(candidate, score, float(success_rate(results)[0]), distance, step)
        self.solved = self.champion.score >= self.settings.until

    # ------------------------------------------------------------------------------------------------- evaluating

    def _evaluate(
        self, stage: str, members: Generation, episodes: Episodes, asked: Sequence[Chunk] | None = None,
        meanwhile: Meanwhile | None = None,
    ) -> Outcome:  # fmt: skip
        task = Task(*self._base(episodes), members.parents, members.key, members.mutation)
        outcome = self.pool.evaluate(task, members.recipes, partial(self.on_progress, stage), asked, meanwhile)
        self.car_steps += int(outcome.results["steps"].sum())
        self._report(stage, outcome)
        return outcome

    def _base(self, episodes: Episodes) -> tuple[str, np.ndarray, np.ndarray, Names, SimConfig]:
        """The first fields of a task, which both kinds have."""
        return self.settings.policy, episodes.rows, episodes.worlds, self._names(episodes.maps), self.sim

    def _names(self, seeds: Sequence[int]) -> Names:
        scenario = self.settings.scenario
        return tuple((scenario, seed_of_map(scenario, seed)) for seed in seeds)

    def _report(self, stage: str, call: Call) -> None:
        self.lost_chunks += int(call.lost.sum())
        for text in call.warnings:
            self.warn(f"{self.settings.step_name} {self.steps}, {stage}: {text}")

    def drive(self, stage: str, genomes: np.ndarray, episodes: Episodes, meanwhile: Meanwhile | None = None) -> Outcome:
        """Results [n, e] of given genomes [n, genes], sent as plain copies."""
        copies = Generation(genomes[:0], recipes(0)).and_copies(genomes)
        return self._evaluate(stage, copies, episodes, meanwhile=meanwhile)

    def add_wall_clock(self, wall_s: float) -> None:
        """Add the wall clock's columns to the last row."""
        row, before = self.history[-1], self.history[-2] if self.steps > 1 else {"car_steps": 0.0, "wall_s": 0.0}
        steps, seconds = row["car_steps"] - before["car_steps"], wall_s - before["wall_s"]
        row |= {"wall_s": wall_s, "car_steps_per_s": steps / max(seconds, 1e-9)}

    def held_out(self) -> tuple[Episodes, dict[str, float]]:
        """The champion on roads never used in training or selection: the same 64 episodes in all runs of a scenario."""
        assert self.champion is not None
        before = self.car_steps
        episodes = spread_starts(self.maps.get, HELD_OUT_SEEDS, HELD_OUT_EPISODES, self.settings.traffic)
        driven = self.drive("held out", self.champion.genome[None], episodes)
        check_any_left(driven.lost, "held out")
        self.car_steps = before  # not part of learning
        return episodes, summarise(driven.results[0], self.sim.episode.control_period)

    # ------------------------------------------------------------------------------------------------------- state

    def state(self, first: int = 0) -> State:
        """All that an exact resume needs, arrays and plain numbers; of the history the rows from step `first` on."""
        champion, none = self.champion, np.zeros(0, dtype=np.float32)
        arrays: dict[str, np.ndarray] = {
            "history": self.table(first),
            "tried": none if self.tried is None else self.tried,
            "champion": champion.genome if champion else none,
        }
        meta: dict[str, Any] = {
            **{name: getattr(self, name) for name in self.kept},
            **self.counts(),
            "columns": list(self.columns),  # of the history, which is also read without its learner
            "champion": champion and [champion.score, champion.success_rate, champion.distance_m, champion.step],
        }
        return arrays, meta

    def restore(self, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
        """Continue from a `state` of the same settings; its checksum and digest were verified."""
        for name in self.kept:
            setattr(self, name, meta[name])
        self.history = [dict(zip(self.columns, row, strict=True)) for row in arrays["history"].tolist()]
        self.tried = arrays["tried"] if arrays["tried"].size else None
        if meta["champion"]:
            self.champion = Champion(arrays["champion"], *meta["champion"])
        self.wall_before_s = self.history[-1]["wall_s"] if self.history else 0.0

    def table(self, first: int = 0) -> np.ndarray:
        """The history from step `first` on, float64 [steps, columns]."""
        rows = [[row[name] for name in self.columns] for row in self.history[first:]]
        return np.array(rows, dtype=np.float64).reshape(-1, len(self.columns))

    def history_csv(self, steps: int) -> bytes:
        """history.csv: a row for each of the first steps. Each is formatted only once: thousands take tens of ms."""
        for k in range(len(self._lines), steps):
            self._lines.append(",".join([str(k), *(repr(self.history[k][name]) for name in self.columns)]))
        return "\n".join([",".join([self.settings.step_name, *self.columns]), *self._lines[:steps], ""]).encode()


def named(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def check_any_left(lost: np.ndarray, stage: str) -> None:
    """Raises: PoolError if all of lost, bool [n], are true: then there is nothing to continue with."""
    if lost.all():
        raise PoolError(f"{stage}: nothing is left, all {len(lost)} that were tried killed their workers")
