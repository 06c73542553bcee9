"""What MLflow is told of a run: names that tell runs apart, tags that put seeds together, figures that are the best."""

import re

from cluster.learn.dqn import Dqn
from cluster.learn.evolution import Evolution
from cluster.settings import DqnSettings, EvolveSettings
from cluster.tracking.description import NOT_LOGGED, group, held_out_metrics, model_name, result, tags

HELD_OUT = {"episodes": 64, "success_rate": 0.984, "distance_m": 2000.2, "speed_mps": 7.61, "collision_rate": 0.016}
SUMMARY = {"generations": 48, "car_steps": 96_300_000, "wall_s": 57.2, "solved": True, "held_out": HELD_OUT}


def test_seeds_are_one_group_and_nothing_else_is():
    def of(kind=EvolveSettings, **settings):
        return group(kind("curved", **settings))

    assert of() == of(seed=1) == of(generations=5) == "curved evolution mlp:64+steering"
    others = [
        of(population=64), of(policy="mlp:8"), of(traffic=3), of(search="random"), of(observation="grid"),
        of(sigma=0.1), of(recombination="two"), of(DqnSettings), of(DqnSettings, discount=0.9),
        of(DqnSettings, observation="grid"),
    ]  # fmt: skip
    assert len({of(), *others}) == 1 + len(others)
    assert of(population=64, sigma=0.1) == "curved evolution mlp:64+steering, population 64, sigma 0.1"
    assert of(search="random", traffic=3) == "curved random mlp:64+motion+steering 3 cars"


def test_tags_are_what_runs_are_compared_by():
    found = tags(EvolveSettings("highway", seed=4, search="random"))
    group = "highway random mlp:64+motion+steering 8 cars"
    assert found == {"algorithm": "evolution", "scenario": "highway", "group": group}
    assert tags(DqnSettings())["algorithm"] == "dqn"
    assert model_name(EvolveSettings("maps/my town@2.png")) == "gridsim-my_town_2-evolution"


def test_every_metric_is_explained(root):
    explained = set(re.findall(r"^\| `([^`]+)`", (root / "docs/mlflow.md").read_text(), re.MULTILINE))
    logged = {*Evolution.columns, *Dqn.columns, *held_out_metrics(HELD_OUT)} - {*NOT_LOGGED}
    assert logged <= explained


def test_the_description_says_what_came_of_it_and_how_to_watch_it(tmp_path):
    said = result(tmp_path / "mine", EvolveSettings("curved", seed=3, traffic=2), SUMMARY)
    for words in ("48 generations, 96.3 million car-steps and 57 s", "**98.4%**", "7.61 m/s", "collides in 1.6%",
                  f"gridsim-watch {tmp_path}/mine", "drive.html", "float32 [n, 64]", "gridsim-curved-evolution",
                  'load_model("runs:/{run_id}/model").predict'):  # fmt: skip
        assert words in said
