"""How a champion drives as its sensor, its actuators and its tyres get worse."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from cluster.report.pictures import drawable, figure_of, plain_style
from cluster.store.champion import Champion, evaluate
from gridsim.config import LIMITS, SimConfig
from gridsim.maps.scenarios import Traffic

PICTURE = "stress.png"


class Stress(NamedTuple):
    """One thing that gets worse level by level: the number `name` in a `part` of SimConfig, such as its sensors."""

    label: str
    part: str
    name: str
    levels: tuple[float, ...]
    share: bool = False  # whether levels are factors on the champion's own number

    def at(self, level: float, sim: SimConfig) -> SimConfig:
        """The configuration `sim` with this number, and its range in `randomise`, set to a level, or if `share` to that
        multiple.
        """
        least, most, *_ = LIMITS[self.part][self.name]

        def worse(value: float) -> float:
            return min(max(level * value, least), most) if self.share else level

        part, randomise = getattr(sim, self.part), sim.randomise
        if self.part == "vehicle":
            randomise = tuple(
                (name, worse(least), worse(most)) if name == self.name else (name, least, most)
                for name, least, most in sim.randomise
            )
        part = dataclasses.replace(part, **{self.name: worse(getattr(part, self.name))})
        return dataclasses.replace(sim, **{self.part: part}, randomise=randomise)


STRESSES = (
    Stress("noise, m", "sensors", "noise", (0.0, 0.1, 0.2, 0.5, 1.0, 2.0)),
    Stress("dropout, share of readings", "sensors", "dropout", (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)),
    Stress("latency of readings, s", "sensors", "latency", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)),
    Stress("latency of commands, s", "vehicle", "latency", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)),
)
KINEMATIC = (Stress("grip, share of its own", "vehicle", "lateral_grip", (1.0, 0.9, 0.8, 0.7, 0.6, 0.5), share=True),)
DYNAMIC = (
    Stress("friction, share of its own", "vehicle", "friction", (1.0, 0.9, 0.8, 0.7, 0.6, 0.5), share=True),
    Stress("mass, share of its own", "vehicle", "mass", (1.0, 1.1, 1.2, 1.3, 1.4, 1.5), share=True),
)
OF_MODEL = {"kinematic": KINEMATIC, "single_track": DYNAMIC}


def stresses(champion: Champion) -> list[Stress]:
    """What can get worse for a champion: STRESSES, and those of its vehicle's model."""
    return [*STRESSES, *OF_MODEL.get(champion.sim.vehicle.model, ())]


def drive(
    champion: Champion, chosen: Iterable[Stress], scenario: str, episodes: int, seed: int, traffic: Traffic | None
) -> Iterator[tuple[Stress, float, dict[str, float]]]:
    """Drive a champion at each level of each stress. Yields: the stress, the level, and the figures of `evaluate`."""
    for stress in chosen:
        for level in stress.levels:
            worse = dataclasses.replace(champion, sim=stress.at(level, champion.sim))
            yield stress, level, evaluate(worse, scenario, episodes, seed, traffic)


@plain_style()
def draw(found: Sequence[tuple[Stress, float, dict[str, float]]], title: str, path: Path) -> None:
    """Draw success against the level of each stress to a PNG; `found` as `drive` yields it."""
    chosen = list(dict.fromkeys(stress for stress, _, _ in found))
    figure, axes = figure_of(3.0 * len(chosen), 3.2, len(chosen))
    for axis, stress in zip(axes, chosen, strict=True):
        levels, shares = zip(
            *((level, 100.0 * figures["success_rate"]) for each, level, figures in found if each == stress), strict=True
        )
        axis.plot(levels, shares, "o-", color="#0b7285")
        axis.set(xlabel=stress.label, ylim=(-3.0, 103.0))
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        if stress.share and stress.levels[-1] < 1.0:
            axis.invert_xaxis()
    axes[0].set_ylabel("success, %")
    figure.suptitle(drawable(title), fontsize=10)
    figure.savefig(path, dpi=100)
