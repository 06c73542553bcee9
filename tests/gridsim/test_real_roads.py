"""Roads from files: every format gives the same lanes; what cannot be driven goes; traffic; bad files."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from written_roads import (
    BRITAIN,
    both_ways,
    commonroad,
    figure_of_eight,
    lanelet2,
    opendrive,
    opendrive_crossing,
    osm,
    street,
)

from gridsim.collision import boxes_touch, collides
from gridsim.config import SimConfig, constants
from gridsim.jit import njit
from gridsim.maps.network import is_junction, make_network
from gridsim.maps.real import load, shape
from gridsim.maps.real.description import Lane, RealRoad, bounds_of
from gridsim.maps.roads import clearances
from gridsim.maps.scenarios import build, label
from gridsim.simulator import Simulator
from gridsim.state import (
    ALONG,
    COS,
    DISTANCE,
    JUNCTION_BEHIND,
    LANE,
    NEXT,
    PERMIT,
    SECOND_NEXT,
    SHIFT,
    SIN,
    SPEED,
    SPEED_FACTOR,
    TRAFFIC_FIELDS,
    X,
    Y,
)  # fmt: skip
from gridsim.traffic.behaviour import drivers, step_traffic
from gridsim.traffic.world import set_pose, spawn

SIM = SimConfig()
NOBODY = np.array([np.inf, 0, 0, 0, 0, 0, 0, 0], dtype=np.float32)
CROSSING = [street((-120.0, 0.0), (0.0, 0.0), (120.0, 0.0)), street((0.0, -120.0), (0.0, 0.0), (0.0, 120.0))]


def written(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return str(path)


def centres(path):
    """Ends of the lanes' middle lines [lanes, 4], in order, with the road's middle at 0."""
    lanes = load.read_road(load.Path(path)).lanes.values()
    ends = np.array([[lane.centre[0, :2], lane.centre[-1, :2]] for lane in lanes])
    ends -= ends.reshape(-1, 2).mean(axis=0)
    return ends[np.argsort(ends[:, 0, 0])].reshape(-1, 4), [lane.speed for lane in lanes]


def test_formats_give_the_same_lanes(tmp_path):
    files = {
        "a.osm": osm([street((0.0, 0.0), (200.0, 0.0))]),
        "b.xodr": opendrive(200.0),
        "c.xml": commonroad(both_ways(200.0)),
        "d.osm": lanelet2(both_ways(200.0)),
        "e.xodr": opendrive(200.0).replace("<OpenDRIVE>", '<OpenDRIVE xmlns="http://code.asam.net/opendrive_schema">'),
    }
    expected = np.array([[-100.0, -1.6, 100.0, -1.6], [100.0, 1.6, -100.0, 1.6]])
    for name, text in files.items():
        lanes, speeds = centres(written(tmp_path, name, text))
        assert np.abs(lanes - expected).max() < 0.2, name
        assert speeds == pytest.approx([50 / 3.6] * 2, abs=0.02), name


@pytest.mark.parametrize(
    ("name", "text", "hand"),
    [
        ("a.osm", osm([street((0.0, 0.0), (200.0, 0.0))]), 1.0),
        ("b.osm", osm([street((0.0, 0.0), (200.0, 0.0))], BRITAIN), -1.0),
        ("c.xodr", opendrive(200.0, "LHT"), -1.0),
        ("d.xml", commonroad(both_ways(200.0, -1.0)), -1.0),
    ],
)
def test_side_of_the_road(tmp_path, name, text, hand):
    here = build(written(tmp_path, name, text), 0)
    assert here.network.hand == hand
    # A lane's room is on its side of the road, where it was measured: beyond it, there is no more.
    points, k = here.network.points, np.argmax(here.network.room)
    along = points[k + 1] - points[k]
    outward = hand * np.array([along[1], -along[0]]) / np.hypot(*along)
    clear = clearances(here.road, np.stack([points[k], points[k] + here.network.room[k] * outward]).astype(np.float32))
    assert clear[1] < clear[0]


def test_left_hand_opendrive_with_a_junction_is_a_mirror_image(tmp_path):
    right, left = (
        load.read_road(load.Path(written(tmp_path, f"{hand}.xodr", opendrive_crossing(hand)))) for hand in (1.0, -1.0)
    )
    assert (right.hand, left.hand) == (1.0, -1.0)
    assert len(right.lanes) == 20
    for key, lane in right.lanes.items():
        image = left.lanes[key]
        assert np.abs((lane.centre + image.centre)[:, 1]).max() < 0.01
        assert np.abs((lane.centre - image.centre)[:, 0]).max() < 0.01
        assert (lane.yields, lane.links) == (image.yields, image.links)
    here = build(str(tmp_path / "-1.0.xodr"), 0)
    world = spawn(here.network, np.full((1, 5), 1e6, np.float32), 10, np.zeros(1, np.uint64), SIM)[0]
    assert drive(here.road, here.network, drivers(SIM), constants(SIM), world, NOBODY, 1200)[:2] == (0, 0)


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.osm", osm(CROSSING)), ("b.xodr", opendrive(200.0)), ("c.xodr", opendrive_crossing())],
)
def test_side_that_a_user_decides(tmp_path, name, text):
    path = written(tmp_path, name, text)
    right, left = (load.read_road(*load.split_name(path + side)) for side in ("@right", "@left"))
    assert [load.hand_of(road.lanes) for road in (right, left)] == [1.0, -1.0]
    assert [build(path + side, 0).network.hand for side in ("", "@left")] == [1.0, -1.0]
    assert label(path + "@left") == name[0]


def test_side_of_lanes_that_lie_alone(tmp_path):
    """Nothing else tells it; and the order of what follows a file's name does not matter."""
    ring = [(100.0 * np.cos(a), 100.0 * np.sin(a)) for a in np.linspace(0.0, 2 * np.pi, 40)]
    inner = [(0.97 * x, 0.97 * y) for x, y in ring]
    path = written(tmp_path, "ring.xml", commonroad([(inner, ring)], {1: [1]}))
    assert [build(path + side, 0).network.hand for side in ("", "@left")] == [1.0, -1.0]
    crop = load.Path("a@b.osm"), (52.1, -3.0, 400.0), -1.0
    assert load.split_name("a@b.osm@52.1,-3.0,400@left") == load.split_name("a@b.osm@left@52.1,-3.0,400") == crop
    assert load.split_name("a.osm@1.2.3,4,5") == (load.Path("a.osm@1.2.3,4,5"), None, None)


def mirrored(worlds, width):
    """Worlds in a mirror across x."""
    worlds = worlds.copy()
    worlds[..., X] = np.mod(width - worlds[..., X], width)
    worlds[..., COS] *= -1.0
    worlds[..., SHIFT] *= -1.0
    return worlds


def test_left_hand_traffic_is_a_mirror_image(tmp_path):
    """Also where it gives way to an ego car that comes along the middle of the road."""
    right = build(written(tmp_path, "right.xml", commonroad(both_ways(200.0))), 0)
    flipped = [([(-x, y) for x, y in b], [(-x, y) for x, y in a]) for a, b in both_ways(200.0)]
    left = build(written(tmp_path, "left.xml", commonroad(flipped)), 0)
    assert [float(here.network.hand) for here in (right, left)] == [1.0, -1.0]
    # In the turning loops, the pixels of the edges differ.
    assert np.percentile(np.abs(right.network.room - left.network.room), 70) < 0.02
    width = float(right.road.width)
    start = np.full((1, 5), 1e6, dtype=np.float32)
    worlds = [spawn(here.network, start, 6, np.array([3], dtype=np.uint64), SIM)[0] for here in (right, left)]
    ego = np.zeros(8, dtype=np.float32)
    ego[[X, Y, COS]] = width / 2, float(right.road.height) / 2, 1.0
    egos, moved = [ego, mirrored(np.append(ego, np.zeros(13, np.float32)), width)[:8]], 0.0
    for _ in range(300):
        for here, world, car in zip((right, left), worlds, egos, strict=True):
            drive(here.road, here.network, drivers(SIM), constants(SIM), world, car, 1)
        moved = max(moved, float(np.abs(worlds[0][:, SHIFT]).max()))
    assert moved > 0.15
    assert np.abs(mirrored(worlds[1], width)[:, [X, Y, SPEED, SHIFT]] - worlds[0][:, [X, Y, SPEED, SHIFT]]).max() < 0.1


@njit
def drive(road, network, drivers, constants, world, ego, steps):
    """Overlaps of cars, and cars off the road, in so many steps; and the most steps for which all cars stood."""
    overlaps, off, stood, longest = 0, 0, 0, 0
    for _ in range(steps):
        step_traffic(network, drivers, world, ego)
        stood = 0 if (world[:, SPEED] > 0.1).any() else stood + 1
        longest = max(longest, stood)
        for i in range(len(world)):
            car = world[i]
            off += car[LANE] >= 0.0 and collides(road, constants, car[X], car[Y], car[COS], car[SIN])
            for j in range(i):
                dx, dy = world[j, X] - car[X], world[j, Y] - car[Y]
                if min(car[LANE], world[j, LANE]) >= 0.0 and abs(dx) + abs(dy) < 9.0:
                    overlaps += boxes_touch(constants, dx, dy, car[COS], car[SIN], world[j, COS], world[j, SIN])
    return overlaps, off, longest


def test_traffic_drives_on_a_crossing_with_turning_loops(tmp_path):
    """Its four roads end: a loop each; 12 cars for ten minutes."""
    name = written(tmp_path, "crossing.osm", osm(CROSSING))
    here = build(name, 0)
    assert "4 roads that end got a turning loop" in load.described(name, SIM).notes
    assert clearances(here.road, here.network.points).max() > 4.3, "loops are wider than the roads of 3.5 m a lane"
    world = spawn(here.network, np.full((1, 5), 1e6, np.float32), 12, np.zeros(1, np.uint64), SIM)[0]
    assert (world[:, LANE] >= 0).sum() >= 10
    overlaps, off, stood = drive(here.road, here.network, drivers(SIM), constants(SIM), world, NOBODY, 6000)
    assert (overlaps, off) == (0, 0)
    assert stood < 600


@pytest.mark.parametrize(("radius", "cars"), [(10.0, 4), (15.0, 6), (80.0, 20)])
def test_road_that_comes_back_over_itself(tmp_path, radius, cars):
    """A lane crosses the one that it follows: there, too, one car goes after another."""
    here = build(written(tmp_path, "eight.xml", commonroad(figure_of_eight(radius), EIGHT)), 0)
    world = spawn(here.network, np.full((1, 5), 1e6, np.float32), cars, np.ones(1, np.uint64), SIM)[0]
    assert (world[:, LANE] >= 0).sum() == cars
    overlaps, off, stood = drive(here.road, here.network, drivers(SIM), constants(SIM), world, NOBODY, 6000)
    assert (overlaps, off) == (0, 0)
    assert stood < 600
    assert (world[:, LANE] >= 0).all()  # none stood so long that it was taken away


EIGHT = {1: [2], 2: [3], 3: [1]}


def test_who_follows_does_not_block_the_way_back_over_its_lane(tmp_path):
    """Two cars on a lane: the first may enter the lane that comes back over it, although the other is on it."""
    name = written(tmp_path, "eight.xml", commonroad(figure_of_eight(30.0), EIGHT))
    lanes = load.read_road(load.Path(name)).lanes
    network = as_they_are(lanes, load.sides_of(RealRoad("", lanes)), build(name, 0).road)
    assert network.crossings.tolist() == [1, 0]
    world = np.zeros((2, TRAFFIC_FIELDS), dtype=np.float32)
    for car, along in zip(world, (57.0, 40.0), strict=True):
        car[[LANE, NEXT, SECOND_NEXT, ALONG, JUNCTION_BEHIND, PERMIT, SPEED_FACTOR]] = 0, 1, 2, along, -1, -1, 1
        set_pose(network, car)
    for _ in range(50):
        step_traffic(network, drivers(SIM), world, NOBODY)
    assert world[0, LANE] == 1.0


def as_they_are(lanes, size, road, crossing=()):
    """The network of lanes that are not shaped; some more of them cross."""
    conflicts = shape.Conflicts(lanes, load.gap_of(SIM), size)
    for one, other in crossing:
        conflicts.cross[one, other] = conflicts.cross[other, one] = True
    network = shape.network_of(lanes, conflicts, 1.0)
    return make_network(network, road, SIM, np.full(len(lanes), 12.0, np.float32))


@pytest.mark.parametrize("crossing", [False, True])
def test_lane_changes(tmp_path, crossing):
    """A car stays where it is beside a lane of another length, and out of a lane in which it would need a permit."""
    x = np.arange(0.0, 257.0)
    sides = np.array([256.0, 128.0])
    bow = np.where((x > 10) & (x < 30), 5.0 * np.sin(np.pi * (x - 10) / 20) ** 2, 0.0)
    lines = {"a": 0.0 * x, "b": 3.5 + bow, "c": 60.0 + 0.0 * x}
    lanes = {}
    for key, y in lines.items():
        bounds = bounds_of(np.column_stack([x, y, 0.0 * x]), 3.2)
        lanes[key] = Lane(*bounds, 12.0, [key])
    lanes["a"].left_lane, lanes["b"].right_lane = "b", "a"
    road = build(written(tmp_path, "a.xml", commonroad(both_ways(200.0))), 0).road
    network = as_they_are(lanes, sides, road, [(1, 2)] if crossing else [])
    lengths = (np.diff(network.offsets) - 1) * network.steps
    assert lengths[1] > lengths[0] + 2.0
    world = np.zeros((2, TRAFFIC_FIELDS), dtype=np.float32)
    for car, along, factor in zip(world, (100.0, 130.0), (1.0, 0.2), strict=True):
        car[[ALONG, JUNCTION_BEHIND, PERMIT, SPEED_FACTOR, SPEED]] = along, -1, -1, factor, 12.0 * factor
        set_pose(network, car)
    changed = False
    for _ in range(60):
        before = world[0].copy()
        step_traffic(network, drivers(SIM), world, NOBODY)
        moved = np.hypot(*(world[0] - before)[[X, Y]])
        assert moved < before[SPEED] * 0.1 + 0.2
        changed |= bool(world[0, LANE] != 0)
    assert changed != crossing


def test_a_lane_hardly_wider_than_a_car_has_room_for_its_ends(tmp_path):
    """Which swing out in bends, and where it changes lanes. A lane of 2.1 m, as one in Karlsruhe."""
    narrow = [([(x, 0.3 * y) for x, y in left], [(x, 0.3 * y) for x, y in right]) for left, right in both_ways(200.0)]
    here = build(written(tmp_path, "narrow.xml", commonroad(narrow)), 0)
    assert clearances(here.road, here.network.points).min() > 1.2


MAIN = [street((-120.0, 0.0), (0.0, 0.0), (120.0, 0.0), highway="primary"), CROSSING[1]]


def test_main_road_goes_first(tmp_path):
    """Traffic of the other road waits for a car that comes 2 s after it, and for one that stands at the line.

    It does not wait for one that has no room to drive on.
    """
    here = build(written(tmp_path, "main.osm", osm(MAIN)), 0)
    network = here.network
    assert len(network.yields) == len(network.crossings)
    lengths, directions = (np.diff(network.offsets) - 1) * network.steps, np.diff(network.points, axis=0)
    towards = [k for k in range(len(lengths)) if is_junction(network, network.successors[k, 0])]
    east_west = {k: abs(directions[network.offsets[k + 1] - 2]) @ [1.0, -1.0] > 0.0 for k in towards}
    main, minor = (next(k for k in towards if east_west[k] == which) for which in (True, False))

    def straight(lane):
        """The lane across the junction from a lane that leads there, and the one after it."""
        ahead = directions[network.offsets[lane + 1] - 2]
        onward = [k for k in network.successors[lane] if k >= 0]
        across = max(onward, key=lambda k: directions[network.offsets[k + 1] - 2] @ ahead)
        return across, network.successors[across, 0]

    for speed, away, full in ((8.0, 44.0, False), (0.0, 2.2, False), (0.0, 2.2, True)):
        first = []
        for lanes in (network, network._replace(yields=network.yields[:0])):
            world = np.zeros((3, TRAFFIC_FIELDS), dtype=np.float32)
            for car, lane, v, metres in zip(world, (minor, main), (6.0, speed), (20.0, away), strict=False):
                car[[LANE, ALONG, SPEED]] = lane, lengths[lane] - metres, v
                car[[NEXT, SECOND_NEXT]] = straight(lane)
                car[[JUNCTION_BEHIND, PERMIT, SPEED_FACTOR]] = -1.0, -1.0, 1.0
                set_pose(lanes, car)
            exit_lane = int(world[1, SECOND_NEXT])
            stands = [exit_lane if full else -1, 4.0, *straight(exit_lane), -1, -1, 1.0]
            world[2, [LANE, ALONG, NEXT, SECOND_NEXT, JUNCTION_BEHIND, PERMIT, SPEED_FACTOR]] = stands
            set_pose(lanes, world[2] if full else world[0])
            standing, entered = world[2].copy(), np.zeros(2)
            for k in range(200):
                world[2] = standing if k < 100 else world[2]
                step_traffic(lanes, drivers(SIM), world, NOBODY)
                entered[(entered == 0) & (world[:2, LANE] != [minor, main])] = k
            assert (entered > 0).all()
            first.append(np.argmin(entered))
        assert first == [0 if full else 1, 0]


def test_driving_back_on_the_other_lane_is_new_distance(tmp_path):
    """Roads end, so a car has to turn; on the same lane a second lap of 80 m still counts nothing."""
    here = build(written(tmp_path, "a.xml", commonroad(both_ways(300.0))), 0)
    x, y = here.network.points[20]
    ahead = here.network.points[21] - here.network.points[20]
    heading = np.arctan2(ahead[1], ahead[0])
    simulator = Simulator(1, SIM)
    simulator.reset(here, np.array([[x, y, heading, 8.0, 0.0]], dtype=np.float32))
    simulator.max_steps, distances = 10_000, []
    for turned in (False, True, False):
        simulator.cars[0, [X, Y]] = np.array([x, y]) + turned * 42.0 * np.array([np.cos(heading), np.sin(heading)])
        simulator.cars[0, [COS, SIN]] = np.array([np.cos(heading), np.sin(heading)]) * (-1.0 if turned else 1.0)
        simulator.cars[0, SPEED] = 8.0
        for _ in range(40):
            simulator.step(np.array([[0.0, 0.0]]))
        distances.append(simulator.cars[0, DISTANCE])
    assert np.diff(distances, prepend=0.0)[:2] == pytest.approx(distances[0], rel=0.2)
    assert distances[2] - distances[1] < 0.2 * distances[0]


def test_lanes_join_and_lie_on_the_road(tmp_path):
    here = build(written(tmp_path, "crossing.osm", osm(CROSSING)), 0)
    n = here.network
    last, first = n.points[n.offsets[1:] - 1], n.points[n.offsets[:-1]]
    for lane, onward in enumerate(n.successors):
        assert (onward >= 0).any()
        for other in onward[onward >= 0]:
            assert np.abs(here.shortest(first[other] - last[lane])).max() < 0.01
    assert clearances(here.road, n.points).min() > 1.0
    assert (n.steps <= 1.0).all()
    assert pickle.loads(pickle.dumps(here)).network.points.tobytes() == n.points.tobytes()


def test_way_under_a_bridge_is_left_out(tmp_path):
    under = street((0.0, -120.0), (0.0, 120.0))
    over = street((-120.0, 0.0), (-60.0, 0.0), (60.0, 0.0), (120.0, 0.0), bridge="yes", layer="1")
    found = load.described(written(tmp_path, "bridge.osm", osm([under, over])), SIM)
    assert any("under bridges" in note for note in found.notes)
    points = found.network.points
    assert np.ptp(points[:, 0]) > 200.0 > np.ptp(points[:, 1])


def test_ring_keeps_both_directions(tmp_path):
    angles = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = list(zip(120.0 * np.cos(angles), 120.0 * np.sin(angles), strict=True))
    network = build(written(tmp_path, "ring.osm", osm([street(*ring[:13]), street(*ring[12:24], ring[0])])), 0).network
    lengths = (np.diff(network.offsets) - 1) * network.steps
    assert lengths.sum() == pytest.approx(2 * 2 * np.pi * 120.0, rel=0.03)


def test_sharp_turns_are_no_ways_of_traffic(tmp_path):
    turn = [[(200.0, 0.0), (201.0, 0.0), (200.0, 0.1)], [(200.0, -3.2), (204.0, 1.6), (200.0, 3.2)]]
    lanes = [*both_ways(200.0), (turn[0], turn[1])]
    found = load.described(written(tmp_path, "turn.xml", commonroad(lanes, {1: [3], 3: [2]})), SIM)
    assert any("turn in less than 3.5 m" in note for note in found.notes)
