"""CommonRoad: lanelets with bounds, successors and neighbours (versions 2018b and 2020a of the format)."""

from __future__ import annotations

import math

import numpy as np

from gridsim.maps.real.content import Element
from gridsim.maps.real.description import Lane, RealRoad, paired, without_repeats
from gridsim.maps.real.lights import program

NOT_FOR_CARS = {"sidewalk", "crosswalk", "bicycleLane", "busLane", "busStop", "border", "parking", "restricted"}
LIMIT_SIGNS = {"274", "R2-1", "r301", "maxspeed", "max_speed", "274.1"}  # Germany and Zamunda, USA, Spain, others
COLOURS = {"red": "r", "redYellow": "r", "yellow": "y"}
SHORTEST_CYCLE = 20.0  # s; if a cycle is shorter, its times are taken to be in s, not in steps
MARK = "solid"  # the marking of a line that may not be crossed; also with broad_ before it


def read_commonroad(root: Element) -> RealRoad:
    """The lanelets for cars of a CommonRoad file."""
    limits, unknown = {}, set()
    for sign in root.iterfind("trafficSign"):
        for element in sign.iterfind("trafficSignElement"):
            kind, value = element.findtext("trafficSignID", ""), _float(element.findtext("additionalValue"))
            if kind in LIMIT_SIGNS and value > 0.0:
                limits[sign.get("id")] = value
            elif value > 0.0:
                unknown.add(kind)
    step = np.nan_to_num(_float(root.get("timeStepSize"))) or 0.1
    lights = {light.get("id"): _program(light, step) for light in root.iterfind("trafficLight")}
    lanes, lit, others = {}, {}, 0
    for lanelet in root.iterfind("lanelet"):
        kinds = {kind.text for kind in lanelet.iterfind("laneletType")}
        users = {user.text for user in lanelet.iterfind("userOneWay")} | {
            user.text for user in lanelet.iterfind("userBidirectional")
        }
        bounds = [_points(lanelet.find(side)) for side in ("leftBound", "rightBound")]
        if kinds & NOT_FOR_CARS or (users and not users & {"vehicle", "car"}) or min(map(len, bounds)) < 2:
            others += 1
            continue
        left, right = bounds if len(bounds[0]) == len(bounds[1]) else paired(*map(without_repeats, bounds))
        signs = [limits.get(ref.get("ref")) for ref in lanelet.iterfind("trafficSignRef")]
        found = [limit for limit in (*signs, _float(lanelet.findtext("speedLimit"))) if limit and limit > 0.0]
        lit[lanelet.get("id", "")] = [lights.get(ref.get("ref"), "") for ref in lanelet.iterfind("trafficLightRef")]
        lanes[lanelet.get("id", "")] = Lane(
            left,
            right,
            min(found, default=math.nan),
            [ref.get("ref", "") for ref in lanelet.iterfind("successor")],
            _neighbour(lanelet, "Left"),
            _neighbour(lanelet, "Right"),
        )
    for key, lane in lanes.items():  # a lanelet's light stands at its end, a `Lane.light` at the beginning
        for other in lane.successors:
            if other in lanes:
                lanes[other].light = next((each for each in lit[key] if each), lanes[other].light)
    road = RealRoad("CommonRoad", lanes)
    if others:
        road.notes.append(f"{others} lanelets that are not for cars were left out")
    if unknown:
        road.notes.append(f"unknown signs with a number were ignored: {', '.join(sorted(unknown))[:60]}")
    return road


def _program(light: Element, step: float) -> str:
    """`Lane.light` of a traffic light whose times are in steps of `step` s, or in s (SHORTEST_CYCLE).

    "": it is off, it has no cycle, or `program` leaves it out.
    """
    cycle = light.find("cycle")
    if cycle is None or light.findtext("active", "true") == "false":
        return ""
    rows = [(each.findtext("color", ""), _float(each.findtext("duration"))) for each in cycle.iterfind("cycleElement")]
    if sum(steps for _, steps in rows) * step < SHORTEST_CYCLE:
        step = 1.0
    offset = np.nan_to_num(_float(cycle.findtext("timeOffset")))
    return program([(COLOURS.get(colour, "g"), steps * step) for colour, steps in rows], float(offset) * step)


def _neighbour(lanelet: Element, side: str) -> str:
    """The lanelet on a side ("Left" or "Right") to which a car may change; "" if there is none."""
    beside = lanelet.find(f"adjacent{side}")
    mark = lanelet.findtext(f"{side.lower()}Bound/lineMarking", "")
    if beside is None or beside.get("drivingDir") != "same" or mark in (MARK, f"broad_{MARK}"):
        return ""
    return beside.get("ref", "")


def _points(bound: Element | None) -> np.ndarray:
    """Points float64 [n, 3] of a bound."""
    found = [] if bound is None else bound.findall("point")
    rows = [[_float(point.findtext(axis)) for axis in "xyz"] for point in found]
    points = np.array(rows, dtype=np.float64).reshape(-1, 3)
    points[:, 2] = np.nan_to_num(points[:, 2])
    return points[np.isfinite(points).all(axis=1)]


def _float(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan
