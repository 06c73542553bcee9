"""What the two learners share: the champion and how it is found, its figures, the history, the state.

All decisions follow from the seed and from what the workers return; none depends on the clock or on which worker
returned what. (A limit of wall time ends a run earlier, and may cut its last step short; all that was done until then
follows from the seed all the same.)

A step is a generator: it yields an `Event` each time it has to wait for the workers, so that its caller can save, show
progress and stop there.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from cluster.learn.maps import Maps
from cluster.settings import RunSettings
from cluster.workers.pool import Call, Chunk, Outcome, WorkerPool
from cluster.workers.worker import Task
from evolution.episodes.curriculum import FINAL_SEEDS, VALIDATION_SEEDS, Curriculum, success_rate
from evolution.episodes.starts import Episodes
from evolution.networks.policy import PolicySpec
from evolution.search.base import Generation, recipes
from gridsim.config import SimConfig

State = tuple[dict[str, np.ndarray], dict[str, Any]]  # arrays, and plain JSON values

WAIT_S = 0.2  # longest time between two looks at progress


@dataclass(frozen=True)
class Event:
    """Something that a run has to say while it goes on."""

    text: str = ""  # what is being done
    done: int = 0  # how many are done of `total` members, or of `total` episodes of experience
    total: int = 0
    warning: bool = False  # whether the text is a warning


Progress = Generator[Event, None, None]


@dataclass
class Champion:
    """The best network found so far, and its figures in the validation episodes."""

    genome: np.ndarray  # float32 [genes]
    # `Curriculum.validation_scores`; on several roads the success rate on the worst one. With the user's own fitness it
    # is `until` at most, so that the tie-break decides between those that reach it.
    score: float = 0.0
    success_rate: float = 0.0
    # Decides between equal scores: mean distance (m); on several roads the mean score; or the user's own fitness.
    tie_break: float = 0.0
    step: int = -1  # in which it was found


@dataclass
class Learning(ABC):
    """One run of a learner: it calls the pool, and holds what is saved in the run's folder."""

    columns: ClassVar[tuple[str, ...]]  # columns of history.csv after the step's number, named so in MLflow, too
    checkpointed: ClassVar[tuple[str, ...]] = ("solved", "car_steps", "validation_steps")
    save_every_s: ClassVar[float] = 0.0  # least s between saves; 0 where the next step changes a `state`'s arrays

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
    validation_steps: int = 0  # how many of the car-steps validation took
    deadline: float = math.inf  # `time.perf_counter` at which learning ends; a long step then ends early

    def __post_init__(self) -> None:
        s = self.settings
        self.sim = self.maps.config  # what a whole run is simulated with
        self.spec = PolicySpec.parse(s.policy)
        self.curriculum = Curriculum(s.curriculum(), s.seed, self.maps.get, self.sim, s.crowds)

    @property
    def comfort(self) -> bool:
        """Whether episodes' results have figures of comfort."""
        return False

    @abstractmethod
    def step(self) -> Progress:
        """Do one step and add its row to the history, without the wall clock's columns."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Counters of the run so far: its steps (under `settings.step_name`), and what `settings.ended` reads.

        `solved` is not among them.
        """

    @property
    def steps(self) -> int:
        """Steps that are done."""
        return len(self.history)

    def done(self) -> bool:
        """Whether there is nothing left to learn."""
        return self.settings.ended({"solved": self.solved, **self.counts()})

    def out_of_time(self) -> bool:
        """Whether the wall time that the run may take is spent."""
        return time.perf_counter() >= self.deadline

    @abstractmethod
    def candidate(self) -> np.ndarray | None:
        """The network that may become champion after the last step, float32 [genes]; None if there is none yet."""

    def choose_champion(self) -> Progress:
        """Choose the champion when a run ends: if unsolved, the better of champion and last candidate on new maps.

        Without a champion, the candidate becomes it. The champion's score was the best of many on the same maps, by
        luck as well, so a later candidate that drives better may not have reached it. This choice is not in the
        checkpoint: a run that is extended goes on as if it had never ended. The car-steps of this choice do not count.
        """
        candidate, before, car_steps = self.candidate(), self.champion, self.car_steps
        if candidate is None or self.solved or (before and np.array_equal(candidate, before.genome)):
            return
        finalists = [(before.genome, before.step)] if before else []
        finalists.append((candidate, self.steps - 1))
        episodes = self.curriculum.validation(FINAL_SEEDS if before else VALIDATION_SEEDS)
        driven = yield from self.drive("choosing the champion", np.stack([genome for genome, _ in finalists]), episodes)
        self.champion = None
        for k, (genome, step) in enumerate(finalists):
            self._judge(genome, driven.results[k : k + 1], step)
        self.car_steps, self.solved = car_steps, False

    def _judge(self, candidate: np.ndarray, results: np.ndarray, step: int) -> None:
        """Make a step's candidate the champion if it is better in validation; `results` are RESULT [1, episodes]."""
        self.tried = candidate
        self.validation_steps += int(results["steps"].sum())
        score, tie_break = self._standing(results)
        if self.champion is None or (score, tie_break) > (self.champion.score, self.champion.tie_break):
            self.champion = Champion(candidate, score, float(success_rate(results)[0]), tie_break, step)
            self.solved = bool(self.curriculum.validation_scores(results[0]).min() >= self.settings.until)

    def _standing(self, results: np.ndarray) -> tuple[float, float]:
        """Score and tie-break, which rank candidates, from a candidate's results in validation, RESULT [1, episodes].

        On several roads the score is success on the worst one: speed on one must not outweigh collisions on others.
        """
        scores = self.curriculum.validation_scores(results[0])
        if len(scores) == 1:
            return float(scores[0]), float(results["distance"].mean())
        return float(success_rate(results.reshape(len(scores), -1)).min()), float(scores.mean())

    def _wait(self, stage: str, call: Call, train: Callable[[], bool] = lambda: False) -> Progress:
        """Wait until the pool has done a call and `train`, called again and again meanwhile, has returned False."""
        warned, busy = 0, True
        yield Event(stage, *call.progress())  # before any training, which changes arrays that the caller may save now
        while self.pool.wait(call, 0.0 if busy else WAIT_S) or busy:
            busy = busy and train()
            for text in call.warnings[warned:]:
                yield Event(f"{self.settings.step_name} {self.steps}, {stage}: {text}", warning=True)
            warned = len(call.warnings)
            yield Event(stage, *call.progress())

    def _evaluate(
        self, stage: str, members: Generation, episodes: Episodes, asked: Sequence[Chunk] | None = None,
        train: Callable[[], bool] = lambda: False,
    ) -> Generator[Event, None, Outcome]:  # fmt: skip
        task = Task(*self._base(episodes), members.parents, members.key, members.mutation, self.comfort)
        outcome = self.pool.start(Outcome(task, members.recipes, asked))
        yield from self._wait(stage, outcome, train)
        self.car_steps += int(outcome.results["steps"].sum())
        return outcome

    def _base(self, episodes: Episodes) -> tuple[str, np.ndarray, np.ndarray, tuple[tuple[str, int], ...], SimConfig]:
        """The fields that both kinds of tasks begin with (`worker._Common`)."""
        return self.settings.policy, episodes.rows, episodes.worlds, self.maps.names(episodes.maps), self.sim

    def drive(
        self, stage: str, genomes: np.ndarray, episodes: Episodes, train: Callable[[], bool] = lambda: False
    ) -> Generator[Event, None, Outcome]:
        """Drive given genomes [n, genes] as they are. Returns: the call, with its results [n, e]."""
        copies = Generation(genomes[:0], recipes(0)).and_copies(genomes)
        return (yield from self._evaluate(stage, copies, episodes, train=train))

    def add_wall_clock(self, wall_s: float) -> None:
        """Add the wall clock's columns to the last row."""
        row, before = self.history[-1], self.history[-2] if self.steps > 1 else {"car_steps": 0.0, "wall_s": 0.0}
        steps, seconds = row["car_steps"] - before["car_steps"], wall_s - before["wall_s"]
        row |= {"wall_s": wall_s, "car_steps_per_s": steps / max(seconds, 1e-9)}

    def state(self) -> State:
        """All that an exact resume needs besides settings and history: arrays, and JSON values, by name."""
        champion, none = self.champion, np.zeros(0, dtype=np.float32)
        arrays: dict[str, np.ndarray] = {
            "tried": none if self.tried is None else self.tried,
            "champion": champion.genome if champion else none,
        }
        meta: dict[str, Any] = {
            **{name: getattr(self, name) for name in self.checkpointed},
            **self.counts(),
            "columns": list(self.columns),  # of the history, which is also read without its learner
            "champion": champion and [champion.score, champion.success_rate, champion.tie_break, champion.step],
        }
        return arrays, meta

    def restore(self, arrays: dict[str, np.ndarray], meta: dict[str, Any], rows: np.ndarray) -> None:
        """Continue from a `state` of the same settings and its history, float64 [steps, columns]."""
        for name in self.checkpointed:
            setattr(self, name, meta[name])
        self.history = [dict(zip(self.columns, row, strict=True)) for row in rows.tolist()]
        self.tried = arrays["tried"] if arrays["tried"].size else None
        if meta["champion"]:
            self.champion = Champion(arrays["champion"], *meta["champion"])

    def table(self, first: int = 0) -> np.ndarray:
        """The history from step `first` on, float64 [steps, columns]."""
        rows = [[row[name] for name in self.columns] for row in self.history[first:]]
        return np.array(rows, dtype=np.float64).reshape(-1, len(self.columns))


def finish(progress: Generator[Event, None, Any], on_event: Callable[[Event], None] = lambda event: None) -> Any:
    """Go through a step, or another generator of events, to its end. Returns: the generator's return value."""
    try:
        while True:
            on_event(next(progress))
    except StopIteration as end:
        return end.value


def named(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
