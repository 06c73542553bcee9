"""GridSim from Python: the three lines, evaluate, and a fitness of one's own."""

import dataclasses
import doctest
import json
import os
import shutil

import numpy as np
import pytest
import tracked
from commands import refused

import gridsim
from cluster import api, evaluator
from cluster.api import Champion, EvolveSettings, evaluate, evolve, load_champion
from cluster.commands.cli import evolve_main
from cluster.learn.evolution import Evolution
from cluster.store.champion import held_out
from cluster.store.checkpoint import CheckpointError, save
from cluster.store.checkpoint import load as load_checkpoint
from cluster.store.folder import RunError, RunFolder, read_config
from evolution.episodes.rollout import trajectory
from evolution.networks import convnet
from evolution.networks.policy import PolicySpec
from gridsim.config import SensorConfig, SimConfig
from gridsim.envs import sb3
from gridsim.errors import GridSimError
from gridsim.maps.map import sample_starts
from gridsim.maps.scenarios import build
from gridsim.state import STEERING

SMALL = EvolveSettings(scenario="curved", population=32, generations=2, seed=3)
ON_THE_GRID = dataclasses.replace(SMALL, observation="grid", policy="cnn:8,8,8@2", population=24)


@pytest.fixture(scope="module")
def champion():
    return evolve(SMALL)[0]


@pytest.fixture(scope="module")
def seer():
    return evolve(ON_THE_GRID)[0]


@pytest.fixture(scope="module")
def pedaller():
    return evolve(dataclasses.replace(SMALL, actions="continuous"))[0]


@pytest.mark.parametrize(
    ("which", "shown"),
    [
        ("champion", "mlp:64+steering of curved: 2,696"),
        ("seer", "cnn:8,8,8@2 of curved: 6,248"),
        ("pedaller", "mlp:64+steering+continuous of curved: 2,306"),
    ],
)
def test_load_drive_evaluate(which, shown, request, tmp_path):
    made = request.getfixturevalue(which)
    made.save(tmp_path / "champion.npz")
    loaded = load_champion(tmp_path / "champion.npz")
    others = [dataclasses.replace(made, genome=-made.genome), dataclasses.replace(made, traffic=3)]
    assert loaded == made
    assert loaded not in others
    assert len({loaded, made, *others}) == 3
    assert repr(loaded) == f"<Champion {shown} genes, sha256 {made.sha256[:8]}>"
    assert load_champion(str(tmp_path)).sha256 == made.sha256  # a run's folder
    env = loaded.make_env()
    observation, _ = env.reset(seed=1)
    env.step(loaded.act(observation))
    figures = evaluate(loaded, episodes=8)
    assert figures == evaluate(made, "curved", episodes=8)
    assert figures["episodes"] == 8
    assert figures["distance_m"] > 0.0


def test_a_run_of_pedal_and_wheel_is_kept_continued_and_refused_as_a_start_for_actions(
    pedaller, here, monkeypatch, capsys
):
    kind = dataclasses.replace(SMALL, actions="continuous")
    evolve(dataclasses.replace(kind, generations=1), folder="r")
    made, _ = evolve(kind, folder="r", resume=True)
    assert (made.sha256, made.policy) == (pedaller.sha256, "mlp:64+steering+continuous")
    assert read_config(here / "r/config.json")[0] == kind
    assert load_checkpoint(here / "r/elites.npz")[1]["policy"] == made.policy
    assert '"outputs":["pedal","wheel"]' in (here / "r/drive.html").read_text()
    for flags in ("", "--policy mlp:64+steering"):
        (line,) = refused(evolve_main, monkeypatch, capsys, "--init", "r", *flags.split())
        assert line.endswith("--init r has continuous actions, this run discrete ones")
    for flags in ("--config r/config.json --actions discrete", "--policy mlp:8+continuous"):
        (line,) = refused(evolve_main, monkeypatch, capsys, *flags.split())
        assert line.endswith("sets pedal and wheel; give --actions continuous, too")
    (line,) = refused(
        evolve_main, monkeypatch, capsys, *["--resume", "r", "--generations", "9", "--actions", "discrete"]
    )
    assert "--actions discrete contradicts the run's continuous; leave it out" in line


@pytest.mark.parametrize(
    ("scenario", "traffic", "cars"),
    [(None, None, 2), ("highway", None, 8), (None, 0, 0), ("highway", 0, 0), (None, 3, 3)],
)
def test_traffic_is_the_champions_the_roads_or_what_is_asked_for(champion, scenario, traffic, cars):
    used_to_two = dataclasses.replace(champion, traffic=2)
    ((_, _, episodes, _),) = held_out(used_to_two, scenario, 1, 0, traffic)
    assert episodes.worlds.shape[1] == cars
    asked = {} if traffic is None else {"traffic": traffic}
    env = used_to_two.make_env(scenario, **asked)
    env.reset(seed=0)
    assert env.cars.simulator.worlds.shape[1] == cars
    small = used_to_two.make_env(scenario, config="f1tenth")
    assert small.cars.simulator.worlds.shape[1] == 0, "traffic is for usual cars"


def test_a_folder_is_used_again_after_a_run_that_failed_was_deleted_or_belongs_to_it(here, monkeypatch):
    once = dataclasses.replace(SMALL, generations=1)

    def broken(results, targets):
        return 1 / 0

    with pytest.raises(GridSimError, match="ZeroDivisionError"):
        evolve(once, fitness=broken, folder="r")
    assert os.listdir("r") == []
    first, _ = evolve(once, folder="r")
    shutil.rmtree("r")
    assert evolve(once, folder="r")[0].sha256 == first.sha256
    (here / "below").mkdir()
    monkeypatch.chdir("below")
    assert len(evolve(SMALL, folder="../r", resume=True)[1]) == 2, "it is this process that has locked it"
    with pytest.raises(GridSimError, match=r"^../r is a run of another learner, gridsim-evolve$"):
        gridsim.train_dqn(scenario="curved", folder="../r", resume=True)


@pytest.mark.usefixtures("in_this_process")
def test_a_finished_run_is_sent_to_mlflow_if_it_is_asked_for(here, uri):
    evolve(SMALL, folder="r")
    assert json.loads((here / "r/summary.json").read_text())["mlflow_run_id"] == ""
    evolve(SMALL, folder="r", resume=True, tracking_uri=uri)
    (logged,) = (each.info for each in tracked.runs(uri) if each.info.run_name == "r")
    assert logged.status == "FINISHED"
    assert json.loads((here / "r/summary.json").read_text())["mlflow_run_id"] == logged.run_id


def test_paths_are_settings_and_a_configuration_is_told_to_be_none(here):
    (here / "car.yaml").write_text("vehicle: {length: 4.5}")
    settings = EvolveSettings(here / "lab.png", sim=here / "car.yaml")
    assert (settings.scenario, settings.sim) == (str(here / "lab.png"), str(here / "car.yaml"))
    with pytest.raises(GridSimError, match=r"^setting 'sim' must be a name or a file's path, not a SimConfig$"):
        EvolveSettings(sim=SimConfig())  # type: ignore[arg-type]


def test_a_champions_traffic_is_its_runs():
    assert evolve(dataclasses.replace(SMALL, traffic=5, generations=1))[0].traffic == 5


def test_environment_and_rollout_drive_alike(champion):
    """What a person sees in the environment is what evolution saw, the wheels (the last input) included."""
    policy = "mlp:8+motion+steering"
    scenario, spec = build("curved", 12), PolicySpec.parse(policy)
    start = sample_starts(scenario, 1, np.random.default_rng(3))[0]
    rng, steps, without = np.random.default_rng(4), 0, 0
    while steps < 40 or steps == without:  # until one drives for whom the last input matters
        genome = rng.normal(size=spec.size).astype(np.float32)
        blind = genome.copy()
        blind[(spec.inputs - 1) * 8 : spec.inputs * 8] = 0.0
        (result, states, _), (other, *_) = (
            trajectory(spec, genes, scenario, start, 2000.0, 400, champion.sim) for genes in (genome, blind)
        )
        steps, without = int(result["steps"]), int(other["steps"])
    driver = Champion(genome, policy, "curved", champion.sim)
    env = driver.make_env(max_episode_steps=400)
    observation, _ = env.reset(seed=1, options={"map_seed": 12, "start": start})
    driven, over, info = 0, False, {}
    while not over:
        observation, _, terminated, truncated, info = env.step(driver.act(observation))
        driven, over = driven + 1, terminated or truncated
        assert observation[-1] == pytest.approx(states[driven, STEERING] / np.radians(27.0), abs=1e-4)
    assert driven == steps
    assert info["distance_m"] == pytest.approx(float(result["distance"]), abs=1e-3)


def test_own_fitness_decides(champion):
    seen = []

    def early(results, targets):
        seen.append((results.dtype.names, results.shape, np.shape(targets)))
        return -results["steps"].mean(axis=1).astype(float)

    other, history = evolve(SMALL, fitness=early)
    assert {"distance", "paced", "steps", "end"} <= set(seen[0][0])
    assert seen[0][1][0] == 32
    assert {goals == (shape[1],) for _, shape, goals in seen} == {True}, "targets of each episode"
    assert len(history) == 2
    assert set(history[-1]) == set(Evolution.columns)
    assert history[-1]["wall_s"] > history[0]["wall_s"] > 0.0
    assert history[-1]["fitness/best"] < 0
    with pytest.raises(GridSimError, match="give either settings or population by name"):
        evolve(SMALL, population=8)
    assert other.genome.tobytes() != champion.genome.tobytes()


def test_bad_champions_are_refused(champion, tmp_path):
    save(tmp_path / "short.npz", {"genome": champion.genome[:10]}, {"policy": "mlp:6,7", "scenario": "curved"})
    with pytest.raises(CheckpointError):
        load_champion(tmp_path / "short.npz")
    for limit in (0.01, 1e9, np.inf):
        episode = dataclasses.replace(champion.sim.episode, time_limit=limit)
        sim = dataclasses.replace(champion.sim, episode=episode)
        dataclasses.replace(champion, sim=sim).save(tmp_path / "long.npz")
        with pytest.raises(CheckpointError, match=r"long.npz: not a champion: [^\n]*$"):
            load_champion(tmp_path / "long.npz")
    more = dataclasses.replace(champion.sim, sensors=dataclasses.replace(champion.sim.sensors, rays=60))
    with pytest.raises(GridSimError, match="sees 31 rays, the sensor has 60"):
        evaluate(dataclasses.replace(champion, sim=more))
    with pytest.raises(ValueError, match="sees an array of numbers, not a dictionary"):
        champion.act({"grid": np.zeros((1, 80, 80), np.uint8), "speed": np.zeros(1)})
    for name in ("a\0b", "a" * 300, tmp_path / "none.npz"):
        with pytest.raises(CheckpointError, match="cannot be read"):
            load_champion(name)
    with pytest.raises(ValueError, match="unknown scenario"):
        evaluate(champion, "moon")
    with pytest.raises(ValueError, match="1 or more"):
        evaluate(champion, episodes=0)
    with pytest.raises(GridSimError, match="--elites must be"):
        evolve(EvolveSettings(population=4, elites=8, recombination="two"))


def test_a_champion_of_the_grid_acts_on_grids_and_speed(seer, monkeypatch):
    stack = np.random.default_rng(1).choice([0, 127, 255], (3, 2, 80, 80)).astype(np.uint8)
    speeds = np.array([0.0, 5.0, 9.0])
    shares = speeds[:, None] / seer.sim.vehicle.speed_limit  # as an environment shows them
    actions = seer.act({"grid": stack, "speed": shares})
    assert [seer.act({"grid": stack[k], "speed": shares[k]}) for k in range(3)] == list(actions)
    with monkeypatch.context() as patch:
        patch.setattr(convnet, "act_on", lambda spec, genome, grids, speed: speed)
        np.testing.assert_allclose(seer.act({"grid": stack, "speed": shares}), speeds, rtol=1e-6)
    with pytest.raises(ValueError, match="sees a dictionary of grid and speed, not ndarray"):
        seer.act(stack)
    with pytest.raises(ValueError, match=r"sees a dictionary of grid and speed, not \['grid'\]"):
        seer.act({"grid": stack})
    for other in (np.zeros(32, dtype=np.float32), stack.astype(np.float32), stack[0, 0], stack[..., None]):
        with pytest.raises(ValueError, match=r"^cnn:8,8,8@2 sees grids uint8"):
            seer.act({"grid": other, "speed": shares})


def test_evolution_on_the_grid_is_the_same_for_any_number_of_workers(seer):
    assert evolve(ON_THE_GRID, workers=2)[0].sha256 == seer.sha256


def test_gridsim_itself_has_the_python_api_and_its_examples_run():
    assert {name for name in api.__all__ if getattr(gridsim, name) is getattr(api, name)} == set(api.__all__)
    assert set(api.__all__) < set(dir(gridsim))
    with pytest.raises(AttributeError, match="no attribute 'evolv'"):
        gridsim.evolv  # type: ignore[attr-defined]  # noqa: B018
    for module, least in ((api, 5), (evaluator, 2), (sb3, 4)):
        done = doctest.testmod(module)
        assert (done.attempted >= least, done.failed) == (True, 0)


# --- A car of one's own ----------------------------------------------------------------------------------------------


@pytest.fixture
def own_sim(tmp_path):
    """A file of a longer car that is done after 30 m."""
    path = tmp_path / "car.yaml"
    path.write_text("vehicle: {length: 4.5}\nepisode: {target: 30, time_limit: 20}\n")
    return path


def test_a_champion_learns_validates_and_is_measured_with_its_own_car(own_sim, tmp_path):
    seen = []

    def fitness(results, targets):
        seen.append(targets)
        return results["distance"].sum(axis=1)

    champion, _ = evolve(scenario="curved", sim=str(own_sim), population=16, generations=2, fitness=fitness)
    assert champion.sim == SimConfig.load(own_sim) != SimConfig()
    assert np.max(seen[0]) == 30.0
    champion.save(tmp_path / "champion.npz")
    own_sim.unlink()
    again = load_champion(tmp_path / "champion.npz")
    assert again.sim == champion.sim
    ((_, _, chosen, _),) = held_out(again, None, 8, 2_000_000, None)
    assert set(chosen.rows["target"]) == {30.0}
    assert again.make_env().unwrapped.cars.config == champion.sim
    assert evaluate(again, episodes=8, sim="default") != evaluate(again, episodes=8)
    with pytest.raises(GridSimError, match="sees 31 rays, the sensor has 40"):
        evaluate(again, episodes=8, sim=SimConfig(sensors=SensorConfig(rays=40)))


def test_a_run_keeps_its_car_and_refuses_another(own_sim, tmp_path):
    run = RunFolder(tmp_path / "run", EvolveSettings(sim=str(own_sim)))
    run.path.mkdir()
    run.write_config()
    assert run.config()["simulator"]["vehicle"]["length"] == 4.5
    settings, _ = read_config(run.path / "config.json")
    assert settings == run.settings
    digest = run.digest()
    own_sim.write_text("vehicle: {length: 4.6}\n")
    assert run.digest() != digest
    with pytest.raises(RunError, match=r"--sim .*car.yaml is not what it was for"):
        read_config(run.path / "config.json")


def test_champions_of_former_versions_count_patience_in_seconds(champion, tmp_path):
    sim = dataclasses.asdict(champion.sim)
    sim["episode"] |= {"patience": 15, "progress": 0.05, "control_period": 0.1}
    sim["traffic"] |= {"kerb": 0.3}
    meta = {"policy": champion.policy, "scenario": champion.scenario, "traffic": 0, "sim": sim}
    save(tmp_path / "c.npz", {"genome": champion.genome}, meta)
    assert load_champion(tmp_path / "c.npz").sim == SimConfig()
