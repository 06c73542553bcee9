"""What the Gymnasium environments can be asked for: sensing, actions and traffic."""

import math
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from driving import SENSING, drive
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from gridsim.car.ego import DISTANCE, SPEED, End
from gridsim.car.vehicle import Action
from gridsim.envs.env import GridSimEnv, GridSimVectorEnv
from gridsim.envs.simulator import views
from gridsim.maps.map import Map
from gridsim.maps.scenarios import REGISTRY
from gridsim.sensing.grid import CELLS, grid_table, grids
from gridsim.traffic.world import LANE

# --- the checker


@pytest.mark.usefixtures("dummy")
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize(
    "sees",
    [
        *({"motion": motion, "steering": steering} for motion in (False, True) for steering in (False, True)),
        *({"observation": kind, "frames": frames} for kind in ("grid", "image") for frames in (1, 4)),
    ],
    ids=lambda sees: "-".join(map(str, sees.values())),
)
@pytest.mark.parametrize("name", REGISTRY)
def test_gymnasiums_checker_passes(maps: dict[str, list[Map]], name: str, sees: dict[str, Any], actions: str) -> None:
    """It makes the environment in both of its render modes, too."""
    options: dict[str, Any] = {"actions": actions, **sees}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(f"GridSim/{name.capitalize()}-v0", maps=maps[name][:1], **options).unwrapped)


@pytest.mark.parametrize(("observation", "frames"), SENSING)
def test_spaces_are_those_of_the_options(observation: str, frames: int) -> None:
    options: Any = {"observation": observation, "frames": frames, "actions": "continuous"}
    env = gymnasium.make_vec("GridSim/City-v0", num_envs=2, **options)
    space: Any = env.single_observation_space
    if observation == "grid":
        assert set(space.spaces) == {"grid", "speed"}
        assert (space["speed"].shape, space["speed"].dtype) == ((1,), np.float32)
        space = space["grid"]
    assert space.shape == ((32,) if observation == "rays" else (frames, CELLS, CELLS))
    assert space.dtype == (np.float32 if observation == "rays" else np.uint8)
    assert env.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
    seen, _ = env.reset(seed=1)
    assert seen in env.observation_space
    seen, *_ = env.step(env.action_space.sample())
    assert seen in env.observation_space


def test_traffic_is_the_scenarios_unless_given() -> None:
    for name, spec in REGISTRY.items():
        assert GridSimVectorEnv(1, scenario=name, maps=1).simulator.state.worlds.shape[1] == spec.traffic
    assert gymnasium.make("GridSim/City-v0", maps=1, traffic=2).unwrapped.cars.traffic == 2  # type: ignore[attr-defined]


# --- seeds


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("highway", {}),
        ("seamless", {"traffic": 6, "actions": "continuous"}),
        ("roundabout", {"observation": "image", "frames": 4}),
        ("city", {"observation": "image", "actions": "continuous"}),
    ],
)
def test_an_episode_follows_from_seed_and_number_alone(
    maps: dict[str, list[Map]], name: str, options: dict[str, Any]
) -> None:
    """Traffic included: the same again, among other cars that do other things, and alone."""
    n, steps = 12, 110
    options = {"scenario": name, "maps": maps[name], "max_episode_steps": 40, **options}
    env = GridSimVectorEnv(n, **options)
    actions = drive(env, steps, seed=1)

    def run(env: GridSimVectorEnv, seed: int, actions: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        observations, _ = env.reset(seed=seed)
        seen: list[tuple[np.ndarray, ...]] = [(observations, env.simulator.state.worlds.copy())]
        for row in actions:
            observations, rewards, terminations, truncations, info = env.step(row)
            worlds = env.simulator.state.worlds.copy()
            seen.append((observations, worlds, rewards, terminations, truncations, info["distance_m"], info["end"]))
        return seen

    first = run(env, 50, actions)
    assert sum((row[3] | row[4]).sum() for row in first[1:]) >= 2 * n  # all are in their third episode
    assert (first[0][1][:, :, LANE] >= 0).all()
    assert not np.array_equal(first[0][1][0], first[0][1][1])
    for ours, theirs in zip(first, run(env, 50, actions), strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)

    car = 7
    among = drive(GridSimVectorEnv(3, **options), steps, seed=2)
    among[:, 1] = actions[:, car]
    for ours, theirs in zip(first, run(GridSimVectorEnv(3, **options), 50 + car - 1, among), strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a[car], b[1])

    single, over = GridSimEnv(**options), True
    for step, ours in enumerate(first):
        if over:
            seen, _ = single.reset(seed=50 + car if step == 0 else None)
            over = False
        else:
            seen, reward, terminated, truncated, _ = single.step(actions[step - 1, car])
            over = terminated or truncated
            assert (reward, terminated, truncated) == tuple(x[car] for x in ours[2:5])
        np.testing.assert_array_equal(seen, ours[0][car])
        np.testing.assert_array_equal(single.cars.simulator.state.worlds[0], ours[1][car])


def test_traffic_follows_from_the_seed_too(maps: dict[str, list[Map]]) -> None:
    env = GridSimVectorEnv(2, scenario="city", maps=maps["city"])
    same = {"map_seed": 0, "start": [*maps["city"][0].lanes.points[0], 0.0, 0.0, 0.0]}
    env.reset(seed=1, options=same)
    first = env.simulator.state.worlds.copy()
    assert not np.array_equal(first[0], first[1])
    env.reset(options=same)
    assert not np.array_equal(env.simulator.state.worlds[0], first[0])  # the next episode's
    env.reset(seed=1, options=same)
    np.testing.assert_array_equal(env.simulator.state.worlds, first)


# --- rewards and observations


def test_the_reward_among_traffic_is_the_papers(maps: dict[str, list[Map]]) -> None:
    """Recomputed from the states, in float64."""
    env = GridSimVectorEnv(8, scenario="highway", maps=maps["highway"])
    env.reset(seed=0)
    nearer = collisions = 0
    over = np.zeros(8, dtype=bool)
    for _ in range(300):
        before = env.simulator.state.cars.astype(np.float64)
        _, rewards, terminations, truncations, info = env.step(np.full(8, Action.ACCELERATE))
        state = env.simulator.state
        for i in range(8):
            cars, road = state.cars[i : i + 1], maps["highway"][state.maps[i]]
            ranges = views(road, cars, state.worlds[i : i + 1], env.config)[0]
            nearer += ranges.min() < views(road, cars, state.worlds[i : i + 1, :0], env.config)[0].min()
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


@pytest.mark.parametrize("name", ["city", "highway"])
def test_a_grid_is_what_the_rays_say(maps: dict[str, list[Map]], name: str) -> None:
    options: dict[str, Any] = {"scenario": name, "maps": maps[name]}
    env, rays = GridSimVectorEnv(6, observation="grid", **options), GridSimVectorEnv(6, **options)
    alone = GridSimVectorEnv(6, observation="image", **options)
    (seen, _), (beside, _) = env.reset(seed=4), rays.reset(seed=4)
    alone.reset(seed=4)
    table = grid_table(env.config)
    for row in drive(env, 60, seed=5):
        np.testing.assert_array_equal(env.ranges, rays.ranges)
        np.testing.assert_array_equal(seen["grid"], grids(table, env.ranges)[:, None])
        np.testing.assert_allclose(seen["speed"], beside[:, -1:], rtol=1e-6)
        seen, *ours, info = env.step(row)
        beside, *theirs, _ = rays.step(row)
        np.testing.assert_array_equal(alone.step(row)[0], seen["grid"])
        for a, b in zip(ours, theirs, strict=True):  # what an observation is made of changes nothing else
            np.testing.assert_array_equal(a, b)
    assert len(np.unique(seen["grid"])) == 3
    named = {"distance_m", "speed_mps", "is_success", "end"}
    assert set(info) == named | {f"_{name}" for name in named}


def test_frames_are_the_last_grids_and_begin_anew_with_an_episode(maps: dict[str, list[Map]]) -> None:
    n = 5
    env = GridSimVectorEnv(n, scenario="city", maps=maps["city"], observation="image", frames=4, max_episode_steps=9)
    table = grid_table(env.config)
    for seed in (3, None):
        seen, _ = env.reset(seed=seed)
        now = grids(table, env.ranges)
        past = [[now[i]] * 4 for i in range(n)]
        over = np.zeros(n, dtype=bool)
        for row in drive(env, 28, seed=6):  # in the middle of an episode
            np.testing.assert_array_equal(seen, np.array(past))
            kept, before = seen, seen.copy()
            seen, _, terminations, truncations, _ = env.step(row)
            now = grids(table, env.ranges)
            past = [[now[i]] * 4 if over[i] else [*past[i][1:], now[i]] for i in range(n)]
            over = terminations | truncations
            np.testing.assert_array_equal(kept, before)  # what was returned is the caller's own
        assert any((stack[0] != stack[3]).any() for stack in past)


def test_pedal_and_wheel_do_what_they_say(maps: dict[str, list[Map]]) -> None:
    env = GridSimVectorEnv(3, maps=maps["seamless"], actions="continuous")
    env.reset(seed=0, options={"map_seed": 0})
    *_, info = env.step(np.array([[1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(info["speed_mps"], [0.3, 0.15, 0.0], atol=1e-6)  # 3 m/s2 for 0.1 s
    assert env.simulator.state.cars[:, 5] == pytest.approx(0.0)
    env.step(np.array([[0.0, 1.0], [0.0, -1.0], [0.0, 0.1]], dtype=np.float32))
    steering = np.degrees(env.simulator.state.cars[:, 5])
    np.testing.assert_allclose(steering, [6.0, -6.0, 2.7], atol=1e-3)  # 60 degrees/s; 27 at the lock


def test_continuous_actions_are_clipped(maps: dict[str, list[Map]]) -> None:
    wild = np.array([[1.5, -7.0], [1e300, -math.inf], [-2.0, 1.01]])
    one, other = (GridSimVectorEnv(3, maps=maps["seamless"], actions="continuous") for _ in range(2))
    one.reset(seed=0)
    other.reset(seed=0)
    for _ in range(5):
        for ours, theirs in zip(one.step(wild)[:4], other.step(np.sign(wild))[:4], strict=True):
            np.testing.assert_array_equal(ours, theirs)


# --- wrong use


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize(
    ("action", "text"),
    [
        ([math.nan, 0.0], "not nan"),
        ([None, 0.0], "numbers"),
        (["a", "b"], "numbers"),
        ([True, False], "numbers"),
        ([0.0], "cars"),
        ([0.0, 0.0, 0.0], "cars"),
        (0.0, "cars"),
        ([[0.0, 0.0]], "cars"),
    ],
)
def test_a_continuous_action_that_is_none_is_refused(
    maps: dict[str, list[Map]], n: int, action: object, text: str
) -> None:
    env = GridSimVectorEnv(n, scenario="city", maps=maps["city"][:1], actions="continuous")
    env.reset(seed=0)
    before, traffic = env.simulator.state.cars.copy(), env.simulator.state.worlds.copy()
    with pytest.raises(ValueError, match=text) as error:
        env.step(np.array([action] * n))
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(env.simulator.state.cars, before)
    np.testing.assert_array_equal(env.simulator.state.worlds, traffic)
    env.step(np.zeros((n, 2)))


def test_an_error_is_one_line_for_any_number_of_cars(maps: dict[str, list[Map]]) -> None:
    kinds: list[dict[str, Any]] = [{"actions": "discrete"}, {"actions": "continuous"}]
    for options in kinds:
        env = GridSimVectorEnv(100, maps=maps["seamless"][:1], **options)
        env.reset(seed=0)
        with pytest.raises(ValueError, match="100 cars") as error:
            env.step(np.zeros((100, 3)))
        assert "\n" not in str(error.value)
    single = GridSimEnv(maps=maps["seamless"][:1], actions="continuous")
    single.reset(seed=0)
    for action in (0.5, [0.5], [0.5, math.nan], Action.ACCELERATE):
        with pytest.raises(ValueError, match=r"cars|nan"):
            single.step(action)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"observation": "film"}, "observation must be rays or grid or image, not 'film'"),
        ({"actions": "both"}, "actions must be discrete or continuous, not 'both'"),
        ({"render_mode": "ansi"}, "render_mode must be None or rgb_array or human, not 'ansi'"),
        ({"frames": 0}, "frames must be 1 to 8"),
        ({"frames": 9, "observation": "grid"}, "frames must be 1 to 8"),
        ({"frames": 4}, "only for grids"),
        ({"motion": True, "observation": "image"}, "leave it out with observation='image'"),
        ({"traffic": -1}, "not -1"),
        ({"traffic": 3, "scenario": "no/map.yaml"}, "no lanes for traffic"),
        ({"scenario": "no/map.yaml"}, "no/map.yaml"),
    ],
)
@pytest.mark.parametrize("kind", [GridSimEnv, GridSimVectorEnv])
def test_a_wrong_argument_is_refused(kind: Any, arguments: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text) as error:
        kind(**arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("options", [{"observation": "grid"}, {"actions": "continuous"}, {"render_mode": "rgb_array"}])
def test_nothing_goes_before_reset(maps: dict[str, list[Map]], options: dict[str, Any]) -> None:
    env = GridSimVectorEnv(2, maps=maps["seamless"][:1], **options)
    single = GridSimEnv(maps=maps["seamless"][:1], **options)
    with pytest.raises(ResetNeeded, match="before reset"):
        env.step(env.action_space.sample())
    with pytest.raises(ResetNeeded, match="before reset"):
        single.step(single.action_space.sample())
    if "render_mode" in options:
        for each in (env, single):
            with pytest.raises(ResetNeeded, match="before reset"):
                each.render()
