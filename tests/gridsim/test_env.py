"""The Gymnasium environments: spaces, exact seeding, observations, rewards, ends, options, and readable errors."""

import ast
import copy
import math
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeAwareObservation

import gridsim
from gridsim import ENVIRONMENTS
from gridsim.car.vehicle import Action
from gridsim.config import EpisodeConfig, SimConfig
from gridsim.envs.env import GridSimEnv, GridSimVectorEnv
from gridsim.maps.map import Map, starts_at
from gridsim.maps.scenarios import REGISTRY
from gridsim.sensing.grid import grid_table, grids
from gridsim.simulator import Simulator, views
from gridsim.state import DISTANCE, LANE, SPEED, STEERING, End

IDS = list(ENVIRONMENTS)
Maps = dict[str, list[Map]]
SENSING = [("rays", 1), ("grid", 1), ("grid", 4), ("image", 1)]


def drive(env: GridSimVectorEnv, steps: int, seed: int) -> np.ndarray:
    """Actions at random for all cars, that mostly speed up: [steps, n, ...]."""
    rng = np.random.default_rng(seed)
    if env.action_space.dtype == np.float32:
        return rng.uniform([-0.2, -0.3], [1.0, 0.3], (steps, env.num_envs, 2)).astype(np.float32)
    return rng.choice([Action.ACCELERATE, Action.NONE, Action.LEFT, Action.RIGHT], (steps, env.num_envs))


# --- spaces


def test_type_checkers_see_the_names_that_are_there(root: Path) -> None:
    stub = ast.parse((root / "gridsim" / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    names = [(node.module, alias.asname) for node in imports for alias in node.names]
    later = [(vars(gridsim)["_API_MODULE"], name) for name in vars(gridsim)["_API"]]
    assert sorted(names) == sorted([*later, ("gridsim.config", "SimConfig")])
    others = [node for node in stub.body if isinstance(node, ast.AnnAssign)]
    assert {ast.unparse(node.target) for node in others} <= vars(gridsim).keys()


SEES: list[dict[str, Any]] = [
    {},
    {"motion": True},
    {"steering": True},
    {"motion": True, "steering": True, "route": True},
]
SEES += [{"observation": observation, "frames": frames} for observation in ("grid", "image") for frames in (1, 4)]


@pytest.mark.usefixtures("no_display")
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("sees", SEES)
@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_checker_passes_without_a_display(maps: Maps, name: str, sees: dict[str, Any], actions: str) -> None:
    env = gymnasium.make(name, maps=maps[ENVIRONMENTS[name]][:1], actions=actions, render_mode="rgb_array", **sees)
    check_env(env.unwrapped)


# --- seeds


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("highway", {}),
        ("seamless", {"traffic": 6, "actions": "continuous", "route": True}),
        ("roundabout", {"observation": "image", "frames": 4}),
        ("city", {"observation": "image", "actions": "continuous"}),
    ],
)
def test_an_episode_follows_from_seed_and_number_alone(maps: Maps, name: str, options: dict[str, Any]) -> None:
    """Traffic included: the same again, and among other cars that do other things. What is returned is the caller's."""
    n, steps = 12, 110
    options = {"scenario": name, "maps": maps[name], "max_episode_steps": 40, **options}
    env = GridSimVectorEnv(n, **options)
    actions = drive(env, steps, seed=1)

    def run(env: GridSimVectorEnv, seed: int, actions: np.ndarray, keep: Any) -> list[list[np.ndarray]]:
        seen = []
        for row in (None, *actions):
            observations, *outcome, info = env.reset(seed=seed) if row is None else env.step(row)
            seen.append(keep([observations, env.simulator.worlds.copy(), *outcome, *info.values()]))
        return seen

    first = run(env, 50, actions, copy.deepcopy)
    assert sum((row[3] | row[4]).sum() for row in first[1:]) >= 2 * n  # all are in their third episode
    assert (first[0][1][:, :, LANE] >= 0).all()
    assert env.simulator.worlds.shape[1] == options.get("traffic", REGISTRY[name].traffic)
    assert not np.array_equal(first[0][1][0], first[0][1][1])
    np.testing.assert_equal(run(env, 50, actions, list), first)

    car, three = 7, GridSimVectorEnv(3, **options)
    among = drive(three, steps, seed=2)
    among[:, 1] = actions[:, car]
    others = run(three, 50 + car - 1, among, list)
    np.testing.assert_equal([[b[1] for b in row] for row in others], [[a[car] for a in row] for row in first])


def test_a_reset_without_a_seed_goes_on_and_another_seed_differs(maps: Maps) -> None:
    env = GridSimEnv(maps=maps["seamless"])
    first, second, other, again = (env.reset(seed=seed)[0].tobytes() for seed in (8, None, 9, np.int64(8)))
    assert again == first
    assert first not in (second, other)
    assert not np.array_equal(*(GridSimEnv(maps=maps["seamless"]).reset()[0] for _ in range(2)))


# --- observations and rewards


def test_the_reward_among_traffic_is_the_papers(maps: Maps) -> None:
    """Recomputed from the states, in float64."""
    env = GridSimVectorEnv(8, scenario="highway", maps=maps["highway"])
    env.reset(seed=0)
    nearer = collisions = 0
    over = np.zeros(8, dtype=bool)
    for _ in range(300):
        before = env.simulator.cars.astype(np.float64)
        _, rewards, terminations, truncations, info = env.step(np.full(8, Action.ACCELERATE))
        state = env.simulator
        for i in range(8):
            cars, road = state.cars[i : i + 1], env.simulator.maps[i]
            ranges = views(road, cars, state.worlds[i : i + 1], env.config)[0][0]
            nearer += ranges.min() < views(road, cars, state.worlds[i : i + 1, :0], env.config)[0][0].min()
            expected = (
                0.15 * min((cars[0, DISTANCE] - before[i, DISTANCE]) / (25.0 * 0.1), 1.0)
                + 0.15 * min(max(cars[0, SPEED] / 25.0, 0.0), 1.0)
                + 0.7 * ranges.min() / 50.0
            )
            if over[i]:
                expected = 0.0
            elif info["end"][i] == End.COLLISION:
                expected = -1.0
                collisions += 1
            assert rewards[i] == pytest.approx(expected, abs=2e-5)
        over = terminations | truncations
    assert nearer > 20  # a car, not the road's edge, was what counted
    assert collisions > 5


@pytest.mark.parametrize(("name", "observation", "frames"), [("city", "image", 4), ("highway", "grid", 1)])
def test_grids_are_what_the_last_rays_say_and_begin_anew_with_an_episode(
    maps: Maps, name: str, observation: Any, frames: int
) -> None:
    options: dict[str, Any] = {"scenario": name, "maps": maps[name], "max_episode_steps": 9}
    env = GridSimVectorEnv(5, observation=observation, frames=frames, **options)
    rays, table = GridSimVectorEnv(5, **options), grid_table(env.config)
    for seed in (3, None):
        (seen, _), (beside, _) = env.reset(seed=seed), rays.reset(seed=seed)
        past = [[grid] * frames for grid in grids(table, env.simulator.ranges)]
        over = np.zeros(5, dtype=bool)
        for row in drive(env, 28, seed=6):  # in the middle of an episode
            np.testing.assert_array_equal(env.simulator.ranges, rays.simulator.ranges)
            np.testing.assert_array_equal(seen["grid"] if observation == "grid" else seen, np.array(past))
            if observation == "grid":
                np.testing.assert_allclose(seen["speed"], beside[:, -1:], rtol=1e-6)
            seen, *ours, info = env.step(row)
            beside, *theirs, _ = rays.step(row)
            np.testing.assert_equal(ours, theirs)  # what an observation is made of changes nothing else
            now = grids(table, env.simulator.ranges)
            past = [[now[i]] * frames if over[i] else [*past[i][1:], now[i]] for i in range(5)]
            over = ours[1] | ours[2]
        assert any((stack[0] != stack[-1]).any() for stack in past) or frames == 1
    named = {"distance_m", "speed_mps", "is_success", "end"}
    assert set(info) == named | {f"_{name}" for name in named}
    assert {part.dtype.kind for part in info.values()} == set("bfu")  # numbers alone, as Gymnasium's NumpyToTorch wants


def test_rays_motion_speed_steering_and_limit_are_shares(maps: Maps) -> None:
    env = GridSimVectorEnv(8, scenario="highway", maps=maps["highway"], motion=True, steering=True, limit=True)
    env.reset(seed=0)
    fastest = 0.0  # m/s at which a car came closer
    for step in range(200):
        seen, *_, info = env.step(np.full(8, Action.ACCELERATE if step % 50 else Action.ACCELERATE_LEFT))
        fastest = max(fastest, np.abs(env.simulator.closing).max())
        cars = env.simulator.cars
        np.testing.assert_allclose(seen[:, :31] * 50.0, env.simulator.ranges, rtol=1e-6)
        np.testing.assert_allclose(seen[:, 31:62] * 30.0, np.clip(env.simulator.closing, -30.0, 30.0), atol=1e-5)
        np.testing.assert_allclose(seen[:, 62] * 30.0, info["speed_mps"], rtol=1e-6)
        np.testing.assert_allclose(seen[:, 63] * 27.0, np.degrees(cars[:, STEERING]), rtol=1e-5)
        np.testing.assert_allclose(seen[:, 64] * 30.0, 25.0, rtol=1e-6)
    assert fastest > 1.0


def test_pedal_and_wheel_are_clipped_and_do_what_they_say(maps: Maps) -> None:
    env = GridSimVectorEnv(3, maps=maps["seamless"], actions="continuous")
    env.reset(seed=0, options={"map_seed": 0})
    *_, info = env.step(np.array([[1e300, 0.0], [0.5, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(info["speed_mps"], [0.3, 0.15, 0.0], atol=1e-6)  # 3 m/s2 for 0.1 s
    assert env.simulator.cars[:, STEERING] == pytest.approx(0.0)
    env.step(np.array([[0.0, 1.01], [0.0, -math.inf], [0.0, 0.1]]))
    steering = np.degrees(env.simulator.cars[:, STEERING])
    np.testing.assert_allclose(steering, [6.0, -6.0, 2.7], atol=1e-3)  # 60 degrees/s; 27 at the lock


# --- ends and options


def test_traffic_is_given_for_each_road() -> None:
    with pytest.raises(ValueError, match=r"for each of 2 roads, not \(4, 6, 8\)$"):
        GridSimVectorEnv(2, scenario="city,highway", traffic=(4, 6, 8))


def test_success_and_time_truncate_and_everything_else_terminates(maps: Maps) -> None:
    def drive_to_the_end(action: Action, **options: Any) -> list[Any]:
        """What each step returned, the same action in all."""
        env = GridSimEnv(maps=maps["seamless"], **options)
        env.reset(seed=0)
        steps: list[Any] = []
        while not steps or not (steps[-1][2] or steps[-1][3]):
            steps.append(env.step(action))
        return steps

    *before, (_, reward, terminated, truncated, info) = drive_to_the_end(Action.ACCELERATE_LEFT)
    assert (terminated, truncated, info["end"], reward) == (True, False, End.COLLISION, -1.0)
    assert all(0.0 < reward <= 1.0 for _, reward, *_ in before)

    *_, (seen, reward, terminated, truncated, info) = drive_to_the_end(Action.BRAKE)
    assert (terminated, truncated, info["end"], info["speed_mps"]) == (True, False, End.IDLE, 0.0)
    assert reward == pytest.approx(0.7 * seen[:31].min())  # of a step at a stand: no penalty

    short = drive_to_the_end(Action.ACCELERATE, config=SimConfig(episode=EpisodeConfig(target=1.0)))
    _, reward, terminated, truncated, info = short[-1]
    assert (terminated, truncated, info["end"], info["is_success"]) == (False, True, End.SUCCESS, True)
    assert info["distance_m"] >= 1.0
    assert len(short) <= 10


def test_options_set_map_and_start(maps: Maps) -> None:
    env = GridSimVectorEnv(2, maps=1, map_seed=5)
    start = starts_at(maps["seamless"][1], np.array([0.3]))[0]
    observations, info = env.reset(seed=0, options={"map_seed": 1, "start": start})
    np.testing.assert_array_equal(observations[0], observations[1])
    np.testing.assert_array_equal(info["speed_mps"], start[3])
    simulator = Simulator(1)
    simulator.reset(maps["seamless"][1], start[None])
    np.testing.assert_array_equal(simulator.ranges[0], env.simulator.ranges[0])
    plain, _ = env.reset(seed=0)
    env.reset(options={"map_seed": [1, 0]})
    np.testing.assert_array_equal(env.reset(seed=0)[0], plain)


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


# --- the next episode


def listed(data: Any) -> Any:
    """The same with lists in place of arrays of objects, which NumPy does not compare."""
    if isinstance(data, dict):
        return {name: listed(part) for name, part in data.items()}
    return [*map(listed, data)] if isinstance(data, tuple) or getattr(data, "dtype", None) == "O" else data


@pytest.mark.parametrize(("observation", "frames"), SENSING)
@pytest.mark.parametrize("mode", AutoresetMode)
def test_each_mode_is_that_of_gymnasiums_own_vector_environment(
    maps: Maps, mode: AutoresetMode, observation: str, frames: int
) -> None:
    options: dict[str, Any] = {"observation": observation, "frames": frames}
    options |= {"scenario": "city", "maps": maps["city"], "max_episode_steps": 25}
    native = GridSimVectorEnv(4, autoreset_mode=mode.value, **options)
    synced = gymnasium.vector.SyncVectorEnv([lambda: GridSimEnv(**options)] * 4, autoreset_mode=mode)
    assert native.metadata["autoreset_mode"] is mode
    seeds: list[int | None] = [40, 7, 40, 3]
    ours: tuple[Any, ...] = native.reset(seed=seeds)
    assert ours[0] in native.observation_space
    np.testing.assert_equal(listed(ours), listed(synced.reset(seed=seeds)))
    ended = 0
    for row in drive(native, 70, seed=2):
        ours = native.step(row)
        np.testing.assert_equal(listed(ours), listed(synced.step(row)))
        over = ours[2] | ours[3]
        ended += over.sum()
        if mode is AutoresetMode.DISABLED and over.any():
            again: Any = {"seed": [None, 5, None, None], "options": {"reset_mask": over}}
            np.testing.assert_equal(listed(native.reset(**again)), listed(synced.reset(**again)))
    assert ended > 4


# --- wrong use


def test_wrong_seeds_and_masks_are_refused_and_a_car_that_has_ended_must_be_reset(maps: Maps) -> None:
    options: Any = {"scenario": "city", "maps": maps["city"], "max_episode_steps": 25}
    env = GridSimVectorEnv(4, autoreset_mode=AutoresetMode.DISABLED, **options)
    with pytest.raises(ResetNeeded, match="first reset of all"):
        env.reset(options={"reset_mask": np.array([True, False, False, True])})
    seeds: list[Any] = [-1, 3.0, [1, 2], [1, 2, 3, -4]]
    for seed in seeds:
        with pytest.raises(ValueError, match="seed must be a whole number from 0, or 4 of them"):
            env.reset(seed=seed)
    env.reset(seed=1)
    for mask in ([True] * 4, np.ones(3, dtype=bool), np.zeros(4, dtype=bool)):
        with pytest.raises(ValueError, match="reset_mask must be an array of 4 bools"):
            env.reset(options={"reset_mask": mask})
    ended = np.zeros(4, dtype=bool)
    while not ended.any():
        ended = env.step(np.full(4, 4))[4]["end"] != 0
    with pytest.raises(ResetNeeded, match="reset_mask"):
        env.step(np.full(4, 4))
    env.reset(options={"reset_mask": ended})
    env.step(np.full(4, 4))


@pytest.mark.parametrize(
    ("actions", "action", "text"),
    [
        ("discrete", 8, "not 8"),
        ("discrete", 1.0, "whole numbers"),
        ("continuous", [math.nan, 0.0], "not nan"),
        ("continuous", [0.0, 0.0, 0.0], "cars"),
    ],
)
def test_a_wrong_action_is_refused(maps: Maps, actions: Any, action: object, text: str) -> None:
    env = GridSimVectorEnv(3, scenario="city", maps=maps["city"][:1], actions=actions)
    env.reset(seed=0)
    before = env.simulator.cars.copy()
    with pytest.raises(ValueError, match=rf"^[^\n]*{text}[^\n]*$"):
        env.step(np.array([action] * 3))
    np.testing.assert_array_equal(env.simulator.cars, before)
    single = GridSimEnv("city", maps=maps["city"][:1], actions=actions)
    single.reset(seed=0)
    with pytest.raises(ValueError, match=text):
        single.step(action)


def test_steps_and_pictures_need_a_reset(maps: Maps) -> None:
    single = GridSimEnv(maps=maps["seamless"], max_episode_steps=1, render_mode="rgb_array")
    for call in (single.render, lambda: single.step(0)):  # as of the vector environment that it wraps
        with pytest.raises(ResetNeeded, match="before reset"):
            call()
    single.reset(seed=0)
    single.step(0)
    with pytest.raises(ResetNeeded, match="after the episode's end"):
        single.step(0)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"num_envs": 0}, "1 car"),
        ({"maps": 0}, "1 map"),
        ({"max_episode_steps": 0}, "1 step"),
        ({"observation": "film"}, "observation must be rays or grid or image, not 'film'"),
        ({"frames": 0}, "frames must be 1 to 8"),
        ({"frames": 4}, "only for grids"),
        ({"motion": True, "observation": "image"}, "leave them out with observation='image'"),
        ({"traffic": -1}, "not -1"),
        ({"traffic": 3, "scenario": "no/map.yaml"}, "no lanes for traffic"),
        ({"route": True, "scenario": "no/map.yaml"}, "no lanes for traffic or a route"),
        ({"scenario": "no/map.yaml"}, "no/map.yaml"),
        ({"autoreset_mode": "never"}, "'never' is not a valid AutoresetMode"),
        ({"options": {"seed": 1}}, "unknown option 'seed'"),
        ({"options": {"map_seed": 1.5}}, "map_seed must be"),
        ({"options": {"map_seed": [1, 2, 3]}}, "map_seed must be"),
        ({"options": {"start": [1, 2, 3]}}, "start must be"),
        ({"options": {"start": [1, 2, np.nan, 0, 0]}}, "finite"),
        ({"options": {"start": [1, 2, 0, 31, 0]}}, "speed"),
        ({"options": {"start": [1, 2, 0, 0, -1.0]}}, "steering"),
        ({"options": {"map_seed": 0, "start": [0, 0, 0, 0, 0]}}, "on the road"),
    ],
)
def test_a_wrong_argument_or_option_of_a_reset_is_refused(arguments: dict[str, Any], text: str) -> None:
    given: Any = {"num_envs": 2, "maps": 1, **arguments}
    options = given.pop("options", None)
    with pytest.raises(ValueError, match=rf"^[^\n]*{re.escape(text)}[^\n]*$"):
        GridSimVectorEnv(**given).reset(seed=0, options=options)
