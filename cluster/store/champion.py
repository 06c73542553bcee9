"""Champions: how they are saved, and what you can do with one: load it, drive it, evaluate it."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cluster.settings import MAX_TRAFFIC
from cluster.store import checkpoint
from cluster.store.checkpoint import CHAMPION, CHECKPOINT, CONFIG, CheckpointError
from cluster.store.folder import read_config
from cluster.text import as_argument
from evolution.episodes import rollout
from evolution.episodes.curriculum import HELD_OUT_SEEDS, spread_starts
from evolution.episodes.figures import summarise
from evolution.episodes.starts import Episodes
from evolution.networks import convnet
from evolution.networks.export import to_onnx
from evolution.networks.policy import CnnSpec, PolicySpec, act_on
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.map import Map
from gridsim.maps.parts import HELD_OUT_SEED, roads_of, seed_of_map
from gridsim.maps.scenarios import AMOUNTS, Traffic, build, check_name, crowds, full_name, has_lanes

SIM_FORMAT = 2  # of `sim` in a champion.npz; format 1 has patience in control steps, progress in m per control step
GONE = ("apart", "kerb")  # traffic parameters of format 1 that no longer exist


@dataclass(frozen=True)
class Champion:
    """A genome and what is needed to run it. Champions are equal if all fields are, the genome bit for bit."""

    genome: np.ndarray  #: float32 [genes]
    policy: str  #: its network, such as `mlp:6,7`
    scenario: str  #: where it learned
    sim: SimConfig  #: the simulator's parameters: those it learned with, unless they were replaced (`in_sim`)
    traffic: Traffic = 0  #: its run's traffic: a number, `usual` or `heavy` (which differ by road); doubled in training

    def __repr__(self) -> str:
        return f"<Champion {self.policy} of {self.scenario}: {self.genome.size:,} genes, sha256 {self.sha256[:8]}>"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Champion):
            return NotImplemented
        return vars(self) | {"genome": self.sha256} == vars(other) | {"genome": other.sha256}

    def __hash__(self) -> int:
        return hash(self.sha256)

    @property
    def sha256(self) -> str:
        """Digest of the genome's bytes."""
        return hashlib.sha256(self.genome.tobytes()).hexdigest()

    def in_sim(self, sim: SimConfig | str | None) -> Champion:
        """The champion with the parameters that `SimConfig.load` makes of `sim`; itself if `sim` is None or "".

        Raises: GridSimError if the parameters are invalid, or if their rays do not fit the network.
        """
        other = dataclasses.replace(self, sim=SimConfig.load(sim)) if sim else self
        rollout.policy_buffers(PolicySpec.parse(self.policy), other.sim)  # raises if the rays do not fit the network
        return other

    def crowds_on(self, scenario: str, asked: Traffic | None = None) -> tuple[int, ...]:
        """The number of other cars on each road of a scenario.

        `asked` is a number, `usual` or `heavy`. None means the champion's own `traffic`, if it learned on all of these
        roads and its present car is not a small one (`SimConfig.unit` is 1); else the scenario's default.
        """
        if asked is None and self.sim.unit == 1.0 and {*roads_of(scenario)} <= {*roads_of(self.scenario)}:
            asked = self.traffic
        return crowds(scenario, asked, self.sim)

    def act(self, observation: np.ndarray | dict[str, np.ndarray]) -> Any:
        """The action for an observation as `make_env`'s environment gives it, or an array of n for n of them.

        An action is an integer (`vehicle.Action`; -1 if an output of the network is NaN), or for a continuous policy
        float32 [2]: pedal and wheel, each in [-1, 1].

        Args: `observation`, for a policy on rays float32 [32] or [n, 32], or more numbers if the policy sees more; on
        the grid a dictionary: grid, uint8 [frames, 80, 80] or [n, frames, 80, 80], and speed, float32 [1] or [n, 1], as
        a share of `vehicle.speed_limit`.
        Raises: ValueError, with a one-line message, for an observation that does not fit this champion.
        """
        spec = PolicySpec.parse(self.policy)
        if isinstance(spec, CnnSpec):
            if not isinstance(observation, dict) or not {"grid", "speed"} <= observation.keys():
                given = list(observation) if isinstance(observation, dict) else type(observation).__name__
                raise ValueError(f"{spec} sees a dictionary of grid and speed, not {given}")
            speeds = observation["speed"][..., 0] * np.float32(self.sim.vehicle.speed_limit)
            return convnet.act_on(spec, self.genome, observation["grid"], speeds)
        if isinstance(observation, dict):
            raise ValueError(f"{spec} sees an array of numbers, not a dictionary of {list(observation)}")
        return act_on(spec, self.genome, np.asarray(observation), self.sim)

    def make_env(self, scenario: str | None = None, **options: Any) -> Any:
        """A Gymnasium environment (`GridSimEnv`) that suits the champion, on its scenario or another.

        `options` are further arguments of the environment; they override those that the champion decides. With a
        `config`, it is the environment of `in_sim(config)`.
        """
        from gridsim.envs.env import GridSimEnv

        scenario = full_name(scenario or self.scenario)
        spec, driver = PolicySpec.parse(self.policy), self.in_sim(options.pop("config", None))
        own: dict[str, Any] = {"observation": spec.observation, "traffic": driver.crowds_on(scenario)}
        own["config"] = driver.sim
        own |= {name: value for name, value in vars(spec).items() if name not in ("hidden", "features")}
        own |= dict.fromkeys(spec.features, True)
        return GridSimEnv(scenario=scenario, **own | options)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write champion.npz. Raises CheckpointError if it cannot be written."""
        meta = {name: getattr(self, name) for name in ("policy", "scenario", "traffic")}
        sim = {"sim": dataclasses.asdict(self.sim), "sim_format": SIM_FORMAT}
        checkpoint.save(path, {"genome": self.genome}, meta | sim)

    def export_onnx(self, path: str | os.PathLike[str]) -> None:
        """Write the policy as an ONNX file, which maps the environment's observations to actions (docs/deploy.md).

        Raises: GridSimError if the package onnx is not installed, CheckpointError if the file cannot be written.
        """
        checkpoint.write_atomic(path, to_onnx(PolicySpec.parse(self.policy), self.genome, self.sim))


class UnfinishedError(CheckpointError):
    """A run that has no champion yet; the message is one line for the user."""


def load_champion(path: str | os.PathLike[str]) -> Champion:
    """Read a champion.npz, given the file or its run's folder.

    Raises: UnfinishedError for a run that has none yet, or RunError if its config.json is not usable either;
    CheckpointError for any other file or folder that is missing or holds no champion.
    """
    path = Path(path)
    if os.path.isdir(path):  # path.is_dir() raises for a name that is too long
        if not (path / CHAMPION).exists():
            raise _missing(path)
        path /= CHAMPION
    arrays, meta = checkpoint.load(path)
    if "genome" not in arrays:
        raise CheckpointError(f"{path} holds no champion")
    try:
        genome, sim = arrays["genome"], meta["sim"]
        spec = PolicySpec.parse(meta["policy"])
        if genome.dtype != np.float32 or genome.shape != (spec.size,):
            raise ValueError(f"its genome does not fit {spec}")
        if not np.isfinite(genome).all():
            raise ValueError("some of its genes are not numbers")
        if meta.get("sim_format", 1) == 1:
            sim = _in_seconds(sim)
        config = SimConfig.of(sim)
        traffic = meta.get("traffic", 0)
        return Champion(
            genome, str(spec), str(meta["scenario"]), config, traffic if traffic in AMOUNTS else int(traffic)
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CheckpointError(f"{path}: not a champion: {error}") from error


def _in_seconds(sim: dict[str, Any]) -> dict[str, Any]:
    """Convert a champion's `sim` of format 1 to SIM_FORMAT: patience in s, progress in m/s, traffic without GONE."""
    episode, period = sim["episode"], sim["episode"]["control_period"]
    episode = episode | {"patience": episode["patience"] * period, "progress": episode["progress"] / period}
    traffic = {name: value for name, value in sim.get("traffic", {}).items() if name not in GONE}
    return sim | {"episode": episode, "traffic": traffic}


def _missing(run: Path) -> CheckpointError:
    """The error for a folder without a champion: its message says why there is none, and what to do."""
    if not (run / CONFIG).is_file():
        return CheckpointError(f"{run} is not a run's folder: it has neither {CHAMPION} nor {CONFIG}")
    command = read_config(run / CONFIG)[0].command
    again = f"continue it with: {command} --resume {as_argument(run)}"
    if not (run / CHECKPOINT).is_file():
        again = f"start it anew with: {command} --config {as_argument(run / CONFIG)}"
    return UnfinishedError(f"{run} has no {CHAMPION} yet: it is written when the run ends; if it was stopped, {again}")


def evaluate(
    champion: Champion,
    scenario: str | None = None,
    episodes: int = 64,
    seed: int = HELD_OUT_SEED,
    traffic: Traffic | None = None,
    sim: SimConfig | str | None = None,
) -> dict[str, float]:
    """Drive a champion through episodes, by default held-out ones, in this process.

    Args: `scenario`, a name (default: the champion's own), also of several roads; `episodes` on each road; `seed` of
    the first map; `traffic`, other cars, usual, heavy or a number (default: as in `Champion.crowds_on`); `sim`, what
    `SimConfig.load` takes (default: the champion's own `sim`).
    Returns: figures of all roads' episodes together: `episodes`, their number; success_rate, distance_m, speed_mps and
    collision_rate, which are means; km_per_collision. With the defaults these are the held-out figures of summary.json.
    Raises: GridSimError (a ValueError), for example for an unknown scenario or fewer than one episode.
    """
    champion = champion.in_sim(sim)
    found = [results for _, _, results in drives(champion, scenario, episodes, seed, traffic)]
    return summarise(np.concatenate(found), champion.sim.episode.control_period)


def drives(
    champion: Champion, scenario: str | None, episodes: int, seed: int, traffic: Traffic | None
) -> Iterator[tuple[str, int, np.ndarray]]:
    """Drive `evaluate`'s episodes, road by road. Yields: the road, its number of other cars, and RESULT [episodes]."""
    spec, sim, genomes = PolicySpec.parse(champion.policy), champion.sim, champion.genome[None]
    for road, cars, chosen, maps in held_out(champion, scenario, episodes, seed, traffic):
        yield road, cars, rollout.evaluate(spec, genomes, maps, chosen.rows, sim, chosen.worlds)[0][0]


def held_out(
    champion: Champion, scenario: str | None, episodes: int, seed: int, traffic: Traffic | None
) -> Iterator[tuple[str, int, Episodes, list[Map]]]:
    """The episodes that `evaluate` drives. Yields for each road: its name, number of other cars, episodes, and the
    maps that these index.

    Raises: GridSimError as `evaluate` does.
    """
    name = full_name(scenario or champion.scenario)
    check_name(name)
    if episodes < 1:
        raise GridSimError(f"episodes must be 1 or more, not {episodes}")
    seeds = range(seed, seed + max(len(HELD_OUT_SEEDS), episodes // 8))
    for road, cars in zip(roads_of(name), champion.crowds_on(name, traffic), strict=True):
        if not 0 <= cars <= MAX_TRAFFIC:
            raise GridSimError(f"traffic must be 0 to {MAX_TRAFFIC} cars, not {cars}")
        if cars and not has_lanes(road):
            raise GridSimError(f"traffic: {road} has no lanes for it; use 0 cars")
        same = {k: seed_of_map(road, k) for k in seeds}
        maps = {k: build(road, k, champion.sim) for k in dict.fromkeys(same.values())}
        chosen = spread_starts(lambda k: maps[same[k]], seeds, episodes, (cars,), champion.sim)  # noqa: B023
        yield road, cars, chosen, [maps[same[k]] for k in chosen.maps]
