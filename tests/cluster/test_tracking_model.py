"""The champion in MLflow's registry, which MLflow loads without GridSim, and what MLflow is told of a run."""

import re

import pytest
from tracked import HELD_OUT, MODEL, client, runs, send, tracking, write_run

from cluster.learn.dqn import Dqn
from cluster.learn.evolution import Evolution
from cluster.settings import DqnSettings, EvolveSettings
from cluster.store.champion import load_champion
from cluster.tracking.address import check_uri
from cluster.tracking.description import NOT_LOGGED, group, held_out_metrics, model_name, read_run
from cluster.tracking.tracking import sync
from evolution.networks.export import example
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig

pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore")  # of MLflow's and its libraries' own making
@pytest.mark.parametrize("policy", ["mlp:6,7+motion+steering", "cnn:8,8,8@2", "mlp:6,7+continuous"])
def test_mlflow_loads_the_champion(uri, tmp_path, policy, monkeypatch):
    import mlflow

    monkeypatch.setenv("MLFLOW_ALLOW_PICKLE_DESERIALIZATION", "false")
    spec = PolicySpec.parse(policy)
    kind = {"policy": policy, "observation": spec.observation, "actions": spec.actions}
    folder = write_run(tmp_path / "a", 1, success_rate=0.5, **kind)
    _, run_id = send(folder, uri)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    champion, shown = load_champion(folder), example(spec, SimConfig())
    gives: dict[str, tuple[int, ...]] = {"outputs": (8,), "action": ()}
    if spec.actions == "continuous":
        gives = {"action": (2,)}
    for address in (f"models:/{MODEL}@best", f"runs:/{run_id}/model"):
        loaded = mlflow.pyfunc.load_model(address)
        found = loaded.predict(shown)
        assert found["action"] == pytest.approx(champion.act(shown.get("observation", shown)), abs=1e-5)
        assert {name: array.shape[1:] for name, array in found.items()} == gives
    about = loaded.metadata
    kinds = {each["name"]: each["tensor-spec"] for each in about.signature.inputs.to_dict()}
    assert kinds == {name: {"dtype": str(x.dtype), "shape": (-1, *x.shape[1:])} for name, x in shown.items()}
    assert {each.name: each.shape[1:] for each in about.signature.outputs} == gives
    assert about.metadata["champion_sha256"] == champion.sha256
    stored = tmp_path / "store/mlartifacts" / run_id / "artifacts/model"
    needed = [line.partition("==")[0] for line in (stored / "requirements.txt").read_text().splitlines()]
    assert needed == ["mlflow", "onnx", "onnxruntime"]
    assert (stored / "model.onnx").read_bytes() == (folder / "champion.onnx").read_bytes()


def test_a_champion_is_registered_once_and_the_best_has_an_alias(uri, tmp_path):
    folder = write_run(tmp_path / "a", 1, success_rate=0.5, seed=1)
    _, run_id = send(folder, uri)
    (version,) = client(uri).search_model_versions(f"name = '{MODEL}'")
    assert version.run_id == run_id
    assert version.source == (tmp_path / "store/mlartifacts" / run_id / "artifacts/model").as_uri()
    tags = {"seed": "1", "policy": "mlp:64+steering", "held_out/success_rate": "0.5"}
    assert version.tags.items() >= {**tags, "champion_sha256": load_champion(folder).sha256}.items()
    assert "seed 1" in version.description

    def ended(name, seed, success_rate):
        """The run goes on, and ends again."""
        run = tracking(write_run(tmp_path / name, 1, seed=seed), uri)
        assert run.wait_id(30)
        write_run(tmp_path / name, 1, success_rate, seed=seed)
        assert run.close("FINISHED") is None
        return run.sent["model"], client(uri).get_model_version_by_alias(MODEL, "best").version

    assert ended("a", 1, 0.5) == (0, 1)  # the same champion
    assert ended("a", 2, 0.75) == (1, 2)  # a better one
    assert ended("another", 3, 0.75) == (1, 2)  # no better
    assert {each.version for each in client(uri).search_model_versions(f"name = '{MODEL}'")} == {1, 2, 3}


def test_a_registry_that_is_elsewhere_and_away_is_named(uri, tmp_path, monkeypatch, impatient):
    folder = write_run(tmp_path / "a", 1, success_rate=0.5)
    monkeypatch.setenv("MLFLOW_REGISTRY_URI", "http://someone:secret@127.0.0.1:1")
    reason = "the registry http://127.0.0.1:1 (MLFLOW_REGISTRY_URI): Connection refused"
    for expected in ("2 rows, 6 files", ""):  # a run, and the command that sends what is missing
        said = f"not logged to MLflow at {uri}: the model: {reason}"
        assert sync(folder, uri, "driving", read_run) == (expected, said)
    (run,) = runs(uri)
    assert {each.path for each in client(uri).list_artifacts(run.info.run_id, "model")} >= {"model/MLmodel"}
    other = check_uri(f"sqlite:///{tmp_path}/registry.db")
    send(write_run(tmp_path / "b", 1), other)
    monkeypatch.setenv("MLFLOW_REGISTRY_URI", other)
    assert send(folder, uri) == ("1 model", run.info.run_id)
    assert client(uri).get_model_version_by_alias(MODEL, "best").run_id == run.info.run_id


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
    assert of(actions="continuous") == "curved evolution mlp:64+steering+continuous"
    assert of(population=64, sigma=0.1) == "curved evolution mlp:64+steering, population 64, sigma 0.1"
    assert of(search="random", traffic=3) == "curved random mlp:128+motion+steering 3 cars"
    assert model_name(EvolveSettings("maps/my town@2.png")) == "gridsim-my_town_2-evolution"


def test_every_metric_is_explained(root):
    explained = set(re.findall(r"^\| `([^`]+)`", (root / "docs/mlflow.md").read_text(), re.MULTILINE))
    assert {*Evolution.columns, *Dqn.columns, *held_out_metrics({"held_out": HELD_OUT})} - {*NOT_LOGGED} <= explained
