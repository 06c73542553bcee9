"""Episodes: how the task grows, and fused loops that agree with `Simulator` step by step; nothing is mixed up."""

import math
from collections import namedtuple

import numpy as np
import pytest
from oracle import corners
from pictures import cars_on
from scipy import stats
from searching import to_bytes

from cluster.store.champion import load_champion
from cluster.workers.worker import Task, Worker
from evolution.dqn.experience import NO_ACTION, Experience, ages, join, unpack
from evolution.episodes.curriculum import Curriculum, CurriculumConfig
from evolution.episodes.rollout import EPISODE, RESULT, collect, evaluate, trajectory
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec, act_on
from evolution.search.breeding import RECIPE, Mutation
from gridsim.config import EpisodeConfig, SimConfig
from gridsim.maps.scenarios import build
from gridsim.sensing.grid import grid_table, grids
from gridsim.sensing.observation import encoding, normalise
from gridsim.simulator import Simulator
from gridsim.state import (
    ALONG,
    CLOCK,
    COS,
    LANE,
    ROUTE_KEY,
    ROUTE_LANE,
    SHIFT,
    SIN,
    SPEED,
    START_FIELDS,
    STEERING,
    TRAFFIC_FIELDS,
    End,
    X,
    Y,
)  # fmt: skip

F = np.float32
CONFIG = SimConfig()
CARS = 8
TARGET, STEPS = 1000.0, 1700


def actions_of(spec, genome, simulator):
    """How a genome drives the cars of a `Simulator`."""
    return act_on(spec, genome, simulator.observations, CONFIG)


@pytest.fixture(scope="module")
def among(root):
    """(spec, genome, maps, episodes, worlds, trajectory of each): a trained driver on three kinds of road."""
    champion = load_champion(root / "benchmarks" / "champion_traffic.npz")
    spec = PolicySpec.parse(champion.policy)
    maps = [build("seamless", 3), build("highway", 4), build("city", 5)]
    episodes, worlds = lane_starts(maps, np.arange(9) % 3, np.random.default_rng(18), CARS)
    episodes["target"], episodes["steps"] = TARGET, STEPS
    paths = [
        trajectory(spec, champion.genome, maps[e["map"]], e["start"].copy(), TARGET, STEPS, CONFIG, w)
        for e, w in zip(episodes, worlds, strict=True)
    ]
    # Worth comparing: crashes, successes, a lane change.
    assert {int(row["end"]) for row, _, _ in paths} >= {End.COLLISION, End.SUCCESS}
    assert any((traffic[..., SHIFT] != 0).any() for _, _, traffic in paths)
    return spec, champion.genome, maps, episodes, worlds, paths


def test_the_same_world_alone_in_a_batch_and_in_a_worker(among):
    """Bit for bit: the fused rollout, a worker, and `Simulator.step` with one car or nine on three maps."""
    spec, genome, maps, episodes, worlds, paths = among
    results, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, worlds)
    assert results.tobytes() == np.array([[row for row, _, _ in paths]], dtype=RESULT).tobytes()
    recipes = np.zeros(3, dtype=RECIPE)
    names = tuple((scenario.name, scenario.seed) for scenario in maps)
    task = Task("mlp:6,7", episodes.copy(), worlds.copy(), names, CONFIG, genome[None].copy(), 0, Mutation())
    shared, _, _ = Worker().evaluate(task, maps, recipes)
    assert all(row.tobytes() == results[0].tobytes() for row in shared)

    for cars in (np.arange(9), np.array([4])):
        simulator = Simulator(len(cars), CONFIG, TARGET, STEPS, traffic=CARS)
        simulator.reset([maps[m] for m in episodes["map"][cars]], episodes["start"][cars], worlds=worlds[cars])
        for step in range(1 + max(int(paths[k][0]["steps"]) for k in cars)):
            for i, k in enumerate(cars):
                row, states, traffic = paths[k]
                at = min(step, int(row["steps"]))
                assert simulator.cars[i].tobytes() == states[at].tobytes()
                assert simulator.worlds[i].tobytes() == traffic[at].tobytes()
            simulator.step(actions_of(spec, genome, simulator))
        assert simulator.ends.tolist() == [int(paths[k][0]["end"]) for k in cars]


def as_start(car):
    """About the start, as in EPISODE, of a car's state."""
    return pytest.approx(
        [*car[[X, Y]], math.atan2(car[SIN], car[COS]), *car[[SPEED, STEERING, ROUTE_LANE, ROUTE_KEY, CLOCK]]]
    )


def test_what_is_rewound_goes_on_as_it_did(among):
    """Car and world of so many steps before the end, or of the start, which change no result, end alike once more."""
    spec, genome, maps, episodes, worlds, paths = among
    both = np.stack([genome, np.full_like(genome, np.nan)])  # whose episodes end before their first step
    plain, starts, then = evaluate(spec, both, maps, episodes, CONFIG, worlds)
    assert (starts.shape, then.shape) == ((2, 0, START_FIELDS), (2, 0, *worlds.shape[1:]))
    crashed = [int(row["end"]) == End.COLLISION for row, _, _ in paths]
    wanted = episodes.copy()
    wanted["rewind"] = np.where(crashed, 64, [0, 1, 5000, 1, 5000, 0, 5000, 0, 1])
    results, starts, then = evaluate(spec, both, maps, wanted, CONFIG, worlds)
    assert results.tobytes() == plain.tobytes()
    kept = np.flatnonzero(wanted["rewind"])
    assert (starts.shape, then.shape) == ((2, len(kept), START_FIELDS), (2, len(kept), *worlds.shape[1:]))
    for start, world, k in zip(starts[1], then[1], kept, strict=True):
        assert start == as_start(paths[k][1][0])
        assert world.tobytes() == worlds[k].tobytes()
    for start, world, k in zip(starts[0], then[0], kept, strict=True):
        row, states, traffic = paths[k]
        last = int(row["steps"])
        first = max(last - int(wanted["rewind"][k]), 0)
        assert world.tobytes() == traffic[first].tobytes()
        assert start == as_start(states[first])
        if not crashed[k]:
            continue
        original, again = (Simulator(1, CONFIG, TARGET, STEPS, traffic=CARS) for _ in range(2))
        road_map = maps[episodes["map"][k]]
        original.reset(road_map, episodes["start"][k : k + 1], worlds=worlds[k : k + 1])
        again.reset(road_map, start[None], worlds=world[None])
        for step in range(last):
            action = actions_of(spec, genome, original)
            original.step(action)
            if step >= first:
                assert not again.ends[0]
                again.step(action)
                # A start has an angle where the state has its cosine and sine: what differs is rounding.
                assert (again.worlds[0, :, LANE] == traffic[step + 1][:, LANE]).all()
                assert again.worlds[0, :, ALONG] == pytest.approx(traffic[step + 1][:, ALONG], abs=1e-2)
        assert again.ends[0] == End.COLLISION


def test_what_is_rewound_of_an_episode_without_a_step_is_its_start(among):
    spec, genome, maps, episodes, worlds, _ = among
    wanted = episodes[:1].copy()
    wanted["rewind"], wanted["steps"] = 40, 60
    both = np.stack([genome, np.full_like(genome, math.nan)])
    results, starts, then = evaluate(spec, both, maps, wanted, CONFIG, worlds[:1])
    assert results["steps"].tolist() == [[60], [0]]
    assert starts[1, 0] == pytest.approx(wanted["start"][0] % [256, 256, 2 * math.pi, 99, 99, 99, 99, 99], abs=1e-4)
    assert then[1].tobytes() == worlds[:1].tobytes()


def test_figures_of_comfort_are_those_of_the_states_driven(among):
    spec, genome, maps, episodes, worlds, paths = among
    plain, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, worlds)
    results, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, worlds, with_comfort=True)
    names = ["distance", "paced", "steps", "end"]
    assert results[names].tolist() == plain[names].tolist()
    dt, length, width = 0.1, 4.0, 2.0
    for result, road, (_, states, traffic) in zip(results[0], episodes["map"], paths, strict=True):
        cars, others = states.astype(float), traffic.astype(float)
        heading, speed = np.unwrap(np.arctan2(cars[:, SIN], cars[:, COS])), cars[:, SPEED]
        across, along = np.diff(heading) / dt * (speed[1:] + speed[:-1]) / 2, np.diff(speed) / dt
        assert result["lateral"] == pytest.approx(np.mean(across**2), rel=1e-3)
        assert result["lateral_peak"] == pytest.approx(np.abs(across).max(), rel=1e-3)
        jerks = np.diff(across) ** 2 + np.diff(along) ** 2
        assert result["jerk"] == pytest.approx(np.mean(jerks) / dt**2, rel=1e-3)
        away, there = others[1:, :, [X, Y]] - cars[1:, None, [X, Y]], others[1:, :, LANE] >= 0
        away -= np.round(away / maps[road].size) * maps[road].size
        angles = [np.arctan2(part[..., SIN], part[..., COS]) for part in (cars[1:, None], others[1:])]
        own, theirs = (
            corners(np.dstack([x, y, h]).reshape(-1, 3), length / 2, width / 2)
            for x, y, h in ((0 * there, 0 * there, angles[0] + 0 * there), (*away.transpose(2, 0, 1), angles[1]))
        )
        gaps = np.full(there.size, -np.inf)
        for h in angles:
            for turn in (0.0, math.pi / 2):
                axis = np.stack([np.cos(h + turn), np.sin(h + turn)], -1) + 0 * away
                a, b = (part @ axis.reshape(-1, 2, 1) for part in (own, theirs))
                gaps = np.maximum(gaps, np.maximum(b.min((1, 2)) - a.max((1, 2)), a.min((1, 2)) - b.max((1, 2))))
        assert result["gap"] == pytest.approx(max(gaps[there.ravel()].min(), 0.0), abs=2e-3)
        unit = np.stack([np.cos(angles[0]), np.sin(angles[0])], -1)
        ahead, aside = (away * unit).sum(-1), np.abs(away[..., 1] * unit[..., 0] - away[..., 0] * unit[..., 1])
        close = (there & (ahead > 0) & (aside < width) & (ahead - length < speed[1:, None])).any(axis=1)
        assert result["close"] == pytest.approx(close.sum() * dt, abs=2.1 * dt)
    assert results["close"].max() > 0.3
    assert not plain["lateral"].any()
    alone, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, worlds[:, :0], with_comfort=True)
    assert np.isinf(alone["gap"]).all()


def test_without_room_for_anybody_there_is_no_traffic(among):
    spec, genome, maps, episodes, _, _ = among
    absent = np.zeros((9, CARS, TRAFFIC_FIELDS), dtype=F)
    absent[..., LANE] = -1.0
    alone, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, absent[:, :0])
    results, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, absent)
    assert results.tobytes() == alone.tobytes()


# --- Collecting ------------------------------------------------------------------------------------------------------

GOAL, MOST = 120.0, 150  # m and steps of its episodes

# The arguments of `collect`, in its order.
Asked = namedtuple("Asked", "spec weights scenarios episodes epsilons keys config worlds")


@pytest.fixture(scope="module")
def ask(root):
    """Makes arguments for `n` episodes; of a `mlp:6,7` the weights are a trained driver's."""
    driver = load_champion(root / "benchmarks" / "champion_traffic.npz").genome
    scenarios = [build("seamless", 3), build("highway", 4)]

    def make(policy, n, epsilon, cars):
        rng = np.random.default_rng(5)
        spec = PolicySpec.parse(policy)
        weights = driver if policy == "mlp:6,7" else (rng.normal(size=spec.size) * 0.3).astype(F)
        episodes, worlds = lane_starts(scenarios, np.arange(n) % len(scenarios), rng, cars)
        episodes["target"], episodes["steps"] = GOAL, MOST
        keys = rng.integers(1 << 63, size=n, dtype=np.uint64)
        return Asked(spec, weights, scenarios, episodes, np.full(n, epsilon, F), keys, CONFIG, worlds)

    return make


def only(of, which):
    rows = np.array(which, dtype=int)
    return of._replace(**{name: getattr(of, name)[rows] for name in ("episodes", "epsilons", "keys", "worlds")})


def cut_up(experience):
    ends = np.flatnonzero(experience.actions == NO_ACTION) + 1
    assert ends[-1] == len(experience.actions)
    return [Experience(*parts) for parts in zip(*(np.split(array, ends[:-1]) for array in experience), strict=True)]


def inputs_of(simulator):
    """What the environment shows of its one car, as a network with these inputs reads it."""
    inputs = np.zeros(simulator.observations.shape[1], dtype=F)
    normalise(encoding(simulator.features), simulator.observations[0], inputs)
    return inputs


@pytest.mark.parametrize("cars", [0, CARS])
@pytest.mark.parametrize("policy", ["mlp:5+motion+steering", "mlp:5+route", "cnn:8,8,16@3"])
def test_every_row_is_what_the_simulator_shows_for_these_actions(ask, policy, cars):
    of = ask(policy, 8, 0.3, cars)
    experience, results = collect(*of)
    inputs = unpack(of.spec, experience.observations, np.arange(len(experience.actions)), ages(experience))
    row, table = 0, grid_table(CONFIG)
    for episode, world, result in zip(of.episodes, of.worlds, results, strict=True):
        road = of.scenarios[episode["map"]]
        simulator = Simulator(1, CONFIG, GOAL, MOST, traffic=cars, features=of.spec.features)
        simulator.reset(road, episode["start"][None], worlds=world[None] if cars else None)
        ranges, ends = simulator.ranges, simulator.ends
        for step in range(int(result["steps"]) + 1):
            seen = inputs_of(simulator)
            shown = seen if policy[:3] == "mlp" else np.append(grids(table, ranges) / F(255.0), seen[-1])
            assert np.abs(inputs[row, -len(shown) :] - shown).max() < 0.6 / 4096
            row += 1
            if step == result["steps"]:
                assert (experience.actions[row - 1], experience.rewards[row - 1]) == (NO_ACTION, 0.0)
                break
            rewards = simulator.step(experience.actions[row - 1 : row].astype(int))
            assert experience.rewards[row - 1] == pytest.approx(rewards[0], abs=2e-6)
            assert experience.ends[row - 1] == ends[0]
        assert ends[0] == result["end"]
    assert row == len(experience.actions) > 150


def test_a_network_reads_the_closing_speeds_that_the_environment_shows():
    """Also those above the 30 m/s at which an observation ends: of a car that comes at 25 m/s."""
    road, spec = build("highway", 4), PolicySpec.parse("mlp:3+motion+steering")
    world = cars_on(road.network, (1, 10.0, 25.0, 1.0))
    episode = np.zeros(1, dtype=EPISODE)
    episode["target"], episode["steps"] = TARGET, 1
    episode["start"][0, :2] = world[0, [X, Y]] + 20.0 * world[0, [COS, SIN]]
    episode["start"][0, 2:4] = math.atan2(world[0, SIN], world[0, COS]) + math.pi, 20.0
    genome = np.ones(spec.size, F)
    experience, _ = collect(spec, genome, [road], episode, np.zeros(1, F), np.zeros(1, np.uint64), CONFIG, world[None])
    simulator = Simulator(1, CONFIG, TARGET, 1, traffic=1, features=spec.features)
    simulator.reset(road, episode["start"], worlds=world[None])
    assert simulator.closing.max() == pytest.approx(45.0, abs=0.1)
    np.testing.assert_allclose(experience.observations[0] / 4096, inputs_of(simulator), rtol=0.0, atol=0.6 / 4096)


@pytest.mark.parametrize("cars", [0, CARS])
@pytest.mark.parametrize("policy", ["mlp:6,7", "mlp:5+motion+steering", "cnn:8,8,16@3"])
def test_without_exploring_it_is_evaluate(ask, policy, cars):
    of = ask(policy, 12, 0.0, cars)
    _, results = collect(*of)
    wanted, _, _ = evaluate(of.spec, of.weights[None], of.scenarios, of.episodes, CONFIG, of.worlds)
    assert results.tobytes() == wanted[0].tobytes()
    assert results["steps"].sum() > 100


def test_all_ends_are_flagged_once_each_and_an_episodes_own_limits_count(ask):
    of = ask("mlp:6,7", 60, 0.1, 0)
    of.epsilons[1::2] = 0.8
    of.episodes["steps"][::3] = 40
    of.episodes["target"][::5] = 25.0
    experience, results = collect(*of)
    for episode, row, result in zip(cut_up(experience), of.episodes, results, strict=True):
        steps, most = len(episode.actions) - 1, row["steps"]
        assert steps == result["steps"] <= most
        assert episode.ends.tolist() == [0] * (steps - 1) + [int(result["end"]), 0]
        assert (episode.actions[:-1] < 8).all()
        assert (episode.rewards[:-1] == -1.0).tolist() == [False] * (steps - 1) + [result["end"] == End.COLLISION]
        assert (result["end"] == End.TIME) <= (steps == most)
        assert (result["end"] == End.SUCCESS) == (result["distance"] >= row["target"])
    assert set(results["end"]) == {End.COLLISION, End.IDLE, End.SUCCESS, End.TIME}


def test_random_actions_are_uniform_and_as_many_as_asked_for(ask):
    of = ask("mlp:6,7", 600, 1.0, 0)
    counts = np.bincount(collect(*of)[0].actions, minlength=256)[:8]
    assert counts.sum() > 8000
    assert stats.chisquare(counts).pvalue > 1e-4
    still = np.zeros_like(of.weights)
    still[-8 + 4] = 1.0  # always action 4
    mixed, _ = collect(*of._replace(weights=still, epsilons=np.full(600, 0.25, F)))
    driven = mixed.actions[mixed.actions != NO_ACTION]
    assert np.mean(driven != 4) == pytest.approx(0.25 * 7 / 8, abs=5 * math.sqrt(0.22 * 0.78 / len(driven)))


def test_an_episode_depends_on_itself_alone(ask):
    """In any order, alone or in company, and with epsilons of its own; another key, another episode."""
    of = ask("mlp:6,7", 12, 0.0, CARS)
    of.epsilons[:] = np.linspace(0.0, 1.0, 12)
    whole, results = collect(*of)
    singles = [collect(*only(of, [k])) for k in range(12)]
    assert to_bytes(join([x for x, _ in singles])) == to_bytes(whole)
    assert np.concatenate([r for _, r in singles]).tobytes() == results.tobytes()
    order = np.random.default_rng(0).permutation(12).tolist()
    assert to_bytes(collect(*only(of, order))[0]) == to_bytes(join([singles[k][0] for k in order]))
    others, _ = collect(*of._replace(keys=of.keys + np.uint64(1)))
    changed = [to_bytes(a) != to_bytes(b) for a, b in zip(cut_up(whole), cut_up(others), strict=True)]
    assert not changed[0], "nothing is drawn for epsilon 0"
    assert all(changed[3:])
    assert [len(array) for array in (*collect(*only(of, []))[0], collect(*only(of, []))[1])] == [0] * 5


# --- The curriculum --------------------------------------------------------------------------------------------------


TASK = CurriculumConfig(maps=3, first_maps=2, groups=3, starts=2, crash_starts=2, crash_memory=10, leader_episodes=8)


@pytest.fixture
def curriculum():
    return Curriculum(TASK, 7, lambda seed: build("seamless", seed), CONFIG, (2,))


def test_full_episodes_are_those_of_the_runs_simulator():
    sim = SimConfig(episode=EpisodeConfig(target=30.0, time_limit=20.0, control_period=0.05))
    own = Curriculum(TASK, 7, lambda seed: build("seamless", seed), sim)
    for full in (own.starts(0, 4), own.validation(range(2))):
        assert {(row["target"], row["steps"]) for row in full.rows} == {(30.0, 400)}
    own._limit(full.rows, full.maps, 14.0)
    assert set(full.rows["steps"]) == {math.ceil((14.0 / TASK.pace[0] + TASK.slack) / 0.05)}


def led(curriculum, generation, ends, distance=0.0, steps=50):
    """Results of the leader's episodes with these ends; told to the curriculum."""
    episodes = curriculum.leader_episodes(generation)
    results = np.zeros(len(episodes.rows), dtype=RESULT)
    results["end"], results["distance"], results["steps"] = ends, distance, steps
    rewound = np.repeat(np.arange(len(results), dtype=np.float32)[:, None], START_FIELDS, axis=1) + 100.0 * generation
    curriculum.learn_from_leader(episodes, results, rewound, episodes.worlds)
    return episodes, rewound


@pytest.mark.parametrize(("pace", "share"), [(0.5, 0.5), (1.0, 1.0), (2.0, 1.0)])
def test_a_validation_score_is_the_success_rate_and_less_for_slow_drivers_only(curriculum, pace, share):
    results = np.zeros((2, 4), dtype=RESULT)
    results["steps"], results["distance"] = 100, 100 * curriculum.period * pace * TASK.champion_pace[0]
    results["end"] = [[End.SUCCESS] * 4, [End.SUCCESS, End.COLLISION, End.TIME, End.SUCCESS]]
    scores = [float(curriculum.validation_scores(each)[0]) for each in results]
    assert scores == pytest.approx([share, share / 2])


def test_only_who_crashed_or_stood_still_on_the_way_is_remembered(curriculum):
    ends = [End.COLLISION, End.SUCCESS, End.TIME, End.IDLE, End.COLLISION, End.IDLE, End.SUCCESS, End.TIME]
    steps = [50, 50, 50, 50, 10, 11, 50, 50]  # the fifth crashed at its start
    episodes, rewound = led(curriculum, 0, ends, steps=steps)
    kept = [0, 3, 5]
    assert curriculum.crashes["start"].tobytes() == rewound[kept].tobytes()
    assert curriculum.crash_worlds.tobytes() == episodes.worlds[kept].tobytes()
    seeds = [curriculum.map_seeds[m] for m in curriculum.crashes["map"]]
    assert seeds == [episodes.maps[m] for m in episodes.rows["map"][kept]]
    assert (curriculum.crashes["rewind"] == 0).all()
    latest, _ = led(curriculum, 1, End.COLLISION)
    assert len(curriculum.crashes) == len(curriculum.crash_worlds) == TASK.crash_memory  # the latest
    assert curriculum.crash_worlds[-8:].tobytes() == latest.worlds.tobytes()
    assert curriculum.crashes["start"][-1, 0] == 107.0
    assert curriculum.crashes["start"][0, 0] == 3.0


def test_the_task_doubles_as_the_leader_succeeds(curriculum):
    distance = np.array([150.0] * 4 + [149.0] * 4)
    led(curriculum, 0, End.TIME, distance)
    assert curriculum.target == 150.0  # 4 of 8 are less than 0.6
    distance[4] = 150.0
    led(curriculum, 1, End.TIME, distance)
    assert curriculum.target == 300.0
    for generation in (2, 3):
        led(curriculum, generation, End.TIME, 1e4)
        assert curriculum.target == TASK.last_target


def test_each_group_has_as_many_new_starts_and_crashes(curriculum):
    assert len(curriculum.episodes(0).rows) == 3 * 2
    led(curriculum, 0, End.COLLISION)
    remembered = {crash["start"].tobytes() for crash in curriculum.crashes}
    episodes = curriculum.episodes(1)
    assert len(episodes.rows) == len(episodes.worlds) == 3 * 4
    of_crash = [row["start"].tobytes() in remembered for row in episodes.rows]
    assert of_crash == [False, False, True, True] * 3
    assert (episodes.rows["target"][of_crash] == TASK.crash_target).all()
    assert (episodes.rows["steps"][of_crash] > 0).all()
    assert episodes.maps == sorted(set(episodes.maps))
    for row, world in zip(episodes.rows[of_crash], episodes.worlds[of_crash], strict=True):
        k = next(k for k, crash in enumerate(curriculum.crashes) if crash["start"].tobytes() == row["start"].tobytes())
        assert episodes.maps[row["map"]] == curriculum.map_seeds[curriculum.crashes["map"][k]]
        assert world.tobytes() == curriculum.crash_worlds[k].tobytes()
    assert curriculum.episodes(1).rows.tobytes() == episodes.rows.tobytes()
    assert curriculum.episodes(2).rows.tobytes() != episodes.rows.tobytes()


def test_crashes_that_all_members_avoid_are_seldom_driven_again(curriculum):
    led(curriculum, 0, End.COLLISION)
    easy = curriculum.crashes["start"][4:, 0]

    def crash_starts(generation):
        """Of each group: [3, 2]."""
        return curriculum.episodes(generation).rows["start"].reshape(3, 4, START_FIELDS)[:, 2:, 0]

    for generation in range(1, 40):
        starts = crash_starts(generation)
        results = np.zeros((3, 6, 4), dtype=RESULT)  # of groups, members, episodes
        results["end"] = End.COLLISION
        results["end"][:, ::2, 2:] = End.SUCCESS  # half of the members avoid the hard ones
        results["end"][:, :, 2:][np.broadcast_to(np.isin(starts, easy)[:, None], (3, 6, 2))] = End.SUCCESS
        curriculum.learn_from_members(generation, list(results))
    assert curriculum.failures[:4] == pytest.approx(0.5)
    assert (curriculum.failures[4:] < 0.05).all()
    drawn = np.concatenate([crash_starts(generation) for generation in range(40, 90)])
    # Of 6 starts without repetition, 4 are hard ones nearly always.
    assert 0.58 < 1.0 - np.isin(drawn, easy).mean() < 0.67
    led(curriculum, 1, End.COLLISION)
    assert len(curriculum.failures) == len(curriculum.crashes) == TASK.crash_memory
    assert curriculum.failures[-8:] == pytest.approx(0.5)
