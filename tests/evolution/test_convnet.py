"""Convolutional networks against PyTorch in float64, and grid policies in the rollout."""

import math

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evolution.episodes.rollout import Limits, evaluate, trajectory
from evolution.episodes.starts import lane_starts
from evolution.networks import convnet
from evolution.networks.dense import plain_dense, plain_tile, vector_dense, vector_tile
from evolution.networks.policy import CnnSpec, PolicySpec
from evolution.search.breeding import RECIPE, Kind, Mutation, breed
from gridsim.car.ego import DISTANCE, STEPS, End
from gridsim.config import SensorConfig, SimConfig
from gridsim.envs.simulator import Simulator
from gridsim.maps.scenarios import build
from gridsim.sensing.grid import grid_table, grids, push_frames

torch = pytest.importorskip("torch")

F = np.float32
TEXTS = ["cnn:8,8,8@1", "cnn:8,16,32@1", "cnn:16,24,40@2", "cnn:24,32,64@3", "cnn"]


@numba.njit
def outputs_of(genome, layers, grids, speed, room):
    for k in range(grids.shape[0]):
        convnet.push(grids[k], False, room)
    convnet.forward(genome, layers, speed, room)
    return room.outputs.copy()


@numba.njit
def decide(genome, layers, speed, room):
    return convnet.decide(genome, layers, speed, room)


@numba.njit
def push(grid, begun, room):
    convnet.push(grid, begun, room)


def cnn(text):
    spec = PolicySpec.parse(text)
    assert isinstance(spec, CnnSpec)
    return spec


def new_genomes(spec, n, seed=1):
    recipes = np.zeros(n, dtype=RECIPE)
    recipes["kind"], recipes["seed"] = Kind.NEW, np.arange(n)
    return breed(np.zeros((0, spec.size), dtype=F), recipes, seed, spec, Mutation())


def random_grids(n, rng):
    """Grids of random ranges, uint8 [n, 80, 80]."""
    return grids(grid_table(SimConfig()), np.minimum(rng.uniform(0, 70, (n, 31)), 50).astype(F))


def in_torch(spec, genome, frames, speed):
    """The textbook: float64 in PyTorch's own layers. frames uint8 [frames, 80, 80]."""
    first, second, dense = spec.hidden
    genes = torch.from_numpy(genome.astype(np.float64))
    at = 0

    def take(*shape):
        nonlocal at
        part = genes[at : at + math.prod(shape)].reshape(shape)
        at += math.prod(shape)
        return part

    x = torch.from_numpy(frames.astype(np.float64) / 255)[None]
    weights = take(spec.frames, 8, 8, first).permute(3, 0, 1, 2)
    x = torch.relu(torch.nn.functional.conv2d(x, weights, take(first), stride=4))
    weights = take(4, 4, first, second).permute(3, 2, 0, 1)
    x = torch.relu(torch.nn.functional.conv2d(x, weights, take(second), stride=2))
    assert x.shape == (1, second, 8, 8)
    x = torch.cat([x.permute(0, 2, 3, 1).flatten(), torch.tensor([speed / 10.0 - 1.0], dtype=torch.float64)])
    weights = take(8 * 8 * second + 1, dense)
    x = torch.relu(x @ weights + take(dense))
    weights = take(dense, 8)
    x = x @ weights + take(8)
    assert at == spec.size
    return x.numpy()


@pytest.mark.parametrize("text", TEXTS)
def test_forward_is_pytorchs(text):
    spec = cnn(text)
    rng = np.random.default_rng(2)
    room = convnet.scratch(spec)
    for genome in new_genomes(spec, 4):
        frames, speed = random_grids(spec.frames, rng), rng.uniform(-3, 30)
        seen = outputs_of(genome, spec.layers, frames.reshape(spec.frames, -1), F(speed), room)
        expected = in_torch(spec, genome, frames, float(F(speed)))
        assert np.abs(expected).max() > 1e-3
        assert seen == pytest.approx(expected, abs=2e-5 * max(1.0, np.abs(expected).max()))
        assert decide(genome, spec.layers, F(speed), room) == int(seen.argmax())


@pytest.mark.parametrize(("positions", "lanes"), [(10, 8), (8, 16), (1, 8), (1, 32)])
@pytest.mark.parametrize("rectify", [False, True])
def test_vector_code_is_the_plain_tile(positions, lanes, rectify):
    plain, vector = plain_tile(positions, lanes, rectify), vector_tile(positions, lanes, rectify)

    @numba.njit
    def compiled(x, w, y):
        vector(x, 3, 2, 2, 50, 3, 11, 5, w, 1, lanes + 4, 2, y, 6, lanes + 1)

    rng = np.random.default_rng(3)
    x, w = rng.normal(size=300).astype(F), rng.normal(size=2 + 31 * (lanes + 4)).astype(F)
    wanted, seen = (np.full(20 + positions * (lanes + 1), 7.0, dtype=F) for _ in range(2))
    plain(x, 3, 2, 2, 50, 3, 11, 5, w, 1, lanes + 4, 2, wanted, 6, lanes + 1)
    compiled(x, w, seen)
    assert seen == pytest.approx(wanted, abs=1e-4)
    assert (seen == 0).any() == rectify
    x[4] = math.nan
    compiled(x, w, seen)
    assert np.isnan(seen).any()


@pytest.mark.parametrize(("lanes", "chains"), [(64, 1), (16, 2), (8, 4)])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 31, 32])
def test_vector_code_is_the_plain_dense_layer(lanes, chains, n):
    plain, vector = plain_dense(lanes, chains), vector_dense(lanes, chains)

    @numba.njit
    def compiled(x, n, w, y):
        vector(x, 3, n, w, 5 + lanes, lanes + 8, 2, y, 6)

    rng = np.random.default_rng(3)
    x, w = rng.normal(size=40).astype(F), rng.normal(size=5 + lanes + 33 * (lanes + 8)).astype(F)
    wanted, seen = (np.full(lanes + 13, 7.0, dtype=F) for _ in range(2))
    plain(x, 3, n, w, 5 + lanes, lanes + 8, 2, wanted, 6)
    compiled(x, n, w, seen)
    assert seen == pytest.approx(wanted, abs=2e-5)
    assert (seen[:6] == 7.0).all()
    assert (seen[-7:] == 7.0).all()
    rows = w[5 + lanes :][: n * (lanes + 8)].reshape(n, lanes + 8)[:, :lanes].astype(float)
    assert seen[6:-7] == pytest.approx(w[2 : 2 + lanes] + x[3 : 3 + n] @ rows, abs=2e-5)
    for k in range(n):
        spoilt = x.copy()
        spoilt[3 + k] = math.nan
        compiled(spoilt, n, w, seen)
        assert np.isnan(seen[6:-7]).all()


def test_a_gene_that_is_not_a_number_is_no_action():
    spec = cnn("cnn:8,8,16@1")
    rng = np.random.default_rng(4)
    genome, room = new_genomes(spec, 1)[0], convnet.scratch(spec)
    room.frames[:] = rng.uniform(0.1, 1, room.frames.size)
    assert decide(genome, spec.layers, F(5), room) >= 0
    let_through = []
    for gene in [*range(0, spec.size, 37), *range(spec.size - 140, spec.size)]:
        spoilt = genome.copy()
        spoilt[gene] = math.nan
        if decide(spoilt, spec.layers, F(5), room) == -1:
            continue
        # A weight whose input is exactly 0, a rectified unit, still makes the sum not a number.
        let_through.append(gene)
    assert let_through == []
    assert decide(genome, spec.layers, F(5), room) >= 0  # and nothing of it stays


def test_the_first_of_equal_outputs_acts():
    spec = cnn("cnn:8,8,8@1")
    genome, room = np.zeros(spec.size, dtype=F), convnet.scratch(spec)
    assert decide(genome, spec.layers, F(0), room) == 0
    genome[-3:] = 1.0
    assert decide(genome, spec.layers, F(0), room) == 5


@given(begins=st.lists(st.booleans(), min_size=1, max_size=8))
@settings(max_examples=20, derandomize=True, deadline=None)
def test_frames_are_the_last_ones_newest_last(begins):
    spec = cnn("cnn:8,8,8@3")
    room = convnet.scratch(spec)
    rng = np.random.default_rng(5)
    stack = np.zeros((1, 3, 80, 80), dtype=np.uint8)
    for k, begun in enumerate(begins):
        new = random_grids(1, rng)
        push(new[0].ravel(), begun or k == 0, room)
        push_frames(stack, new, np.array([begun or k == 0]))
    assert room.frames == pytest.approx(stack.ravel() / 255, abs=1e-6)


# --- In the rollout --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def task():
    maps = [build("seamless", seed) for seed in (1, 2)]
    episodes, _ = lane_starts(maps, np.arange(6) % 2, np.random.default_rng(6))
    episodes["start"][:, 3] = 6.0
    return maps, episodes


def by_hand(spec, genome, scenario, start, limits, config):
    """One episode, step by step through the simulator, its grids and `act_on`."""
    simulator = Simulator([scenario], 1, config, target=limits.target, max_steps=limits.steps)
    table = grid_table(config)
    ranges, speeds = simulator.reset(start[None])
    stack = np.zeros((1, spec.frames, 80, 80), dtype=np.uint8)
    push_frames(stack, grids(table, ranges), np.array([True]))
    while not simulator.state.ends[0]:
        action = convnet.act_on(spec, genome, stack[0, 0] if spec.frames == 1 else stack[0], speeds[0])
        ranges, speeds, _, _ = simulator.step(np.array([action]))
        push_frames(stack, grids(table, ranges), np.array([False]))
    return simulator.state


@pytest.mark.parametrize("text", ["cnn:8,8,16@1", "cnn:8,8,8@4"])
def test_a_rollout_is_the_simulator_the_grid_and_the_network(task, text):
    maps, episodes = task
    spec, limits, config = cnn(text), Limits(60.0, 80), SimConfig()
    genomes = new_genomes(spec, 24)
    results, _, _ = evaluate(spec, genomes, maps, episodes, limits, config)
    longest = np.argsort(-results["steps"].sum(axis=1))[:3]
    assert results["steps"][longest].max() > 20
    for member in longest:
        for row, episode in zip(results[member], episodes, strict=True):
            scenario = maps[episode["map"]]
            state = by_hand(spec, genomes[member], scenario, episode["start"], limits, config)
            assert (row["steps"], row["end"]) == (state.cars[0, 11], state.ends[0])
            assert row["distance"] == state.cars[0, DISTANCE]
    one, states, _ = trajectory(spec, genomes[longest[0]], maps[0], episodes[0]["start"], limits, config)
    assert one == results[longest[0], 0]
    assert len(states) == one["steps"] + 1  # the last is where it ended
    assert (states[-1, DISTANCE], states[-1, STEPS]) == (one["distance"], one["steps"])


@given(data=st.data())
@settings(max_examples=10, derandomize=True, deadline=None)
def test_results_do_not_depend_on_the_chunk(task, data):
    maps, episodes = task
    spec, limits, config = cnn("cnn:8,8,8@2"), Limits(80.0, 100), SimConfig()
    genomes = new_genomes(spec, 12, seed=8)
    episodes = episodes.copy()
    episodes["rewind"] = 8
    whole, rewound, _ = evaluate(spec, genomes, maps, episodes, limits, config)
    members = data.draw(st.lists(st.integers(0, 11), min_size=1, max_size=5))
    columns = data.draw(st.lists(st.integers(0, 5), min_size=1, max_size=4))
    part, back, _ = evaluate(spec, genomes[members], maps, episodes[columns], limits, config)
    assert part.tobytes() == whole[np.ix_(members, columns)].tobytes()
    assert back.tobytes() == rewound[np.ix_(members, columns)].tobytes()


def test_a_rewound_state_is_on_the_way(task):
    maps, episodes = task
    spec, limits, config = cnn("cnn:8,8,8@1"), Limits(80.0, 100), SimConfig()
    genomes = new_genomes(spec, 16, seed=9)
    wanted = episodes.copy()
    wanted["rewind"] = 10
    results, rewound, _ = evaluate(spec, genomes, maps, wanted, limits, config)
    member, column = np.unravel_index(results["steps"].argmax(), results.shape)
    steps = int(results["steps"][member, column])
    assert steps > 20
    episode = episodes[column]
    _, states, _ = trajectory(spec, genomes[member], maps[episode["map"]], episode["start"], limits, config)
    assert rewound[member, column, :2] == pytest.approx(states[steps - 10, :2])
    assert rewound[member, column, 3] == states[steps - 10, 4]


def test_an_episodes_own_target_and_steps_count(task):
    maps, episodes = task
    episodes = episodes.copy()
    episodes["steps"][:3] = 5
    spec = cnn("cnn:8,8,8@1")
    results, _, _ = evaluate(spec, new_genomes(spec, 8), maps, episodes, Limits(500.0, 50), SimConfig())
    assert results["steps"][:, :3].max() == 5
    assert (results["end"][:, :3] == End.TIME).any()
    assert results["steps"][:, 3:].max() > 5


def test_a_genome_that_is_not_a_number_stands_still(task):
    maps, episodes = task
    spec = cnn("cnn:8,8,8@1")
    results, _, _ = evaluate(spec, np.full((1, spec.size), np.nan, F), maps, episodes, Limits(80.0, 100), SimConfig())
    assert (results["steps"] == 0).all()
    assert (results["end"] == End.IDLE).all()


def test_the_grid_is_there_for_any_number_of_rays(task):
    maps, episodes = task
    spec, config = cnn("cnn:8,8,8@1"), SimConfig(sensors=SensorConfig(rays=61))
    results, _, _ = evaluate(spec, new_genomes(spec, 4), maps, episodes, Limits(80.0, 100), config)
    assert (results["steps"] > 0).all()


# --- Acting on an environment's observations -------------------------------------------------------------------------


def test_act_on_takes_one_or_many():
    rng = np.random.default_rng(7)
    for text in ("cnn:8,16,32@1", "cnn:8,8,8@4"):
        spec = cnn(text)
        genome = new_genomes(spec, 1)[0]
        stack = random_grids(5 * spec.frames, rng).reshape(5, spec.frames, 80, 80)
        stack = stack[:, 0] if spec.frames == 1 else stack
        speeds = rng.uniform(0, 20, 5).astype(F)
        actions = np.asarray(convnet.act_on(spec, genome, stack, speeds))
        assert actions.shape == (5,)
        for grid, speed, action in zip(stack, speeds, actions, strict=True):
            assert convnet.act_on(spec, genome, grid, float(speed)) == action


@pytest.mark.parametrize(
    ("text", "shape", "kind"),
    [
        ("cnn:8,8,8@1", (4, 80, 80, 1), np.uint8),
        ("cnn:8,8,8@4", (80, 80), np.uint8),
        ("cnn:8,8,8@4", (3, 80, 80), np.uint8),
        ("cnn:8,8,8@1", (80, 80), np.float32),
        ("cnn:8,8,8@1", (32,), np.float32),
    ],
)
def test_other_observations_are_refused(text, shape, kind):
    spec = cnn(text)
    with pytest.raises(ValueError, match=r"^cnn:8,8,8@\d sees grids uint8"):
        convnet.act_on(spec, np.zeros(spec.size, F), np.zeros(shape, kind), 1.0)
