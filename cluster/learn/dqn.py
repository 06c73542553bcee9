"""The DQN's loop: workers collect a batch of experience while the learner trains on the batches before.

Each batch requires some updates. The learner makes them while the workers collect the next batch, or drive validation;
the weights that drive the next batch are those from before these updates. So workers and learner do not wait for each
other, and the network is the same for any number of workers. A step of the run is an evaluation: the averaged network
drives the validation episodes, as evolution's candidates do.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cluster.learn.learning import Event, Learning, Progress, State, named
from cluster.settings import DqnSettings
from cluster.workers.pool import Collected
from cluster.workers.worker import CollectTask
from evolution.dqn.learner import DqnConfig, DqnLearner, exploration, finite
from evolution.dqn.replay import Replay
from evolution.episodes.curriculum import success_rate
from evolution.episodes.figures import mean_speed

EPISODE_STEPS = 256  # time limit of training episodes, in control steps; they are truncated at it
BATCH_STEPS = 32_768  # approximate number of car-steps in a batch
EPISODES = (64, 2048)  # least and greatest number of episodes in a batch
WARM_UP = 20_000  # rows of replay before the first update; the replay's capacity if that is less
SLICE = 8  # updates between two looks at the workers, at most
PROBE = {"rays": 512, "grid": 32}  # number of observations whose Q values are compared between evaluations
STABLE = 3  # a run has converged after so many evaluations in a row with little change of its Q values


@dataclass
class Dqn(Learning):
    """One run of the DQN."""

    # `best` is the network's in validation; `mean` is since the previous evaluation: distance and speed of training
    # episodes, reward of car-steps, and q, like `loss`, of updates.
    columns: ClassVar[tuple[str, ...]] = (
        "distance_m/best", "distance_m/mean", "speed_mps/best", "speed_mps/mean", "network/success_rate",
        "validation/success_rate", "reward/mean", "loss", "q/mean", "q/change", "exploration", "learning_rate",
        "episodes", "updates", "car_steps", "wall_s", "car_steps_per_s",
    )  # fmt: skip
    checkpointed: ClassVar[tuple[str, ...]] = (
        *Learning.checkpointed, "batches", "episodes", "stable_evaluations", "updates_due", "mean_steps",
    )  # fmt: skip

    settings: DqnSettings
    batches: int = 0
    episodes: int = 0
    stable_evaluations: int = 0  # evaluations in a row with little change of the Q values
    updates_due: float = 0.0  # updates that the batches so far still require
    mean_steps: float = 32.0  # mean length of the last batch's episodes, in control steps; at first a guess

    def __post_init__(self) -> None:
        super().__post_init__()
        s = self.settings
        config = DqnConfig(
            batch=s.batch, learning_rate=s.learning_rate, target_period=s.target_period,
            learning_rate_updates=max(int(s.anneal * s.updates / 1000), 1),
        )  # fmt: skip
        self.learner = DqnLearner(self.spec, config, s.seed, s.device)
        self.replay = Replay(self.spec, s.replay, s.discount)
        if self.initial is not None:
            self.learner.load_weights(self.initial)
        self.probe = np.zeros((0, self.spec.inputs), dtype=np.float32)
        self.probe_q = np.zeros((0, self.spec.outputs), dtype=np.float32)

    def step(self) -> Progress:
        """Train until the next evaluation is due, and evaluate."""
        self._losses: list[tuple[int, float, float]] = []  # (number of updates, their mean loss, their mean Q)
        steps, rewards = 0, 0.0
        results: list[np.ndarray] = []
        while steps < self.settings.evaluate_every and not (steps and (self.out_of_time() or self.done())):
            batch, reward = yield from self._collect()
            results.append(batch)
            steps += int(batch["steps"].sum())
            rewards += reward
        driven = np.concatenate(results)
        row = yield from self._evaluate_network()
        updates = sum(n for n, _, _ in self._losses)
        row |= {
            "distance_m/mean": float(driven["distance"].mean(dtype=np.float64)),
            "speed_mps/mean": mean_speed(driven, self.sim.episode.control_period),
            "reward/mean": rewards / steps,
            "loss": sum(n * loss for n, loss, _ in self._losses) / max(updates, 1),
            "q/mean": sum(n * q for n, _, q in self._losses) / max(updates, 1),
            "q/change": self._change_of_values(updates),
            "exploration": float(self._exploration(EPISODES[0]).mean()),
            "learning_rate": self.learner.config.learning_rate_at(self.learner.updates),
            "episodes": float(self.episodes),
            "updates": float(self.learner.updates),
            "car_steps": float(self.car_steps),
        }
        row["validation/success_rate"] = self.champion.success_rate if self.champion else 0.0
        self.history.append(row)

    def _collect(self) -> Generator[Event, None, tuple[np.ndarray, float]]:
        """Have one batch collected into the replay, and train meanwhile.

        Returns: RESULT [episodes] and the sum of their rewards.
        """
        s, k = self.settings, self.batches
        n = int(np.clip(BATCH_STEPS / self.mean_steps, *EPISODES))
        episodes = self.curriculum.starts(k, n)
        episodes.rows["steps"] = EPISODE_STEPS
        self.maps.ahead(self.curriculum.map_seeds[: k + 8])
        keys = np.random.default_rng(np.random.SeedSequence([s.seed, k, 14])).integers(1 << 63, size=n, dtype=np.uint64)
        weights = finite(self.learner.weights, self.learner.updates)
        task = CollectTask(*self._base(episodes), weights, self._exploration(n), keys)
        brought = self.pool.start(Collected(task))
        yield from self._wait("collect", brought, self._train)
        self.replay.add(brought.experience)
        results = brought.results[0]
        steps = int(results["steps"].sum())
        self.updates_due += steps * s.updates / 1000.0
        self.mean_steps = steps / len(results)
        self.car_steps += steps
        self.episodes += len(results)
        self.batches += 1
        return results, float(brought.experience.rewards.sum())

    def _exploration(self, n: int) -> np.ndarray:
        return exploration(self.settings.epsilon, self.car_steps / self.settings.anneal, n)

    def _train(self) -> bool:
        """Make some of the updates that the batches so far require. Returns whether any are left.

        While the replay has fewer rows than `WARM_UP`, none are made, and those required are dropped.
        """
        if len(self.replay) < min(WARM_UP, self.replay.capacity):
            self.updates_due = 0.0
        n = min(int(self.updates_due), SLICE)
        if n:
            self._losses.append((n, *self.learner.train(self.replay, n)))
            self.updates_due -= n
        return self.updates_due >= 1.0

    def candidate(self) -> np.ndarray | None:
        return self.tried  # the last evaluation's network, as each evaluation validates its own

    def _evaluate_network(self) -> Generator[Event, None, dict[str, float]]:
        """Validate the averaged network. Returns its figures."""
        network = finite(self.learner.average, self.learner.updates)
        self.elites[self.steps] = network
        driven = yield from self.drive("validate", network[None], self.curriculum.validation(), self._train)
        self._judge(network, driven.results, self.steps)
        results = driven.results[0]
        return {
            "distance_m/best": float(results["distance"].mean()),
            "speed_mps/best": mean_speed(results, self.sim.episode.control_period),
            "network/success_rate": float(success_rate(results[None])[0]),
        }

    def _change_of_values(self, updates: int) -> float:
        """Change of the Q values of fixed observations since the last evaluation, as a share of their spread.

        It is 1 in the first evaluation. A small change counts towards convergence only if there were updates since the
        last evaluation.
        Raises: FloatingPointError if weights or values are not finite.
        """
        if not len(self.probe):
            key = int(np.random.SeedSequence([self.settings.seed, 15]).generate_state(1, np.uint64)[0])
            self.probe = self.replay.sample(key, PROBE[self.spec.observation]).observations
        before, self.probe_q = self.probe_q, self.learner.q_values(self.probe)
        finite(self.learner.weights, self.learner.updates)
        finite(self.probe_q, self.learner.updates)
        change = 1.0
        if len(before):
            q = self.probe_q.astype(np.float64)  # squares of large values are beyond float32
            change = float(np.sqrt(np.mean((q - before) ** 2)) / max(float(q.std()), 1e-9))
        self.stable_evaluations = self.stable_evaluations + 1 if updates and change < self.settings.converged else 0
        return change

    @property
    def converged(self) -> bool:
        """Whether the Q values have stopped changing."""
        return self.settings.converged > 0.0 and self.stable_evaluations >= STABLE

    def counts(self) -> dict[str, int]:
        return {
            "evaluation": self.steps,
            "car_steps": self.car_steps,
            "episodes": self.episodes,
            "updates": self.learner.updates,
            "converged": self.converged,
        }

    def state(self) -> State:
        arrays, meta = super().state()
        arrays |= {f"learner_{name}": array for name, array in self.learner.state().items()}
        if not self.done() and not self.out_of_time():  # the replay is large; a run that is extended fills a new one
            arrays |= {f"replay_{name}": array for name, array in self.replay.state().items()}
        arrays |= {"probe": self.probe, "probe_q": self.probe_q}
        return arrays, meta

    def restore(self, arrays: dict[str, np.ndarray], meta: dict[str, Any], rows: np.ndarray) -> None:
        super().restore(arrays, meta, rows)
        self.learner.restore(named(arrays, "learner_"))
        if "replay_added" in arrays:
            self.replay.restore(named(arrays, "replay_"))
        self.probe, self.probe_q = arrays["probe"], arrays["probe_q"]
