"""`gridsim.Evaluator`: what a search of the user's own asks for."""

from pathlib import Path

import numpy as np
import pytest
from commands import finish

import gridsim
from evolution.episodes import fitness
from gridsim.config import EpisodeConfig, SimConfig
from gridsim.errors import GridSimError

SHORT = SimConfig(episode=EpisodeConfig(target=100.0, time_limit=30.0))


def test_episodes_follow_from_the_seed_and_results_from_genome_and_episode_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # only address="auto" asks for it
    with gridsim.Evaluator("curved", policy="mlp:8", traffic=2, sim=SHORT, episodes=6) as evaluator:
        genomes = np.random.default_rng(0).normal(size=(40, evaluator.genes)).astype(np.float32)
        results = evaluator.evaluate(genomes, seed=3)
        assert results.shape == (40, 6)
        assert results.tobytes() == evaluator.evaluate(genomes[::-1], seed=3)[::-1].tobytes()
        assert results.tobytes() != evaluator.evaluate(genomes, seed=4).tobytes()
        scores = evaluator.fitness(genomes, seed=3)
        assert np.array_equal(scores, fitness.scalar(results, 100.0))
        assert 0.0 < scores.max() <= 1.0
        driver = evaluator.champion(genomes[0])
    assert (driver.policy, driver.scenario, driver.traffic, driver.sim) == ("mlp:8", "curved", 2, SHORT)
    assert gridsim.evaluate(driver, episodes=4)["episodes"] == 4


IN_USE = """
import numpy as np
import ray

import gridsim

ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
found = []
for workers in (0, 2):
    with gridsim.Evaluator("curved", policy="mlp:8", workers=workers, episodes=4) as evaluator:
        genomes = np.random.default_rng(0).normal(size=(40, evaluator.genes)).astype(np.float32)
        found.append(evaluator.evaluate(genomes).tobytes())
print(found[0] == found[1], ray.is_initialized())
"""


@pytest.mark.e2e
def test_it_uses_a_ray_that_is_in_use_for_the_same_bits_and_leaves_it(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(IN_USE)
    assert finish("python", "own.py", cwd=tmp_path, RAY_AUTH_MODE="disabled").stdout.splitlines()[-1] == "True True"


@pytest.mark.parametrize("given", [{"policy": "mlp:8", "actions": "continuous"}, {"policy": "mlp:8+continuous"}])
def test_it_evaluates_networks_of_pedal_and_wheel(given: dict) -> None:
    with gridsim.Evaluator("curved", sim=SHORT, episodes=2, **given) as evaluator:
        genomes = np.random.default_rng(0).normal(size=(40, evaluator.genes)).astype(np.float32)
        assert evaluator.fitness(genomes).max() > 0.0
        driver = evaluator.champion(genomes[0])
    assert driver.policy == "mlp:8+continuous"
    assert driver.make_env().action_space.shape == (2,)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"policy": "mlp"}, "mlp"),
        ({"workers": -1}, "--workers must be"),
        ({"sim": SimConfig.load("f1tenth"), "traffic": 3}, "traffic is for cars of 2.83 m or more"),
        ({"episodes": 0}, "episodes must be 1 to 10,000, not 0"),
    ],
)
def test_wrong_use_is_said_in_one_line(given: dict, said: str) -> None:
    with pytest.raises(GridSimError, match=said):
        gridsim.Evaluator(**given)


@pytest.mark.parametrize("sim", ["f1tenth", SimConfig.load("f1tenth")])
def test_a_small_car_has_no_traffic_by_default(sim: SimConfig | str) -> None:
    with gridsim.Evaluator("highway", policy="mlp:8", sim=sim, episodes=1) as evaluator:
        assert evaluator.evaluate(np.zeros((1, evaluator.genes), dtype=np.float32)).shape == (1, 1)


def test_genomes_that_do_not_fit_are_refused() -> None:
    with gridsim.Evaluator("curved", policy="mlp:8") as evaluator:
        for wrong in (np.zeros((2, 5)), np.zeros(evaluator.genes)):
            with pytest.raises(GridSimError, match=r"^genomes of mlp:8 must be \[n, 336\], not \["):
                evaluator.evaluate(wrong)
        with pytest.raises(GridSimError, match=r"^at most 65,536 genomes can be evaluated at once, not 65,537$"):
            evaluator.evaluate(np.zeros((65_537, evaluator.genes), dtype=np.float32))
        wrong = np.zeros((3, evaluator.genes))
        wrong[2, 7] = np.nan
        with pytest.raises(GridSimError, match=r"must be finite numbers; those of member 2 are not$"):
            evaluator.fitness(wrong)
