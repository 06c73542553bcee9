"""Small roads, cars on them, pictures of roads, what is where on the maps made of them, and recorded drives."""

import math
from contextlib import closing

import numpy as np
import oracle
import yaml
from PIL import Image

from gridsim import state
from gridsim.collision import collides
from gridsim.config import SimConfig, constants
from gridsim.jit import freeze, njit
from gridsim.maps.map import without_lanes
from gridsim.maps.roads import Strips, clearance_nodes, clearances, make_road
from gridsim.state import End, poses_of
from gridsim.view.drive import Recorder, manual

PPM = 16
W, H = 100.0, 72.0  # m
LINES = [[15.0, 12.0, 80.0, 50.0, 4.0], [15.0, 12.0, 85.0, 15.0, 3.5]]
TRACK = oracle.ExactRoad(Strips.of(LINES, [[40.0, 45.0, 16.0, 0.0, 2 * math.pi, 3.5]]), 256.0, 256.0)


def distance(x, y):
    """Clearance (m) of the strips above."""
    return TRACK.clearance(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)


def picture(shape=distance, width=W, height=H, ppm=PPM):
    """An anti-aliased picture uint8 [rows, columns] of a shape, its highest row first, as pictures are."""
    x, y = ((np.arange(round(side * ppm)) + 0.5) / ppm for side in (width, height))
    d = shape(*np.meshgrid(x, y[::-1]))
    return np.clip(127.5 + 255 * ppm * d, 0, 255).round().astype(np.uint8)


def ring(radius, half_width):
    """Pixels of a ring of road."""
    return picture(lambda x, y: half_width - np.abs(np.hypot(x - 45, y - 45) - radius), 90.0, 90.0)


def save(path, pixels):
    Image.fromarray(pixels).save(path)
    return str(path)


def write_yaml(folder, pixels=None, name="map", **values):
    if pixels is not None:
        save(folder / "map.png", pixels)
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({"image": "map.png", "resolution": 1 / PPM, "origin": [0, 0, 0], **values}))
    return str(path)


@njit
def _crashed(road, constants, starts, out):
    for k in range(len(starts)):
        x, y, heading = starts[k, 0], starts[k, 1], starts[k, 2]
        out[k] = collides(road, constants, x, y, np.float32(math.cos(heading)), np.float32(math.sin(heading)))


def crashes(road, starts, config=None):
    """Whether a car would touch a wall at each of starts float32 [n, 5]."""
    out = np.empty(len(starts), dtype=np.bool_)
    _crashed(road, constants(config or SimConfig()), freeze(starts), out)
    return out


def read(road, points):
    return clearances(road, freeze(np.asarray(points, dtype=np.float32)))


def small_map(lines, width=64.0, height=64.0):
    """A map of straight roads on a torus with these sides (m), for 5 to 12 m/s, without lanes."""
    nodes = clearance_nodes(Strips.of(lines), width, height)
    return without_lanes("small", nodes, (5.0, 12.0), 1.0, np.zeros((0, 5), dtype=np.float32))


def straight_road(width, height, limit, half_width=0.0):
    """A road along x in the middle of a torus, where traffic may drive at `limit` m/s; 0 m wide, it has no room for it
    to move over."""
    nodes = clearance_nodes(Strips.of([[0.0, height / 2, width, height / 2, half_width]]), width, height)
    return make_road(nodes, (limit, limit), 1.0)


def cars_on(network, *rows):
    """A world of cars (lane, m along it, m/s, factor), placed by one look at where they are."""
    world = np.zeros((len(rows), state.TRAFFIC_FIELDS), dtype=np.float32)
    for car, (lane, along, speed, factor) in zip(world, rows, strict=True):
        car[[state.LANE, state.ALONG, state.SPEED, state.SPEED_FACTOR]] = lane, along, speed, factor
        car[[state.JUNCTION_BEHIND, state.PERMIT]] = -1.0
        car[state.NEXT] = network.successors[lane, 0]
        car[state.SECOND_NEXT] = network.successors[int(car[state.NEXT]), 0]
        at = along / float(network.steps[lane])
        first = network.offsets[lane] + int(at)
        a, b = network.points[first], network.points[first + 1]
        car[[state.X, state.Y]] = (a + (at - int(at)) * (b - a)) % [network.width, network.height]
        car[[state.COS, state.SIN]] = (b - a) / np.hypot(*(b - a))
    return world


def record_drive(path, scenario, start, episodes, sim="default"):
    """Record a person's drive: episodes from one start, of these actions, until they end; the states in the file."""
    simulator, states = manual(SimConfig.load(sim)), []
    with closing(Recorder(path, scenario, sim=sim)) as recorder:
        for episode, actions in enumerate(episodes):
            simulator.reset(scenario, start[None])
            for step, action in enumerate(actions):
                states.append(start if step == 0 else poses_of(simulator.cars[0]))
                recorder.write(step, states[-1], action, episode)
                assert path.read_text().count("\n") == recorder.rows + 1  # whatever happens next, it is kept
                simulator.step(np.array([action]))
                if simulator.ends[0] != End.RUNNING:
                    break
    return np.array(states)


def strip(cx, cy, angle, half_width, half_length=45.0):
    """A corridor's clearance, its ends closed."""

    def shape(x, y):
        u = (x - cx) * math.cos(angle) + (y - cy) * math.sin(angle)
        v = -(x - cx) * math.sin(angle) + (y - cy) * math.cos(angle)
        return np.minimum(half_width - np.abs(v), half_length - np.abs(u))

    return shape
