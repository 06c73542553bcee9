"""SUMO nets, and the formats that SUMO's `netconvert` converts to one: OpenStreetMap and OpenDRIVE."""

from __future__ import annotations

import math
import os
import re
import subprocess
import tempfile
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gridsim.errors import GridSimError
from gridsim.maps.real.content import INSTALL, Element, parse
from gridsim.maps.real.description import Lane, RealRoad, bounds_of, without_repeats
from gridsim.maps.real.lights import program

TIME_LIMIT = 120.0  # s, for netconvert
COLOURS = {"r": "r", "u": "r", "y": "y", "Y": "y"}  # by SUMO's signal state; all others, also off, count as green
METRES_PER_DEGREE = 111_320.0  # of latitude
OPTIONS = {
    "osm": [
        "--keep-edges.by-vclass=passenger", "--geometry.remove", "--junctions.join", "--osm.layer-elevation=6",
        "--default.junctions.radius=6", "--junctions.internal-link-detail=12",
        "--tls.guess-signals", "--tls.discard-simple",
    ],
    "opendrive": [
        "--keep-edges.by-vclass=passenger", "--opendrive.curve-resolution=0.5", "--output.original-names",
        "--offset.disable-normalization",  # x and y stay the file's
    ],
}  # fmt: skip
# Boxes (degrees): south, west, north, east. Traffic keeps left in those of LEFT_HAND, except in those of RIGHT_HAND.
RIGHT_HAND = [
    (17.5, 92.3, 21.2, 97.3), (15.5, 94.0, 24.0, 97.3), (21.0, 93.4, 23.9, 97.3), (24.0, 94.8, 27.0, 97.5),  # Myanmar
    (17.93, 101.3, 22.5, 109.5), (20.3, 100.1, 22.5, 101.3), (16.0, 104.8, 18.0, 109.5),  # northern Laos and Vietnam
    (14.0, 105.5, 16.0, 109.5),  # southern Laos, central Vietnam
    (8.0, 103.3, 14.0, 109.5), (33.0, 124.5, 43.0, 129.4),  # Cambodia, Korea
    (31.4, 60.5, 38.5, 69.9), (29.3, 86.5, 37.1, 97.4), (22.51, 113.8, 22.6, 114.5),  # Afghanistan, Tibet, Shenzhen
    (49.8, 1.4, 50.98, 1.9), (-17.3, 11.6, -4.4, 21.9), (-12.1, 25.3, -8.2, 28.4),  # Calais, Angola, Katanga
    (-2.84, 28.86, -1.45, 30.8), (-4.47, 29.0, -2.31, 30.85),  # Rwanda, Burundi
    (-23.0, 163.0, -13.0, 170.5), (1.1, -61.5, 5.3, -59.9),  # New Caledonia and Vanuatu, Roraima
]  # fmt: skip
LEFT_HAND = [
    (49.8, -8.7, 60.9, 1.8), (51.3, -10.7, 55.5, -5.4),  # Great Britain and Ireland
    (34.5, 32.2, 35.8, 34.7), (35.7, 14.1, 36.1, 14.6),  # Cyprus, Malta
    (-47.5, 112.0, -9.0, 180.0), (-12.0, 141.0, 0.0, 157.0),  # Australia, New Zealand, New Guinea
    (24.0, 122.9, 45.6, 146.0), (-11.0, 95.0, 6.0, 141.0),  # Japan, Indonesia
    (5.6, 97.3, 20.5, 105.7), (0.8, 99.5, 7.5, 119.3),  # Thailand, Malaysia and Singapore
    (5.8, 60.8, 37.1, 97.4), (22.1, 113.8, 22.6, 114.5),  # India and its neighbours, Hong Kong
    (-35.0, 16.4, -16.9, 41.0), (-27.0, 11.7, -8.2, 40.9), (-12.0, 29.3, 4.7, 41.9),  # southern and eastern Africa
    (17.6, -78.5, 18.6, -76.1), (10.0, -61.95, 11.4, -60.4), (1.1, -61.5, 8.6, -53.9),  # the Caribbean, the Guyanas
    (13.0, -59.7, 13.4, -59.4), (23.3, -79.4, 27.3, -74.0),  # Barbados, the Bahamas
    (49.1, -2.8, 49.8, -1.95), (-20.6, 57.2, -19.9, 57.9),  # Jersey and Guernsey, Mauritius
]  # fmt: skip


def keeps_left(latitude: float, longitude: float) -> bool:
    """Whether traffic keeps left at a place, by a coarse table of countries."""

    def inside(boxes: list[tuple[float, float, float, float]]) -> bool:
        return any(s <= latitude <= n and w <= longitude <= e for s, w, n, e in boxes)

    return inside(LEFT_HAND) and not inside(RIGHT_HAND)


def convert(
    path: Path,
    data: bytes,
    kind: str,
    root: Element,
    crop: tuple[float, float, float] | None = None,
    hand: float | None = None,
) -> RealRoad:
    """The roads of an OpenStreetMap ("osm") or OpenDRIVE ("opendrive") file.

    `crop`, for OpenStreetMap only, is a square: latitude and longitude of its middle, and its side (m). `hand` is the
    side on which traffic drives: 1 right, -1 left; None: it follows from the coordinates
    (`keeps_left`, OpenStreetMap) or from the rule in the file (OpenDRIVE).
    """
    options, notes, middle = list(OPTIONS[kind]), [], ""
    if kind == "osm":
        places = np.array([(float(n.get("lat", "nan")), float(n.get("lon", "nan"))) for n in root.iterfind("node")])
        if not len(places):
            raise GridSimError(f"{path}: it has no nodes; is it an extract of OpenStreetMap in XML?")
        latitude, longitude = np.nanmedian(places, axis=0)
        middle = f"{latitude:.5f},{longitude:.5f}"
        lefthand = keeps_left(latitude, longitude) if hand is None else hand < 0.0
        if crop:
            half = np.array([crop[2], crop[2] / max(math.cos(math.radians(crop[0])), 0.01)]) / 2 / METRES_PER_DEGREE
            (south, west), (north, east) = crop[:2] - half, crop[:2] + half
            options.append(f"--keep-edges.in-geo-boundary={west},{south},{east},{north}")
        if lefthand and hand is None:
            notes.append("traffic keeps left, as the country of the coordinates does")
    else:
        lefthand = b'rule="LHT"' in data or b"rule='LHT'" in data if hand is None else hand < 0.0
    # netconvert puts the lanes of an OpenDRIVE road that keeps left on the wrong side of its median. If such a file
    # has no junctions, it is converted as one that keeps right: then only the directions of the lanes are wrong, and
    # `_turn_round` reverses them.
    turned = lefthand and kind == "opendrive" and root.find("junction") is None
    options += ["--lefthand"] * (lefthand and not turned)
    net = _netconvert(path, data, kind, options)
    road = read_net(parse(path, net), _limits(root) if kind == "opendrive" else None)
    if turned:
        _turn_round(road)
    road.hand, road.middle = -1.0 if lefthand else 1.0, middle
    road.format, road.notes = {"osm": "OpenStreetMap", "opendrive": "OpenDRIVE"}[kind], notes + road.notes
    return road


def _netconvert(path: Path, data: bytes, kind: str, options: list[str]) -> bytes:
    """The SUMO net (XML) that netconvert makes of a file; if that fails, with --ignore-errors. Raises: GridSimError."""
    spec = find_spec("sumo")
    home = Path((spec.submodule_search_locations or [""])[0]) if spec else None
    if home is None or not (home / "bin" / "netconvert").is_file():
        raise GridSimError(f"{path}: reading this format needs SUMO's netconvert: {INSTALL}")
    with tempfile.TemporaryDirectory(prefix="gridsim-road-") as folder:
        # netconvert takes a space or comma in a file's name for the name's end, so the file gets a name without them.
        Path(folder, "road.xml").write_bytes(data)
        errors = ""
        for more in ([], ["--ignore-errors"]):
            own = [f"--{kind}-files=road.xml", "--output-file=net.xml"]
            command = [str(home / "bin" / "netconvert"), *own, *options, *more]
            try:
                done = subprocess.run(
                    command,
                    cwd=folder,
                    env={**os.environ, "SUMO_HOME": str(home)},
                    stdin=subprocess.DEVNULL,
                    capture_output=True,
                    text=True,
                    errors="replace",
                    timeout=TIME_LIMIT,
                )
            except subprocess.TimeoutExpired:
                raise GridSimError(f"{path}: netconvert took more than {TIME_LIMIT:g} s; crop the file") from None
            except OSError as error:
                raise GridSimError(f"{path}: netconvert does not run: {error.strerror or error}") from None
            if done.returncode == 0 and Path(folder, "net.xml").is_file():
                return Path(folder, "net.xml").read_bytes()
            lines = [line for line in done.stderr.splitlines() if line.startswith("Error")] or done.stderr.splitlines()
            errors = errors or " ".join((lines or [f"exit status {done.returncode}"])[0].split())[:160]
    raise GridSimError(f"{path}: netconvert failed: {errors}")


def _limits(root: Element) -> dict[str, float]:
    """Speed limits (m/s) by road of an OpenDRIVE file, which netconvert drops."""
    units, found = {"mph": 0.44704, "km/h": 1 / 3.6, "m/s": 1.0}, {}
    for road in root.iterfind("road"):
        speed = road.find("type/speed")
        if speed is not None and re.fullmatch(r"\s*[\d.]+(e[+-]?\d+)?\s*", speed.get("max", "")):
            found[road.get("id", "")] = float(speed.get("max", "")) * units.get(speed.get("unit") or "m/s", 1.0)
    return found


def read_net(root: Element, limits: dict[str, float] | None = None) -> RealRoad:
    """The roads of a SUMO net, with lanes across junctions. `limits` (m/s, by OpenDRIVE road) replace the net's."""
    inner: dict[str, Element] = {}
    lanes: dict[str, Lane] = {}
    numbered: dict[tuple[str, int], str] = {}
    closed = 0
    for edge in root.iterfind("edge"):
        function, key = edge.get("function", ""), edge.get("id", "")
        if function in ("crossing", "walkingarea", "connector"):
            continue
        before = ""
        for element in sorted(edge.iterfind("lane"), key=lambda lane: int(lane.get("index", "0"))):
            name = element.get("id", "")
            if function == "internal":
                inner[name] = element
                continue
            line = _shape(element)
            if not _for_cars(element) or len(line) < 2:
                closed, before = closed + 1, ""
                continue
            origin = element.find("param[@key='origId']")
            roads = "" if origin is None else origin.get("value", "").partition(" ")[0].rpartition("_")[0]
            limit = (limits or {}).get(roads, math.nan)
            speed = float(element.get("speed", "nan")) if math.isnan(limit) else limit
            lanes[name] = Lane(*bounds_of(line, _width(element)), speed, junction="")
            numbered[key, int(element.get("index", "0"))] = name
            if before:
                _set_neighbours(lanes, before, name)
            before = name
    road = RealRoad("SUMO net", lanes)
    if closed:
        road.notes.append(f"{closed} lanes that are not for cars were left out")
    _add_connections(root, road, inner, numbered)
    for junction in root.iterfind("junction"):
        outline = _points(junction.get("shape", ""))[:, :2]
        if len(outline) > 2:
            road.junctions[junction.get("id", "")] = outline
    return road


def _add_connections(
    root: Element, road: RealRoad, inner: dict[str, Element], numbered: dict[tuple[str, int], str]
) -> None:
    """Add a lane for each connection of two lanes of the road, except U-turns.

    It consists of the connection's internal lanes, or is a curve if there are none. Where a lane ends at the beginning
    of another, that one follows it without a lane between.
    """
    onward = {
        f"{c.get('from')}_{c.get('fromLane')}": c.get("via", "")
        for c in root.iterfind("connection")
        if c.get("from", "").startswith(":")
    }
    programs = {logic.get("id"): _program(logic) for logic in root.iterfind("tlLogic")}
    yields = _right_of_way(root)
    leads_to = {edge.get("id", ""): edge.get("to", "") for edge in root.iterfind("edge")}
    turns = 0
    for number, connection in enumerate(root.iterfind("connection")):
        ends = [numbered.get((connection.get(e, ""), int(connection.get(f"{e}Lane", "-1")))) for e in ("from", "to")]
        if ends[0] is None or ends[1] is None:
            continue
        if connection.get("dir") == "t":
            turns += 1
            continue
        one, other = road.lanes[ends[0]], road.lanes[ends[1]]
        via = connection.get("via", "")
        pieces: list[np.ndarray] = []
        speed = one.speed
        while via in inner and len(pieces) < 8:
            pieces.append(_shape(inner[via]))
            speed = float(inner[via].get("speed", "nan"))
            via = onward.get(via, "")
        start, end = one.centre, other.centre
        line = np.concatenate([start[-1:], *pieces, end[:1]]) if pieces else _curve(start, end)
        line = without_repeats(line, 0.05)
        if len(line) < 2:
            one.successors.append(ends[1])
            continue
        name = f"{ends[0]}>{ends[1]}#{number}"
        width = min(np.hypot(*(lane.left - lane.right)[at, :2]) for lane, at in ((one, -1), (other, 0)))
        junction = leads_to[connection.get("from", "")]
        columns = programs.get(connection.get("tl"), [])
        link = int(connection.get("linkIndex", "-1"))
        light = columns[link] if 0 <= link < len(columns) else ""
        way = _name(connection)
        lane = Lane(*bounds_of(line, float(width)), speed, [ends[1]], junction=junction, light=light)
        lane.links, lane.yields = frozenset([way]), yields.get(way, frozenset())
        road.lanes[name] = lane
        one.successors.append(name)
    if turns:
        road.notes.append(f"{turns} U-turns are not ways of traffic")


def _name(connection: Element) -> str:
    ends = ("from", "fromLane", "to", "toLane")
    return " ".join(connection.get(end, "") for end in ends)


def _right_of_way(root: Element) -> dict[str, frozenset[str]]:
    """For each connection (`_name`), those to which it gives way.

    A junction numbers its connections in the order of the lanes that lead to it.
    """
    of_lane, yields = defaultdict(list), {}
    for connection in root.iterfind("connection"):
        of_lane[f"{connection.get('from')}_{connection.get('fromLane')}"].append(_name(connection))
    for junction in root.iterfind("junction"):
        names = [name for lane in junction.get("incLanes", "").split() for name in of_lane[lane]]
        for request in junction.iterfind("request"):
            answers = request.get("response", "")[::-1]
            index = int(request.get("index", "-1"))
            if 0 <= index < len(names):
                others = (name for name, answer in zip(names, answers, strict=False) if answer == "1")
                yields[names[index]] = frozenset(others)
    return yields


def _program(logic: Element) -> list[str]:
    """For each link of a traffic light, `Lane.light`."""
    phases = [(phase.get("state", ""), float(phase.get("duration", "0"))) for phase in logic.iterfind("phase")]
    links = min((len(state) for state, _ in phases), default=0)
    colours = [[COLOURS.get(state[link], "g") for state, _ in phases] for link in range(links)]
    return [
        program([*zip(column, (t for _, t in phases), strict=True)], float(logic.get("offset", "0")))
        for column in colours
    ]


def _curve(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """A curve [n, 3] from the end of one line to the beginning of another, tangent to both."""
    a, d = start[-1], end[0]
    reach = np.hypot(*(d - a)[:2]) / 3
    if reach < 0.05:
        return np.stack([a, d])
    b, c = (
        p + s * reach * (q / max(np.hypot(*q[:2]), 1e-9))
        for p, s, q in ((a, 1.0, start[-1] - start[-2]), (d, -1.0, end[1] - end[0]))
    )
    t = np.linspace(0.0, 1.0, 16)[:, None]
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d


def _turn_round(road: RealRoad) -> None:
    """Reverse the driving direction of all lanes."""
    before: dict[str, list[str]] = {key: [] for key in road.lanes}
    for key, lane in road.lanes.items():
        for other in lane.successors:
            before[other].append(key)
    for key, lane in road.lanes.items():
        lane.left, lane.right = lane.right[::-1], lane.left[::-1]
        lane.left_lane, lane.right_lane, lane.successors = lane.right_lane, lane.left_lane, before[key]


def _set_neighbours(lanes: dict[str, Lane], one: str, other: str) -> None:
    """Mark two lanes of an edge as neighbours; the geometry tells which is on the left."""
    a, b = lanes[one].centre[:, :2], lanes[other].centre[:, :2]
    along, away = a[-1] - a[0], b.mean(axis=0) - a.mean(axis=0)
    left, right = (other, one) if along[0] * away[1] - along[1] * away[0] > 0.0 else (one, other)
    lanes[right].left_lane, lanes[left].right_lane = left, right


def _points(text: str) -> np.ndarray:
    """Points float64 [n, 3] of a shape."""
    rows = [([float(v) for v in point.split(",")] + [0.0])[:3] for point in text.split()]
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _shape(lane: Element) -> np.ndarray:
    return without_repeats(_points(lane.get("shape", "")))


def _width(lane: Element) -> float:
    return float(lane.get("width", "3.2"))


def _for_cars(lane: Element) -> bool:
    allowed, forbidden = lane.get("allow"), lane.get("disallow", "").split()
    return "passenger" in allowed.split() or allowed == "all" if allowed else not {"passenger", "all"} & set(forbidden)
