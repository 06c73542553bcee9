"""The cluster files: held against Ray's schema and the project, and local.yaml used for real, on two hosts over SSH."""

import contextlib
import json
import re
import shlex
import shutil
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import distribution, packages_distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hosts
import jsonschema  # type: ignore[import-untyped]
import pytest
import yaml
from commands import BIN, all_in_mlflow, finish, needed, ray_workers, requirements, summary, wait_until
from hosts import HOME, Host
from packaging.utils import canonicalize_name

from cluster.commands.cli import EvolveFlags
from cluster.commands.common import parse
from cluster.workers.ray_session import PACKAGES
from gridsim import evolve
from gridsim.jit import CACHE_FOLDER

CLOUDS = ("aws", "gcp")
LAUNCHED = ("local", *CLOUDS)


def read(root: Path, name: str) -> Any:
    return yaml.safe_load((root / "cluster" / f"{name}.yaml").read_text(encoding="utf-8"))


def kuberay(root: Path) -> dict[str, Any]:
    """The documents of kuberay.yaml by their kind."""
    text = (root / "cluster" / "kuberay.yaml").read_text(encoding="utf-8")
    return {document["kind"]: document for document in yaml.safe_load_all(text)}


def pinned(config: dict[str, Any], head: bool = True) -> dict[str, str]:
    """Versions that a file's commands install, by name; without `head`, on workers."""
    text = " ".join(config["setup_commands"] + config["head_setup_commands"] * head)
    return dict(re.findall(r"([a-z]+)(?:\[[a-z]+\])?==(\S+)", text))


@pytest.mark.parametrize("name", LAUNCHED)
def test_file_fits_rays_schema_and_gives_each_machine_the_project_and_the_token(root: Path, name: str) -> None:
    schema = json.loads(Path(str(distribution("ray").locate_file("ray/autoscaler/ray-schema.json"))).read_text())
    config = read(root, name)
    jsonschema.validate(config, schema)
    assert config["provider"]["type"] == name
    if name in CLOUDS:
        assert config["head_node_type"] in config["available_node_types"]
        largest = sum(kind.get("max_workers", 0) for kind in config["available_node_types"].values())
        assert config["max_workers"] == largest
    mounts = config["file_mounts"]
    assert mounts.pop("~/.ray/auth_token") == "~/.ray/auth_token"
    assert set(PACKAGES) < set(mounts.values())
    assert [path for path in mounts.values() if not (root / path).exists()] == []
    assert {there.removeprefix("~/gridsim/") for there in mounts} == set(mounts.values())
    for which in ("head", "worker"):
        last = config[f"{which}_start_ray_commands"][-1]
        assert re.search(r"RAY_AUTH_MODE=token\b.* start ", last), "without it Ray lets everyone in"
        assert "dashboard-host" not in last, "it is on loopback"


@pytest.mark.parametrize("name", LAUNCHED)
def test_versions_are_those_that_the_project_asks_for(root: Path, name: str) -> None:
    wanted = {item.name: item for item in requirements("evolve")}
    versions = pinned(read(root, name))
    assert set(versions) >= {"gymnasium", "numpy", "numba", "scipy", "torch"}
    assert [package for package, version in versions.items() if not wanted[package].specifier.contains(version)] == []
    assert versions == {package: pinned(read(root, "local"))[package] for package in versions}
    ray = pinned(read(root, "local"))["ray"]
    if name in CLOUDS:
        assert read(root, name)["docker"]["image"].startswith(f"rayproject/ray:{ray}-py3")
    for kind in ("RayJob", "RayCluster"):
        spec = kuberay(root)[kind]["spec"]
        assert spec.get("rayClusterSpec", spec)["rayVersion"] == ray


def lacking(root: Path) -> set[str]:
    """What GridSim's commands need, and workers do not have."""
    return {canonicalize_name(item.name) for item in requirements("evolve")} - needed(
        pinned(read(root, "local"), head=False)
    )


def test_workers_import_only_what_they_have(root: Path) -> None:
    text = "import sys, cluster.workers.ray_pool; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = {*finish("python", "-c", text, cwd=root).stdout.split()}
    projects, without = packages_distributions(), lacking(root)
    assert "gymnasium" in loaded
    assert not [name for name in loaded if {*map(canonicalize_name, projects.get(name, "?"))} <= without]


def test_kuberay_has_a_run_and_a_cluster_that_stays(root: Path) -> None:
    documents = kuberay(root)
    spec = documents["RayCluster"]["spec"]
    assert documents["RayJob"]["spec"]["rayClusterSpec"] == spec
    program, *flags = shlex.split(documents["RayJob"]["spec"]["entrypoint"])
    parsed = parse(EvolveFlags, program, flags)
    assert spec["authOptions"] == {"mode": "token"}
    assert spec["headGroupSpec"]["serviceType"] == "ClusterIP"
    (workers,) = spec["workerGroupSpecs"]
    version = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    labels = documents["NetworkPolicy"]["spec"]["podSelector"]["matchLabels"]
    for group in (workers, spec["headGroupSpec"]):
        assert group["template"]["metadata"]["labels"] == labels
        pod = group["template"]["spec"]
        (container,) = pod["containers"]
        assert pod["securityContext"]["runAsNonRoot"]
        assert f"--uid {pod['securityContext']['runAsUser']} " in (root / "docker/Dockerfile").read_text()
        assert container["image"].endswith(f"/gridsim:{version}")
        assert not container["securityContext"]["allowPrivilegeEscalation"]
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
        if group is workers:
            assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
            assert group["replicas"] * int(container["resources"]["limits"]["cpu"]) == parsed.work.workers
            assert container["readinessProbe"]["tcpSocket"]["port"] == int(group["rayStartParams"]["node-manager-port"])
    (mount,) = container["volumeMounts"]  # of the head, which came last
    assert parsed.work.output == mount["mountPath"]
    assert parsed.work.tracking_uri.startswith(f"sqlite:///{mount['mountPath']}/")
    claim = pod["volumes"][0]["persistentVolumeClaim"]["claimName"]
    assert claim == documents["PersistentVolumeClaim"]["metadata"]["name"]
    guide = (root / "docs" / "cluster.md").read_text(encoding="utf-8")
    assert set(re.findall(r"cluster/(\w+)\.yaml", guide)) == {*LAUNCHED, "kuberay"}


RAY = BIN / "ray"
SMALL = ["--scenario", "curved", "--traffic", "2", "--population", "48", "--generations", "6", "--seed", "5"]
UP_S = 300.0  # for what takes half a minute on a quiet machine


class Machines:
    """A laptop, with the switch, and machines that serve SSH: a head, and a worker without GridSim."""

    def __init__(self, folder: Path, root: Path, stack: contextlib.ExitStack):
        keep = [root, Path(sys.prefix), Path(sys.base_prefix), CACHE_FOLDER]
        self.laptop = stack.enter_context(contextlib.closing(hosts.switch(folder / "laptop", keep)))
        self.head = stack.enter_context(contextlib.closing(Host(folder / "head", keep)))
        assert {"mlflow", "pillow", "torch"} <= lacking(root)
        without = hosts.package_folders() | hosts.folders_of(lacking(root))
        self.worker = stack.enter_context(contextlib.closing(Host(folder / "worker", keep, without)))
        self.laptop.run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", HOME / ".ssh/gridsim")
        authorized = (self.laptop.home / ".ssh/gridsim.pub").read_text()
        for address, host in (("10.77.0.2", self.head), ("10.77.0.3", self.worker)):
            host.connect(self.laptop, address)
            host.serve_ssh(authorized)
            (host.home / ".bashrc").write_text(f"export GRIDSIM_CACHE_DIR={CACHE_FOLDER.parents[1]}\n")
        with (self.head.home / ".bashrc").open("a") as profile:
            profile.write(f"export PYTHONPATH={root}\n")  # these sources, whatever is installed
        self.config = HOME / "cluster.yaml"
        (self.laptop.home / "cluster.yaml").write_text(yaml.safe_dump(self._adapted(root)))

    def _adapted(self, root: Path) -> dict[str, Any]:
        """local.yaml with these addresses, without downloads, and with one core of each machine."""
        config = read(root, "local")
        config["provider"].update(head_ip=self.head.address, worker_ips=[self.worker.address])
        config["auth"]["ssh_user"] = "root"
        config["setup_commands"] = config["setup_commands"][:2]
        config["head_setup_commands"] = []
        for which in ("head", "worker"):
            config[f"{which}_start_ray_commands"][-1] += " --num-cpus=1 --object-store-memory=100000000"
        return config


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory, root: Path, empty_database: Path) -> Iterator[Machines]:
    if reason := hosts.missing():
        pytest.skip(reason)
    with contextlib.ExitStack() as stack:
        machines = Machines(tmp_path_factory.mktemp("hosts"), root, stack)
        shutil.copy(empty_database, machines.head.home / "mlflow.db")
        yield machines


@pytest.fixture(scope="module")
def up(machines: Machines, root: Path) -> Machines:
    laptop = machines.laptop
    laptop.run(RAY, "get-auth-token", "--generate")
    laptop.run(RAY, "up", "--yes", "--no-config-cache", machines.config, cwd=root, timeout=UP_S)
    wait_until(lambda: any("raylet" in process for process in machines.worker.processes()), UP_S, 0.5)
    return machines


def drives(pid: int) -> bool:
    """Whether a worker below it has loaded the simulator (its compiler is in its memory), and not only been started."""
    for worker in ray_workers(pid):
        with contextlib.suppress(OSError):
            if "llvmlite" in Path(f"/proc/{worker}/maps").read_text():
                return True
    return False


@pytest.mark.e2e
def test_the_same_run_as_a_job(up: Machines) -> None:
    if not find_spec("aiohttp_cors"):  # as all that its dashboard needs
        pytest.skip("needs pip install 'ray[default]'")
    found = up.worker.start(RAY.with_name("python"), "-c", "import gridsim.config")
    assert "No module named 'gridsim.config'" in found.finish(60, code=1), "it has no GridSim"
    (up.laptop.folder / "tmp/mine").mkdir()
    (up.laptop.folder / "tmp/mine/helper.py").touch()
    brought = json.dumps({"py_modules": ["/tmp/mine"]})  # which the run's own stand in place of
    tunnel = up.laptop.start(RAY, "dashboard", up.config)
    try:
        wait_until(lambda: 8265 in up.laptop.listening() or tunnel.process.poll() is not None, UP_S, 0.5)
        job = ["job", "submit", "--address", "http://127.0.0.1:8265", "--runtime-env-json", brought]
        run = up.laptop.start(
            RAY, *job, "--", "gridsim-evolve", "--workers", 2, "--name", "j", *SMALL, RAY_AUTH_MODE="token"
        )
        there = wait_until(lambda: drives(up.worker.pid) or (run.process.poll() is not None and "over"), UP_S)
        run.finish(UP_S)
    finally:
        tunnel.process.kill()
        tunnel.process.wait()
    assert there is True, "both machines evaluate"
    alone = evolve(scenario="curved", traffic=2, population=48, seed=5, generations=6)[0]
    assert summary(up.head.home / "runs/j")["champion_sha256"] == alone.sha256
    assert all_in_mlflow(up.head.home / "runs/j")


@pytest.mark.e2e
def test_who_can_reach_the_cluster(up: Machines, root: Path) -> None:
    here = {"PYTHONPATH": str(root), "GRIDSIM_CACHE_DIR": str(CACHE_FOLDER.parents[1])}
    refused = up.laptop.start(BIN / "gridsim-evolve", "--address", f"{up.head.address}:6379", **here)
    assert "wants its token" in refused.finish(60, code=1)
    assert (up.worker.home / ".ray/auth_token").read_text() == (up.laptop.home / ".ray/auth_token").read_text()
    assert (up.worker.home / ".ray/auth_token").stat().st_mode & 0o77 == 0
    open_ports = up.head.listening()
    assert 6379 in open_ports
    assert open_ports.get(8265, {"127.0.0.1"}) == {"127.0.0.1"}, "the dashboard"


@pytest.mark.e2e
def test_ray_down(up: Machines, root: Path) -> None:
    up.laptop.run(RAY, "down", "--yes", up.config, cwd=root, timeout=UP_S)
    assert [process for process in up.head.processes() if "gcs_server" in process or "raylet" in process] == []
