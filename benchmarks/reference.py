"""The reference driver on the held-out episodes: `python benchmarks/reference.py [SCENARIO ...] [--episodes 64]`."""

from __future__ import annotations

import argparse

import numpy as np

from cluster.training.trainer import Maps, held_out_episodes
from evolution.episodes.curriculum import HELD_OUT_EPISODES
from gridsim.car.ego import DISTANCE, PACED, STEPS, End
from gridsim.config import SimConfig
from gridsim.maps.scenarios import REGISTRY
from gridsim.reference.driver import drive_reference

TRAFFIC = {"seamless": 6, "curved": 6}  # beside 0, where the scenario's default is none


def main() -> None:
    """Print a line for each scenario, without and with traffic; failures as (episode, end, steps)."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="*", choices=[[], *REGISTRY], metavar="SCENARIO", help="all, by default")
    parser.add_argument("--episodes", type=int, default=HELD_OUT_EPISODES, help="of each (64)")
    options = parser.parse_args()
    if not 1 <= options.episodes <= HELD_OUT_EPISODES:
        parser.error(f"--episodes must be 1 to {HELD_OUT_EPISODES}")
    print(f"{'scenario':>10} {'traffic':>7} {'success':>7} {'m/s':>6} {'paced':>5}  interval  ends")
    for name in options.scenarios or REGISTRY:
        spec = REGISTRY[name]
        maps = Maps(name, SimConfig())
        for cars in (0, spec.traffic or TRAFFIC[name]):
            episodes = held_out_episodes(maps, cars)
            scenarios = [maps.get(seed) for seed in episodes.maps]
            drives = [
                drive_reference(scenarios[row["map"]], row["start"], world, k)
                for k, (row, world) in enumerate(
                    zip(episodes.rows[: options.episodes], episodes.worlds[: options.episodes], strict=True)
                )
            ]
            speeds = [drive.car[DISTANCE] / drive.car[STEPS] * 10.0 for drive in drives]
            paced = np.mean([drive.car[PACED] / drive.car[DISTANCE] for drive in drives])
            ends = [drive.end for drive in drives]
            low, high = spec.speed_interval
            bad = [
                (k, end.name, len(d.poses))
                for k, (end, d) in enumerate(zip(ends, drives, strict=True))
                if end != End.SUCCESS
            ]
            print(
                f"{name:>10} {cars:7d} {np.mean([end == End.SUCCESS for end in ends]):7.3f} {np.mean(speeds):6.2f} "
                f"{paced:5.2f}  {low:.0f} - {high:.0f}  {len(bad)} {bad[:12]}",
                flush=True,
            )


if __name__ == "__main__":
    main()
