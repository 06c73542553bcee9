"""Episodes among traffic: the fused rollout, a worker and `Simulator` agree bit for bit."""

import math

import numpy as np
import pytest

from cluster.runs.champion import load_champion
from cluster.workers.worker import Task, Worker
from evolution.episodes.rollout import RESULT, Limits, evaluate, trajectory
from evolution.episodes.starts import lane_starts
from evolution.networks.policy import PolicySpec, outputs_of
from evolution.search.breeding import RECIPE, Mutation
from gridsim.car.ego import COS, SIN, SPEED, STEERING, End, X, Y
from gridsim.config import SimConfig
from gridsim.envs.simulator import Simulator
from gridsim.maps.scenarios import build
from gridsim.traffic.world import ALONG, LANE, SHIFT
from gridsim.traffic.world import FIELDS as TRAFFIC_FIELDS

F = np.float32
CONFIG = SimConfig()
CARS = 8
AMONG = Limits(1000.0, 1700)


def actions_of(spec, genome, ranges, speeds):
    """How a genome drives the cars of a `Simulator`."""
    return outputs_of(spec, genome, ranges, ranges, speeds, np.zeros_like(speeds)).argmax(axis=1)


@pytest.fixture(scope="module")
def among(root):
    """(spec, genome, maps, episodes, worlds, trajectory of each): a trained driver on three kinds of road."""
    champion = load_champion(root / "benchmarks" / "champion_traffic.npz")
    spec = PolicySpec.parse(champion.policy)
    maps = [build("seamless", 3), build("highway", 4), build("city", 5)]
    episodes, worlds = lane_starts(maps, np.arange(9) % 3, np.random.default_rng(18), CARS)
    paths = [
        trajectory(spec, champion.genome, maps[e["map"]], e["start"].copy(), AMONG, CONFIG, w)
        for e, w in zip(episodes, worlds, strict=True)
    ]
    # Worth comparing: crashes, successes, a lane change.
    assert {int(row["end"]) for row, _, _ in paths} >= {End.COLLISION, End.SUCCESS}
    assert any((traffic[..., SHIFT] != 0).any() for _, _, traffic in paths)
    return spec, champion.genome, maps, episodes, worlds, paths


def test_the_same_world_alone_in_a_batch_and_in_a_worker(among):
    """Bit for bit: the fused rollout, a worker, and `Simulator.step` with one car or nine on three maps."""
    spec, genome, maps, episodes, worlds, paths = among
    results, _, _ = evaluate(spec, genome[None], maps, episodes, AMONG, CONFIG, worlds=worlds)
    assert results.tobytes() == np.array([[row for row, _, _ in paths]], dtype=RESULT).tobytes()
    recipes = np.zeros(3, dtype=RECIPE)
    names = tuple((scenario.name, scenario.seed) for scenario in maps)
    task = Task("mlp:6,7", episodes.copy(), worlds.copy(), names, AMONG, CONFIG, genome[None].copy(), 0, Mutation())
    shared, _, _ = Worker().evaluate(task, maps, recipes)
    assert all(row.tobytes() == results[0].tobytes() for row in shared)

    for cars in (np.arange(9), np.array([4])):
        simulator = Simulator(maps, len(cars), CONFIG, AMONG.target, AMONG.steps, traffic=CARS)
        ranges, speeds = simulator.reset(episodes["start"][cars], episodes["map"][cars], worlds=worlds[cars])
        for step in range(1 + max(int(paths[k][0]["steps"]) for k in cars)):
            for i, k in enumerate(cars):
                row, states, traffic = paths[k]
                at = min(step, int(row["steps"]))
                assert simulator.state.cars[i].tobytes() == states[at].tobytes()
                assert simulator.state.worlds[i].tobytes() == traffic[at].tobytes()
            ranges, speeds, _, ends = simulator.step(actions_of(spec, genome, ranges, speeds))
        assert ends.tolist() == [int(paths[k][0]["end"]) for k in cars]


def test_what_is_rewound_goes_on_as_it_did(among):
    """64 steps before the end the ego car and its world are those of then, and with the same actions end the same."""
    spec, genome, maps, episodes, worlds, paths = among
    wanted = episodes.copy()
    wanted["rewind"] = 64
    _, starts, then = evaluate(spec, genome[None], maps, wanted, AMONG, CONFIG, worlds)
    compared = 0
    for k, (row, states, traffic) in enumerate(paths):
        first, last = max(int(row["steps"]) - 64, 0), int(row["steps"])
        assert then[0, k].tobytes() == traffic[first].tobytes()
        car = states[first]
        pose = [*car[[X, Y]], math.atan2(car[SIN], car[COS]), *car[[SPEED, STEERING]]]
        assert starts[0, k] == pytest.approx(pose)
        if End(int(row["end"])) != End.COLLISION:
            continue
        compared += 1
        original, again = (
            Simulator([maps[episodes["map"][k]]], 1, CONFIG, AMONG.target, AMONG.steps, traffic=CARS) for _ in range(2)
        )
        ranges, speeds = original.reset(episodes["start"][k : k + 1], worlds=worlds[k : k + 1])
        again.reset(starts[0, k : k + 1], worlds=then[0, k : k + 1])
        for step in range(last):
            action = actions_of(spec, genome, ranges, speeds)
            ranges, speeds, *_ = original.step(action)
            if step >= first:
                assert not again.state.ends[0]
                again.step(action)
                # A start has an angle where the state has its cosine and sine: what differs is rounding.
                assert (again.state.worlds[0, :, LANE] == traffic[step + 1][:, LANE]).all()
                assert again.state.worlds[0, :, ALONG] == pytest.approx(traffic[step + 1][:, ALONG], abs=1e-2)
        assert again.state.ends[0] == End.COLLISION
    assert compared


def test_only_episodes_that_ask_for_it_are_rewound_and_no_result_depends_on_it(among):
    """Each as far back as it says; a longer way than it drove is back to its start."""
    spec, genome, maps, episodes, worlds, paths = among
    both = np.stack([genome, np.zeros_like(genome)])
    plain, starts, then = evaluate(spec, both, maps, episodes, AMONG, CONFIG, worlds)
    assert (starts.shape, then.shape) == ((2, 0, 5), (2, 0, *worlds.shape[1:]))
    some = episodes.copy()
    some["rewind"][[1, 4, 6]] = 1, 64, 5000
    results, starts, then = evaluate(spec, both, maps, some, AMONG, CONFIG, worlds)
    assert results.tobytes() == plain.tobytes()
    assert (starts.shape, then.shape) == ((2, 3, 5), (2, 3, *worlds.shape[1:]))
    for k, (column, back) in enumerate([(1, 1), (4, 64), (6, 5000)]):
        row, states, traffic = paths[column]
        first = max(int(row["steps"]) - back, 0)
        assert then[0, k].tobytes() == traffic[first].tobytes()
        assert starts[0, k, :2] == pytest.approx(states[first][[X, Y]])
    assert starts[0, 2] == pytest.approx(episodes["start"][6], abs=1e-5)


def test_without_room_for_anybody_there_is_no_traffic(among):
    """All the cars of a world may be missing: everything is as without traffic."""
    spec, genome, maps, episodes, _, _ = among
    absent = np.zeros((9, CARS, TRAFFIC_FIELDS), dtype=F)
    absent[..., LANE] = -1.0
    alone, _, _ = evaluate(spec, genome[None], maps, episodes, AMONG, CONFIG, absent[:, :0])
    results, _, _ = evaluate(spec, genome[None], maps, episodes, AMONG, CONFIG, worlds=absent)
    assert results.tobytes() == alone.tobytes()
