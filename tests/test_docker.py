"""The image and the compose file, without Docker: held against the project, and their commands run as they stand."""

import contextlib
import json
import os
import re
import shlex
import subprocess
from fnmatch import fnmatch
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import pytest
import yaml
from commands import BIN, PROJECT, end, finish, requirements, wait_until
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from tracked import free_port

from cluster.commands import cli, common
from cluster.settings import DqnSettings, EvolveSettings
from cluster.workers.kernels import everything_by_default
from gridsim.maps.scenarios import REGISTRY

ROOT = Path(__file__).parents[1]
DOCKERFILE = (ROOT / "docker/Dockerfile").read_text(encoding="utf-8")
TOKEN = "0123456789abcdef" * 4


def instructions() -> list[tuple[str, str]]:
    """(instruction, the rest) of the Dockerfile."""
    text = re.sub(r"^#.*\n", "", DOCKERFILE, flags=re.MULTILINE).replace("\\\n", " ")
    return [tuple(line.split(None, 1)) for line in text.splitlines() if line.strip()]  # type: ignore[misc]


def final_stage() -> list[tuple[str, str]]:
    steps = instructions()
    return steps[max(k for k, (name, _) in enumerate(steps) if name == "FROM") :]


def compose() -> dict[str, Any]:
    """The compose file with its variables filled in as their defaults are."""
    text = (ROOT / "docker/compose.yaml").read_text(encoding="utf-8")
    text = text.replace("${RAY_AUTH_TOKEN:?is not set; docker/README.md says how}", TOKEN)
    return yaml.safe_load(re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text))


def ignored(path: str) -> bool:
    """Whether .dockerignore keeps a path from the builder: the last pattern that fits decides."""
    kept = True
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines():
        pattern = line.lstrip("!").removeprefix("**/")
        if line and not line.startswith("#") and (fnmatch(path, pattern) or fnmatch(Path(path).name, pattern)):
            kept = line.startswith("!")
    return not kept


def test_what_is_copied_is_there_and_is_what_pip_needs() -> None:
    copied = [rest.split()[:-1] for name, rest in instructions() if name == "COPY" and "--from" not in rest]
    sources = [source for each in copied for source in each]
    assert [source for source in sources if not (ROOT / source).exists()] == []
    files = [path for source in sources for path in [ROOT / source, *(ROOT / source).rglob("*.py")] if path.is_file()]
    assert [path for path in files if ignored(str(path.relative_to(ROOT)))] == []
    project = PROJECT["project"]
    packages = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert {"pyproject.toml", project["readme"], *project["license-files"], *packages} <= set(sources)
    assert all(map(ignored, ("runs/a/checkpoint.npz", ".git/config", "cluster/__pycache__/cli.cpython-311.pyc")))


def test_python_and_every_package_are_pinned_to_a_version_that_the_project_takes() -> None:
    (version,) = re.findall(r"^ARG PYTHON=(3\.\d+\.\d+)$", DOCKERFILE, re.MULTILINE)
    assert version in SpecifierSet(PROJECT["project"]["requires-python"])
    assert all(rest.startswith("python:${PYTHON}-slim-") for name, rest in instructions() if name == "FROM")
    lines = (ROOT / "docker/requirements.txt").read_text(encoding="utf-8").splitlines()
    found = [re.fullmatch(r"([A-Za-z0-9._-]+)==([A-Za-z0-9.+]+)", line) for line in lines if line[0] not in "#-"]
    assert all(found), "every package with one version"
    pinned = {canonicalize_name(match[1]): match[2] for match in found if match}
    dashboard = [item for item in map(Requirement, requires("ray") or ()) if str(item.marker) == 'extra == "default"']
    assert len(dashboard) > 5, "which `ray job submit` asks"
    for requirement in [*requirements("evolve"), *dashboard, *map(Requirement, PROJECT["build-system"]["requires"])]:
        assert pinned[canonicalize_name(requirement.name)] in requirement.specifier, requirement


def test_it_runs_as_a_user_whose_caches_and_volumes_are_its_own() -> None:
    steps = final_stage()
    last, text = dict(steps), "\n".join(rest for _, rest in steps)
    user = last["USER"]
    assert re.search(rf"useradd --uid [1-9]\d+ .*{user}", text)
    (owned,) = re.findall(rf"install --directory --owner={user} --group={user} (.*)", text)
    folders = set(owned.split())
    (cache,) = re.findall(r"GRIDSIM_CACHE_DIR=(\S+)", text)
    assert cache in folders
    assert f"{last['WORKDIR']}/{common.WorkFlags().output}" in folders, "where runs go by default"
    volumes = [volume for service in compose()["services"].values() for volume in service.get("volumes", [])]
    assert {volume.split(":")[1] for volume in volumes} <= folders, "a new volume has its folder's owner"
    assert {volume.split(":")[0] for volume in volumes} == set(compose()["volumes"])
    assert json.loads(last["CMD"])[0] in PROJECT["project"]["scripts"]


def test_the_user_compiles_all_kernels_from_sources_of_whole_seconds_and_there_is_no_other_compiler() -> None:
    assert "apt-get" not in DOCKERFILE
    assert re.search(r"touch --date=@.*\nUSER .*\nRUN python -m cluster.workers.kernels", DOCKERFILE, re.DOTALL)
    wanted = everything_by_default()
    assert {s.scenario for s in wanted} == set(REGISTRY)
    assert {type(s) for s in wanted} == {EvolveSettings, DqnSettings}
    assert {bool(s.traffic) for s in wanted} == {False, True}
    for settings in wanted:
        settings.check()


def test_compose_is_one_image_of_this_version_with_a_token_and_ports_on_loopback_alone() -> None:
    services = compose()["services"]
    for service in services.values():
        assert service["image"] == f"gridsim:{PROJECT['project']['version']}"
        assert service["build"] == {"context": "..", "dockerfile": "docker/Dockerfile"}
        assert service["healthcheck"]["test"][0] == "CMD"
        assert service.keys().isdisjoint({"privileged", "network_mode"})
        if "ray start" in service["command"]:
            assert service["environment"].items() >= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": TOKEN}.items()
    ports = {name: service["ports"] for name, service in services.items() if "ports" in service}
    assert ports == {"mlflow": ["127.0.0.1:5000:5000"]}


def test_the_guides_commands_are_read_by_the_real_parser() -> None:
    text = (ROOT / "docker/README.md").read_text(encoding="utf-8")
    commands = re.findall(r"gridsim-evolve ([^`\n]*)", text.replace("\n", " \n"))
    assert len(commands) >= 3
    for line in commands:
        common.parse(cli.EvolveFlags, "gridsim-evolve", shlex.split(line))
    for option in re.findall(r"--file (\S+)", text):
        assert (ROOT / option).is_file()


class Services:
    """The services of the compose file as processes of this machine, with ports and folders of their own."""

    def __init__(self, folder: Path):
        self.folder, self.services = folder, compose()["services"]
        ray, mlflow = free_port(), free_port()
        self.changes = {
            r"head:6379": f"127.0.0.1:{ray}",
            r"--port=6379": f"--port={ray} --node-ip-address=127.0.0.1",
            r"--object-store-memory=\d+": "--object-store-memory=100000000",
            r"--host 0\.0\.0\.0": "--host 127.0.0.1",
            r"/home/gridsim/mlflow": str(folder / "mlflow"),
            r"\bmlflow:5000": "127.0.0.1:5000",
            r"\b5000\b": str(mlflow),
        }
        self.started: dict[str, subprocess.Popen[bytes]] = {}

    def here(self, text: str) -> str:
        for old, new in self.changes.items():
            text = re.sub(old, new, text)
        return text

    def environment(self, name: str) -> dict[str, str]:
        image = dict(re.findall(r"((?:RAY|MLFLOW|GIT)_\w+)=(\S+)", "".join(rest for _, rest in final_stage())))
        given = {k: self.here(v) for k, v in self.services[name].get("environment", {}).items()}
        path = f"{BIN}:{os.environ['PATH']}"
        return {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), **image, **given}

    def start(self, name: str) -> None:
        command, environment = shlex.split(self.here(self.services[name]["command"])), self.environment(name)
        with (self.folder / f"{name}.log").open("wb") as log:
            self.started[name] = subprocess.Popen(
                command, cwd=self.folder, env=environment, stdout=log, stderr=log, start_new_session=True
            )

    def healthy(self, name: str) -> bool:
        assert self.started[name].poll() is None, (self.folder / f"{name}.log").read_text()
        check = [self.here(word) for word in self.services[name]["healthcheck"]["test"][1:]]
        return subprocess.run(check, env=self.environment(name), capture_output=True, timeout=60).returncode == 0

    def close(self) -> None:
        for process in reversed(self.started.values()):
            end(process)


@pytest.mark.e2e
def test_the_services_come_up_and_a_run_is_evolved_on_them_and_tracked(tmp_path: Path) -> None:
    """`docker compose up`, and the guide's `exec head gridsim-evolve`, with processes in place of containers."""
    (tmp_path / "mlflow").mkdir()
    with contextlib.closing(Services(tmp_path)) as services:
        services.start("mlflow")
        services.start("head")
        wait_until(lambda: services.healthy("head"))
        services.start("worker")
        wait_until(lambda: services.healthy("worker"))
        wait_until(lambda: services.healthy("mlflow"))
        address = services.here("head:6379")  # where containers say auto: another Ray may run on this machine
        small = ["--workers", "1", "--population", "16", "--generations", "1", "--name", "composed"]
        run = "gridsim-evolve", "--address", address, *small
        finish(*run, cwd=tmp_path, timeout=500, **services.environment("head"))
        summary = json.loads((tmp_path / "runs/composed/summary.json").read_text())
        assert summary["workers"] == 1
        assert summary["mlflow_run_id"], "the server has it"
        without_token = finish("gridsim-evolve", "--address", address, cwd=tmp_path, code=1).stderr
        assert f"could not join the Ray cluster at {address}: it wants its token: set RAY_AUTH_MODE=" in without_token
