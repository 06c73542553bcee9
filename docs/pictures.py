"""The README's pictures of the scenarios: a champion among traffic, what its rays see, and where it has been.

    python docs/pictures.py [FOLDER]

The champion is that of the benchmarks, which learned on `seamless`. Which moment of which drive a picture shows is
chosen by eye, on held-out maps.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from cluster.report.film import picture, record
from cluster.store.champion import load_champion
from evolution.episodes.starts import lane_starts
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import build
from gridsim.view.render import Renderer

SIZE = (480, 360)
TRAFFIC = 24  # more than usual, so that there is something to see
STARTS = 6  # drawn on each map
# Scenario: map (from HELD_OUT_SEED on), start, seconds since then.
MOMENTS = {
    "highway": (3, 5, 13.0),
    "curved": (3, 1, 23.0),
    "seamless": (5, 4, 18.0),
    "roundabout": (1, 4, 28.0),
    "city": (4, 3, 8.0),
}


def main() -> int:
    """Draw them."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    folder.mkdir(parents=True, exist_ok=True)
    champion = load_champion(Path(__file__).parent.parent / "benchmarks" / "champion_traffic.npz")
    for name, (number, start, seconds) in MOMENTS.items():
        scenario = build(name, HELD_OUT_SEED + number, champion.sim)
        rng = np.random.default_rng(scenario.seed)
        episodes, worlds = lane_starts([scenario], np.zeros(STARTS, dtype=int), rng, TRAFFIC, champion.sim)
        drive = record(champion, scenario, episodes["start"][start], seconds, worlds[start])
        drawn = picture(Renderer(scenario, SIZE, config=champion.sim), drive, seconds, name)
        # 256 colours are enough, and a third of the bytes.
        Image.fromarray(drawn).quantize(256, dither=Image.Dither.NONE).save(folder / f"{name}.png", optimize=True)
        print(folder / f"{name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
