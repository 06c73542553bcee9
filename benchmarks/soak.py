"""Whether memory or a checkpoint grows over generations: soak.py [--generations 2000] [--workers 0] [--policy P]

Evolves a small population from a trained driver, so that everything a long run does happens from the start: crashes,
validation, checkpoints and MLflow rows; with --policy, from random networks of that kind. After each generation, the
memory of the command and of all that it started (with --workers Ray's processes) is added up as PSS, in which shared
memory counts once.

The memory after the first 100 generations (or half of a shorter run) is compared with that at the end, as medians of
20. Exits with 1 if it grew by over 5 %, of the command alone or of all. Linux only.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

from cluster.run import Place, train
from cluster.settings import EvolveSettings
from cluster.store.champion import load_champion
from cluster.store.folder import new_run
from cluster.tracking.address import check_uri

FIRST = 100  # generations, after which nothing may grow
WINDOW = 20  # generations that a figure is the median of
GROWTH = 0.05
MIB = 2**20


def tree(pid: int) -> list[int]:
    """A process and all its descendants."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, IndexError):
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                children.setdefault(parent, []).append(int(entry.name))
    found = [pid]
    for process in found:
        found += children.get(process, [])
    return found


def memory(pid: int) -> int:
    """Bytes of a process: its own, and its part of what it shares (PSS). 0 if it is gone."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) * 1024
    return 0


def soak(generations: int, workers: int, policy: str = "") -> dict[str, list[float]]:
    """After each generation: bytes of the command (`own`), of all that it started, and of the checkpoint."""
    champion = load_champion(Path(__file__).with_name("champion.npz"))
    # Small steps, so that the drivers keep driving well.
    settings = EvolveSettings(
        policy=policy or champion.policy, population=32, sigma=0.01, generations=generations, until=2.0
    )
    seen: dict[str, list[float]] = {"own": [], "started": [], "checkpoint": []}
    with tempfile.TemporaryDirectory() as folder:
        run = new_run(Path(folder), "soak", settings)

        def look(generation: int, row: dict[str, float]) -> None:
            own, *started = tree(os.getpid())
            seen["own"].append(memory(own))
            seen["started"].append(sum(map(memory, started)))
            path = run.path / "checkpoint.npz"
            seen["checkpoint"].append(path.stat().st_size if path.exists() else 0)
            if sys.stderr.isatty():
                print(f"\rgeneration {generation} ", end="", file=sys.stderr, flush=True)

        place = Place(workers, uri=check_uri(f"sqlite:///{folder}/mlflow.db"))
        train(run, place, on_row=look, initial=None if policy else champion.genome)
    return seen


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--generations", type=int, default=2_000, help="how many (2000)")
    parser.add_argument("--workers", type=int, default=0, help="Ray workers; 0: in this process (0)")
    parser.add_argument("--policy", default="", help="start from random networks of this kind (champion.npz)")
    parser.add_argument("--json", action="store_true", help="print one flat JSON object and nothing else")
    options = parser.parse_args()
    if options.generations < 2 or options.workers < 0:
        parser.error("--generations must be 2 or more, --workers 0 or more")
    begun = time.perf_counter()
    seen = soak(options.generations, options.workers, options.policy)
    checkpoint = seen.pop("checkpoint")
    seen["all"] = [sum(both) for both in zip(*seen.values(), strict=True)]
    first = min(FIRST, len(seen["all"]) // 2)
    window = min(WINDOW, len(seen["all"]) - first)
    before, after = (
        {name: statistics.median(values[part]) for name, values in seen.items()}
        for part in (slice(first, first + window), slice(-window, None))
    )
    growth = {name: after[name] / before[name] - 1.0 for name in ("own", "all")}
    figures = {
        "generations": len(seen["all"]),
        "seconds": round(time.perf_counter() - begun, 1),
        "mib_before": round(before["all"] / MIB, 1),
        "mib_after": round(after["all"] / MIB, 1),
        "own_mib_before": round(before["own"] / MIB, 1),
        "own_mib_after": round(after["own"] / MIB, 1),
        "growth": round(growth["all"], 4),
        "own_growth": round(growth["own"], 4),
        "checkpoint_kib_before": round(statistics.median(checkpoint[first : first + window]) / 1024, 1),
        "checkpoint_kib_after": round(statistics.median(checkpoint[-window:]) / 1024, 1),
    }
    if options.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:21} {value:12,}")
    if max(growth.values()) > GROWTH:
        print(f"soak: memory has grown by {max(growth.values()):.1%}, more than {GROWTH:.0%}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
