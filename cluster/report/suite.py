"""The suite: fixed drives in which anybody's champions are compared, and a digest of the drives to check figures by.

Only figures of the same NUMBER can be compared. Whoever changes the suite's roads, traffic, car or number of drives
increases NUMBER.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cluster.store.champion import Champion, drives
from cluster.store.checkpoint import CheckpointError
from evolution.episodes.figures import summarise
from gridsim.config import SimConfig
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import ALL, Traffic
from gridsim.packages import DISTRIBUTION

FILE = "suite.json"
NUMBER = 1
EPISODES = 512  # on each road
TRAFFIC: Traffic = "usual"


def drive(champion: Champion) -> Iterator[tuple[str, int, np.ndarray]]:
    """Drive the suite with the default simulator parameters, not the champion's. Yields as `drives` does."""
    return drives(champion.in_sim("default"), ALL, EPISODES, HELD_OUT_SEED, TRAFFIC)


def report(champion: Champion, driven: list[tuple[str, int, np.ndarray]]) -> dict[str, Any]:
    """What suite.json holds. The digest is of all drives: their distances, control steps and ends."""
    digest, period = hashlib.sha256(), SimConfig().episode.control_period
    for _, _, results in driven:
        for name in ("distance", "steps", "end"):
            digest.update(np.ascontiguousarray(results[name]).tobytes())
    return {
        "suite": NUMBER,
        "gridsim": version(DISTRIBUTION),
        "policy": champion.policy,
        "champion_sha256": champion.sha256,
        "digest": digest.hexdigest(),
        **summarise(np.concatenate([results for _, _, results in driven]), period),
        "by_road": {road: {"cars": cars, **summarise(results, period)} for road, cars, results in driven},
    }


def earlier(path: Path) -> dict[str, Any]:
    """A suite.json's number of the suite, champion's digest and drives' digest; {} if there is no such file.

    Raises: CheckpointError if it cannot be read.
    """
    try:
        found = json.loads(path.read_bytes())
        return {name: found[name] for name in ("suite", "champion_sha256", "digest")}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path} cannot be read as a suite's figures; move it away") from error


def compared(before: dict[str, Any], found: dict[str, Any]) -> str:
    """Whether an earlier suite.json had the same drives, in words; "" without one of this champion and NUMBER."""
    if any(before.get(name) != found[name] for name in ("suite", "champion_sha256")):
        return ""
    if before["digest"] == found["digest"]:
        return f"{FILE} had the same drives: checked"
    return f"{FILE} had other drives (digest {before['digest'][:8]}, now {found['digest'][:8]}); it is replaced"
