"""What the Gymnasium environments can be asked for: sensing, actions, traffic, pictures, and Gymnasium's wrappers."""

import copy
import math
import pickle
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, RecordEpisodeStatistics, RecordVideo
from gymnasium.wrappers import vector as wrappers

from gridsim.ego import DISTANCE, SPEED
from gridsim.env import RENDER_SIZE, GridSimEnv, GridSimVectorEnv, env_id
from gridsim.grid import CELLS, grid_table, grids
from gridsim.render import NoDisplayError
from gridsim.scenarios import REGISTRY, Scenario, build
from gridsim.simulator import views
from gridsim.vehicle import Action
from gridsim.world import LANE

F = np.float32
SENSING = [("rays", 1), ("grid", 1), ("grid", 4)]


@pytest.fixture(scope="module")
def maps() -> dict[str, list[Scenario]]:
    """Two maps of each scenario."""
    return {name: [build(name, seed) for seed in range(2)] for name in REGISTRY}


@pytest.fixture
def dummy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows that nobody sees."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def drive(env: GridSimVectorEnv, steps: int, seed: int) -> np.ndarray:
    """Random actions for all cars of a vector environment, that mostly speed up: [steps, n, ...]."""
    rng = np.random.default_rng(seed)
    if env.action_space.dtype == np.float32:
        return rng.uniform([-0.2, -0.3], [1.0, 0.3], (steps, env.num_envs, 2)).astype(np.float32)
    return rng.choice([Action.ACCELERATE, Action.NONE, Action.LEFT, Action.RIGHT], (steps, env.num_envs))


# --- the checker


@pytest.mark.usefixtures("dummy")
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize(("observation", "frames"), SENSING)
@pytest.mark.parametrize("name", REGISTRY)
def test_gymnasiums_checker_passes(
    maps: dict[str, list[Scenario]], name: str, observation: str, frames: int, actions: str
) -> None:
    """It makes the environment in both of its render modes, too."""
    options: dict[str, Any] = {"observation": observation, "frames": frames, "actions": actions}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(env_id(name), maps=maps[name][:1], **options).unwrapped)


@pytest.mark.parametrize(("observation", "frames"), SENSING)
def test_spaces_are_those_of_the_options(observation: str, frames: int) -> None:
    env = gymnasium.make_vec(env_id("city"), num_envs=2, observation=observation, frames=frames, actions="continuous")
    shape = {"rays": (32,), "grid": (CELLS, CELLS) if frames == 1 else (frames, CELLS, CELLS)}[observation]
    assert env.single_observation_space.shape == shape
    assert env.single_observation_space.dtype == (np.float32 if observation == "rays" else np.uint8)
    assert env.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
    seen, _ = env.reset(seed=1)
    assert seen in env.observation_space
    seen, *_ = env.step(env.action_space.sample())
    assert seen in env.observation_space


def test_traffic_is_the_scenarios_unless_given() -> None:
    for name, spec in REGISTRY.items():
        assert GridSimVectorEnv(1, scenario=name, maps=1).simulator.state.worlds.shape[1] == spec.traffic
    assert gymnasium.make(env_id("city"), maps=1, traffic=2).unwrapped.cars.traffic == 2  # type: ignore[attr-defined]


# --- seeds


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("highway", {}),
        ("seamless", {"traffic": 6, "actions": "continuous"}),
        ("roundabout", {"observation": "grid", "frames": 4}),
        ("city", {"observation": "grid", "actions": "continuous"}),
    ],
)
def test_an_episode_follows_from_seed_and_number_alone(
    maps: dict[str, list[Scenario]], name: str, options: dict[str, Any]
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


def test_traffic_follows_from_the_seed_too(maps: dict[str, list[Scenario]]) -> None:
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


def test_the_reward_among_traffic_is_the_papers(maps: dict[str, list[Scenario]]) -> None:
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
            elif info["end"][i] == "collision":
                expected = -1.0
                collisions += 1
            assert rewards[i] == pytest.approx(expected, abs=2e-5)
        over = terminations | truncations
    assert nearer > 20  # a car, not the road's edge, was what counted
    assert collisions > 5


@pytest.mark.parametrize("name", ["city", "highway"])
def test_a_grid_is_what_the_rays_say(maps: dict[str, list[Scenario]], name: str) -> None:
    options: dict[str, Any] = {"scenario": name, "maps": maps[name]}
    env, rays = GridSimVectorEnv(6, observation="grid", **options), GridSimVectorEnv(6, **options)
    seen, _ = env.reset(seed=4)
    rays.reset(seed=4)
    table = grid_table(env.config)
    for row in drive(env, 60, seed=5):
        np.testing.assert_array_equal(env.ranges, rays.ranges)
        np.testing.assert_array_equal(seen, grids(table, env.ranges))
        seen, *ours, info = env.step(row)
        _, *theirs, _ = rays.step(row)
        for a, b in zip(ours, theirs, strict=True):  # what an observation is made of changes nothing else
            np.testing.assert_array_equal(a, b)
    assert len(np.unique(seen)) == 3
    assert set(info) == {"distance_m", "speed_mps", "end", "_distance_m", "_speed_mps", "_end"}


def test_frames_are_the_last_grids_and_begin_anew_with_an_episode(maps: dict[str, list[Scenario]]) -> None:
    n = 5
    env = GridSimVectorEnv(n, scenario="city", maps=maps["city"], observation="grid", frames=4, max_episode_steps=9)
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


def test_pedal_and_wheel_do_what_they_say(maps: dict[str, list[Scenario]]) -> None:
    env = GridSimVectorEnv(3, maps=maps["seamless"], actions="continuous")
    env.reset(seed=0, options={"map_seed": 0})
    *_, info = env.step(np.array([[1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(info["speed_mps"], [0.3, 0.15, 0.0], atol=1e-6)  # 3 m/s2 for 0.1 s
    assert env.simulator.state.cars[:, 5] == pytest.approx(0.0)
    env.step(np.array([[0.0, 1.0], [0.0, -1.0], [0.0, 0.1]], dtype=np.float32))
    steering = np.degrees(env.simulator.state.cars[:, 5])
    np.testing.assert_allclose(steering, [6.0, -6.0, 2.7], atol=1e-3)  # 60 degrees/s; 27 at the lock


# --- wrong use


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize(
    ("action", "text"),
    [
        ([math.nan, 0.0], "not nan"),
        ([0.0, math.inf], "not inf"),
        ([1.5, 0.0], "not 1.5"),
        ([0.0, -1.01], "not -1.01"),
        ([0.0, 1e300], "not inf"),
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
    maps: dict[str, list[Scenario]], n: int, action: object, text: str
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


def test_an_error_is_one_line_for_any_number_of_cars(maps: dict[str, list[Scenario]]) -> None:
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
        ({"observation": "image"}, "observation must be rays or grid, not 'image'"),
        ({"actions": "both"}, "actions must be discrete or continuous, not 'both'"),
        ({"render_mode": "ansi"}, "render_mode must be None or rgb_array or human, not 'ansi'"),
        ({"frames": 0}, "frames must be 1 to 16"),
        ({"frames": 17, "observation": "grid"}, "frames must be 1 to 16"),
        ({"frames": 4}, "only for observation='grid'"),
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
def test_nothing_goes_before_reset(maps: dict[str, list[Scenario]], options: dict[str, Any]) -> None:
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


# --- pictures


def test_a_window_without_a_display_is_a_clear_error(
    maps: dict[str, list[Scenario]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(variable, raising=False)
    for env in (GridSimEnv, GridSimVectorEnv):
        human = env(maps=maps["seamless"][:1], render_mode="human")
        with pytest.raises(NoDisplayError, match="DISPLAY") as error:
            human.reset(seed=0)
        assert "\n" not in str(error.value)
        human.close()


@pytest.mark.usefixtures("dummy")
def test_a_window_shows_what_the_pictures_show_until_it_is_closed(maps: dict[str, list[Scenario]]) -> None:
    import pygame

    options: dict[str, Any] = {"scenario": "city", "maps": maps["city"]}
    human, array = GridSimEnv(render_mode="human", **options), GridSimEnv(render_mode="rgb_array", **options)
    for env in (human, array):
        env.reset(seed=5)
        for _ in range(3):
            env.step(Action.ACCELERATE)
    assert human.render() is None
    picture = array.render()
    assert picture is not None
    assert picture.dtype == np.uint8
    assert picture.shape == (RENDER_SIZE[1], RENDER_SIZE[0], 3)
    surface = pygame.display.get_surface()
    assert surface is not None
    shown = pygame.surfarray.array3d(surface).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, picture)

    pygame.event.post(pygame.event.Event(pygame.QUIT))
    human.step(Action.ACCELERATE)
    assert pygame.display.get_surface() is None
    human.step(Action.ACCELERATE)  # drives on, unseen
    human.close()
    human.close()


def test_pictures_show_each_cars_world(maps: dict[str, list[Scenario]]) -> None:
    env = GridSimVectorEnv(3, scenario="highway", maps=maps["highway"], render_mode="rgb_array", observation="grid")
    env.reset(seed=0)
    pictures = env.render()
    assert pictures is not None
    assert len(pictures) == 3
    assert len({p.tobytes() for p in pictures}) == 3
    again = env.render()
    assert again is not None
    np.testing.assert_array_equal(pictures, again)


def film(path: Path) -> tuple[int, float]:
    """Count of pictures, and pictures a second, of a film."""
    reader = imageio_ffmpeg.read_frames(str(path))
    fps = next(reader)["fps"]
    reader.close()
    return imageio_ffmpeg.count_frames_and_secs(str(path))[0], fps


# MoviePy 2 cuts the last picture of films of 8, 10 or 11 at 10 a second: their seconds, added up, are less than that.


def test_record_video_keeps_a_picture_for_each_step_and_one_for_the_reset(tmp_path: Path) -> None:
    env: Any = gymnasium.make(env_id("city"), maps=1, render_mode="rgb_array", max_episode_steps=12)
    env = RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda _: True)
    steps = []
    for seed in (0, None):
        env.reset(seed=seed)
        over, count = False, 0
        while not over:
            _, _, terminated, truncated, _ = env.step(int(Action.ACCELERATE))
            over, count = terminated or truncated, count + 1
        steps.append(count)
    env.close()
    films = sorted((tmp_path / "films").glob("*.mp4"))
    assert [film(path) for path in films] == [(count + 1, 10.0) for count in steps]


def test_record_video_works_on_the_vector_environment(tmp_path: Path) -> None:
    env: Any = gymnasium.make_vec(env_id("highway"), num_envs=2, maps=1, render_mode="rgb_array", max_episode_steps=6)
    env = wrappers.RecordVideo(env, str(tmp_path / "films"), video_aspect_ratio=(2, 1), episode_trigger=lambda _: True)
    env.reset(seed=0)
    for _ in range(6 + 1 + 4):  # an episode, the step that begins the next one, and some of that one
        env.step(np.full(2, Action.ACCELERATE))
    env.close()
    films = sorted((tmp_path / "films").glob("*.mp4"))
    assert [film(path) for path in films] == [(7, 10.0), (5, 10.0)]


# --- other wrappers


@pytest.mark.parametrize(("observation", "frames"), SENSING)
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_wrappers_of_a_single_environment(observation: str, frames: int, actions: str) -> None:
    options: dict[str, Any] = {"maps": 1, "observation": observation, "frames": frames, "actions": actions}
    plain = gymnasium.make(env_id("city"), **options)
    env: Any = RecordEpisodeStatistics(
        FrameStackObservation(FlattenObservation(gymnasium.make(env_id("city"), **options)), 3)
    )
    first, _ = plain.reset(seed=2)
    seen, _ = env.reset(seed=2)
    past = [first.reshape(-1)] * 3
    total, steps, over = 0.0, 0, False
    action: Any = int(Action.ACCELERATE) if actions == "discrete" else np.array([1.0, 0.1], dtype=np.float32)
    while not over:
        np.testing.assert_array_equal(seen, np.array(past))
        assert seen in env.observation_space
        now, reward, terminated, truncated, _ = plain.step(action)
        past = [*past[1:], now.reshape(-1)]
        seen, wrapped, *_, info = env.step(action)
        assert wrapped == reward
        total, steps, over = total + float(reward), steps + 1, terminated or truncated
    assert info["episode"]["l"] == steps > 5
    assert info["episode"]["r"] == pytest.approx(total, abs=1e-4)


def side_by_side(
    wrap: Any, steps: int = 40, inner: Any = None, **options: Any
) -> tuple[gymnasium.vector.VectorEnv, list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    """A wrapped vector environment and a plain one, driven alike: (the first, what it says, what the second says).

    `inner` turns the actions that the wrapped one is given into those of the plain one.
    """
    made: list[Any] = [gymnasium.make_vec(env_id("city"), num_envs=3, maps=1, **options) for _ in range(2)]
    env, plain = wrap(made[0]), made[1]
    theirs, ours = [plain.reset(seed=3)], [env.reset(seed=3)]
    for row in drive(made[1].unwrapped, steps, seed=4):
        ours.append(env.step(row))
        theirs.append(plain.step(row if inner is None else inner(row)))
    return env, ours, theirs


def test_vector_wrappers_of_observations() -> None:
    low, high = np.zeros(32, dtype=np.float32), np.full(32, 2.0, dtype=np.float32)
    expected: list[tuple[Any, dict[str, Any], Any]] = [
        (lambda env: wrappers.DtypeObservation(env, F), {"observation": "grid"}, lambda seen: seen.astype(F)),
        (lambda env: wrappers.ReshapeObservation(env, (4, 8)), {}, lambda seen: seen.reshape(-1, 4, 8)),
        (lambda env: wrappers.FlattenObservation(env), {"observation": "grid"}, lambda seen: seen.reshape(3, -1)),
        (
            lambda env: wrappers.TransformObservation(env, lambda seen: 1.0 - seen),
            {},
            lambda seen: 1.0 - seen,
        ),
        (
            lambda env: wrappers.RescaleObservation(env, low, high),
            {},
            lambda seen: (seen - [*[0.0] * 31, -0.1]) * 2.0 / [*[1.0] * 31, 1.1],
        ),
    ]
    for wrap, options, transform in expected:
        env, ours, theirs = side_by_side(wrap, **options)
        assert len(ours) == 41
        for mine, plain in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(mine[0], transform(plain[0]), atol=1e-6)
            if len(mine) == 5:
                np.testing.assert_array_equal(mine[1], plain[1])
        env.close()
    _, ours, _ = side_by_side(lambda env: wrappers.NormalizeObservation(env), steps=200)
    late = np.concatenate([row[0] for row in ours[100:]])
    assert np.isfinite(late).all()
    assert np.abs(late.mean()) < 1.0


def test_vector_wrappers_of_actions() -> None:
    continuous: dict[str, Any] = {"actions": "continuous"}
    low, high = np.full(2, -0.5, dtype=F), np.full(2, 2.0, dtype=F)
    cases: list[tuple[Any, Any]] = [
        (lambda env: wrappers.ClipAction(env), lambda row: row),
        (
            lambda env: wrappers.RescaleAction(env, low, high),
            lambda row: np.clip((row + 0.5) / 1.25 - 1.0, -1.0, 1.0),
        ),
        (lambda env: wrappers.TransformAction(env, lambda row: -row), lambda row: -row),
    ]
    for wrap, inner in cases:
        _, ours, theirs = side_by_side(wrap, inner=inner, **continuous)
        for mine, plain in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(mine[0], plain[0], atol=1e-3)
    # Beyond the limits it is clipped, and not refused.
    env = wrappers.ClipAction(gymnasium.make_vec(env_id("city"), num_envs=2, maps=1, **continuous))
    env.reset(seed=0)
    *_, info = env.step(np.array([[7.0, 0.0], [1.0, 0.0]], dtype=np.float32))
    np.testing.assert_allclose(info["speed_mps"], 0.3, atol=1e-6)


def test_vector_wrappers_of_rewards() -> None:
    _, ours, theirs = side_by_side(lambda env: wrappers.ClipReward(env, 0.0, 0.4))
    clipped = np.array([row[1] for row in ours[1:]])
    np.testing.assert_allclose(clipped, np.clip([row[1] for row in theirs[1:]], 0.0, 0.4))
    _, ours, theirs = side_by_side(lambda env: wrappers.TransformReward(env, lambda reward: 3.0 * reward))
    np.testing.assert_allclose([row[1] for row in ours[1:]], [3.0 * row[1] for row in theirs[1:]], rtol=1e-6)
    _, ours, theirs = side_by_side(lambda env: wrappers.NormalizeReward(env))
    normal, plain = (np.array([row[1] for row in rows[1:]]) for rows in (ours, theirs))
    np.testing.assert_array_equal(np.sign(normal), np.sign(plain))
    assert not np.allclose(normal, plain)


def test_vector_wrappers_of_what_is_known_of_episodes() -> None:
    env, ours, theirs = side_by_side(
        lambda env: wrappers.DictInfoToList(wrappers.RecordEpisodeStatistics(env)), steps=150, max_episode_steps=30
    )
    returns, lengths, counted = np.zeros(3), np.zeros(3, dtype=int), 0
    over = np.zeros(3, dtype=bool)
    for (*_, infos), (_, rewards, terminations, truncations, info) in zip(ours[1:], theirs[1:], strict=True):
        returns, lengths = np.where(over, 0.0, returns + rewards), np.where(over, 0, lengths + 1)
        over = terminations | truncations
        assert [each["distance_m"] for each in infos] == info["distance_m"].tolist()
        assert [each["end"] for each in infos] == info["end"].tolist()
        for k in range(3):
            assert ("episode" in infos[k]) == over[k]
            if over[k]:
                assert infos[k]["episode"]["r"] == pytest.approx(returns[k], abs=1e-4)
                assert infos[k]["episode"]["l"] == lengths[k]
                counted += 1
    assert counted > 9
    env.close()


def test_maps_in_the_arguments_are_not_compiled_for_anew(maps: dict[str, list[Scenario]]) -> None:
    """Gymnasium copies what it is given; a kernel takes arrays that can be written to for another type."""
    spec = gymnasium.make(env_id("city"), maps=maps["city"][:1]).spec
    assert spec is not None
    copied = spec.make().unwrapped.cars.simulator.scenarios[0]  # type: ignore[attr-defined]
    assert copied.seed == maps["city"][0].seed
    for again in (copied, copy.deepcopy(maps["city"][0]), pickle.loads(pickle.dumps(maps["city"][0]))):
        for name, array in again.arrays().items():
            np.testing.assert_array_equal(array, maps["city"][0].arrays()[name])
        for array in (*again.road[:3], *(part for part in again.network if np.ndim(part)), again.lanes.points):
            assert not array.flags.writeable
