"""The image, built without Docker: the Dockerfile's own steps, run one by one in fresh Debian roots.

It fetches two gigabytes of packages and compiles everything, which takes ten minutes: `GRIDSIM_IMAGE=1 pytest
tests/test_image.py`, as root, with debootstrap. Python is Debian's 3.11 in place of the image's; else nothing differs.
"""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from hosts import HOME
from test_docker import ROOT, ignored, instructions

MIRROR = "http://deb.debian.org/debian"
STEP_S = 1800.0
# Arguments: the root, the user, the folder, the command, the environment up to --, folders to be seen inside.
ENTER = """
root=$1 user=$2 folder=$3 command=$4; shift 4
environment=(); while [ "$1" != -- ]; do environment+=("$1"); shift; done; shift
mount -t proc proc "$root/proc"
mkdir -p "$root/dev/shm"; mount -t tmpfs tmpfs "$root/dev/shm"
for path in "$@"; do mkdir -p "$root$path"; mount --bind "$path" "$root$path"; done
exec chroot --userspec="$user" "$root" env -i "${environment[@]}" sh -c 'cd "$1" && eval "$2"' sh "$folder" "$command"
"""

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(not os.environ.get("GRIDSIM_IMAGE"), reason="takes ten minutes: GRIDSIM_IMAGE=1 runs it"),
]


class Stage:
    """What the builder has in hand between FROM and FROM."""

    def __init__(self, root: Path):
        self.root, self.user, self.folder = root, "root", "/"
        self.environment = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root"}

    def inside(self, path: str) -> Path:
        return self.root / path.lstrip("/")

    def run(self, command: str) -> str:
        """A command in it; returns its output, errors included."""
        given = [f"{name}={value}" for name, value in (self.environment | pip_settings()).items()]
        done = subprocess.run(
            ["unshare", "--mount", "--pid", "--fork", "--kill-child", "bash", "-euc", ENTER, "enter", str(self.root),
             self.user, self.folder, command, *given, "--", *pip_folders()],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=STEP_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}"
        return done.stdout

    @staticmethod
    def kept_out(path: Path) -> bool:
        """Whether .dockerignore says so; another stage's files all come along."""
        return ROOT in path.parents and ignored(str(path.relative_to(ROOT)))

    def copy(self, sources: list[Path], target: str) -> None:
        """Files go into the target, a folder's contents become the target's."""
        for source in sources:
            if source.is_dir():
                shutil.copytree(
                    source, self.inside(target), symlinks=True, dirs_exist_ok=True,
                    ignore=lambda folder, names: [name for name in names if self.kept_out(Path(folder) / name)],
                )  # fmt: skip
            else:
                self.inside(target).mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, self.inside(target))


def pip_settings() -> dict[str, str]:
    """Where pip finds packages on this machine; an index that is out of reach is asked for each of them."""
    return {"PIP_RETRIES": "0"} | {name: value for name, value in os.environ.items() if name.startswith("PIP_")}


def pip_folders() -> list[str]:
    """Folders of packages that pip is told of, where this machine has any."""
    env = os.environ | {"HOME": str(HOME)}
    said = subprocess.run(["pip", "config", "list"], env=env, capture_output=True, text=True, check=True).stdout
    named = re.findall(r"(?<![\w.:/])(?:file://)?(/[\w./-]+)", said)
    return sorted({path.removesuffix("/simple") for path in named if Path(path).is_dir()})  # files lie beside an index


def fresh(folder: Path) -> Path:
    """A root with Debian, Python, and this machine's way to the network."""
    include = "--include=python3,python3-venv,ca-certificates"
    subprocess.run(["debootstrap", "--variant=minbase", include, "bookworm", str(folder), MIRROR], check=True)
    (folder / "usr/local/bin/python").symlink_to("/usr/bin/python3")
    for path in ("/etc/resolv.conf", "/etc/hosts", "/etc/pip.conf", "/etc/ssl/certs/ca-certificates.crt"):
        if Path(path).is_file():
            shutil.copy(path, folder / path[1:])
    own = HOME / ".config/pip/pip.conf"
    if own.is_file():
        (folder / "root/.config/pip").mkdir(parents=True)
        shutil.copy(own, folder / "root/.config/pip/pip.conf")
    return folder


def build(folder: Path) -> Stage:
    """Run the Dockerfile. Returns its last stage."""
    base = fresh(folder / "base")
    stages: dict[str, Stage] = {}
    stage = Stage(base)
    for name, rest in instructions():
        if name == "FROM":
            title = rest.split()[-1]
            subprocess.run(["cp", "-a", str(base), str(folder / f"stage{len(stages)}")], check=True)
            stage = stages[title] = Stage(folder / f"stage{len(stages)}")
        elif name == "RUN":
            stage.run(rest)
        elif name == "ENV":
            for item in shlex.split(rest):
                key, value = item.split("=", 1)
                stage.environment[key] = value.replace("$PATH", stage.environment["PATH"])
        elif name == "COPY":
            *sources, target = rest.split()
            origin = ROOT
            if sources[0].startswith("--from="):
                origin = stages[sources.pop(0).removeprefix("--from=")].root
            stage.copy([origin / source.lstrip("/") for source in sources], target)
        elif name == "USER":
            stage.user, stage.environment["HOME"] = f"{rest}:{rest}", f"/home/{rest}"
        elif name == "WORKDIR":
            stage.folder = rest
        else:
            assert name in ("ARG", "LABEL", "CMD"), f"{name}: what does it do?"
    return stage


def test_the_image_is_built_and_evolves_a_driver_without_compiling_anything(tmp_path: Path) -> None:
    if os.geteuid() != 0 or not shutil.which("debootstrap"):
        pytest.fail("building the image takes root's rights and debootstrap")
    image = build(tmp_path)
    cache = image.inside("/var/cache/gridsim")
    compiled = sorted(path for path in cache.rglob("*") if path.is_file())
    assert compiled
    assert "--generations" in image.run("gridsim-evolve --help")
    said = image.run(
        "gridsim-evolve --workers 2 --scenario city --population 32 --elites 4 --generations 2 --name first"
    )
    assert "champion" in said
    assert image.inside("/home/gridsim/runs/first/drive.html").is_file()
    assert sorted(path for path in cache.rglob("*") if path.is_file()) == compiled, "kernels were there"
    size = sum(path.lstat().st_size for path in image.inside("/opt").rglob("*") if path.is_file())
    print(f"the image's own layer: {size / 1e9:.2f} GB; {len(compiled)} files of compiled kernels")
