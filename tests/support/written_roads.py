"""Small roads written in each format, in metres around a point of the middle meridian of a UTM zone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

GERMANY, BRITAIN = (50.0, 9.0), (52.0, -3.0)
HALF = 1.6  # m, half the width of a lane


Way = tuple[Sequence[tuple[float, float]], dict[str, str]]


def osm(ways: Sequence[Way], place: tuple[float, float] = GERMANY, lights: Sequence[tuple[float, float]] = ()) -> str:
    """Ways of points (m) with their tags; points that are the same are one node. Some nodes have traffic lights."""
    north, east = 111_240.0, 111_320.0 * math.cos(math.radians(place[0])) * 1.00196
    numbers: dict[tuple[float, float], int] = {}
    for points, _ in ways:
        for point in points:
            numbers.setdefault(point, len(numbers) + 1)
    nodes = "".join(
        f'<node id="{n}" lat="{place[0] + y / north:.9f}" lon="{place[1] + x / east:.9f}" version="1">'
        + ('<tag k="highway" v="traffic_signals"/>' if (x, y) in lights else "")
        + "</node>"
        for (x, y), n in numbers.items()
    )
    text = ""
    for k, (points, tags) in enumerate(ways):
        refs = "".join(f'<nd ref="{numbers[point]}"/>' for point in points)
        values = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        text += f'<way id="{100 + k}" version="1">{refs}{values}</way>'
    return f'<?xml version="1.0"?><osm version="0.6">{nodes}{text}</osm>'


def street(*points: tuple[float, float], **tags: str) -> Way:
    """A way of two lanes."""
    return points, {"highway": "residential", "lanes": "2", "maxspeed": "50", **tags}


def opendrive(length: float, rule: str = "RHT") -> str:
    """A straight road along x, of one lane each way."""
    lanes = "".join(
        f'<{side}><lane id="{k}" type="driving" level="false"><width sOffset="0" a="{2 * HALF}" b="0" c="0" d="0"/>'
        f"</lane></{side}>"
        for side, k in (("left", 1), ("right", -1))
    )
    middle = '<center><lane id="0" type="none" level="false"/></center>'
    left, right = lanes.split("</left>")
    return (
        '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1.00"/>'
        f'<road name="" length="{length}" id="1" junction="-1" rule="{rule}"><link/>'
        '<type s="0" type="town"><speed max="50" unit="km/h"/></type>'
        f'<planView><geometry s="0" x="0" y="0" hdg="0" length="{length}"><line/></geometry></planView>'
        f'<lanes><laneSection s="0">{left}</left>{middle}{right}</laneSection></lanes></road></OpenDRIVE>'
    )


def opendrive_crossing(hand: float = 1.0) -> str:
    """Four roads of 85 m from a junction on, of one lane each way; `hand` -1: a mirror image across x, on the left."""
    rule = "RHT" if hand > 0 else "LHT"

    def road(number: int, junction: int, link: str, start: tuple[float, float, float], length: float, bend: float,
             lanes: dict[int, str]) -> str:  # fmt: skip
        x, y, angle = start
        shape = f'<arc curvature="{bend * hand}"/>' if bend else "<line/>"
        text = {
            side: "".join(
                f'<lane id="{round(k * hand)}" type="driving" level="false"><link>{links}</link>'
                f'<width sOffset="0" a="{2 * HALF}" b="0" c="0" d="0"/></lane>'
                for k, links in lanes.items()
                if k * hand * sign > 0
            )
            for side, sign in (("left", 1), ("right", -1))
        }
        left, right = (f"<{side}>{lane}</{side}>" if lane else "" for side, lane in text.items())
        middle = '<center><lane id="0" type="none" level="false"/></center>'
        return (
            f'<road name="" length="{length}" id="{number}" junction="{junction}" rule="{rule}"><link>{link}</link>'
            f'<planView><geometry s="0" x="{x}" y="{y * hand}" hdg="{angle * hand}" length="{length}">'
            f'{shape}</geometry></planView><lanes><laneSection s="0">{left}{middle}{right}</laneSection></lanes></road>'
        )

    radius, roads, connections = 15.0, "", ""
    for i in range(4):
        angle = i * math.pi / 2
        x, y = radius * math.cos(angle), radius * math.sin(angle)
        link = '<predecessor elementType="junction" elementId="900"/>'
        roads += road(i + 1, -1, link, (x, y, angle), 85.0, 0.0, {1: "", -1: ""})
        for turn, bend in ((1, -1), (2, 0), (3, 1)):  # from the first road to the second, the third and the fourth
            j, number = (i + turn) % 4, 10 * (i + 1) + turn
            length = 2 * radius if not bend else radius * math.pi / 2
            ends = (("predecessor", i + 1), ("successor", j + 1))
            link = "".join(f'<{n} elementType="road" elementId="{k}" contactPoint="start"/>' for n, k in ends)
            own = f'<predecessor id="{round(hand)}"/><successor id="{round(-hand)}"/>'
            roads += road(number, 900, link, (x, y, angle + math.pi), length, bend / radius, {-1: own})
            connections += (
                f'<connection id="{number}" incomingRoad="{i + 1}" connectingRoad="{number}" contactPoint="start">'
                f'<laneLink from="{round(hand)}" to="{round(-hand)}"/></connection>'
            )
    head = '<header revMajor="1" revMinor="4" name="" version="1.00"/>'
    return (
        f'<?xml version="1.0"?><OpenDRIVE>{head}{roads}<junction id="900" name="">{connections}</junction></OpenDRIVE>'
    )


Bounds = tuple[Sequence[tuple[float, float]], Sequence[tuple[float, float]]]


def both_ways(length: float, hand: float = 1.0) -> list[Bounds]:
    """Left and right bounds of the lanes of a straight road along x; `hand` 1: traffic keeps right."""
    w = 2 * HALF * hand
    there = [(0.0, 0.0), (length, 0.0)], [(0.0, -w), (length, -w)]
    back = [(length, 0.0), (0.0, 0.0)], [(length, w), (0.0, w)]
    return [there, back] if hand > 0 else [there[::-1], back[::-1]]


def figure_of_eight(radius: float) -> list[Bounds]:
    """Three lanes, one behind the other in a circle: a straight one, a loop back across it, and a loop to its start."""
    r, n = radius, 40
    turns = [(i + 0.5) / n * 1.5 * math.pi for i in range(n)]
    straight = [(-r, 0.0), (0.0, 0.0), (r, 0.0)]
    loop = [(r + r * math.sin(a), r - r * math.cos(a)) for a in turns]
    back = [(-r + r * math.cos(a), -r - r * math.sin(a)) for a in turns]
    lines = [straight, [straight[-1], *loop, (0.0, r), (0.0, 0.0), (0.0, -r)], [(0.0, -r), *back, straight[0]]]
    lanes: list[Bounds] = []
    for line in lines:
        left, right = [], []
        for k, (x, y) in enumerate(line):
            (a, b), (c, d) = line[max(k - 1, 0)], line[min(k + 1, len(line) - 1)]
            w = HALF / math.hypot(c - a, d - b)
            left.append((x - w * (d - b), y + w * (c - a)))
            right.append((x + w * (d - b), y - w * (c - a)))
        lanes.append((left, right))
    return lanes


def commonroad(
    lanes: Sequence[Bounds], successors: Mapping[int, Sequence[int]] | None = None, lights: dict[int, int] | None = None
) -> str:
    """Lanelets, numbered from 1, with their successors; `lights` are red for so many steps of 0.1 s at first."""

    def bound(name: str, points: Sequence[tuple[float, float]]) -> str:
        return f"<{name}>" + "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in points) + f"</{name}>"

    text = ""
    for k, (left, right) in enumerate(lanes, 1):
        after = "".join(f'<successor ref="{s}"/>' for s in (successors or {}).get(k, ()))
        sign = '<trafficSignRef ref="900"/>'
        if k in (lights or {}):
            sign += f'<trafficLightRef ref="{800 + k}"/>'
        text += f'<lanelet id="{k}">{bound("leftBound", left)}{bound("rightBound", right)}{after}{sign}</lanelet>'
    element = "<trafficSignID>274</trafficSignID><additionalValue>13.89</additionalValue>"
    signs = f'<trafficSign id="900"><trafficSignElement>{element}</trafficSignElement></trafficSign>'
    for k, red in (lights or {}).items():
        phases = [("red", red), ("redYellow", 10), ("green", 300), ("yellow", 30)]
        steps = [f"<cycleElement><duration>{n}</duration><color>{c}</color></cycleElement>" for c, n in phases]
        signs += f'<trafficLight id="{800 + k}"><cycle>{"".join(steps)}</cycle></trafficLight>'
    head = '<commonRoad timeStepSize="0.1" commonRoadVersion="2020a" benchmarkID="ZAM_A-1">'
    return f'<?xml version="1.0"?>{head}{text}{signs}</commonRoad>'


def lanelet2(lanes: Sequence[Bounds]) -> str:
    """Lanelets with nodes in local metres."""
    numbers: dict[tuple[float, float], int] = {}
    for bounds in lanes:
        for point in (*bounds[0], *bounds[1]):
            numbers.setdefault(point, len(numbers) + 1)
    text = "".join(
        f'<node id="{n}" lat="" lon=""><tag k="local_x" v="{x}"/><tag k="local_y" v="{y}"/></node>'
        for (x, y), n in numbers.items()
    )
    relations = ""
    for k, bounds in enumerate(lanes):
        members = ""
        for role, number, points in zip(("left", "right"), (1000 + 10 * k, 1001 + 10 * k), bounds, strict=True):
            refs = "".join(f'<nd ref="{numbers[point]}"/>' for point in points)
            text += f'<way id="{number}">{refs}</way>'
            members += f'<member type="way" ref="{number}" role="{role}"/>'
        tags = {"type": "lanelet", "subtype": "road", "speed_limit": "50"}
        values = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        relations += f'<relation id="{5000 + k}">{members}{values}</relation>'
    return f'<?xml version="1.0"?><osm>{text}{relations}</osm>'
