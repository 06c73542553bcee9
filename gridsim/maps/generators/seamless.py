"""The seamless road network: tiles, a few of them roundabouts."""

from __future__ import annotations

import numpy as np

from gridsim.maps.generators.roundabout import lay_tiles
from gridsim.maps.lanes import Plan, Scenario
from gridsim.maps.tiles import tile_graph

ROUNDABOUT_SHARE = 0.05  # probability that a T or crossing is a roundabout


def seamless_layout(rng: np.random.Generator) -> Plan:
    """The strips and lanes of a random network."""
    return lay_tiles(rng, tile_graph(rng), ROUNDABOUT_SHARE)


SCENARIO = Scenario(seamless_layout, (5.0, 12.0))
