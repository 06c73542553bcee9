"""A champion's ONNX file as a model that `mlflow.pyfunc.load_model` loads. Imports MLflow."""

from __future__ import annotations

import json
import shutil
from importlib.metadata import version
from pathlib import Path

from cluster.tracking.content import Model

CHAMPION_TAG = "champion_sha256"  # tag of a registered version that identifies its champion


def write_model(folder: Path, model: Model) -> list[Path]:
    """Write the files of MLflow's flavour `onnx` into a folder. Returns: the files, `MLmodel` last.

    `mlflow.onnx.save_model` writes the same, but loads the model to try the example: 0.7 s of processor time.
    """
    import numpy as np
    from mlflow.models import Model as Saved
    from mlflow.models import ModelSignature
    from mlflow.pyfunc import add_to_model
    from mlflow.types.schema import Schema, TensorSpec

    data, example, shape = "model.onnx", model.example.tolist(), (-1, model.example.shape[1])
    shutil.copyfile(model.onnx, folder / data)
    (folder / "input_example.json").write_text(json.dumps(example))
    (folder / "serving_input_example.json").write_text(json.dumps({"inputs": example}))
    needed = [f"{name}=={version(name)}" for name in ("mlflow", "onnx", "onnxruntime")]
    (folder / "requirements.txt").write_text("\n".join(needed) + "\n")
    (folder / "python_env.yaml").write_text("dependencies:\n- -r requirements.txt\n")
    saved = Saved(
        metadata={**model.tags, CHAMPION_TAG: model.champion_sha256},
        saved_input_example_info={
            "artifact_path": "input_example.json",
            "serving_input_path": "serving_input_example.json",
            "type": "ndarray",
        },
    )
    float32 = np.dtype(np.float32)
    saved.signature = ModelSignature(
        Schema([TensorSpec(float32, shape, "observation")]),
        Schema([TensorSpec(float32, (-1, model.outputs), "outputs")]),
    )
    add_to_model(saved, "mlflow.onnx", data=data, python_env="python_env.yaml")
    saved.add_flavor("onnx", onnx_version=version("onnx"), data=data, providers=["CPUExecutionProvider"])
    files = sorted(folder.iterdir())
    saved.save(str(folder / "MLmodel"))
    return [*files, folder / "MLmodel"]
