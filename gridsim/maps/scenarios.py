"""The scenarios by name, and their maps from a seed."""

from __future__ import annotations

import difflib
import glob
import hashlib
import os
import re
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Literal, get_args

import numpy as np

from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps import generators
from gridsim.maps.lanes import Scenario
from gridsim.maps.map import Map
from gridsim.maps.network import make_network
from gridsim.maps.parts import (
    PICTURES,
    YAMLS,
    file_of,
    files_of,
    is_map_file,
    road_of,
    roads_of,
    seed_of_map,
    seeds_of_files,
    with_seed,
)
from gridsim.maps.roads import clearance_nodes, make_road

ALL = "all"  # the name of all roads of the registry
REAL_TRAFFIC = 8  # default number of other cars on real roads
Amount = Literal["usual", "heavy"]
AMOUNTS: tuple[str, ...] = get_args(Amount)
Traffic = int | Amount  # as users ask for it

_FOUND = {
    file.name: import_module(f"{generators.__name__}.{file.name}").SCENARIO
    for file in iter_modules(generators.__path__)
}
#: The scenarios by name, the fastest road first.
REGISTRY: dict[str, Scenario] = dict(
    sorted(_FOUND.items(), key=lambda item: item[1].speed_interval[::-1], reverse=True)
)


def full_name(name: str) -> str:
    """A scenario's name that means the same in another folder: paths are absolute, and `all` is spelt out."""
    roads = [road for each in roads_of(name) for road in (REGISTRY if each == ALL else [each])]
    return ",".join(os.path.abspath(road) if is_map_file(road) else road for road in roads)


def has_lanes(name: str) -> bool:
    """Whether all roads of a scenario have lanes, and so may have traffic: all but pictures and YAML files."""
    files = [file for road in roads_of(name) if is_map_file(road) for file in files_of(road)]
    return all(Path(file).suffix.lower() not in PICTURES + YAMLS for file in files)


def check_name(name: str) -> None:
    """Raises: GridSimError if a road is neither in the registry nor a path, or if two have the same label.

    A path (`is_map_file`) need not exist. `all` must be spelt out (`full_name`).
    """
    roads = roads_of(name)
    if not all(roads):
        raise GridSimError(f"scenario {name!r}: the name of a road is empty")
    for road in roads:
        if road not in REGISTRY and not is_map_file(road):
            like = difflib.get_close_matches(road, REGISTRY, 1)
            hint = f"did you mean {like[0]}? There" if like else "there"
            names = ", ".join(sorted(REGISTRY))
            raise GridSimError(f"unknown scenario {road!r}; {hint} are: {names}, {ALL}, and files of maps and roads")
    labels = [label(road) for road in roads]
    for road, short in zip(roads, labels, strict=True):
        if labels.count(short) > 1:
            if roads.count(road) > 1:
                raise GridSimError(f"scenario {name}: {road} is there twice")
            raise GridSimError(f"scenario {name}: two of its roads have the name {short}; rename or copy a file")


def label(name: str) -> str:
    """A short name of a scenario; for a file, its name without folder, format and crop."""
    if len(roads := roads_of(name)) > 1:
        every = {*REGISTRY} <= {*roads}
        return "+".join([ALL] * every + [label(road) for road in roads if not (every and road in REGISTRY)])
    if not is_map_file(name):
        return name
    if glob.has_magic(name) and not Path(name).exists():
        name = re.sub(r"[*?\[\]]", "", "-".join(Path(name).parts[-2:]))
    return re.sub(r"(\.net)?(\.\w+)(\.gz)?(@.*)?$", "", Path(name).name)


def map_digest(name: str) -> str:
    """SHA-256 of the files of a scenario's maps; "" without any. Raises: GridSimError if they cannot be read."""
    from gridsim.maps import files
    from gridsim.maps.real.load import file_digest

    names = [file for road in roads_of(name) if is_map_file(road) for file in files_of(road)]
    digests = [(file_digest if has_lanes(file) else files.map_digest)(file) for file in names]
    return hashlib.sha256("".join(digests).encode()).hexdigest() if len(digests) > 1 else "".join(digests)


def traffic_on(name: str, asked: Traffic | None = None, config: SimConfig | None = None) -> int:
    """The number of other cars on a road, if a number, `usual`, `heavy` or None (the default) is asked for.

    Unless `asked` is a number, there are none on a map without lanes, or if cars are small (`SimConfig.unit` below 1).
    Raises: GridSimError for anything else.
    """
    if isinstance(asked, (int, np.integer)) and not isinstance(asked, bool):
        return int(asked)
    if asked not in (None, *AMOUNTS):
        raise GridSimError(f"traffic is {', '.join(AMOUNTS)} or a number of cars, not {asked!r}")
    if not has_lanes(name) or (config is not None and config.unit < 1.0):
        return 0
    cars = REGISTRY[name].traffic if name in REGISTRY else REAL_TRAFFIC
    if asked and not cars:
        cars = REGISTRY[name].usual_traffic
    return 2 * cars if asked == "heavy" else cars


def crowds(name: str, asked: Traffic | None = None, config: SimConfig | None = None) -> tuple[int, ...]:
    """`traffic_on` for each road of a scenario; if it has several roads, the default (None) is `usual`."""
    roads = roads_of(name)
    asked = "usual" if asked is None and len(roads) > 1 else asked
    return tuple(traffic_on(road, asked, config) for road in roads)


def speed_interval(name: str, config: SimConfig) -> tuple[float, float]:
    """A road's speed interval, m/s."""
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

    For a small car, all lengths of a generated road are multiplied by the car's unit (`SimConfig.unit`), its speeds by
    `SimConfig.pace`, and the road has no lights.
    """
    config = config or SimConfig()
    check_name(name)
    if seed < 0:
        raise GridSimError(f"a seed must be 0 or more, not {seed}")
    name, seed = road_of(name, seed)
    if is_map_file(name):  # imported here, because workers never read files
        from gridsim.maps.files import load_map
        from gridsim.maps.real.load import load_road

        file = file_of(name, seed)
        road_map = (load_road if has_lanes(file) else load_map)(file, config)
        return with_seed(road_map, seed_of_map(name, seed), file == name)
    spec = REGISTRY[name]
    rng = np.random.default_rng(np.random.SeedSequence([seed, *name.encode()]))
    lit = config.traffic.lights and config.traffic.city_lights and config.unit == 1.0
    strips, lanes = (spec.lit if spec.lit and lit else spec.layout)(rng)
    nodes = clearance_nodes(strips, float(lanes.width), float(lanes.height))
    road = make_road(nodes, speed_interval(name, config), spec.thinnest, config.unit)
    strips, lanes = strips.scaled(config.unit), lanes.scaled(config.unit)
    return Map(name, seed, road, strips, make_network(lanes, road, config))
