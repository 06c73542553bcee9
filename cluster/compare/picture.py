"""A comparison's picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cluster.compare.tables import Group
from cluster.report.pictures import drawable, figure_of, plain_style

_LEARNERS = {"evolution": "#0b7285", "two-parents": "#7048e8", "dqn": "#f08c00", "random": "#868e96"}


@plain_style()
def comparison(groups: Sequence[Group], path: Path) -> None:
    """Draw success, velocity error and training time of each road and learner to a PNG.

    Bars are medians over seeds, whiskers quartiles, dots the seeds.
    """
    roads = list(dict.fromkeys(group.road for group in groups))
    names = list(dict.fromkeys(group.name for group in groups))
    several_observations = len({group.observation for group in groups}) > 1
    width = 0.8 / len(names)
    figure, axes = figure_of(max(12.0, 4.0 + 3.0 * len(roads)), 4.6, 3)
    panels = (
        ("success_rate", 100.0, "success on held-out roads, %"),
        ("velocity_error_percent", 1.0, "velocity error, % of the reference's speed"),
        ("best_wall_s", 1.0, "time to the champion, s"),
    )
    for axis, (name, scale, title) in zip(axes, panels, strict=True):
        for group in groups:
            place = roads.index(group.road) + (names.index(group.name) - (len(names) - 1) / 2) * width
            n, *found = group.spread(name)
            if not n:
                axis.text(place, 0.0, " no run", rotation=90, ha="center", va="bottom", fontsize=7, color="#868e96")
                continue
            color = f"C{names.index(group.name) % 10}" if group.variant else _LEARNERS[group.learner]
            lower, median, upper = (scale * value for value in found)
            whiskers = [[median - lower], [upper - median]] if n > 1 else None
            hatch = "//" if group.observation == "grid" and several_observations else None
            axis.bar(
                place, median, 0.92 * width, color=color, alpha=0.75, yerr=whiskers, capsize=3,
                hatch=hatch, error_kw={"ecolor": "#212529", "elinewidth": 1.1}, zorder=2, label=group.name,
            )  # fmt: skip
            seeds = [scale * value for value in group.values(name)]
            beside = place + width * np.linspace(-0.22, 0.22, len(seeds)) if len(seeds) > 1 else [place]
            axis.plot(beside, seeds, linestyle="", marker="o", markersize=3.5, color="white",
                      markeredgecolor="#212529", markeredgewidth=0.8, zorder=4)  # fmt: skip
        axis.set_title(title)
        axis.set_xticks(range(len(roads)), map(drawable, roads))
        axis.set_xlim(-0.5, len(roads) - 0.5)
        axis.set_ylim(bottom=0.0)
        axis.grid(axis="y", alpha=0.25, zorder=0)
        axis.spines[["top", "right"]].set_visible(False)
    bars = {bar.get_label(): bar for bar in axes[-1].containers if hasattr(bar, "patches")}
    figure.legend(
        bars.values(), bars, loc="outside lower center", ncols=len(names), frameon=False, title_fontsize=9,
        title="bars: medians over seeds; whiskers: quartiles; dots: the seeds",
    )  # fmt: skip
    figure.savefig(path, dpi=100)
