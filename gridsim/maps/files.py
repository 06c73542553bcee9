"""Maps from files: a picture in which bright pixels are road, or the YAML form of ROS's map_server with a picture.

Unknown pixels (`MapFile.unknown`) are wall, and so is everything outside the picture. World coordinates have their
origin at the picture's lower left corner; a file's own coordinates are turned and shifted by its `origin`.

A file gives the same road for every seed. It has no lanes: episodes begin at `Map.starts`, which are either poses given
in the file, or poses on the ridge of the free space, heading along it in both directions.
"""

from __future__ import annotations

import difflib
import hashlib
import io
import math
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from PIL import Image

from gridsim.config import FILE_SPEEDS, LIMITS, SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.closing import NODE
from gridsim.maps.map import Map, without_lanes
from gridsim.maps.parts import YAMLS
from gridsim.maps.raster import (
    HALF_WALL,
    OUTSIDE,
    check_starts,
    find_starts,
    has_room,
    road_length,
    signed_clearance,
)  # fmt: skip
from gridsim.maps.roads import CELLS_PER_UNIT
from gridsim.reading import number, read_bytes, read_yaml, shown

PIXELS_PER_M = 16.0  # of a picture without a given scale
PICTURES = {".png": "PNG", ".pgm": "PPM", ".jpg": "JPEG", ".jpeg": "JPEG", ".bmp": "BMP"}
KEYS = ["image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode", "starts", "speed"]

MAX_PIXELS = 1 << 26
MAX_NODES = 1 << 24  # of the field
# The least and the greatest value that a file may give.
RESOLUTION = (0.001, 1.0)  # m a pixel
PLACE, TURN = (-1e8, 1e8), (-2 * math.pi, 2 * math.pi)  # m, rad
SHORTEST_SIDE = 16  # in units (`SimConfig.unit`), of the field
UNKNOWN = 205  # of 255, the grey of unknown pixels in maps that robots save
ALIKE = 0.8  # similarity (`difflib.SequenceMatcher.ratio`) above which an unknown key is a known one, misspelt
MOST_BORDER = 0.5  # if this share of a picture's border, or more, is road, that road is taken for surroundings
MOST_CLOSED = 0.05  # share of the road; a warning is given if this much of it, or more, is closed


class MapWarning(UserWarning):
    """A probable mistake in a map; the message is one line for the user."""


@dataclass(frozen=True)
class MapFile:
    """The contents of a map file."""

    image: Path
    resolution: float = 1.0 / PIXELS_PER_M  # m a pixel
    # In the file's own coordinates: x, y (m) of the picture's lower left corner, and the heading (rad) of its rows.
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    negate: bool = False  # whether dark pixels are road
    free_thresh: float = 0.5  # darkness, 0 to 1, below which a pixel is road; if `negate`, brightness
    unknown: bool = False  # whether pixels of the grey UNKNOWN are wall, whatever the threshold says
    # x, y (m, the file's coordinates), heading (rad); without any, starts are found along the road.
    starts: Sequence[Sequence[float]] = ()
    speed: tuple[float, float] | None = None  # m/s, the speed interval; None: `SimConfig.file_speeds`
    ignored: Sequence[str] = ()  # keys of its YAML that mean nothing here


def load_map(name: str, config: SimConfig | None = None) -> Map:
    """The map of a file. The last four maps are cached, each for one content of its files and one configuration.

    Warns (MapWarning) when it is built: of what is ignored or closed, if the road is very short, and if the picture
    seems inverted. Raises: GridSimError.
    """
    return _load(os.path.abspath(name), map_digest(name), config or SimConfig())


def map_digest(name: str) -> str:
    """SHA-256 of a map's files. Raises: GridSimError if they cannot be read."""
    path = Path(os.path.abspath(name))
    files = dict.fromkeys((path, read_map_file(path).image))  # both are one file if the map is a picture alone
    return hashlib.sha256(b"".join(hashlib.sha256(read_bytes(file)).digest() for file in files)).hexdigest()


def read_map_file(path: Path) -> MapFile:
    """Read and check a map's YAML; for a picture alone, use defaults."""
    suffix = path.suffix.lower()
    if suffix in PICTURES:
        return MapFile(path, unknown=suffix == ".pgm")
    if suffix not in YAMLS:
        raise GridSimError(f"{path}: a map is a .yaml file of map_server's form or a picture ({', '.join(PICTURES)})")
    values = read_yaml(path)
    try:
        return _checked(path, values)
    except ValueError as error:
        raise GridSimError(f"{path}: {error}") from None


def _numbers(value: Any, what: str, *limits: tuple[float, float]) -> list[float]:
    """A list of numbers, each within its limits."""
    if not isinstance(value, list) or len(value) != len(limits):
        raise ValueError(f"{what} must be a list of {len(limits)} numbers, not {shown(value)}")
    return [number(each, what, *limit) for each, limit in zip(value, limits, strict=True)]


def _checked(path: Path, values: Any) -> MapFile:
    """The MapFile of a YAML's values. Raises: ValueError, whose message does not name the file."""
    if not isinstance(values, dict):
        raise ValueError(f"a map's YAML needs image and resolution, as keys with values, not {shown(values)}")
    ignored = [str(key) for key in values if key not in KEYS]
    for key in ignored:
        if like := difflib.get_close_matches(key, KEYS, 1, ALIKE):
            raise ValueError(f"unknown key {shown(key)}; did you mean {like[0]}?")
    if "image" not in values or "resolution" not in values:
        raise ValueError("it needs an image, and its resolution (m a pixel)")
    mode, negate, starts = values.get("mode", "trinary"), values.get("negate", 0), values.get("starts", [])
    if mode not in ("trinary", "scale"):
        raise ValueError(f"mode must be trinary or scale, not {shown(mode)}")
    if negate not in (0, 1):
        raise ValueError(f"negate must be true or false, not {shown(negate)}")
    if not isinstance(starts, list):
        raise ValueError(f"starts must be a list of [x, y, heading], not {shown(starts)}")
    origin = values.get("origin", [0, 0, 0])
    if isinstance(origin, list) and len(origin) == 3 and str(origin[2]).strip("+-").lower() == "nan":
        origin = [*origin[:2], 0]  # some programs write the yaw of a flat map as -nan
    x, y, yaw = _numbers(origin, "origin's x, y (m) and yaw (rad)", PLACE, PLACE, TURN)
    free = number(values.get("free_thresh", 0.196), "free_thresh", 0.0, 1.0)
    occupied = number(values.get("occupied_thresh", 0.65), "occupied_thresh", 0.0, 1.0)
    if not 0.0 < free <= occupied:
        raise ValueError(f"free_thresh must be above 0 and not above occupied_thresh, not {free:g} with {occupied:g}")
    pace = 0.0, LIMITS["vehicle"]["speed_limit"][1]
    low, high = _numbers(values.get("speed", list(FILE_SPEEDS)), "speed (m/s)", pace, pace)
    if not low < high:
        raise ValueError(f"speed must be [low, high] with low below high, not [{low:g}, {high:g}]")
    return MapFile(
        image=_image_path(path, values["image"]),
        resolution=number(values["resolution"], "resolution (m a pixel)", *RESOLUTION),
        origin=(x, y, yaw),
        negate=bool(negate),
        free_thresh=free,
        unknown=mode == "trinary",
        starts=[_numbers(start, "a start's x, y (m) and heading (rad)", PLACE, PLACE, TURN) for start in starts],
        speed=(low, high) if "speed" in values else None,
        ignored=ignored,
    )


def _image_path(path: Path, image: Any) -> Path:
    """The picture that a YAML names, in or below the YAML's folder; else one of the same file name in that folder."""
    if not isinstance(image, str) or Path(image).suffix.lower() not in PICTURES:
        raise ValueError(f"image must name a picture ({', '.join(PICTURES)}), not {shown(image)}")
    try:
        for picture in (path.parent / image, path.parent / PureWindowsPath(image).name):
            if picture.exists() and picture.resolve().is_relative_to(path.parent.resolve()):
                return picture
    except (OSError, ValueError, RuntimeError):  # a null character, a link to itself
        raise ValueError(f"image: {shown(image)} is not a valid path") from None
    raise ValueError(f"image: {shown(image)} is not in the YAML's own folder or below it; put the picture there")


def read_free(file: MapFile) -> np.ndarray:
    """Which pixels are road: bool [rows, columns], the lowest row first."""
    data = read_bytes(file.image)
    try:
        with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning):
            picture = Image.open(io.BytesIO(data), formats=tuple(dict.fromkeys(PICTURES.values())))
        if picture.width * picture.height > MAX_PIXELS:
            raise Image.DecompressionBombError
    except Image.DecompressionBombError:
        raise GridSimError(f"{file.image}: more than {MAX_PIXELS:,} pixels; make the picture smaller") from None
    except Exception:
        raise GridSimError(f"{file.image}: not a readable picture ({', '.join(PICTURES)})") from None
    if picture.mode == "F":
        raise GridSimError(f"{file.image}: its pixels are real numbers; save it with 8 or 16 bits")
    try:
        free = _free(picture, file)
    except Exception as error:  # decoders raise many types of error
        raise GridSimError(f"{file.image}: truncated or damaged: {shown(str(error))}") from None
    if not free.any():
        raise GridSimError(f"{file.image}: all wall; road must be {'darker' if file.negate else 'brighter'}")
    if free.all():
        raise GridSimError(f"{file.image}: all road; wall must be {'brighter' if file.negate else 'darker'}")
    return free[::-1]


def _free(picture: Image.Image, file: MapFile) -> np.ndarray:
    """Decode a picture: bool [rows, columns], True for road, the highest row first.

    Road is opaque, below the threshold of darkness (if `negate`, of brightness), and not a grey that means unknown.
    """
    opaque: np.ndarray | bool = True
    if picture.mode.startswith("I"):
        light, full = np.asarray(picture).astype(np.uint16), 65_535
    else:
        if picture.has_transparency_data:
            picture = picture.convert("RGBA")
            opaque = np.asarray(picture.getchannel("A")) >= 128
        if picture.mode != "L":
            # The mean of the channels, as in map_server, not the luminance.
            picture = picture.convert("RGB").convert("L", (1 / 3, 1 / 3, 1 / 3, 0))
        light, full = np.asarray(picture), 255
    values = np.arange(full + 1) / full
    free = (values if file.negate else 1.0 - values) < file.free_thresh
    if file.unknown:
        free[UNKNOWN * full // 255] = False
    return free[light] & opaque


def _sides(free: np.ndarray, pixel: float, unit: float) -> tuple[int, int]:
    """Columns and rows of the field, in nodes: powers of two. A pixel's side is `pixel` units of `unit` m."""
    sides = []
    for axis in (0, 1):
        used = np.flatnonzero(free.any(axis=axis))
        first, last = used[0] * pixel, (used[-1] + 1) * pixel
        side = max(last + OUTSIDE, last - first + 2 * OUTSIDE + 1, SHORTEST_SIDE)
        sides.append(1 << (math.ceil(side * CELLS_PER_UNIT) - 1).bit_length())
    columns, rows = sides
    node = unit / CELLS_PER_UNIT
    width, height = columns * node, rows * node
    if columns * rows > MAX_NODES:
        raise ValueError(
            f"a map of {width:,.0f} m x {height:,.0f} m (its sides are rounded up to powers of two) is too large: "
            f"at most {MAX_NODES * node**2:,.0f} square metres; check the resolution, or crop it"
        )
    return columns, rows


def _border(road: np.ndarray) -> float:
    """Share of the border of `road`, bool [rows, columns], that is road."""
    return float(np.concatenate([road[0], road[-1], road[:, 0], road[:, -1]]).mean())


def _warnings(
    file: MapFile, border: float, inverted: bool, closed: float, length: float, revisit: float
) -> Iterator[str]:
    """What a user should know of a map: texts that follow the map's name.

    Args: `border`, the share of the picture's border that is road; `inverted`, whether road and wall seem exchanged;
    `closed`, the share of the road that is closed; `length` of the road (m); `revisit`, `episode.revisit` (m).
    """
    if file.ignored:
        yield f"has keys in its YAML that mean nothing here: {', '.join(file.ignored)}"
    if closed >= MOST_CLOSED:
        yield (
            f"loses {closed:.0%} of its road, which is closed by walls: dead ends in which the car cannot turn round, "
            "and what is narrow. Give starts in its YAML to keep it as it is drawn"
        )
    if length <= 1.05 * revisit:  # 5 % for the error of the estimate
        yield (
            f"has about {length:.0f} m of road. Ground driven again within {revisit:g} m does not count: "
            "cars end idle in their second lap. Make the road longer, or its resolution larger"
        )
    if inverted:
        yield (
            f"has road on {border:.0%} of its border. If the road is {'bright' if file.negate else 'dark'}, "
            f"set negate: {int(not file.negate)} in its YAML; if the cars are to stay on a track, draw its "
            "surroundings as wall"
        )


@lru_cache(maxsize=4)
def _load(name: str, _digest: str, config: SimConfig) -> Map:
    """Build a map. The digest is part of the cache's key, so that a changed file is read again."""
    path, unit = Path(name), config.unit
    file = read_map_file(path)
    free = read_free(file)
    pixel, border, closed = file.resolution / unit, _border(free), 0.0
    sizes = {key: getattr(config.vehicle, key) / unit for key in ("length", "width", "wheelbase", "rear_axle")}
    vehicle = replace(config.vehicle, **sizes)
    picture = np.s_[1 : int(len(free) * pixel / NODE), 1 : int(free.shape[1] * pixel / NODE)]
    try:
        nodes = signed_clearance(free, pixel, *_sides(free, pixel, unit))
        inverted = border >= MOST_BORDER and bool(has_room(-nodes[picture], vehicle).any())
        if file.starts:
            poses = (np.array(file.starts) - file.origin) / [unit, unit, 1.0]
            c, s = math.cos(file.origin[2]), math.sin(file.origin[2])
            poses[:, :2] @= [[c, -s], [s, c]]
            check_starts(nodes, poses, vehicle, unit)
        else:
            nodes, poses, closed = find_starts(nodes, vehicle, unit, border >= MOST_BORDER)
    except ValueError as error:
        raise GridSimError(f"{path}: {error}") from None
    inverted |= _border(nodes[picture] > 0.0) >= MOST_BORDER
    length = road_length(nodes) * unit
    for text in _warnings(file, border, inverted, closed, length, config.episode.revisit):
        warnings.warn(f"{path.stem} {text}", MapWarning, stacklevel=1)
    starts = np.zeros((len(poses), 5), dtype=np.float32)
    starts[:, :3] = poses * [unit, unit, 1.0]
    return without_lanes(name, nodes, file.speed or config.file_speeds, 2.0 * HALF_WALL, starts, unit)
