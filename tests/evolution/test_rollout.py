"""Episodes among traffic: the fused rollout, a worker and `Simulator` agree bit for bit."""

import math

import numpy as np
import pytest
from oracle import corners

from cluster.store.champion import load_champion
from cluster.workers.worker import Task, Worker
from evolution.episodes.rollout import RESULT, evaluate, trajectory
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec, act_on
from evolution.search.breeding import RECIPE, Mutation
from gridsim.config import SimConfig, constants
from gridsim.maps.scenarios import build
from gridsim.sensing.observation import observations
from gridsim.simulator import Simulator
from gridsim.state import ALONG, COS, LANE, SHIFT, SIN, SPEED, STEERING, TRAFFIC_FIELDS, End, X, Y

F = np.float32
CONFIG = SimConfig()
K = constants(CONFIG)
CARS = 8
TARGET, STEPS = 1000.0, 1700


def actions_of(spec, genome, simulator):
    """How a genome drives the cars of a `Simulator`."""
    return act_on(spec, genome, observations(K, simulator.ranges, None, simulator.cars, False), CONFIG)


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
        own = [maps[m] for m in episodes["map"][cars]]
        simulator.reset(own, episodes["start"][cars], worlds=worlds[cars])
        for step in range(1 + max(int(paths[k][0]["steps"]) for k in cars)):
            for i, k in enumerate(cars):
                row, states, traffic = paths[k]
                at = min(step, int(row["steps"]))
                assert simulator.cars[i].tobytes() == states[at].tobytes()
                assert simulator.worlds[i].tobytes() == traffic[at].tobytes()
            simulator.step(actions_of(spec, genome, simulator))
        assert simulator.ends.tolist() == [int(paths[k][0]["end"]) for k in cars]


def test_what_is_rewound_goes_on_as_it_did(among):
    """The car and its world are those of so many steps before the end, or of the start; no result depends on it.

    With the same actions they end the same.
    """
    spec, genome, maps, episodes, worlds, paths = among
    both = np.stack([genome, np.zeros_like(genome)])
    plain, starts, then = evaluate(spec, both, maps, episodes, CONFIG, worlds)
    assert (starts.shape, then.shape) == ((2, 0, 5), (2, 0, *worlds.shape[1:]))
    crashed = [int(row["end"]) == End.COLLISION for row, _, _ in paths]
    wanted = episodes.copy()
    wanted["rewind"] = np.where(crashed, 64, [0, 1, 5000, 1, 5000, 0, 5000, 0, 1])
    results, starts, then = evaluate(spec, both, maps, wanted, CONFIG, worlds)
    assert results.tobytes() == plain.tobytes()
    kept = np.flatnonzero(wanted["rewind"])
    assert (starts.shape, then.shape) == ((2, len(kept), 5), (2, len(kept), *worlds.shape[1:]))
    for start, world, k in zip(starts[0], then[0], kept, strict=True):
        row, states, traffic = paths[k]
        last = int(row["steps"])
        first = max(last - int(wanted["rewind"][k]), 0)
        car = states[first]
        assert world.tobytes() == traffic[first].tobytes()
        assert start == pytest.approx([*car[[X, Y]], math.atan2(car[SIN], car[COS]), *car[[SPEED, STEERING]]])
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
    assert starts[1, 0] == pytest.approx(wanted["start"][0] % [256, 256, 2 * math.pi, 99, 99], abs=1e-4)
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
    """All the cars of a world may be missing: everything is as without traffic."""
    spec, genome, maps, episodes, _, _ = among
    absent = np.zeros((9, CARS, TRAFFIC_FIELDS), dtype=F)
    absent[..., LANE] = -1.0
    alone, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, absent[:, :0])
    results, _, _ = evaluate(spec, genome[None], maps, episodes, CONFIG, absent)
    assert results.tobytes() == alone.tobytes()
