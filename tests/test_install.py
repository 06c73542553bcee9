"""What pip installs: the same files from each build, and in a clean environment the simulator alone."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from commands import PROJECT, requirements

MOST_MB = 450
DRIVE = """
import sys
import gymnasium
import gridsim

env = gymnasium.make("GridSim/Curved-v0", render_mode="rgb_array")
env.reset(seed=0)
for _ in range(100):
    _, _, terminated, truncated, _ = env.step(0)
    if terminated or truncated:
        env.reset()
assert env.render().any()
assert sys.prefix in gridsim.__file__
assert not {"cluster", "torch", "ray", "mlflow", "pygame", "tyro", "rich"} & sys.modules.keys()
help(gridsim)
"""
WITHOUT_EXTRAS = {  # what is run, and the extra that it lacks
    "import gridsim; gridsim.evolve": "evolve",
    "import gridsim; gridsim.Evaluator": "evolve",
    "from gridsim import load_champion": "evolve",
    "from gridsim.view.render import Window; Window((64, 64))": "view",
}


def build(source: Path, out: Path) -> dict[str, str]:
    """Build both files in `out`; their digests by name."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(source)]
    subprocess.run(command, env={**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}, check=True, timeout=300)
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in out.iterdir()}


@pytest.fixture(scope="module")
def built(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    build(root, out)
    return out


@pytest.mark.e2e
def test_a_build_from_the_source_distribution_gives_the_same_files(built: Path, tmp_path: Path) -> None:
    digests = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in built.iterdir()}
    name = f"{PROJECT['project']['name'].replace('-', '_')}-{PROJECT['project']['version']}"
    assert digests.keys() == {f"{name}.tar.gz", f"{name}-py3-none-any.whl"}
    subprocess.run(["tar", "-xf", built / f"{name}.tar.gz", "-C", tmp_path], check=True, timeout=60)
    assert build(tmp_path / name, tmp_path / "dist") == digests
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *built.iterdir()], check=True, timeout=60)


@pytest.mark.e2e
@pytest.mark.parametrize("versions", ["newest", "lowest"])
def test_a_clean_environment_drives_and_says_what_else_needs(built: Path, tmp_path: Path, versions: str) -> None:
    pins = []
    if versions == "lowest":
        if sys.version_info >= (3, 14):
            pytest.skip("those versions are older than this Python")
        pins = [str(item).replace(">=", "==") for item in requirements() if item.specifier]
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "env"], check=True, timeout=60)
    python = tmp_path / "env/bin/python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--only-binary=:all:"]
    subprocess.run([*pip, *built.glob("*.whl"), *pins], check=True, timeout=300)
    files = [path for path in (tmp_path / "env").rglob("*") if path.is_file() and not path.is_symlink()]
    assert sum(path.stat().st_size for path in files) < MOST_MB * 2**20

    def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
        own = os.environ | {"GRIDSIM_CACHE_DIR": str(tmp_path / "cache")}  # where no kernels are
        return subprocess.run(command, cwd=tmp_path, env=own, capture_output=True, text=True, timeout=300)

    driven = run(python, "-c", DRIVE)
    assert driven.returncode == 0, driven.stderr
    assert driven.stderr.startswith("compiling the simulator for drives of this kind, once")
    for code, extra in WITHOUT_EXTRAS.items():
        line = run(python, "-c", code).stderr.splitlines()[-1]
        assert line.startswith(f'gridsim.errors.GridSimError: pip install "{PROJECT["project"]["name"]}[{extra}]" ')
    for command in PROJECT["project"]["scripts"]:
        refused = run(python.with_name(command), "--help")
        (line,) = refused.stderr.splitlines()
        assert line.startswith(f'{command}: error: pip install "{PROJECT["project"]["name"]}[evolve]" '), line
        assert (refused.returncode, refused.stdout) == (2, "")


def test_citation_and_project_agree(root: Path) -> None:
    citation = yaml.safe_load((root / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["version"], citation["license"]) == (PROJECT["project"]["version"], PROJECT["project"]["license"])
