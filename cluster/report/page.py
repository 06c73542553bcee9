"""The drive's page: one HTML file that plays drives in any browser, offline.

Its script is in `drive.html`; this file packs the numbers. A drive is a table of 16-bit numbers, one row per channel,
one column per moment; the differences from each moment to the next are compressed. Positions are in 65,536ths of the
map's sides and headings in 65,536ths of a turn, so that both wrap as the torus and the angle do. Rays are in
hundredths of a unit (`SimConfig.unit`), speeds in cm/s, new ground in dm, and outputs as shares of 65,535. New ground
may be more than 16 bits hold: it never falls, so that the script adds its differences up without wrapping. Outside
the table, lengths are in units and speeds in m/s.
"""

from __future__ import annotations

import base64
import io
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from cluster.report.film import Recording
from cluster.report.pictures import bounds, plain_style
from cluster.store.checkpoint import write_atomic
from gridsim.car.vehicle import Action
from gridsim.config import constants
from gridsim.jit import freeze
from gridsim.maps.lights import programs_of_lines
from gridsim.maps.map import Map
from gridsim.maps.roads import clearances
from gridsim.state import CLOCK, DISTANCE, SPEED
from gridsim.view.marks import lane_marks

TURN = 1 << 16
PIXELS_PER_M, MOST_PIXELS = 4.0, 2048
OFF_ROAD, ROAD = (224, 228, 220), (112, 120, 124)  # colours
ACTIONS = [action.name.lower().replace("_", " ") for action in Action]
COMMAND = ["pedal", "wheel"]


@dataclass(frozen=True)
class Shown:
    """A drive on a page: the driver's name, a shorter name that is drawn beside its car, and the recording.

    `stride`: control steps from one moment of the page to the next; rays, outputs and route are shown only if it is 1.
    """

    label: str
    short: str
    drive: Recording
    stride: int = 1

    def packed(self) -> dict[str, object]:
        """The drive as the page's script reads it."""
        drive, road = self.drive, self.drive.scenario.road
        size = float(road.width), float(road.height)
        cars, boxes = drive.cars[:: self.stride], drive.boxes[:: self.stride]
        channels = [
            *_place(cars, size),
            np.clip(cars[:, SPEED], 0.0, None) * 100.0,
            cars[:, DISTANCE] * 10.0,
        ]
        for k in range(boxes.shape[1]):
            channels += _place(boxes[:, k], size)
        rays, outputs, middle = 0, list[str](), 0  # middle: % of a bar's length from which it is filled
        if self.stride == 1:
            rays = drive.ranges.shape[1]
            channels += [ray * 100.0 / float(road.unit) for ray in drive.ranges.T]
            if drive.outputs is not None:
                shares = drive.outputs
                if shares.shape[1] == len(COMMAND):
                    outputs, middle = COMMAND, 50
                    shares = 0.5 + shares * [0.5, -0.5]  # wheel to the left: bar to the left
                else:
                    outputs, low, high = ACTIONS, shares.min(axis=1, keepdims=True), shares.max(axis=1, keepdims=True)
                    shares = (shares - low) / np.maximum(high - low, 1e-9)
                channels += list((shares * (TURN - 1)).T)
            channels += list((drive.route / size * TURN).reshape(len(cars), -1).T)
        numbers = np.rint(channels).astype(np.int64).astype("<u2")
        series = np.diff(numbers, axis=1, prepend=np.zeros((len(numbers), 1), dtype="<u2"))
        return {
            "label": self.label,
            "short": self.short,
            "end": drive.end.name.lower(),
            "period": drive.period * self.stride,
            "clock": float(cars[0, CLOCK]) * drive.period,
            "cars": boxes.shape[1],
            "rays": rays,
            "outputs": outputs,
            "middle": middle,
            "points": drive.route.shape[1] if self.stride == 1 else 0,
            "series": base64.b64encode(zlib.compress(series.tobytes(), 9)).decode(),
        }


def _place(cars: np.ndarray, size: tuple[float, float]) -> list[np.ndarray]:
    """Channels x, y and heading of one car from its states [n, 4 or more]: x, y (m), heading (cosine, sine)."""
    x, y, cosine, sine = cars[:, :4].T.astype(float)
    return [x / size[0] * TURN, y / size[1] * TURN, np.arctan2(sine, cosine) / math.tau * TURN]


def write_page(path: Path, title: str, shown: Sequence[Shown], together: bool = False) -> None:
    """Write a page of drives on one map. It begins with the last of them, or shows all of them `together`.

    The map, the car's size and the sensor that it shows are those of the last drive. Raises: WriteError.
    """
    last = shown[-1].drive
    road_map, constant, unit = last.scenario.magnified(), constants(last.sim), last.sim.unit
    lines, programs = road_map.network.lines.astype(float), programs_of_lines(road_map.network)
    x, y, cosine, sine, half, _ = lane_marks(road_map).T.astype(float)
    data = {
        "title": title,
        "width": float(road_map.road.width),
        "height": float(road_map.road.height),
        "torus": road_map.torus,
        "view": bounds(road_map),
        "interval": [round(float(road_map.road.speed_low), 2), round(float(road_map.road.speed_high), 2)],
        "fastest": 1.2 * float(road_map.road.speed_high),
        "car": [last.sim.vehicle.length / unit, last.sim.vehicle.width / unit],
        "sensor": float(constant.front_axle) / unit,
        "fan": [float(constant.ray_first), float(constant.ray_step)],
        # Each dash: its centre x, y, and the vector dx, dy from there to its end (units).
        "marks": np.stack([x, y, half * cosine, half * sine], axis=1).round(2).tolist(),
        # Each stop line: centre and vector as for the dashes, and a digit for the colour of its light in each second.
        "lights": [
            [round(n, 2) for n in (x, y, -half * sine, half * cosine)] + ["".join(map(str, program))]
            for (x, y, cosine, sine, half), program in zip(lines, programs, strict=True)
        ],
        "picture": base64.b64encode(_picture(road_map)).decode(),
        "together": together,
        "drives": [each.packed() for each in shown],
    }
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # a < in a name could end the data
    page = files("cluster.report").joinpath("drive.html").read_text(encoding="utf-8")
    write_atomic(path, page.replace('type="application/json">{}<', f'type="application/json">{text}<').encode())


@plain_style()
def _picture(road_map: Map) -> bytes:
    """The map as a PNG, its road with smooth edges; the first row is the map's upper side."""
    from matplotlib.image import imsave

    width, height = float(road_map.road.width), float(road_map.road.height)
    scale = min(PIXELS_PER_M, MOST_PIXELS / max(width, height))
    columns, rows = round(width * scale), round(height * scale)
    x, y = np.meshgrid((np.arange(columns) + 0.5) / scale, height - (np.arange(rows) + 0.5) / scale)
    points = freeze(np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32))
    share = np.clip(clearances(road_map.road, points) * scale + 0.5, 0.0, 1.0).reshape(rows, columns, 1)
    colours = np.array(OFF_ROAD) + share * (np.array(ROAD) - np.array(OFF_ROAD))
    picture = io.BytesIO()
    imsave(picture, (np.rint(colours / 4.0) * 4.0).astype(np.uint8), format="png")  # fewer colours: a smaller file
    return picture.getvalue()
