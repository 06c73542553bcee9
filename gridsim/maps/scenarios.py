"""The scenarios by name, and their maps from a seed."""

from __future__ import annotations

import glob
import hashlib
import re
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import numpy as np

from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps import generators
from gridsim.maps.lanes import Scenario
from gridsim.maps.map import Map
from gridsim.maps.network import make_network
from gridsim.maps.parts import PICTURES, YAMLS, file_of, files_of, is_map_file, seed_of_map, seeds_of_files, with_seed
from gridsim.maps.roads import clearance_nodes, make_road

REAL_TRAFFIC = 8  # default number of other cars on real roads

_FOUND = {
    file.name: import_module(f"{generators.__name__}.{file.name}").SCENARIO
    for file in iter_modules(generators.__path__)
}
#: The scenarios by name, the fastest road first.
REGISTRY: dict[str, Scenario] = dict(
    sorted(_FOUND.items(), key=lambda item: item[1].speed_interval[::-1], reverse=True)
)


def has_lanes(name: str) -> bool:
    """Whether a scenario has lanes, and so may have traffic: all but pictures and YAML files."""
    if not is_map_file(name):
        return True
    return all(Path(file).suffix.lower() not in PICTURES + YAMLS for file in files_of(name))


def check_name(name: str) -> None:
    """Raises: GridSimError if the name is neither in the registry nor a map file's."""
    if name not in REGISTRY and not is_map_file(name):
        names = ", ".join(sorted(REGISTRY))
        raise GridSimError(f"unknown scenario {name!r}; there are: {names}, and files of maps and roads")


def label(name: str) -> str:
    """A short name of a scenario: for a file, its name without what says its format."""
    if not is_map_file(name):
        return name
    if glob.has_magic(name) and not Path(name).exists():
        name = re.sub(r"[*?\[\]]", "", "-".join(Path(name).parts[-2:]))
    return re.sub(r"(\.net)?(\.\w+)(\.gz)?(@.*)?$", "", Path(name).name)


def map_digest(name: str) -> str:
    """SHA-256 of a map's files. Raises: GridSimError if they cannot be read."""
    from gridsim.maps import files
    from gridsim.maps.real.load import file_digest

    digests = [(file_digest if has_lanes(file) else files.map_digest)(file) for file in files_of(name)]
    return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


def default_traffic(name: str, config: SimConfig | None = None) -> int:
    """A scenario's default number of other cars; 0 on a map without lanes, and for small cars."""
    if not has_lanes(name) or (config is not None and config.unit < 1.0):
        return 0
    return REGISTRY[name].traffic if name in REGISTRY else REAL_TRAFFIC


def speed_interval(name: str, config: SimConfig) -> tuple[float, float]:
    """A scenario's speed interval, m/s."""
    if name in REGISTRY:
        low, high = REGISTRY[name].speed_interval
        return low * config.pace, high * config.pace
    return _interval_of_files(name, map_digest(name), config)


@lru_cache
def _interval_of_files(name: str, _digest: str, config: SimConfig) -> tuple[float, float]:
    """The speed interval of map files with this digest: from the lowest to the highest of all."""
    roads = [build(name, seed, config).road for seed in seeds_of_files(name)]
    return min(float(road.speed_low) for road in roads), max(float(road.speed_high) for road in roads)


def build(name: str, seed: int, config: SimConfig | None = None) -> Map:
    """Build a scenario's map from a seed; the same seed gives the same map.

    For a small car, a generated road is as much smaller as the car's unit (`SimConfig.unit`).
    """
    config = config or SimConfig()
    check_name(name)
    if seed < 0:
        raise GridSimError(f"a seed must be 0 or more, not {seed}")
    if is_map_file(name):  # imported here, because workers never read files
        from gridsim.maps.files import load_map
        from gridsim.maps.real.load import load_road

        file = file_of(name, seed)
        road_map = (load_road if has_lanes(file) else load_map)(file, config)
        return with_seed(road_map, seed_of_map(name, seed), file == name)
    spec = REGISTRY[name]
    rng = np.random.default_rng(np.random.SeedSequence([seed, *name.encode()]))
    strips, lanes = spec.layout(rng)
    nodes = clearance_nodes(strips, float(lanes.width), float(lanes.height))
    road = make_road(nodes, speed_interval(name, config), spec.thinnest, config.unit)
    strips, lanes = strips.scaled(config.unit), lanes.scaled(config.unit)
    return Map(name, seed, road, strips, make_network(lanes, road, config))
