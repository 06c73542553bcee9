"""Champions: what is written of them, and what a person does with one: load it, drive it, evaluate it.

>>> champion = load_champion("runs/NAME/champion.npz")  # doctest: +SKIP
>>> env = champion.make_env()  # doctest: +SKIP
>>> evaluate(champion, "seamless", episodes=64)  # doctest: +SKIP
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from cluster import checkpoint
from cluster.checkpoint import CheckpointError
from cluster.learning import Maps, summarise
from cluster.settings import MAX_TRAFFIC
from evolution import convnet
from evolution.curriculum import HELD_OUT_SEEDS, spread_starts
from evolution.episodes import Episodes
from evolution.policy import CnnSpec, MlpSpec, Observation, PolicySpec, act_on
from evolution.rollout import Limits
from evolution.rollout import evaluate as roll_out
from gridsim.config import EpisodeConfig, SensorConfig, SimConfig, TrafficConfig, VehicleConfig
from gridsim.scenarios import HELD_OUT_SEED, check_name, default_traffic


@dataclass(frozen=True)
class Champion:
    """A genome and what is needed to run it.

    Attributes:
        genome: float32 [genes].
        policy: its network, as in `mlp:6,7`.
        scenario: where it learned.
        sim: the simulator's numbers it learned with.
        traffic: other cars it learned among.
    """

    genome: np.ndarray
    policy: str
    scenario: str
    sim: SimConfig
    traffic: int = 0

    @property
    def sha256(self) -> str:
        """Of the genome's bytes."""
        return hashlib.sha256(self.genome.tobytes()).hexdigest()

    @property
    def observation(self) -> Observation:
        """What it sees: rays or grid."""
        return PolicySpec.parse(self.policy).observation

    def act(self, observation: np.ndarray, speed: float | np.ndarray | None = None) -> int | np.ndarray:
        """The action for an observation, or actions [n] for n of them.

        Args: of rays, the environment's float32 [32] or [n, 32], which contain the speed, and what else it may see
        (`make_env` gives it). Of the grid, what `convnet.act_on` takes, uint8 [80, 80] or [frames, 80, 80], and the
        speed in m/s, which a grid does not show: the environment's `info["speed_mps"]`.
        Raises: ValueError with one line for an observation that this champion does not see.
        """
        spec = PolicySpec.parse(self.policy)
        if isinstance(spec, CnnSpec):
            if speed is None:
                raise ValueError(f'{spec} needs the speed beside the grid: act(observation, info["speed_mps"])')
            return convnet.act_on(spec, self.genome, observation, speed)
        return act_on(
            spec,
            self.genome,
            observation,
            self.sim.sensors.range,
            self.sim.vehicle.speed_limit,
            math.radians(self.sim.vehicle.steering_limit),
        )

    def make_env(self, scenario: str | None = None, **options: Any) -> Any:
        """A Gymnasium environment on the champion's scenario, or another."""
        from gridsim.env import GridSimEnv

        spec = PolicySpec.parse(self.policy)
        sees: dict[str, Any] = {"observation": spec.observation}
        if isinstance(spec, CnnSpec):
            sees["frames"] = spec.frames
        elif isinstance(spec, MlpSpec):
            sees |= {"motion": spec.motion, "steering": spec.steering}
        if scenario in (None, self.scenario):
            sees["traffic"] = self.traffic
        return GridSimEnv(scenario=scenario or self.scenario, config=self.sim, **{**sees, **options})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write champion.npz. Raises CheckpointError if that cannot be done."""
        meta = {
            "policy": self.policy,
            "scenario": self.scenario,
            "traffic": self.traffic,
            "sim": dataclasses.asdict(self.sim),
        }
        checkpoint.save(path, {"genome": self.genome}, meta)


def load_champion(path: str | os.PathLike[str]) -> Champion:
    """Read champion.npz.

    Raises: CheckpointError with one line for a file that is missing, damaged, hostile or no champion.
    """
    arrays, meta = checkpoint.load(path)
    try:
        genome, sim = arrays["genome"], meta["sim"]
        spec = PolicySpec.parse(meta["policy"])
        if genome.dtype != np.float32 or genome.shape != (spec.size,):
            raise ValueError(f"its genome does not fit {spec}")
        config = SimConfig(
            VehicleConfig(**sim["vehicle"]),
            SensorConfig(**sim["sensors"]),
            EpisodeConfig(**sim["episode"]),
            TrafficConfig(**sim.get("traffic", {})),
        )
        return Champion(genome, str(spec), str(meta["scenario"]), config, int(meta.get("traffic", 0)))
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: no champion: {error}") from error


def evaluate(
    champion: Champion,
    scenario: str | None = None,
    episodes: int = 64,
    seed: int = HELD_OUT_SEED,
    traffic: int | None = None,
) -> dict[str, float]:
    """Drive a champion through episodes on maps it never saw, in this process.

    Args: a scenario's name (default: the champion's own); how many episodes; the first map's seed; other cars on the
    road (default: as many as it learned among, or as the other scenario has by default).
    Returns: episodes, success_rate, distance_m, speed_mps, collision_rate (means). With the defaults these are the
    held-out figures of summary.json.
    Raises: ValueError for an unknown scenario or fewer than one episode.
    """
    name = scenario or champion.scenario
    maps = Maps(name, champion.sim)
    try:
        chosen = held_out(champion, maps, name, episodes, seed, traffic)
        episode = champion.sim.episode
        limits = Limits(episode.target, round(episode.time_limit / episode.control_period))
        scenarios = [maps.get(s) for s in chosen.maps]
        results = roll_out(
            PolicySpec.parse(champion.policy),
            champion.genome[None],
            scenarios,
            chosen.rows,
            limits,
            champion.sim,
            worlds=chosen.worlds,
        )[0]
        return summarise(results[0], episode.control_period)
    finally:
        maps.close()


def held_out(champion: Champion, maps: Maps, name: str, episodes: int, seed: int, traffic: int | None) -> Episodes:
    """The episodes that `evaluate` drives. Raises: ValueError as it does."""
    check_name(name)
    if episodes < 1:
        raise ValueError(f"episodes must be 1 or more, not {episodes}")
    if traffic is None:
        traffic = champion.traffic if name == champion.scenario else default_traffic(name)
    if not 0 <= traffic <= MAX_TRAFFIC:
        raise ValueError(f"traffic must be 0 to {MAX_TRAFFIC} cars, not {traffic}")
    used = max(len(HELD_OUT_SEEDS), episodes // 8)
    return spread_starts(maps.get, range(seed, seed + used), episodes, traffic)
