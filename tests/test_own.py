"""A vehicle model, a sensor and a kind of road of one's own, in a copy of the sources, to the letter of docs/own.md."""

import re
import shutil
from pathlib import Path

import pytest
from commands import finish

TRAIN = """
import gridsim, onnxruntime
flags = dict(scenario="eight", sim="car.yaml", policy="mlp:4+sideways", generations=1, population=16)
champion, _ = gridsim.evolve(**flags, folder="run")
session, env = onnxruntime.InferenceSession("run/champion.onnx"), champion.make_env()
seen, _ = env.reset(seed=1)
for action in [0] * 10 + [1] * 5:
    assert session.run(["action"], {"observation": seen[None]})[0][0] == champion.act(seen)
    seen, *_ = env.step(action)
print(champion.sim.vehicle.drag, champion.policy, champion.scenario, float(seen[-1]))
"""


def put(path: Path, before: str, line: str) -> None:
    """Insert a line before a text that is there once."""
    text = path.read_text(encoding="utf-8")
    assert text.count(before) == 1, before
    path.write_text(text.replace(before, f"{line}{before}"), encoding="utf-8")


@pytest.mark.e2e
def test_a_model_a_sensor_and_a_road_are_added_as_the_page_says_and_train(root: Path, tmp_path: Path) -> None:
    for package in ("gridsim", "evolution", "cluster"):
        shutil.copytree(root / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    page = (root / "docs/own.md").read_text(encoding="utf-8")
    for folder, name in (("car", "drag"), ("sensing", "sideways"), ("maps/generators", "eight")):
        text = re.split(rf"`{name}\.py`", page)[1].split("```python\n")[1].split("```")[0]
        (tmp_path / "gridsim" / folder / f"{name}.py").write_text(text, encoding="utf-8")
    models, observation = tmp_path / "gridsim/car/models.py", tmp_path / "gridsim/sensing/observation.py"
    put(models, "kinematic, single_track\n", "drag, ")
    put(models, '"single_track": single_track}', '"drag": drag, ')
    put(models, "single_track.Numbers)", "drag.Numbers, ")
    feature, line = re.findall(r"^(?:Feature|_put)\(.*$", page, flags=re.MULTILINE)
    put(observation, "from gridsim.state import", "from gridsim.sensing import sideways\n")
    put(observation, "    )\n\n\nUSUAL", f"        {feature}\n")
    put(observation, "\n\n@exact\ndef normalise", f"    {line}\n")
    (tmp_path / "car.yaml").write_text("vehicle: {model: drag, drag: 0.002}\n", encoding="utf-8")
    said = finish("python", "-c", TRAIN, cwd=tmp_path, PYTHONPATH=str(tmp_path)).stdout.split()
    assert said[:3] == ["0.002", "mlp:4+sideways", "eight"]
    assert float(said[3]) > 0.0, "the nose moves to the left"
