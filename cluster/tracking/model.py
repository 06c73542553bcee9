"""A champion's ONNX file as a model that `mlflow.pyfunc.load_model` loads. Imports MLflow."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from cluster.tracking.content import Model


def write_model(folder: Path, model: Model) -> None:
    """Write the files of MLflow's flavour `onnx` into a new folder."""
    import numpy as np
    import onnx
    from mlflow.models import ModelSignature
    from mlflow.onnx import save_model
    from mlflow.types.schema import Schema, TensorSpec

    float32 = np.dtype(np.float32)
    observations = TensorSpec(float32, (-1, model.example.shape[1]), "observation")
    save_model(
        onnx.load(model.onnx),
        str(folder),
        signature=ModelSignature(Schema([observations]), Schema([TensorSpec(float32, (-1, 8), "outputs")])),
        input_example=model.example,
        metadata=dict(model.tags),
        pip_requirements=[f"{name}=={version(name)}" for name in ("mlflow", "onnx", "onnxruntime")],
        onnx_execution_providers=["CPUExecutionProvider"],
        save_as_external_data=False,
    )
