"""What mirrors show: how far behind the next cars that drive the same way are, to the right and to the left."""

from __future__ import annotations

from gridsim.jit import ZERO, F, exact
from gridsim.maps.network import wrapped
from gridsim.state import COS, LANE, SIN, X, Y

REACH = F(20.0)  # m behind, bumper to bumper, as far as mirrors show cars
SAME_WAY = F(0.7)  # least cosine of the angle between the headings of cars that drive the same way
ASIDE = F(5.5)  # m to either side that mirrors show: the next lane, not the one after it


@exact
def read(simulation, car, world, ways):
    """Write to `ways` float32 [2] how far behind (m) the next car on the right and the next one on the left are.

    The gap is bumper to bumper: 0 for a car alongside, and REACH if there is none. A car straight behind is in neither
    mirror, nor is one that comes the other way or from the side, or whose middle is ahead of this car's front.
    """
    road, constants = simulation.road, simulation.constants
    ways[0] = ways[1] = REACH
    if world is not None:
        length = F(2.0) * constants.half_length
        for j in range(world.shape[0]):
            if world[j, LANE] < ZERO:
                continue
            dx, dy = wrapped(world[j, X] - car[X], road.width), wrapped(world[j, Y] - car[Y], road.height)
            forward, aside = dx * car[COS] + dy * car[SIN], dy * car[COS] - dx * car[SIN]
            same_way = car[COS] * world[j, COS] + car[SIN] * world[j, SIN] > SAME_WAY
            if same_way and forward < constants.half_length and constants.half_width < abs(aside) < ASIDE:
                side = 1 if aside > ZERO else 0
                ways[side] = min(ways[side], max(-forward - length, ZERO))
