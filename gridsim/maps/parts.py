"""Which maps are for training, which for the choice of the champion, and which only for the final report.

Each map has a seed, and seeds are in three parts. A generated road has a new map for each seed; the files of a folder
are divided among the parts; and on a single file, unless it is small, episodes of each part begin in regions of their
own. If a scenario's name lists n roads, these take turns: in each part, the k-th seed (from 0) is for road k modulo n.
"""

from __future__ import annotations

import glob
import os
import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from gridsim import ENVIRONMENTS
from gridsim.config import names_file
from gridsim.errors import GridSimError
from gridsim.maps.map import Map

TRAINING_SEED: int = 0
VALIDATION_SEED: int = 1_000_000
HELD_OUT_SEED: int = 2_000_000
FIRST_SEEDS = TRAINING_SEED, VALIDATION_SEED, HELD_OUT_SEED  # the first seed of each part
PICTURES = (".png", ".pgm", ".jpg", ".jpeg", ".bmp")
YAMLS = (".yaml", ".yml")
ROADS = (".osm", ".pbf", ".xodr", ".xml", ".gz")
# A square of a file: PATH@X,Y,METRES or PATH@LAT,LON,METRES (its middle and side), perhaps with @left or @right.
CROP = re.compile(r"(.+)@(-?[\d.]+),(-?[\d.]+),([\d.]+)(?:@left|@right)?")
_TURNS = 0, 1, 2, 0, 0  # parts (`part_of`) of files 0 to 4, then of 5 to 9 and so on; also of regions along a row
_REGIONS = 10  # square regions along the longer side of the box around a map's lanes or starts


def roads_of(name: str) -> list[str]:
    """The roads that a scenario's name lists, separated by commas.

    The commas of a CROP separate nothing, nor do those of a name that as a whole is an existing path.
    """
    words, roads = [name] if os.path.exists(name) else name.split(","), list[str]()
    while words:
        n = 3 if CROP.fullmatch(",".join(words[:3])) else 1
        roads.append(",".join(words[:n]))
        del words[:n]
    return roads


def road_number(seed: int, roads: int) -> int:
    """Which of a scenario's roads a seed is for, as a number from 0; `roads` is how many there are."""
    return (seed - FIRST_SEEDS[part_of(seed)]) % roads


def seed_on(number: int, roads: int, own: int) -> int:
    """The seed of a scenario of `roads` roads for the map that its road `number` alone has for seed `own`."""
    first = FIRST_SEEDS[part_of(own)]
    return first + (own - first) * roads + number


def seeds_on(own: range, roads: int) -> range:
    """The seeds of a scenario of `roads` roads for the maps that each road alone has for the seeds `own`."""
    return range(seed_on(0, roads, own.start), seed_on(0, roads, own.stop))


def road_of(name: str, seed: int) -> tuple[str, int]:
    """The road that a scenario's seed is for, and the seed for which this road alone has the same map."""
    roads, first = roads_of(name), FIRST_SEEDS[part_of(seed)]
    return roads[road_number(seed, len(roads))], first + (seed - first) // len(roads)


def is_map_file(name: str) -> bool:
    """Whether a scenario's name is one road, given by a path: of a file, of a folder, or a pattern such as maps/*.osm.

    Any name with a dot or a separator of folders counts as a path; the file need not exist.
    """
    own = name in ENVIRONMENTS.values()  # whatever folders there are: ./city is the folder
    return len(roads_of(name)) == 1 and not own and (names_file(name) or glob.has_magic(name) or os.path.isdir(name))


def files_of(name: str) -> list[str]:
    """The map files of a path, sorted: the file itself, all that match a pattern, or those of a folder.

    Pictures count only if there is no YAML file among them. Raises: GridSimError for a folder or a pattern with fewer
    than three.
    """
    if os.path.isdir(name):
        files = [os.path.join(name, file) for file in sorted(os.listdir(name))]
    elif glob.has_magic(name) and not os.path.exists(name):
        files = sorted(glob.glob(name))
    else:
        return [name]
    kinds = ROADS + (YAMLS if any(file.lower().endswith(YAMLS) for file in files) else PICTURES)
    files = [file for file in files if Path(file).suffix.lower() in kinds]
    if len(files) < len(FIRST_SEEDS):
        raise GridSimError(
            f"{name}: {len(files)} map files; it needs 3 or more, one to learn on, one to choose the champion on, and "
            "one to judge it on"
        )
    return files


def divided(name: str) -> list[list[str]]:
    """The map files of a path, a list for each part; a single file is in all three.

    The lists do not depend on a run's seed, so that runs can be compared.
    """
    files = files_of(name)
    if len(files) == 1:
        return [files] * len(FIRST_SEEDS)
    turns = np.resize(_TURNS, len(files))
    return [[file for file, turn in zip(files, turns, strict=True) if turn == part] for part in range(len(FIRST_SEEDS))]


def part_of(seed: int) -> int:
    """The part of a map's seed: 0 training, 1 the choice of the champion, 2 the final report."""
    return sum(seed >= first for first in FIRST_SEEDS) - 1


def seed_of_map(name: str, seed: int) -> int:
    """The smallest seed of the same part that gives the same map; for a generated road, the seed itself."""
    if (roads := len(roads_of(name))) > 1:
        return seed_on(road_number(seed, roads), roads, seed_of_map(*road_of(name, seed)))
    if not is_map_file(name):
        return seed
    part = part_of(seed)
    return FIRST_SEEDS[part] + (seed - FIRST_SEEDS[part]) % len(divided(name)[part])


def seeds_of_files(name: str) -> list[int]:
    """The smallest seed of each map of a path; of a single file, the first seed of each part."""
    return [first + k for first, files in zip(FIRST_SEEDS, divided(name), strict=True) for k in range(len(files))]


def file_of(name: str, seed: int) -> str:
    """The file that the map of a seed is read from."""
    part = part_of(seed)
    return divided(name)[part][seed_of_map(name, seed) - FIRST_SEEDS[part]]


@lru_cache(maxsize=16)
def with_seed(road_map: Map, seed: int, alone: bool) -> Map:
    """The map of a file for a seed.

    If its road has no other file (`alone`), episodes begin in regions of the seed's part.
    On a map so small that a part would have no region, they begin anywhere, for all parts.
    """
    regions = _regions(road_map) if alone else None
    if regions is None:
        return replace(road_map, seed=seed)
    begins = regions == part_of(seed)
    if len(road_map.network.steps):
        return replace(road_map, seed=seed, begins=begins)
    return replace(road_map, seed=seed, starts=road_map.starts[begins], begins=begins)


def _regions(road_map: Map) -> np.ndarray | None:
    """The part of each step between the network's points, or of each start if there are no lanes: int [n].

    None if a part has none of them.
    """
    places = road_map.starts[:, :2]
    if len(road_map.network.steps):
        points = road_map.network.points
        places = (points[1:] + points[:-1]) / 2.0
    low, extent = places.min(axis=0), np.ptp(places, axis=0).max()
    column, row = ((places - low) * (_REGIONS / max(extent, 1e-6))).astype(int).T
    parts = np.take(_TURNS, (column + 2 * row) % len(_TURNS))
    return parts if len(np.unique(parts)) == len(FIRST_SEEDS) else None


def held_out_place(name: str, held_out: Map) -> str:
    """Words for where the drives of the final report take place; `held_out` is one of their maps."""
    if (roads := len(roads_of(name))) > 1:
        return f"held-out drives of {roads} roads"
    if not is_map_file(name):
        return "held-out drives"
    files = [Path(file).name for file in divided(name)[2]]
    if files_of(name) != [name]:
        return f"held-out maps: {', '.join(files[:3])}" + (f" and {len(files) - 3} more" if len(files) > 3 else "")
    return "this map, from held-out regions" if len(held_out.begins) else "this map, from the starts of training"
