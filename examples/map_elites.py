"""MAP-Elites, of the library pyribs, makes an atlas of drivers: python examples/map_elites.py [--generations 150]

Each cell keeps the driver that comes furthest of those with its mean speed and lateral acceleration (root mean square).
On `curved`, gentle drivers come through at 3 to 5 m/s with 0.4 to 0.8 m/s2, hard-cornering ones at 10 to 11 m/s with
2.8 and more. To the right of that edge no driver stays on the road; to its left they weave. `pip install ribs` first.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib import pyplot
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter
from ribs.schedulers import Scheduler

import gridsim
from gridsim.config import EpisodeConfig, SimConfig
from gridsim.state import End

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--scenario", default="curved", help="road to drive on (curved)")
parser.add_argument("--generations", type=int, default=150, help="of 256 drivers each (150)")
parser.add_argument("--output", default="atlas", help="folder for atlas.png and the drivers (atlas)")
options = parser.parse_args()
short = SimConfig(episode=EpisodeConfig(target=300.0, time_limit=100.0))  # m and s; held-out drives are of 2,000 m
cells, ranges = (10, 10), [(2.0, 12.0), (0.0, 4.0)]  # mean speed, m/s; lateral acceleration, m/s2


def measures(results: np.ndarray) -> np.ndarray:
    """Mean speed and lateral acceleration of drivers [n, 2], given their results [n, episodes]."""
    seconds = results["steps"] * short.episode.control_period
    speed = results["distance"].sum(axis=1) / seconds.sum(axis=1)
    return np.stack([speed, np.average(results["lateral"], axis=1, weights=seconds) ** 0.5], axis=1)


with gridsim.Evaluator(options.scenario, policy="mlp:8+steering", traffic=0, sim=short, episodes=12) as evaluator:
    archive = GridArchive(solution_dim=evaluator.genes, dims=cells, ranges=ranges, seed=0)
    first, es = np.zeros(evaluator.genes), "sep_cma_es"  # variances alone: there are too many genes for covariances
    emitters = [EvolutionStrategyEmitter(archive, x0=first, sigma0=0.3, es=es, batch_size=64, seed=k) for k in range(4)]
    search = Scheduler(archive, emitters)
    for generation in range(1, options.generations + 1):
        results = evaluator.evaluate(search.ask())  # always the same episodes, so that drivers can be compared
        search.tell(np.minimum(results["distance"] / short.episode.target, 1.0).mean(axis=1), measures(results))
        if generation % 10 == 0:
            print(f"generation {generation}: {archive.stats.qd_score:.1f} of {archive.cells} cells", flush=True)
    elites = archive.data()
    results = evaluator.evaluate(elites["solution"], seed=1)  # the atlas shows success in episodes new to all drivers

success, folder = np.full(cells, np.nan), Path(options.output)
success.flat[elites["index"]] = (results["end"] == End.SUCCESS).mean(axis=1)
folder.mkdir(parents=True, exist_ok=True)
for genome, (speed, lateral) in zip(elites["solution"], elites["measures"], strict=True):
    evaluator.champion(genome, SimConfig()).save(folder / f"{speed:.1f}mps-{lateral:.2f}mps2.npz")
for (i, j), share in np.ndenumerate(success):
    pyplot.text(2.5 + i, 0.2 + 0.4 * j, "" if np.isnan(share) else f"{share:.0%}", ha="center", va="center")
pyplot.imshow(success.T, cmap="YlGn", vmin=0, vmax=1.5, origin="lower", extent=(*ranges[0], *ranges[1]), aspect="auto")
pyplot.xlabel("mean speed, m/s")
pyplot.ylabel("lateral acceleration, m/s²")
pyplot.savefig(folder / "atlas.png", dpi=150)
