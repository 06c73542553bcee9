"""Maps of real roads: from a file to the project's `Map`."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import re
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gridsim.config import TRAFFIC_PACE, SimConfig
from gridsim.errors import GridSimError
from gridsim.jit import CACHE_FOLDER, F, freeze
from gridsim.maps.lights import no_lights
from gridsim.maps.map import Map
from gridsim.maps.network import Network, make_network
from gridsim.maps.parts import CROP
from gridsim.maps.raster import HALF_WALL, OUTSIDE
from gridsim.maps.real import ends, select
from gridsim.maps.real.area import clearance_of
from gridsim.maps.real.commonroad import read_commonroad
from gridsim.maps.real.content import format_of, parse, read_content
from gridsim.maps.real.description import Lane, RealRoad
from gridsim.maps.real.lanelet2 import read_lanelet2
from gridsim.maps.real.lights import with_lights
from gridsim.maps.real.shape import network_of, resampled, shaped
from gridsim.maps.real.sumo import convert, read_net
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR, FIELD_STEPS, Strips, make_road
from gridsim.reading import read_bytes, shown

NO_ROAD = "no road for cars is left on which one can go on; are there roads in the file, and in the crop?"
MAX_NODES = 1 << 24  # of a field, at most: those of 4 square km
SHORTEST_SIDE = 128.0  # m, of the torus; half of it is more than a sensor's range can be
USUAL_LIMIT = 50 / 3.6  # m/s, where a file gives none
SLOWEST_LIMIT = 15 / 3.6  # m/s; a lower limit must be in a wrong unit, and counts as none
SPEEDS = 0.45, 0.95  # the speed interval, as shares of the map's median limit (weighted by length)
SIDES = {"right": 1.0, "left": -1.0}
FASTEST = 27.0  # m/s; the upper end of the speed interval is at most this, and the lower end is limited in proportion


def read_road(path: Path, crop: tuple[float, float, float] | None = None, hand: float | None = None) -> RealRoad:
    """The roads of a file as it has them; with a `crop` only those in a square, given by its middle and its side (m).

    The middle is latitude and longitude if the file has these, else x and y in m. `hand` is the side on which traffic
    drives: 1 right, -1 left; None: `RealRoad.hand` follows from the file, or is 0 (unknown).
    """
    data = read_content(path)
    root = parse(path, data)
    kind = format_of(path, data, root)
    if kind == "osm":
        return convert(path, data, kind, root, crop, hand)
    readers = {"commonroad": read_commonroad, "lanelet2": read_lanelet2, "sumo": read_net}
    road = readers[kind](root) if kind in readers else convert(path, data, kind, root, hand=hand)
    road.hand = hand or road.hand
    if crop is not None:
        middle = np.array(crop[:2])
        select.cropped(road, (middle[::-1] - road.degrees[:2]) * road.degrees[2:] if road.degrees else middle, crop[2])
    return road


@dataclass
class Prepared:
    """A real road made ready: the parts of a map that depend on the configuration only through `gap_of`."""

    format: str
    notes: list[str]  # of `RealRoad`
    nodes: np.ndarray  # clearance (m), float32 [rows, columns]; `save` rounds it to the bytes of a field
    network: Network  # `speeds`, `clear` and `room` are zeros: `make_network` computes them
    limits: np.ndarray  # float64 [lanes], m/s; USUAL_LIMIT where the file gives none

    def save(self, path: Path) -> None:
        """Write a file of plain arrays, so that loading it runs no code. It appears at `path` whole, or not at all."""
        field = np.clip((self.nodes - FIELD_FLOOR) * FIELD_STEPS + 0.5, 0, 255).astype(np.uint8)
        lanes = {f"lanes_{name}": array for name, array in self.network._asdict().items()}
        text = np.array([self.format, *self.notes])
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".new", delete=False) as file:
            np.savez_compressed(file, text=text, field=field, limits=self.limits, **lanes)
        os.replace(file.name, path)

    @classmethod
    def load(cls, path: Path) -> Prepared:
        """Read what `save` wrote. A missing or damaged file raises whatever NumPy and zipfile raise."""
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            name, *notes = (str(line) for line in arrays["text"])
            nodes = arrays["field"].astype(np.float32) / F(FIELD_STEPS) + F(FIELD_FLOOR)
            *columns, width, height, hand = (arrays[f"lanes_{key}"] for key in Network._fields)
            scalars = (np.float32(value.item()) for value in (width, height, hand))
            network = Network._make([*map(freeze, columns), *scalars])
            return cls(name, notes, nodes, network, arrays["limits"])


def hand_of(lanes: dict[str, Lane]) -> float:
    """The side on which traffic drives: 1 right, -1 left; found from where opposite lanes lie. 1 if there are none."""
    lines = [resampled(lane, math.ceil(lane.length / 3.0))[0] for lane in lanes.values() if not lane.junction]
    if not lines:
        return 1.0
    points = np.concatenate([(line[1:] + line[:-1]) / 2 for line in lines])
    steps = np.concatenate([np.diff(line, axis=0) for line in lines])
    ways = steps / np.maximum(np.hypot(*steps.T), 1e-9)[:, None]
    one, other = cKDTree(points).query_pairs(9.0, output_type="ndarray").T
    away = points[other] - points[one]
    across = ways[one, 0] * away[:, 1] - ways[one, 1] * away[:, 0]
    beside = ((ways[one] * ways[other]).sum(axis=1) < -0.9) & (abs((away * ways[one]).sum(axis=1)) < 4.0)
    return -1.0 if np.sign(across[beside & (abs(across) > 1.5)]).sum() < 0.0 else 1.0


def prepare(road: RealRoad, gap: float) -> Prepared:
    """Select the lanes that can be driven, and make a network and a clearance field of them. This changes `road`."""
    if not (read := road.length):
        raise GridSimError(NO_ROAD)
    select.without_tight_turns(road)
    select.on_one_level(road)
    if not road.lanes:
        raise GridSimError(NO_ROAD)
    ends.add_turning_loops(road)
    road.lanes = select.keep(road.lanes, select.largest_connected(road.lanes))
    size = None
    joined = select.largest_joined(road.lanes)
    if sum(lane.length for lane in joined.values()) < road.length / 2:
        size = sides_of(road)
        ends.join_round_the_world(road, size)
        joined = select.largest_joined(road.lanes)
    if not joined:
        raise GridSimError(NO_ROAD)
    road.lanes = joined
    if (cut := read - road.length) > 1.0:
        road.notes.append(f"{cut / 1000:.1f} of {read / 1000:.1f} km of lanes lead nowhere, or do not join the rest")
    size = sides_of(road) if size is None else size
    points = np.concatenate([lane.centre[:, :2] for lane in road.lanes.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    origin = np.round((low + high) / 2 - size / 2, 2)
    if not road.middle:
        road.notes.append(f"the map's lower left corner is the file's x {origin[0]:g} m, y {origin[1]:g} m")
    shift = np.append(origin, 0.0)
    for lane in road.lanes.values():
        lane.left, lane.right = lane.left - shift, lane.right - shift
    used = {lane.junction for lane in road.lanes.values()}
    # Parts of a junction far beyond the lanes that are left would come in again on the other side of the torus.
    inside = (np.clip(road.junctions[key], low - OUTSIDE, high + OUTSIDE) for key in road.junctions if key in used)
    outlines = [outline - origin for outline in inside]
    hand = road.hand or hand_of(road.lanes)
    lanes, conflicts = shaped(road.lanes, gap, size)
    nodes = clearance_of(lanes, outlines, size, gap)
    road_there = make_road(nodes, (0.0, 1.0), 2.0 * HALF_WALL)
    network = with_lights(network_of(lanes, conflicts, hand), lanes, road_there)
    limits = np.array([lane.speed for lane in lanes.values()])
    limits[~(limits >= SLOWEST_LIMIT)] = USUAL_LIMIT
    return Prepared(road.format, road.notes, nodes, network, limits)


def sides_of(road: RealRoad) -> np.ndarray:
    """Sides (m) of the torus for a road's lanes: powers of two."""
    points = np.concatenate([bound[:, :2] for lane in road.lanes.values() for bound in (lane.left, lane.right)])
    extent = np.maximum(np.ptp(points, axis=0) + 2 * OUTSIDE + 1, SHORTEST_SIDE)
    sides = 2.0 ** np.ceil(np.log2(extent))
    if sides.prod() * CELLS_PER_UNIT**2 > MAX_NODES:
        x, y = points.min(axis=0) + np.ptp(points, axis=0) / 2
        raise GridSimError(
            f"a map of {sides[0]:,.0f} m x {sides[1]:,.0f} m (sides rounded up to powers of two) is too large: at most "
            f"{MAX_NODES / CELLS_PER_UNIT**2:,.0f} square metres; crop it to 2,000 m at most, here about its middle: "
            f"FILE@{road.middle or f'{x:.0f},{y:.0f}'},2000"
        )
    return sides


def map_of(name: str, prepared: Prepared, config: SimConfig) -> Map:
    """The map of a prepared road: traffic's speeds and the speed interval follow from the limits."""
    network, limits = prepared.network, prepared.limits
    if not config.traffic.lights:
        network = network._replace(**no_lights(len(limits)))
    lengths = (np.diff(network.offsets) - 1) * network.steps
    order = np.argsort(limits)
    usual = float(limits[order][np.searchsorted(np.cumsum(lengths[order]), lengths.sum() / 2)])
    low, high = (min(share * usual, FASTEST * share / SPEEDS[1]) for share in SPEEDS)
    # Where a road ends, a car turns and drives back: that is new ground (`ways`).
    road = make_road(prepared.nodes, (low, high), 2.0 * HALF_WALL, ways=2)
    paces = (limits / usual * TRAFFIC_PACE * (low + high)).astype(np.float32)
    return Map(name, 0, road, Strips.of(), make_network(network, road, config, paces))


def split_name(name: str) -> tuple[Path, tuple[float, float, float] | None, float | None]:
    """The path, the crop and the side of traffic (1 right, -1 left) in a scenario's name; None: the name gives none.

    The name may end in @LAT,LON,METRES or @X,Y,METRES, and in @left or @right.
    """
    side = re.search(r"@(left|right)(?=@|$)", name)
    if side:
        name = name[: side.start()] + name[side.end() :]
    found = CROP.fullmatch(name)
    try:
        crop = tuple(map(float, found.groups()[1:])) if found else None
    except ValueError:
        crop, found = None, None
    path = Path(found[1] if found else name)
    return path, crop, SIDES[side[1]] if side else None  # type: ignore[return-value]


def load_road(name: str, config: SimConfig) -> Map:
    """The map of a file of real roads; the last four are cached. Raises: GridSimError, also if config.unit < 1."""
    if config.unit < 1.0:
        raise GridSimError(f"{name}: real roads are for cars of 2.83 m or more, not of {config.vehicle.length:g} m")
    return load(os.path.abspath(name), file_digest(name), config)


def file_digest(name: str) -> str:
    """SHA-256 of a road's file. Raises: GridSimError if it cannot be read."""
    return hashlib.sha256(read_bytes(split_name(name)[0])).hexdigest()


@lru_cache(maxsize=4)
def load(name: str, digest: str, config: SimConfig) -> Map:
    """The map of a file with this digest; a changed file has another, so that its map is built anew."""
    return map_of(name, prepared(name, digest, gap_of(config)), config)


def described(name: str, config: SimConfig) -> Prepared:
    """What `prepare` makes of a file, with the notes on what it read."""
    return prepared(os.path.abspath(name), file_digest(name), gap_of(config))


def gap_of(config: SimConfig) -> float:
    """The distance (m) between lanes' middle lines below which their cars may touch."""
    return config.vehicle.width + config.traffic.beside


def cached(name: str, digest: str, gap: float) -> Path:
    """The path in the cache of what `prepare` makes of a file."""
    key = hashlib.sha256(f"{digest} {split_name(name)[1:]} {gap}".encode()).hexdigest()[:32]
    return CACHE_FOLDER / f"road-{key}.npz"


def prepared(name: str, digest: str, gap: float) -> Prepared:
    """What `prepare` makes of a file, from the cache if it is there."""
    path, crop, hand = split_name(name)
    kept = cached(name, digest, gap)
    with contextlib.suppress(Exception):  # a missing or damaged file may raise anything; the road is prepared anew
        return Prepared.load(kept)
    try:
        made = prepare(read_road(path, crop, hand), gap)
    except GridSimError as error:
        raise GridSimError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None
    except ValueError as error:
        raise GridSimError(f"{path}: damaged, or not as its format says: {shown(str(error))}") from error
    with contextlib.suppress(OSError):
        made.save(kept)
    return made
