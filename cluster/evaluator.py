"""Driving any genomes, for a search of one's own (`gridsim.Evaluator`)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from cluster.learn.maps import Maps
from cluster.settings import EvolveSettings, check_workers
from cluster.store.champion import Champion
from cluster.workers.address import cluster_address
from cluster.workers.open import open_pool
from cluster.workers.pool import Outcome
from cluster.workers.worker import Task
from evolution.episodes import fitness
from evolution.episodes.starts import Episodes, lane_starts
from evolution.networks.policy import Actions, PolicySpec
from evolution.search.base import Generation, recipes
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.parts import TRAINING_SEED, road_number
from gridsim.maps.scenarios import AMOUNTS, Traffic
from gridsim.traffic.world import check_traffic

MAPS = 128  # training maps from which episodes are drawn
MAX_EPISODES = 10_000
MAX_GENOMES = 1 << 16  # that a recipe can name


class Evaluator:
    """Drives networks on training roads, on all cores or by Ray workers, for a search of your own.

    >>> import gridsim, numpy as np
    >>> with gridsim.Evaluator("curved", policy="mlp:8", episodes=4) as evaluator:
    ...     evaluator.fitness(np.zeros((2, evaluator.genes), dtype=np.float32)).shape
    (2,)

    Attributes: `genes`, the number of genes of a genome; `spec`, the network, as a `PolicySpec`.
    """

    def __init__(
        self,
        scenario: str | os.PathLike[str] = "seamless",
        policy: str = "",
        traffic: Traffic = -1,
        sim: SimConfig | str | os.PathLike[str] = "",
        workers: int = 0,
        address: str | None = None,
        episodes: int = 16,
        actions: Actions = "discrete",
    ):
        """Open the pool of workers, which `close`, or the end of a `with`, ends.

        Args:
            scenario: as for --scenario of gridsim-evolve: a road's name, a map file, or several, separated by commas.
            policy: the network, as for --policy of gridsim-evolve, with the same default.
            traffic: number of other cars, or "usual" or "heavy"; -1 is as by default in gridsim-evolve.
            sim: the simulator's configuration (vehicle, sensors, episodes, traffic), or the name of a preset or of a
                YAML file; "" is as by default in gridsim-evolve. A lower target and time limit make an evaluation
                shorter.
            workers: number of Ray workers; 0 without `address`: this process evaluates, on all its cores.
            address: a Ray cluster, as for `gridsim.evolve`; None is this machine, whatever RAY_ADDRESS says.
            episodes: how many each genome drives, on all roads together.
            actions: as for --actions of gridsim-evolve; continuous also if the policy's text ends with +continuous.

        Raises: GridSimError, a ValueError, in one line.
        """
        sim = os.fspath(sim) if isinstance(sim, os.PathLike) else sim
        given: dict[str, Any] = {"sim": sim} if isinstance(sim, str) else {}
        if policy:
            spec = PolicySpec.parse(policy)
            given["observation"], actions = spec.observation, spec.actions if spec.suffix else actions
        if isinstance(sim, SimConfig) and sim.unit < 1.0 and traffic in (-1, *AMOUNTS):
            traffic = 0  # the default for small cars, which settings know by name alone
        settings = EvolveSettings(
            scenario=os.fspath(scenario), policy=policy, traffic=traffic, actions=actions, **given
        )
        settings.check(None if isinstance(sim, str) else sim)
        check_workers(workers, 0.0)
        if not 1 <= episodes <= MAX_EPISODES:
            raise GridSimError(f"episodes must be 1 to {MAX_EPISODES:,}, not {episodes}")
        self._settings, self._episodes = settings, episodes
        self._sim = settings.simulator() if isinstance(sim, str) else sim
        check_traffic(max(settings.crowds), self._sim)
        self.spec = PolicySpec.parse(settings.policy)
        self.genes: int = self.spec.size
        self._maps = Maps(settings.scenario, self._sim)
        try:
            self._pool = open_pool(workers, cluster_address(address) if address else None, 0.0, self._maps.build)
        except BaseException:
            self._maps.close()
            raise

    def __enter__(self) -> Evaluator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the workers. May be called again."""
        self._pool.close()
        self._maps.close()

    def evaluate(self, genomes: np.ndarray, seed: int = 0) -> np.ndarray:
        """Drive genomes [n, genes], all of them through the same episodes, which the seed decides.

        Returns: the results, structured, [n, episodes], with the fields that `gridsim.evolve` gives to a fitness. They
        are the same bits for any number of workers.
        Raises: GridSimError for genomes that do not fit or are not finite, and for a negative seed.
        """
        return self._drive(genomes, self._draw(seed), comfort=True)

    def fitness(self, genomes: np.ndarray, seed: int = 0) -> np.ndarray:
        """Drive as `evaluate`. Returns: gridsim-evolve's default fitness, float64 [n] in [0, 1], higher is better."""
        episodes = self._draw(seed)
        return fitness.scalar(self._drive(genomes, episodes), episodes.rows["target"].astype(np.float64))

    def champion(self, genome: np.ndarray, sim: SimConfig | None = None) -> Champion:
        """A genome [genes] as a champion, to save, watch or evaluate on held-out roads.

        Args: `sim`, the configuration that it drives with; by default the evaluator's.
        """
        s, genome = self._settings, self._checked(np.asarray(genome)[None])[0]
        return Champion(genome, str(self.spec), s.scenario, sim or self._sim, s.traffic)

    def _draw(self, seed: int) -> Episodes:
        """Episodes with new starts on training maps, drawn at random from the seed."""
        if seed < 0:
            raise GridSimError(f"a seed must be 0 or more, not {seed}")
        rng = np.random.default_rng(np.random.SeedSequence([seed, 21]))
        used, local = np.unique(rng.integers(MAPS, size=self._episodes), return_inverse=True)
        seeds = [TRAINING_SEED + m for m in used.tolist()]
        self._maps.ahead(seeds)
        maps, crowds = [self._maps.get(each) for each in seeds], self._settings.crowds
        cars = [crowds[road_number(each, len(crowds))] for each in seeds]
        return Episodes(seeds, *lane_starts(maps, local, rng, cars, self._sim, max(crowds)))

    def _drive(self, genomes: np.ndarray, episodes: Episodes, comfort: bool = False) -> np.ndarray:
        members = Generation(np.zeros((0, self.genes), np.float32), recipes(0)).and_copies(self._checked(genomes))
        shared = str(self.spec), episodes.rows, episodes.worlds, self._maps.names(episodes.maps), self._sim
        task = Task(*shared, members.parents, members.key, members.mutation, comfort)
        return self._pool.run(Outcome(task, members.recipes)).results

    def _checked(self, genomes: np.ndarray) -> np.ndarray:
        genomes = np.ascontiguousarray(genomes, dtype=np.float32)
        if len(genomes) > MAX_GENOMES:
            raise GridSimError(f"at most {MAX_GENOMES:,} genomes can be evaluated at once, not {len(genomes):,}")
        if genomes.ndim != 2 or genomes.shape[1] != self.genes:
            raise GridSimError(f"genomes of {self.spec} must be [n, {self.genes}], not {list(genomes.shape)}")
        finite = np.isfinite(genomes).all(axis=1)
        if not finite.all():
            raise GridSimError(f"genomes must be finite numbers; those of member {finite.argmin()} are not")
        return genomes
