"""The car's motion, the order of events and whole episodes against the oracle, and what must not earn distance."""

import math
from types import SimpleNamespace

import numpy as np
import oracle
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pictures import crashes, small_map
from scipy.integrate import solve_ivp

from gridsim.car.kinematic import move, path_curvature
from gridsim.car.vehicle import Action, act, act_continuous
from gridsim.config import EpisodeConfig, SimConfig, VehicleConfig, constants
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.simulator import Simulator, _control_all
from gridsim.state import COS, DISTANCE, IDLE, LANE, ODOMETER, PACED, SIN, SPEED, STEERING, STEPS, End, X, Y
from gridsim.traffic.world import spawn

CONFIG = SimConfig()
K = constants(CONFIG)
F = np.float32
DT = 0.1  # s
STILL = 1e-6  # m/s, rounding: what stands still may seem to move by as much

speeds = st.floats(-3.0, 30.0, width=32)
steerings = st.floats(-27.0, 27.0).map(math.radians).map(F)
actions = st.sampled_from(list(Action))


def moved(car, acceleration, kappa, k=K):
    """A car (x, y, cosine, sine, speed) after a control period."""
    return tuple(map(F, move(None, k, None, kappa, *car, F(acceleration), k.dt)[:5]))


@pytest.mark.parametrize("pedal", [-1.0, -0.3])
@pytest.mark.parametrize("speed", [12.3, 0.5, -2.0])
def test_the_pedal_brakes_to_a_stand_and_not_further(pedal, speed):
    car = F(0.0), F(0.0), F(1.0), F(0.0), F(speed)
    for _ in range(60):
        acceleration, _ = act_continuous(K, F(pedal), F(0.0), car[4], F(0.0))
        assert abs(acceleration) <= -8.0 * pedal * (1 + 1e-6)
        car = moved(car, acceleration, F(0.0))
    assert abs(car[4]) <= STILL
    assert car[0] * speed > 0.0


def test_braking_in_a_bend_stays_within_the_friction_circle():
    """Of 1 g, whatever an action asks for at any speed; CommonRoad's cars may have 11.5 m/s2."""
    assert float(act(K, Action.BRAKE, F(30.0), F(0.0))[0]) == -8.0
    for speed in np.linspace(0.0, 30.0, 61):
        lateral = speed**2 * float(path_curvature(K, F(speed), K.steering_limit))
        assert max(math.hypot(lateral, float(act(K, a, F(speed), F(0.0))[0])) for a in Action) < 9.81


def kong(_t: float, state: np.ndarray, steering: float, acceleration: float) -> list[float]:
    """Kong et al. 2015, equations 1: derivatives of x, y, psi, v."""
    _, _, psi, v = state
    beta = math.atan(1.25 / 2.5 * math.tan(steering))
    return [v * math.cos(psi + beta), v * math.sin(psi + beta), v / 1.25 * math.sin(beta), acceleration]


def test_ten_seconds_of_stepwise_steering_are_kongs():
    """A command acts at the beginning of its period: Kong's equations under the same steps, without a grip limit."""
    rng, state, steering = np.random.default_rng(0), [0.0, 0.0, 0.0, 8.0], F(0.0)
    car, k = (F(0.0), F(0.0), F(1.0), F(0.0), F(8.0)), constants(SimConfig(VehicleConfig(lateral_grip=math.inf)))
    for action in rng.choice([Action.LEFT, Action.RIGHT, Action.NONE], 100):
        steering = F(act(k, int(action), car[4], steering)[1])
        car = moved(car, 0.0, path_curvature(k, car[4], steering), k)
        state = list(solve_ivp(kong, (0.0, DT), state, args=(float(steering), 0.0), rtol=1e-9, atol=1e-9).y[:, -1])
    assert math.hypot(car[0] - state[0], car[1] - state[1]) < 1e-3


@given(speed=speeds, steering=steerings, heading=st.floats(-math.pi, math.pi), action=actions)
def test_a_period_is_the_oracles(speed, steering, heading, action):
    acceleration, angle = act(K, int(action), F(speed), steering)
    expected = oracle.act(CONFIG, int(action), float(speed), float(steering))
    assert (float(acceleration), float(angle)) == pytest.approx(expected, abs=2e-6, rel=1e-6)
    kappa = path_curvature(K, F(speed), F(angle))
    start = (F(3.0), F(-2.0), F(math.cos(heading)), F(math.sin(heading)), F(speed))
    x, y, cosine, sine, after, length = move(None, K, None, kappa, *start, F(acceleration), K.dt)
    looks = oracle.advance(CONFIG, (3.0, -2.0, heading), float(speed), float(angle), float(acceleration))
    # A speed limit reached within the period: the kernel's mean speed is that of its ends, the oracle's is exact.
    clipped = not -3.0 <= float(speed) + float(acceleration) * DT <= 30.0
    tolerance = 6e-3 if clipped else 1e-5
    assert float(length) == pytest.approx(looks[-1, 4], abs=tolerance)
    assert (float(x), float(y)) == pytest.approx((looks[-1, 0], looks[-1, 1]), abs=tolerance)
    assert float(after) == pytest.approx(looks[-1, 3], abs=1e-5)
    assert abs(math.remainder(math.atan2(sine, cosine) - looks[-1, 2], 2 * math.pi)) < tolerance


def test_discrete_and_continuous_actions_have_one_kernel():
    simulator, road = Simulator(1), build("curved", 1)
    simulator.reset(road, sample_starts(road, 1, np.random.default_rng(0)))
    simulator.step(np.array([Action.ACCELERATE]))
    kinds = len(_control_all.signatures)
    simulator.step(np.array([[1.0, 0.0]]))
    assert len(_control_all.signatures) == kinds


# --- Episodes --------------------------------------------------------------------------------------------------------

SIDE = 256.0
INTERVAL = (5.0, 12.0)  # m/s
TARGET, MAX_STEPS = 150.0, 200  # of the episodes that are driven at random and by sight


def run(road_map, start, choose, target=2000.0, max_steps=4000, config=CONFIG):
    """Drive until the episode ends; `choose` is called with (step, ranges, car) and returns an action.

    Returns: the start, the actions [n], the states after each [n, CAR_FIELDS], and how it ended.
    """
    start = np.asarray(start, dtype=F)
    simulator = Simulator(1, config, target, max_steps)
    simulator.reset(road_map, start[None])
    actions: list[int] = []
    states = []
    while simulator.ends[0] == End.RUNNING:
        actions.append(int(choose(len(actions), simulator.ranges[0], simulator.cars[0])))
        simulator.step(np.array(actions[-1:]))
        states.append(simulator.cars[0].copy())
    end = End(simulator.ends[0]).name
    return SimpleNamespace(start=start, actions=np.array(actions), states=np.array(states), end=end)


def at_random(rng):
    """Actions at random, each kept for a while; accelerating more often than not, so that it goes somewhere."""
    chances = np.array([6, 2, 2, 1, 2, 3, 3, 1]) / 20
    kept = [0, 4]

    def choose(step, ranges, car):
        if step >= kept[0]:
            kept[:] = step + rng.integers(1, 9), rng.choice(8, p=chances)
        return kept[1]

    return choose


def by_sight(rng):
    """A simple driver: to where there is more room, no faster than the view ahead allows."""

    def choose(step, ranges, car):
        left, right = ranges[16:26].sum(), ranges[5:15].sum()
        wanted = np.clip(1.2 * ((left - right) / (left + right) + 0.03 * rng.normal()), -0.45, 0.45)
        pace = np.clip(0.6 * ranges[13:18].min(), 3.0, 9.0)
        turn = int(np.sign(wanted - car[STEERING])) if abs(wanted - car[STEERING]) > 0.05 else 0
        if car[SPEED] > pace + 0.3:
            return Action.BRAKE
        if car[SPEED] < pace:
            return (Action.ACCELERATE, Action.ACCELERATE_LEFT, Action.ACCELERATE_RIGHT)[turn]
        return (Action.NONE, Action.LEFT, Action.RIGHT)[turn]

    return choose


def always(action):
    return lambda step, ranges, car: action


@pytest.fixture(scope="module")
def scenarios():
    return [build("seamless", seed) for seed in (0, 11)]


@pytest.fixture(scope="module")
def exact(scenarios):
    return [oracle.ExactRoad(s.strips, SIDE, SIDE) for s in scenarios]


@pytest.fixture(scope="module")
def episodes(scenarios):
    """(index of the map, what `run` returns): 80 episodes at random and 30 of a driver, from lanes, at any speed."""
    rng = np.random.default_rng(21)
    found = []
    for k in range(110):
        start = sample_starts(scenarios[k % 2], 1, rng)[0]
        start[3] = rng.uniform(-3.0, 12.0)
        choose = at_random(rng) if k < 80 else by_sight(rng)
        found.append((k % 2, run(scenarios[k % 2], start, choose, target=TARGET, max_steps=MAX_STEPS)))
    # They are worth comparing.
    states = np.concatenate([r.states for _, r in found])
    assert {"COLLISION", "IDLE", "SUCCESS", "TIME"} == {r.end for _, r in found}
    assert len(states) > 4000
    assert {int(a) for _, r in found for a in r.actions} == set(range(8))
    assert states[:, SPEED].min() < -2.5
    assert states[:, SPEED].max() > 15.0
    return found


def test_whole_episodes_are_the_oracles(scenarios, episodes, exact):
    """The oracle drives by itself from start to end, never set right: same path, same distance, same end."""
    odd = 0
    for m, r in episodes:
        rows, end = oracle.drive(CONFIG, exact[m], INTERVAL, r.start, r.actions, TARGET, MAX_STEPS)
        same = end == r.end and len(rows) == len(r.states)
        # Where one of the two saw a collision that the other did not, the last step cannot be compared.
        upto = min(len(rows), len(r.states)) - (not same)
        s, o = r.states[:upto].astype(float), rows[:upto]
        for seen, true, tolerance in (
            (scenarios[m].shortest(s[:, [X, Y]] - o[:, :2]), 0.0, 5e-3),
            (s[:, COS], np.cos(o[:, 2]), 1e-3),
            (s[:, SIN], np.sin(o[:, 2]), 1e-3),
            (s[:, SPEED], o[:, 3], 1e-3),
            (s[:, STEERING], o[:, 4], 1e-4),
            (s[:, DISTANCE], o[:, 5], 0.1),
            (s[:, PACED], o[:, 6], 0.1),
        ):
            assert np.abs(seen - true).max(initial=0.0) < tolerance
        if not same:
            odd += 1
            # The kernel looks at points of the outline, the oracle at all of it: a matter of some cm at an edge.
            x, y, cosine, sine = r.states[-1, [X, Y, COS, SIN]].astype(float)
            last = rows[-1:, :3] if len(rows) <= len(r.states) else np.array([[x, y, math.atan2(sine, cosine)]])
            assert "COLLISION" in (end, r.end)
            assert exact[m].widened(0.25).outline_on_road(last, 2.0, 1.0)[0]
            assert not exact[m].widened(-0.05).outline_on_road(last, 2.0, 1.0)[0]
    assert odd <= 0.1 * len(episodes)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_collision_is_the_outline_off_the_road(scenarios, exact, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, SIDE, (40_000, 2))
    points = points[exact[seed].clearance(points) > 0.8][:5000]
    poses = np.column_stack([points, rng.uniform(-math.pi, math.pi, len(points))]).astype(F).astype(float)
    hit = crashes(scenarios[seed].road, np.pad(poses.astype(F), ((0, 0), (0, 2))))
    assert 0.1 < hit.mean() < 0.5

    def on_road(margin):
        return exact[seed].widened(margin).outline_on_road(poses, 2.0, 1.0)

    assert (hit == on_road(0.0)).mean() < 0.003
    assert not (hit & on_road(-0.03)).any()  # no false alarm with more than 3 cm to spare
    missed = ~hit & ~on_road(0.05)  # a pointed corner may reach in between the points that are looked at
    assert missed.mean() < 0.001
    assert not (~hit & ~on_road(0.4)).any()


def test_no_corner_of_a_parked_car_is_overlooked():
    city = build("city", 3)
    rng, parked, sides = np.random.default_rng(0), city.strips.blocks, city.size
    away, angle = rng.uniform(1.0, 3.6, (6000, 1)), rng.uniform(-math.pi, math.pi, 6000)
    points = parked[rng.integers(len(parked), size=6000), :2] + away * np.column_stack([np.cos(angle), np.sin(angle)])
    poses = np.column_stack([points % sides, rng.uniform(-math.pi, math.pi, 6000)]).astype(F).astype(float)
    hit = crashes(city.road, np.pad(poses.astype(F), ((0, 0), (0, 2))))

    def on_road(margin):
        return oracle.ExactRoad(city.strips, *sides).widened(margin).outline_on_road(poses, 2.0, 1.0)

    assert 200 < (~hit).sum() < 1000
    assert not (hit & on_road(-0.03)).any()
    assert not (~hit & ~on_road(0.15)).any()  # the clearance's grid rounds corners off, by less than 0.2 m


@pytest.fixture(scope="module")
def plain():
    """Road everywhere: a torus of 128 m without an edge."""
    return small_map([[0, y, 128, y, 40.0] for y in (0, 40, 80)], width=128.0, height=128.0)


@pytest.fixture(scope="module")
def straight():
    """A road of 8 m round a torus of 1,024 m, along x."""
    return small_map([[0, 32.0, 1024, 32.0, 4.0]], width=1024.0)


@pytest.mark.parametrize(("speed", "radius"), [(4.0, 5.06), (7.0, 49 / 4.9), (11.5, 11.5**2 / 4.9)])
@pytest.mark.parametrize("side", [1, -1])
def test_circling_on_the_spot_earns_one_round(plain, speed, radius, side):
    """As the wheels are turned when it is slow, and of v^2 / 4.9 when it is faster."""
    r = run(plain, [64, 64, 0.3, speed, side * math.radians(27.0)], always(Action.LEFT if side > 0 else Action.RIGHT))
    rnd = 2 * math.pi * radius
    assert rnd < 200.0
    assert r.end == "IDLE"
    # A square's length more or less where the circle closes, and then 15 steps.
    assert r.states[-1, DISTANCE] == pytest.approx(rnd, abs=6.0)
    assert r.states[-1, ODOMETER] < rnd + 15 * speed * 0.1 + 6.0
    assert r.states[-1, PACED] == pytest.approx(r.states[-1, DISTANCE] if speed >= INTERVAL[0] else 0.0, abs=1e-3)


def test_a_round_longer_than_200_m_is_new_ground_again(plain):
    speed = 13.0
    assert 2 * math.pi * speed**2 / 4.9 > 200.0 + 12.0
    r = run(plain, [64, 64, 0.0, speed, math.radians(27.0)], always(Action.LEFT), target=600.0)
    assert r.end == "SUCCESS"
    assert r.states[-1, ODOMETER] == pytest.approx(r.states[-1, DISTANCE], abs=1.0)


def test_back_and_forth_earns_the_furthest_point(straight):
    """The classic cheat: ground is made good before anything counts again."""
    plan = [Action.ACCELERATE] * 15 + [Action.BRAKE] * 20 + [Action.REVERSE] * 7 + [Action.ACCELERATE] * 13
    patient = SimConfig(episode=EpisodeConfig(patience=100))
    start, length = [100, 32, 0, 0, 0], len(plan)
    r = run(straight, start, lambda step, *_: plan[step % length], max_steps=10 * length, config=patient)
    assert r.end == "TIME"
    furthest = np.maximum.accumulate(r.states[:, X].astype(float)) - 100
    assert (np.diff(r.states[:, X]) < -0.01).sum() > 30
    assert r.states[:, DISTANCE] == pytest.approx(furthest, abs=0.02)
    driven = np.abs(np.diff(r.states[:, X].astype(float), prepend=100.0)).cumsum()
    assert r.states[:, ODOMETER] == pytest.approx(driven, abs=0.02)


@pytest.mark.parametrize("wall", [1.0, 2.0])
@pytest.mark.parametrize("heading", [0.0, 0.02, math.pi])
def test_nothing_tunnels_through_a_thin_wall(wall, heading):
    """30 m/s at a wall across the road, from starts 10 cm apart: 3 m a step, and never beyond it."""
    road_map = small_map([[0, 32, 64, 32, 16.0], [80 + 16 + wall, 32, 120, 32, 16.0]], width=128.0, height=128.0)
    first, edge, way = (40.0, 80.0, 1) if heading < 1.0 else (120.0, 80.0 + wall, -1)
    for k in range(32):
        r = run(road_map, [first + 0.1 * k * way, 32, heading, 30.0, 0.0], always(Action.ACCELERATE), max_steps=40)
        assert r.end == "COLLISION"
        into = (r.states[-1, X] - edge) * way + 2.0
        assert -0.1 < into < 1.0 + 0.1  # m: what a sub-step covers, at most


def test_a_start_is_taken_onto_the_torus(straight):
    simulator = Simulator(1)
    for _ in range(2):  # the second time after a step
        simulator.reset(straight, np.array([[-4.0, 32.0 + 128.0, math.pi / 2, 7.0, 0.1]]))
        car = simulator.cars[0].copy()
        simulator.step(np.array([Action.ACCELERATE_LEFT]))
    assert (car[X], car[Y]) == (1020.0, 32.0)
    assert (car[COS], car[SIN]) == pytest.approx((0.0, 1.0), abs=1e-6)
    assert (car[SPEED], car[STEERING]) == (7.0, F(0.1))
    assert not car[[DISTANCE, PACED, ODOMETER, IDLE, STEPS]].any()


def test_cars_that_begin_without_traffic_have_none():
    scenario = build("curved", 0)
    starts = sample_starts(scenario, 4, np.random.default_rng(0))
    worlds = spawn(scenario.network, starts, 3, np.arange(4, dtype=np.uint64), CONFIG)
    simulator = Simulator(4, traffic=3)
    with pytest.raises(ValueError, match="there are 4 cars, not"):
        simulator.reset(scenario, starts[:3])
    simulator.reset(scenario, starts, worlds=worlds)
    assert (simulator.worlds[:, :, LANE] >= 0).any()
    simulator.reset(scenario, starts[:2], cars=np.array([0, 1]))
    assert (simulator.worlds[:2, :, LANE] < 0).all()
    assert (simulator.worlds[2:] == worlds[2:]).all()
