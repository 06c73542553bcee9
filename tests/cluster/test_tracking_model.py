"""The champion as a torch model: written without pickle, read back by MLflow, registered once."""

import contextlib
import dataclasses
import os
import subprocess

import numpy as np
import pytest
from commands import finish
from tracked import client, steps, tracker

from cluster.settings import EvolveSettings
from cluster.store.champion import Champion
from cluster.tracking.description import torch_model
from cluster.tracking.mlflow_run import write_model
from evolution.networks.export import example
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig

torch = pytest.importorskip("torch")
# Of torch's and MLflow's own making; what users see is held against silence in fresh processes.
pytestmark = pytest.mark.filterwarnings("ignore")

HELD_OUT = {"episodes": 64, "success_rate": 0.5, "distance_m": 1000.0, "speed_mps": 7.0, "collision_rate": 0.5}
NAME = "gridsim-curved-evolution"


def champion_model(seed=1, success_rate=0.5, policy="mlp:6,7"):
    genome = 0.3 * np.random.default_rng(seed).standard_normal(PolicySpec.parse(policy).size).astype(np.float32)
    settings = EvolveSettings("curved", seed=seed)
    held_out = HELD_OUT | {"success_rate": success_rate}
    return torch_model(Champion(genome, policy, "curved", SimConfig()), settings, held_out)


@pytest.mark.e2e
@pytest.mark.parametrize("policy", ["mlp:6,7+motion+steering", "cnn:8,8,8@2"])
def test_what_is_written_is_the_module(tmp_path, policy, monkeypatch):
    import mlflow.pytorch
    from mlflow.models import Model

    monkeypatch.setenv("MLFLOW_ALLOW_PICKLE_DESERIALIZATION", "false")
    folder, inputs = tmp_path / "model", PolicySpec.parse(policy).inputs
    model = champion_model(policy=policy)
    module, _ = model.build()
    write_model(folder, model)
    assert os.listdir(tmp_path) == ["model"]

    loaded = mlflow.pytorch.load_model(str(folder))
    for n in (1, 2, 7):
        x = torch.rand((n, inputs), generator=torch.Generator().manual_seed(n))
        assert torch.allclose(loaded(x), module(x), atol=1e-5)
    about = Model.load(str(folder))
    assert about.signature.inputs.to_dict()[0]["tensor-spec"] == {"dtype": "float32", "shape": (-1, inputs)}
    assert about.signature.outputs.to_dict()[0]["tensor-spec"] == {"dtype": "float32", "shape": (-1, 8)}
    shown = np.asarray(about.load_input_example(str(folder)), dtype=np.float32)
    assert shown == pytest.approx(example(PolicySpec.parse(policy), SimConfig()))

    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert files >= {"MLmodel", "data/model.pt2", "requirements.txt", "input_example.json"}
    assert not [name for name in files if "pickle" in name or name.endswith((".pth", ".pkl"))]
    assert "cloudpickle" not in (folder / "requirements.txt").read_text()


def logged(uri, folder, model, key="the-key"):
    """A run that logs a row and a champion; returns its id."""
    begun = tracker(uri, 1, key=key)
    begun.log_model(folder, model)
    assert begun.close("FINISHED", timeout_s=120) is None
    return begun.run_id


def test_a_champion_is_registered_once_and_the_best_has_an_alias(uri, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    run_id = logged(uri, folder, champion_model(1))
    (version,) = client(uri).search_model_versions(f"name = '{NAME}'")
    assert version.run_id == run_id
    stored = tmp_path / "store/mlartifacts" / run_id / "artifacts"
    assert version.source == (stored / "model").as_uri()
    assert version.tags.items() >= {"seed": "1", "policy": "mlp:6,7", "held_out/success_rate": "0.5"}.items()
    assert version.tags["champion_sha256"] == champion_model(1).champion_sha256
    assert "seed 1" in version.description
    for path in ("model/MLmodel", "model/data/model.pt2"):
        assert (stored / path).read_bytes() == (folder / path).read_bytes()

    before = (folder / "model/data/model.pt2").stat().st_mtime_ns
    assert logged(uri, folder, champion_model(1)) == run_id  # a killed run goes on, and ends again
    assert len(client(uri).search_model_versions(f"name = '{NAME}'")) == 1
    assert (folder / "model/data/model.pt2").stat().st_mtime_ns == before
    assert client(uri).get_model_version_by_alias(NAME, "best").version == 1
    assert logged(uri, folder, champion_model(2, 0.75)) == run_id  # it was extended, and has a better champion
    assert {v.version for v in client(uri).search_model_versions(f"name = '{NAME}'")} == {1, 2}
    assert (folder / "model/data/model.pt2").stat().st_mtime_ns != before
    assert champion_model(2).champion_sha256 in (stored / "model/MLmodel").read_text()
    logged(uri, tmp_path, champion_model(3, 0.75), key="another")  # no better
    assert client(uri).get_model_version_by_alias(NAME, "best").version == 2


def test_without_torch_everything_else_is_logged(uri, tmp_path):
    def build():
        raise ModuleNotFoundError("No module named 'torch'")

    begun = tracker(uri, 1)
    begun.log_model(tmp_path, dataclasses.replace(champion_model(), build=build))
    (tmp_path / "a.png").write_bytes(b"png")
    begun.log_files([tmp_path / "a.png"])
    assert begun.close("FINISHED") == f"not logged to MLflow at {uri}: the model: No module named 'torch'"
    assert steps(uri, begun.run_id) == [0]
    assert client(uri).get_run(begun.run_id).info.status == "FINISHED"
    assert [each.path for each in client(uri).list_artifacts(begun.run_id)] == ["a.png"]


def test_a_run_that_is_stopped_registers_nothing(uri, tmp_path):
    begun = tracker(uri)
    begun.wait_ready()
    begun.log_model(tmp_path, champion_model(1))
    assert begun.close("KILLED", timeout_s=120) is None
    assert client(uri).search_model_versions() == []


def test_a_registry_that_is_elsewhere_and_away_is_named(uri, tmp_path, monkeypatch, impatient):
    monkeypatch.setenv("MLFLOW_REGISTRY_URI", "http://someone:secret@127.0.0.1:1")
    run_id = None
    for _ in range(2):  # a run, and the command that sends what is missing
        begun = tracker(uri, 1)
        begun.log_model(tmp_path, champion_model())
        said = begun.close("FINISHED", timeout_s=120)
        assert said == (
            f"not logged to MLflow at {uri}: the registration of the model, whose files are stored: "
            "the registry http://127.0.0.1:1 (MLFLOW_REGISTRY_URI): Connection refused"
        )
        assert run_id in (None, begun.run_id)
        run_id = begun.run_id
    assert {each.path for each in client(uri).list_artifacts(run_id, "model")} >= {"model/MLmodel"}
    monkeypatch.delenv("MLFLOW_REGISTRY_URI")
    assert logged(uri, tmp_path, champion_model()) == run_id
    assert len(client(uri).search_model_versions(f"name = '{NAME}'")) == 1


@pytest.mark.e2e
@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a small file system")
def test_a_full_temporary_folder_costs_the_model_only_which_is_sent_later(tmp_path, database):
    (tmp_path / "small").mkdir()
    flags = ("--scenario", "curved", "--traffic", "0", "--population", "16", "--generations", "2", "--workers", "0")
    with contextlib.ExitStack() as stack:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=32k", "small", tmp_path / "small"], check=True)
        stack.callback(subprocess.run, ["umount", "-l", tmp_path / "small"], check=True)
        done = finish("gridsim-evolve", *flags, "--name", "a", cwd=tmp_path, TMPDIR=str(tmp_path / "small"))
        full = f"the temporary folder, {tmp_path}/small, has no 3 MB left: No space left on device"
        assert f"the model: {full}; make room, or set TMPDIR; send it later with: " in done.stderr
        assert done.stderr.count("\n") == 1
        run = tmp_path / "runs/a"
        assert {"summary.json", "drive.html", "curves.png", "trajectory.png"} <= {path.name for path in run.iterdir()}
    again = finish("gridsim-evolve", "--resume", "runs/a", cwd=tmp_path)
    assert again.stderr == ""
    assert "sent to MLflow: 1 model" in again.stdout
