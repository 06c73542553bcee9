"""Collecting: the fused loop against `Simulator`, step by step; nothing lost, nothing mixed up."""

import math
from collections import namedtuple

import numpy as np
import pytest
from driving import to_bytes
from pictures import cars_on
from scipy import stats

from cluster.store.champion import load_champion
from evolution.dqn.experience import NO_ACTION, Experience, ages, join, unpack
from evolution.episodes.rollout import EPISODE, collect, evaluate
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec, normalise
from gridsim.config import SimConfig, constants
from gridsim.maps.map import starts_at
from gridsim.maps.scenarios import build
from gridsim.sensing.grid import grid_table, grids
from gridsim.sensing.observation import observations
from gridsim.simulator import Simulator
from gridsim.state import COS, SIN, End, X, Y

F = np.float32
CONFIG = SimConfig()
K = constants(CONFIG)
CARS = 8
TARGET, STEPS = 120.0, 150

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
        episodes["target"], episodes["steps"] = TARGET, STEPS
        keys = rng.integers(1 << 63, size=n, dtype=np.uint64)
        return Asked(spec, weights, scenarios, episodes, np.full(n, epsilon, F), keys, CONFIG, worlds)

    return make


def only(of, which):
    """The same for some episodes."""
    rows = np.array(which, dtype=int)
    return of._replace(**{name: getattr(of, name)[rows] for name in ("episodes", "epsilons", "keys", "worlds")})


def cut_up(experience):
    """Its episodes."""
    ends = np.flatnonzero(experience.actions == NO_ACTION) + 1
    assert ends[-1] == len(experience.actions)
    return [Experience(*parts) for parts in zip(*(np.split(array, ends[:-1]) for array in experience), strict=True)]


def inputs_of(simulator):
    """What the environment shows of its one car, as a network with all inputs reads it."""
    inputs = observations(K, simulator.ranges, simulator.closing, simulator.cars, True)[0]
    normalise(K, 62, inputs)
    return inputs


@pytest.mark.parametrize("cars", [0, CARS])
@pytest.mark.parametrize("policy", ["mlp:5+motion+steering", "cnn:8,8,16@3"])
def test_every_row_is_what_the_simulator_shows_for_these_actions(ask, policy, cars):
    of = ask(policy, 8, 0.3, cars)
    experience, results = collect(*of)
    inputs = unpack(of.spec, experience.observations, np.arange(len(experience.actions)), ages(experience))
    row, table = 0, grid_table(CONFIG)
    for episode, world, result in zip(of.episodes, of.worlds, results, strict=True):
        road = of.scenarios[episode["map"]]
        simulator = Simulator(1, CONFIG, TARGET, STEPS, traffic=cars)
        simulator.reset(road, episode["start"][None], worlds=world[None] if cars else None)
        ranges, ends = simulator.ranges, simulator.ends
        for step in range(int(result["steps"]) + 1):
            seen = inputs_of(simulator)
            shown = seen if policy[:3] == "mlp" else np.append(grids(table, ranges) / F(255.0), seen[62])
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
    episode["start"], episode["target"], episode["steps"] = starts_at(road, np.zeros(1)), TARGET, 1
    episode["start"][0, :2] = world[0, [X, Y]] + 20.0 * world[0, [COS, SIN]]
    episode["start"][0, 2:4] = math.atan2(world[0, SIN], world[0, COS]) + math.pi, 20.0
    genome = np.ones(spec.size, F)
    experience, _ = collect(spec, genome, [road], episode, np.zeros(1, F), np.zeros(1, np.uint64), CONFIG, world[None])
    simulator = Simulator(1, CONFIG, TARGET, 1, traffic=1)
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
