"""The Gymnasium environments: exact seeding, how episodes end, wrappers, and errors that can be read."""

import re
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, TimeAwareObservation
from gymnasium.wrappers import RecordEpisodeStatistics as RecordOne
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from gymnasium.wrappers.vector import FlattenObservation as FlattenAll

from evolution.episodes.rollout import EPISODE, Limits, evaluate
from evolution.networks.policy import PolicySpec, decide, encode, pack, packed_size
from gridsim import ENVIRONMENTS
from gridsim.car.ego import End
from gridsim.car.vehicle import Action
from gridsim.config import EpisodeConfig, SimConfig
from gridsim.envs.env import GridSimEnv, GridSimVectorEnv
from gridsim.envs.simulator import Simulator
from gridsim.maps.map import Map, sample_starts, starts_at
from gridsim.maps.roads import clearance, freeze
from gridsim.maps.scenarios import REGISTRY, build

SPEC = PolicySpec.parse("mlp:6,7")
IDS = list(ENVIRONMENTS)


@pytest.fixture(scope="module")
def maps() -> list[Map]:
    """Three maps that several tests share."""
    return [build("seamless", seed) for seed in range(3)]


class Driver:
    """A network at the wheel of every car of a vector environment."""

    def __init__(self, genome: np.ndarray):
        self.layers = SPEC.layers
        self.packed = np.empty(packed_size(self.layers), dtype=np.float32)
        pack(freeze(genome), self.layers, self.packed)
        self.scratch = np.zeros(64, dtype=np.float32)

    def __call__(self, ranges: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        actions = []
        for row, speed in zip(ranges, speeds, strict=True):
            encode(row, None, speed, np.float32(0.0), self.scratch)
            actions.append(decide(self.packed, self.layers, self.scratch))
        return np.array(actions)


def genomes(count: int) -> np.ndarray:
    """Random networks, most of which speed up: float32 [count, genes]."""
    drawn = np.random.default_rng(5).normal(0.0, 0.7, (count, SPEC.size)).astype(np.float32)
    drawn[:, -8] += 1.0
    return drawn


def drive(env: GridSimVectorEnv, actions: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """What a vector environment returns for actions [steps, n]."""
    return [env.step(row)[:4] for row in actions]


# --- the registry


@pytest.mark.parametrize("name", IDS)
def test_make_vec_gives_the_native_environment(name: str) -> None:
    env = gymnasium.make_vec(name, num_envs=3, vectorization_mode="vector_entry_point", maps=1)
    assert isinstance(env.unwrapped, GridSimVectorEnv)
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    observations, _ = env.reset(seed=1)
    assert observations in env.observation_space
    observations, rewards, *_ = env.step(env.action_space.sample())
    assert observations in env.observation_space
    assert rewards.shape == (3,)


def test_every_scenario_has_an_id() -> None:
    assert list(ENVIRONMENTS.values()) == list(REGISTRY)


def test_importing_gridsim_registers_and_loads_no_numba() -> None:
    code = "import sys, gridsim, gymnasium; print('GridSim/City-v0' in gymnasium.registry, 'numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.split() == ["True", "False"]


def test_observations_are_ranges_and_speed(maps: list[Map]) -> None:
    env = GridSimVectorEnv(5, maps=maps)
    env.reset(seed=3)
    observations, _, _, _, info = env.step(np.full(5, Action.ACCELERATE))
    assert observations.dtype == np.float32
    np.testing.assert_allclose(observations[:, :-1] * 50.0, env.ranges, rtol=1e-6)
    np.testing.assert_allclose(observations[:, -1] * 30.0, info["speed_mps"], rtol=1e-6)


# --- seeds


def test_the_same_seed_gives_the_same_episodes_alone_and_in_a_batch_of_64(maps: list[Map]) -> None:
    actions = np.random.default_rng(0).integers(len(Action), size=(150, 64))
    batch = GridSimVectorEnv(64, maps=maps)
    first_seen, _ = batch.reset(seed=100)
    first = drive(batch, actions)
    seen_again, _ = batch.reset(seed=100)
    again = drive(batch, actions)
    np.testing.assert_array_equal(first_seen, seen_again)
    for a, b in zip(first, again, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    assert sum(term.sum() for _, _, term, _ in first) > 64  # some cars are in their second episode or later
    for car in (0, 7, 63):
        env = GridSimEnv(maps=maps)
        observation, _ = env.reset(seed=100 + car)
        np.testing.assert_array_equal(observation, first_seen[car])
        over = False
        for step, row in enumerate(actions):
            if over:
                observation, _ = env.reset()
                reward, term, trunc = 0.0, False, False
            else:
                observation, reward, term, trunc, _ = env.step(row[car])
            over = term or trunc
            np.testing.assert_array_equal(observation, first[step][0][car])
            assert (reward, term, trunc) == tuple(x[car] for x in first[step][1:])


def test_a_reset_without_a_seed_goes_on_and_another_seed_differs(maps: list[Map]) -> None:
    env = GridSimEnv(maps=maps)
    first, _ = env.reset(seed=8)
    second, _ = env.reset()
    other, _ = env.reset(seed=9)
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, other)
    np.testing.assert_array_equal(env.reset(seed=8)[0], first)
    assert not np.array_equal(GridSimEnv(maps=maps).reset()[0], GridSimEnv(maps=maps).reset()[0])


def test_environments_drive_as_rollout_does_bit_for_bit(maps: list[Map]) -> None:
    limits = Limits(30.0, 40)
    config = SimConfig(episode=EpisodeConfig(target=limits.target, time_limit=limits.steps / 10))
    episodes = np.zeros(24, dtype=EPISODE)
    episodes["map"] = np.arange(24) % 3
    for m in range(3):
        episodes["start"][m::3] = sample_starts(maps[m], 8, np.random.default_rng(m))
    episodes["start"][:, 3] = 5.0
    ends = set()
    for genome in genomes(40):
        results, _, _ = evaluate(SPEC, genome[None], maps, episodes, limits, config)
        env, driver = GridSimVectorEnv(24, maps=maps, config=config), Driver(genome)
        options = {"map_seed": [maps[m].seed for m in episodes["map"]], "start": episodes["start"]}
        _, info = env.reset(seed=0, options=options)
        running = np.ones(24, dtype=bool)
        for step in range(1, limits.steps + 1):
            *_, terminations, truncations, info = env.step(driver(env.ranges, info["speed_mps"]))
            for k in np.flatnonzero(running & (terminations | truncations)):
                row = results[0, k]
                assert (row["distance"], row["steps"]) == (np.float32(info["distance_m"][k]), step)
                assert row["end"] == info["end"][k]
                assert info["is_success"][k] == (row["end"] == End.SUCCESS)
                assert truncations[k] == (row["end"] in (End.SUCCESS, End.TIME))
            ends |= set(info["end"][running])
            running &= ~(terminations | truncations)
        assert not running.any()
    assert ends == set(End)


def test_starts_lie_on_lanes_and_spread_over_their_length(maps: list[Map]) -> None:
    scenario = maps[0]
    starts = sample_starts(scenario, 500, np.random.default_rng(1))
    assert starts.shape == (500, 5)
    assert starts.dtype == np.float32
    assert min(clearance(scenario.road, x, y) for x, y in starts[:, :2]) > 1.0
    np.testing.assert_array_equal(starts[:, 3:], np.tile([0.0, 0.0], (500, 1)))
    # The first share is the first lane's beginning, and equal shares are equal lengths along a lane.
    first = starts_at(scenario, np.array([0.0]))[0]
    np.testing.assert_allclose(first[:2], scenario.lanes.points[0], atol=1e-5)
    metres = np.arange(5.0)
    near = starts_at(scenario, metres / scenario.mileage[-1])
    np.testing.assert_allclose(np.hypot(*(near[1:, :2] - near[:-1, :2]).T), 1.0, atol=0.02)
    np.testing.assert_array_equal(starts, sample_starts(scenario, 500, np.random.default_rng(1)))


# --- ends, rewards, automatic resets


def test_success_and_time_truncate_and_everything_else_terminates(maps: list[Map]) -> None:
    timed = GridSimEnv(maps=maps, max_episode_steps=3)
    timed.reset(seed=0)
    outcomes = [timed.step(Action.NONE) for _ in range(3)]
    assert [(o[2], o[3], o[4]["end"]) for o in outcomes] == [(False, False, End.RUNNING)] * 2 + [
        (False, True, End.TIME)
    ]
    assert not any(o[4]["is_success"] for o in outcomes)

    crashing = GridSimEnv(maps=maps)
    crashing.reset(seed=0)
    while True:
        _, reward, term, trunc, info = crashing.step(Action.ACCELERATE_LEFT)
        if term or trunc:
            break
        assert 0.0 < reward <= 1.0
    assert (term, trunc, info["end"], reward) == (True, False, End.COLLISION, -1.0)

    parked = GridSimEnv(maps=maps)
    parked.reset(seed=0)
    for _ in range(100):
        _, reward, term, trunc, info = parked.step(Action.BRAKE)
        if term or trunc:
            break
    assert (term, trunc, info["end"], info["speed_mps"]) == (True, False, End.IDLE, 0.0)
    assert reward == pytest.approx(0.7 * parked.cars.ranges.min() / 50.0)  # of a step at a stand: no penalty

    short = GridSimEnv(maps=maps, config=SimConfig(episode=EpisodeConfig(target=1.0)))
    short.reset(seed=0)
    for _ in range(10):
        _, reward, term, trunc, info = short.step(Action.ACCELERATE)
        if term or trunc:
            break
    assert (term, trunc, info["end"], info["is_success"]) == (False, True, End.SUCCESS, True)
    assert reward > 0.0
    assert info["distance_m"] >= 1.0


def test_the_reward_is_the_papers(maps: list[Map]) -> None:
    env = GridSimVectorEnv(16, maps=maps)
    env.reset(seed=2)
    before = np.zeros(16)
    for _ in range(5):
        observations, rewards, terminations, _, info = env.step(np.full(16, Action.ACCELERATE))
        assert not terminations.any()
        progress, before = info["distance_m"] - before, info["distance_m"].astype(float)
        expected = (
            0.15 * np.clip(progress / 1.2, 0, 1)
            + 0.15 * np.clip(info["speed_mps"] / 12.0, 0, 1)
            + 0.7 * observations[:, :-1].min(axis=1)
        )
        np.testing.assert_allclose(rewards, expected, atol=1e-4)


def test_the_step_after_an_end_begins_the_next_episode_and_does_not_drive(maps: list[Map]) -> None:
    env = GridSimVectorEnv(8, maps=maps, max_episode_steps=4)
    env.reset(seed=0)
    for _ in range(4):
        *_, truncations, info = env.step(np.full(8, Action.ACCELERATE))
    assert truncations.all()
    assert (info["distance_m"] > 0.0).all()
    _, rewards, terminations, truncations, info = env.step(np.full(8, Action.ACCELERATE))
    assert not (terminations | truncations | (rewards != 0.0) | (info["distance_m"] != 0.0)).any()
    np.testing.assert_array_equal(info["speed_mps"], 0.0)
    assert set(info["end"]) == {End.RUNNING}
    *_, info = env.step(np.full(8, Action.ACCELERATE))
    assert (info["distance_m"] > 0.0).all()


def test_what_was_returned_is_the_callers_own(maps: list[Map]) -> None:
    env = GridSimVectorEnv(4, maps=maps)
    first, first_info = env.reset(seed=0)
    kept = [first, *first_info.values()]
    for _ in range(40):
        before = [array.copy() for array in kept]
        *outcome, info = env.step(np.full(4, Action.ACCELERATE_RIGHT))
        for array, copy in zip(kept, before, strict=True):
            np.testing.assert_array_equal(array, copy)
        kept = [*outcome, *info.values()]


def test_options_set_map_and_start(maps: list[Map]) -> None:
    env = GridSimVectorEnv(2, maps=1, map_seed=0)
    start = starts_at(maps[2], np.array([0.3]))[0]
    observations, info = env.reset(seed=0, options={"map_seed": 2, "start": start})
    np.testing.assert_array_equal(observations[0], observations[1])
    np.testing.assert_array_equal(info["speed_mps"], start[3])
    simulator = Simulator([maps[2]], 1)
    np.testing.assert_array_equal(simulator.reset(start[None])[0][0], env.ranges[0])
    plain, _ = env.reset(seed=0)
    env.reset(options={"map_seed": [1, 2]})
    np.testing.assert_array_equal(env.reset(seed=0)[0], plain)


# --- wrappers


def test_wrappers_of_a_single_environment_work() -> None:
    env = RecordOne(FrameStackObservation(FlattenObservation(gymnasium.make(IDS[0], maps=1)), 4))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (4, 32)
    total, over = 0.0, False
    while not over:
        observation, reward, term, trunc, info = env.step(int(Action.ACCELERATE))
        total, over = total + float(reward), term or trunc
    assert observation in env.observation_space
    assert info["episode"]["r"] == pytest.approx(total, abs=1e-5)


@pytest.mark.parametrize("mode", ["single", "sync", "vector_entry_point"])
@pytest.mark.parametrize("steps", [2, 40])
def test_the_time_limit_of_make_is_the_environments_own(mode: str, steps: int) -> None:
    """Below and above that of the configuration, which holds unless one is given."""
    config = SimConfig(episode=EpisodeConfig(time_limit=2.0, patience=100))
    for limit, given in ((20, {}), (steps, {"max_episode_steps": steps})):
        options: dict[str, Any] = {"maps": 1, "config": config, **given}
        if mode == "single":
            env: Any = gymnasium.make(IDS[2], **options)
            assert env.spec.max_episode_steps == limit
            TimeAwareObservation(env)
            again = env.spec.make()
            assert again.unwrapped.cars.simulator.max_steps == again.spec.max_episode_steps == limit
        else:
            env = gymnasium.make_vec(IDS[2], 1, vectorization_mode=mode, **options)
        env.reset(seed=0)
        seen = [env.step(4 if mode == "single" else np.array([4]))[2:] for _ in range(limit)]
        assert not any(trunc or info["end"] for _, trunc, info in seen[:-1])
        terminated, truncated, info = seen[-1]
        assert (terminated, truncated, info["end"]) == (False, True, End.TIME)


def test_wrappers_of_vector_environments_work(maps: list[Map]) -> None:
    n = 6
    env = DictInfoToList(RecordEpisodeStatistics(FlattenAll(GridSimVectorEnv(n, maps=maps, max_episode_steps=30))))
    env.reset(seed=0)
    returns, counted = np.zeros(n), 0
    over = np.zeros(n, dtype=bool)
    for _ in range(100):
        _, rewards, term, trunc, infos = env.step(np.full(n, Action.ACCELERATE))
        returns = np.where(over, 0.0, returns + rewards)
        over = term | trunc
        assert len(infos) == n
        for k in np.flatnonzero(over):
            assert infos[k]["episode"]["r"] == pytest.approx(returns[k], abs=1e-4)
            assert infos[k]["end"] in {End.COLLISION, End.TIME}
            counted += 1
    assert counted > n


def test_the_native_environment_equals_gymnasiums_own_vector_of_singles(maps: list[Map]) -> None:
    native = GridSimVectorEnv(4, maps=maps)
    synced = gymnasium.vector.SyncVectorEnv([lambda: GridSimEnv(maps=maps)] * 4)
    np.testing.assert_array_equal(native.reset(seed=40)[0], synced.reset(seed=40)[0])
    for row in np.random.default_rng(3).integers(len(Action), size=(120, 4)):
        ours, theirs = native.step(row), synced.step(row)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(a, b)
        assert ours[4].keys() == theirs[4].keys()
        np.testing.assert_array_equal(ours[4]["distance_m"], theirs[4]["distance_m"])
        np.testing.assert_array_equal(ours[4]["end"], theirs[4]["end"])
        np.testing.assert_array_equal(ours[4]["is_success"], theirs[4]["is_success"])


# --- wrong use


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize(
    ("action", "text"),
    [(8, "not 8"), (-1, "not -1"), (np.nan, "nan"), (1.0, "whole numbers"), (None, "whole numbers")],
)
def test_an_action_that_is_none_is_refused(maps: list[Map], n: int, action: object, text: str) -> None:
    env = GridSimVectorEnv(n, maps=maps)
    env.reset(seed=0)
    before = env.simulator.state.cars.copy()
    with pytest.raises(ValueError, match=text) as error:
        env.step(np.array([action] * n))
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(env.simulator.state.cars, before)


def test_a_wrong_number_of_actions_is_refused(maps: list[Map]) -> None:
    env = GridSimVectorEnv(3, maps=maps)
    env.reset(seed=0)
    for actions in (np.zeros(2, dtype=int), np.array(1), np.zeros((3, 1), dtype=int)):
        with pytest.raises(ValueError, match="3 cars"):
            env.step(actions)
    single = GridSimEnv(maps=maps)
    single.reset(seed=0)
    with pytest.raises(ValueError, match="not 9"):
        single.step(9)


def test_a_step_before_reset_or_after_an_end_says_so(maps: list[Map]) -> None:
    with pytest.raises(ResetNeeded, match="before reset"):
        GridSimVectorEnv(2, maps=maps).step(np.zeros(2, dtype=int))
    single = GridSimEnv(maps=maps, max_episode_steps=1)
    with pytest.raises(ResetNeeded, match="before reset"):
        single.step(0)
    single.reset(seed=0)
    single.step(0)
    with pytest.raises(ResetNeeded, match="after the episode's end"):
        single.step(0)
    with pytest.raises(RuntimeError, match="before every car was reset"):
        Simulator(maps, 2).step(np.zeros(2, dtype=int))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"seed": 1}, "unknown option 'seed'"),
        ({"map_seed": -1}, "map_seed must be"),
        ({"map_seed": 1.5}, "map_seed must be"),
        ({"map_seed": [1, 2, 3]}, "map_seed must be"),
        ({"start": [1, 2, 3]}, "start must be"),
        ({"start": "here"}, "start must be"),
        ({"start": [1, 2, np.nan, 0, 0]}, "finite"),
        ({"start": [1, 2, 0, 31, 0]}, "speed"),
        ({"start": [1, 2, 0, 0, 1.0]}, "steering"),
        ({"map_seed": 0, "start": [0, 0, 0, 0, 0]}, "on the road"),
    ],
)
def test_a_wrong_option_is_refused(options: dict[str, object], text: str) -> None:
    env = GridSimVectorEnv(2, maps=1)
    with pytest.raises(ValueError, match=re.escape(text)) as error:
        env.reset(seed=0, options=options)
    assert "\n" not in str(error.value)
    env.reset(seed=0)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"num_envs": 0}, "1 car"),
        ({"maps": 0}, "1 map"),
        ({"map_seed": -1}, "map_seed"),
        ({"max_episode_steps": 0}, "1 step"),
        ({"config": SimConfig(episode=EpisodeConfig(target=-1.0))}, "target"),
    ],
)
def test_a_wrong_argument_is_refused(arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(text)):
        GridSimVectorEnv(**arguments)
