"""The scenarios by name, and their maps from a seed."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import numpy as np

from gridsim.config import SimConfig, names_file
from gridsim.errors import GridSimError
from gridsim.maps import generators
from gridsim.maps.lanes import Scenario
from gridsim.maps.map import Map
from gridsim.maps.network import make_network
from gridsim.maps.roads import clearance_nodes, make_road

PICTURES = (".png", ".pgm", ".jpg", ".jpeg", ".bmp", ".yaml", ".yml")  # files of maps without lanes
REAL_TRAFFIC = 8  # default number of other cars on real roads
# First seeds of the maps for training, for the choice of the champion, and for the final report and nothing else.
TRAINING_SEED, VALIDATION_SEED, HELD_OUT_SEED = 0, 1_000_000, 2_000_000

_FOUND = {
    file.name: import_module(f"{generators.__name__}.{file.name}").SCENARIO
    for file in iter_modules(generators.__path__)
}
#: The scenarios by name, the fastest road first.
REGISTRY: dict[str, Scenario] = dict(
    sorted(_FOUND.items(), key=lambda item: item[1].speed_interval[::-1], reverse=True)
)


def is_map_file(name: str) -> bool:
    """Whether a scenario's name is the path of a map file (`gridsim.maps.files`)."""
    return names_file(name)


def has_lanes(name: str) -> bool:
    """Whether a scenario has lanes, and so may have traffic: all but pictures and YAML files."""
    return not is_map_file(name) or Path(name).suffix.lower() not in PICTURES


def check_name(name: str) -> None:
    """Raises: GridSimError if the name is neither in the registry nor a map file's."""
    if name not in REGISTRY and not is_map_file(name):
        names = ", ".join(sorted(REGISTRY))
        raise GridSimError(f"unknown scenario {name!r}; there are: {names}, and files of maps and roads")


def label(name: str) -> str:
    """A short name of a scenario: for a file, its name without what says its format."""
    if not is_map_file(name):
        return name
    return re.sub(r"(\.net)?(\.\w+)(\.gz)?(@.*)?$", "", Path(name).name)


def map_digest(name: str) -> str:
    """SHA-256 of a map's files. Raises: GridSimError if they cannot be read."""
    if has_lanes(name):
        from gridsim.maps.real.load import file_digest

        return file_digest(name)
    from gridsim.maps import files

    return files.map_digest(name)


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
    road = build(name, 0, config).road
    return float(road.speed_low), float(road.speed_high)


def seed_of_map(name: str, seed: int) -> int:
    """The seed of the map that `build` returns: always 0 for a map file, which has only one map."""
    return 0 if is_map_file(name) else seed


def build(name: str, seed: int, config: SimConfig | None = None) -> Map:
    """Build a scenario's map from a seed; the same seed gives the same map.

    For a small car, a generated road is as much smaller as the car's unit (`SimConfig.unit`).
    """
    config = config or SimConfig()
    check_name(name)
    if seed < 0:
        raise GridSimError(f"a seed must be 0 or more, not {seed}")
    if is_map_file(name):  # imported here, because workers never read files
        if has_lanes(name):
            from gridsim.maps.real.load import load_road

            return load_road(name, config)
        from gridsim.maps.files import load_map

        return load_map(name, config)
    spec = REGISTRY[name]
    rng = np.random.default_rng(np.random.SeedSequence([seed, *name.encode()]))
    strips, lanes = spec.layout(rng)
    nodes = clearance_nodes(strips, float(lanes.width), float(lanes.height))
    road = make_road(nodes, speed_interval(name, config), spec.thinnest, config.unit)
    strips, lanes = strips.scaled(config.unit), lanes.scaled(config.unit)
    return Map(name, seed, road, strips, make_network(lanes, road, config))
