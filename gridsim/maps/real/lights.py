"""Traffic lights of real roads: their programs from the files' phases, and their stop lines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from gridsim.jit import freeze
from gridsim.maps.lights import CLEARING, GO, STOP, lights_of
from gridsim.maps.network import Network
from gridsim.maps.real.description import Lane
from gridsim.maps.roads import Road, clearances

SHOWS = {"g": GO, "y": CLEARING, "r": STOP}
LONGEST_PHASE, USUAL_PHASE = 300.0, 30.0  # s; a longer phase ends on demand, and is taken to last the usual time
LONGEST_CYCLE = 600  # s
REACH = 12.0  # m from the middle of a lane to the end of its stop line, at most
APART = 1.6  # m from a stop line's end to the middle of another lane that leads the same way, at least


def program(phases: Sequence[tuple[str, float]], offset: float = 0.0) -> str:
    """`Lane.light` of phases, each a colour and a duration (s); the first begins at `offset` (s).

    "": the light never changes, is never green, or has a cycle under 1 s or over LONGEST_CYCLE.
    """
    times = [USUAL_PHASE if time > LONGEST_PHASE else max(time, 0.0) for _, time in phases]
    if not 1.0 <= sum(times) <= LONGEST_CYCLE or len({colour for colour, _ in phases}) < 2:
        return ""
    ends = np.rint(np.cumsum([0.0, *times])).astype(int)
    text = "".join(colour * int(n) for (colour, _), n in zip(phases, np.diff(ends), strict=True))
    late = round(offset) % len(text)
    return text[len(text) - late :] + text[: len(text) - late] if "g" in text else ""


def with_lights(network: Network, lanes: dict[str, Lane], road: Road) -> Network:
    """The network with the lights of its lanes and their stop lines.

    Lights where no lanes cross are left out, and so are lights at which cars would wait inside a junction. A lane ends
    at a stop line only if all its successors have lights, and these are red together at times.
    """
    crossed = np.diff(network.crossing_offsets) > 0
    light = [lane.light if crossed[k] else "" for k, lane in enumerate(lanes.values())]
    inside = network.successors[crossed]
    light = ["" if k in inside else text for k, text in enumerate(light)]
    ways, programs, lines = _Ways(network, road), list[str](), []
    for lane, onward in enumerate(network.successors):
        after = [k for k in onward.tolist() if k >= 0]
        if not all(light[k] for k in after):
            continue
        text = _together([light[k] for k in after])
        line = ways.stop_line(lane, after)
        if "r" in text and line not in lines:  # lanes that end at one place have one line
            programs.append(text)
            lines.append(line)
    if not lines:  # the remaining lights would stop nobody
        return network
    own = sorted(set(light) - {""})
    programs += own
    signals = [own.index(text) + len(lines) if text else -1 for text in light]
    shown = [[SHOWS[colour] for colour in text] for text in programs]
    return network._replace(**lights_of(signals, lines, shown))


def _together(lights: list[str]) -> str:
    """The program of a stop line before several lanes: at each time, it shows the most permissive of their lights."""
    cycle = math.lcm(*map(len, lights))
    cycle = cycle if cycle <= LONGEST_CYCLE else max(map(len, lights))
    return "".join(min((light[k % len(light)] for light in lights), key=SHOWS.__getitem__) for k in range(cycle))


class _Ways:
    """Points and directions of all lanes, to find how far a stop line may reach."""

    def __init__(self, network: Network, road: Road):
        self.network, self.road, self.size = network, road, np.array([network.width, network.height], dtype=float)
        points, offsets = network.points.astype(float), network.offsets
        step = np.diff(points, axis=0, append=points[-1:])
        step[offsets[1:] - 1] = step[offsets[1:] - 2]
        self.heading = step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
        self.owner = np.repeat(np.arange(len(network.steps)), np.diff(offsets))
        self.tree = cKDTree(np.mod(np.mod(points, self.size), self.size), boxsize=self.size)

    def stop_line(self, before: int, after: list[int]) -> list[float]:
        """A row of `Network.lines`: the stop line at the end of lane `before`, which leads to the lanes `after`.

        It reaches to the edge of the road, or to lanes that go the same way. It also crosses lanes that come the other
        way, so that a car that overtakes on these must stop, too.
        """
        end = self.network.offsets[before + 1] - 1
        place, along = self.network.points[end].astype(float), self.heading[end]
        left, own = np.array([-along[1], along[0]]), {before, *after}
        ends = []
        for side in (1.0, -1.0):
            far = np.arange(0.0, REACH, 0.25)
            points = np.mod(np.mod(place + side * far[:, None] * left, self.size), self.size)
            free = clearances(self.road, freeze(points.astype(np.float32))) > 0.0
            for k, near in enumerate(self.tree.query_ball_point(points, APART)):
                others = [n for n in near if self.owner[n] not in own and self.heading[n] @ along > 0.5]
                free[k] &= k < 4 or not others
            ends.append(side * far[np.argmin(np.append(free, False)) - 1])
        middle = np.mod(np.mod(place + sum(ends) / 2 * left, self.size), self.size)
        return [*middle, *along, (ends[0] - ends[1]) / 2 + 0.25]
