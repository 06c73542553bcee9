"""Every script in benchmarks/ runs, on a small scale."""

import json
import subprocess
import sys
from pathlib import Path

import hosts
import pytest
from written_roads import osm, street

FOLDER = Path(__file__).parents[1] / "benchmarks"
#: A script (and its mode) and how it is run here; what `--json` must print.
RUNS = {
    "ablations.py": (["as it is", "--seeds", "1", "--millions", "0.05"], None),
    # Where a test can have two hosts, it adds --cluster.
    "faults.py": (
        ["--faults", "1", "--generations", "10", "--json"],
        {"faults", "runs", "champions", "processes_left", "shared_memory_left", "worker_killed", "MLflow_full"},
    ),
    "learners.py": (
        ["--quick", "--json"],
        {"import_gridsim_ms", "sb3_vec_env_ratio", "ppo_sb3_success", "ppo_example_success"},
    ),
    "learners.py --roads": (["curved", "--quick", "--json"], {"ppo_sb3_curved_1s", "evolution_curved_2s"}),
    "peers.py": ([], None),
    "roads.py": (["--minutes", "0.2", "--cars", "4", "--json"], {"block.osm km", "block.osm overlaps"}),
    "scaling.py": (
        ["--quick", "--json"],
        {
            "speedup_2_threads", "speedup_2_workers", "threads_over_workers", "overhead_ms_per_generation",
            "children_per_s",
        },
    ),
    "soak.py": (
        ["--generations", "12", "--policy", "mlp:64,64", "--json"],
        {"growth", "own_growth", "mib_before", "mib_after"},
    ),
    "throughput.py": (["--runs", "1", "--json"], {"rollout_rays", "vector_env_grid", "breed_512x1000_ms"}),
    "traffic.py": (["--hours", "0.01", "--seeds", "1", "--scenario", "curved", "--json"], set()),
    "traffic.py --ego": (["3", "--seeds", "1", "--scenario", "curved", "--json"], {"curved_off_road"}),
}  # fmt: skip
PARTS = {"two_hosts.py"}  # of faults.py


def test_every_script_is_run_here() -> None:
    assert {"results.py", *(run.split()[0] for run in RUNS)} | PARTS == {path.name for path in FOLDER.glob("*.py")}


@pytest.mark.e2e
@pytest.mark.parametrize("name", RUNS)
def test_script_runs(name: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    arguments, figures = RUNS[name]
    script, *mode = name.split()
    if script == "faults.py" and not hosts.missing():
        mode, figures = ["--cluster"], {*(figures or ()), "host_gone", "link_down"}
    if script == "roads.py":
        block = tmp_path_factory.mktemp("roads") / "block.osm"
        block.write_text(osm([street((0, 0), (200, 0), (200, 200), (0, 200), (0, 0))]))
        mode = [str(block)]
    command = [sys.executable, str(FOLDER / script), *mode, *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=900)
    # A peer has to be named; and in so few generations memory still grows.
    allowed = {"peers.py": {2}, "soak.py": {0, 1}}.get(name, {0})
    assert done.returncode in allowed, done.stderr
    assert "Traceback" not in done.stderr
    if figures is not None:
        printed = json.loads(done.stdout)
        assert figures <= set(printed)
        assert all(isinstance(value, int | float) for value in printed.values()), "one flat object of numbers"
    assert list(tmp_path.iterdir()) == [], "nothing is left where it is called"


@pytest.mark.e2e
def test_results_are_measured_once_and_printed_as_a_table(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / "results.py"), "seeds", "--quick", "--output", str(tmp_path)]
    first = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert first.returncode == 0, first.stderr
    assert "| `gridsim-evolve --seed 0 --car-steps 1000` | 1 | 0.0 | inf | " in first.stdout
    runs = sorted(tmp_path.glob("*/summary.json"))
    again = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert (again.stdout, sorted(tmp_path.glob("*/summary.json"))) == (first.stdout, runs)
