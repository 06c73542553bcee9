"""A comparison's picture."""

from pathlib import Path

import numpy as np

from cluster.compare.tables import NAMES, Groups, quartiles
from cluster.report.pictures import drawable, figure_of, plain_style

COLOURS = dict(zip(NAMES.values(), ("#0b7285", "#7048e8", "#f08c00", "#868e96"), strict=True))
PANELS = (
    ("success_rate", 100.0, "success on held-out roads, %"),
    ("velocity_error_percent", 1.0, "velocity error, % of the reference's speed"),
    ("best_wall_s", 1.0, "time to the champion, s"),
)


@plain_style()
def comparison(groups: Groups, path: Path) -> None:
    """Draw success, velocity error and time to the champion, for each road and learner, to a PNG.

    Bars are medians over seeds, whiskers quartiles, dots the seeds.
    """
    roads, learners = (list(dict.fromkeys(names)) for names in zip(*groups, strict=True))
    width = 0.8 / len(learners)
    figure, axes = figure_of(max(12.0, 4.0 + 3.0 * len(roads)), 4.6, 3)
    bars = {}
    for axis, (figure_name, scale, title) in zip(axes, PANELS, strict=True):
        for (road, learner), runs in groups.items():
            k = learners.index(learner)
            place = roads.index(road) + (k - (len(learners) - 1) / 2) * width
            values, found = quartiles(runs, figure_name)
            lower, median, upper = (scale * value for value in found)
            bars[learner] = axis.bar(
                place, median, 0.92 * width, color=COLOURS.get(learner, f"C{k % 10}"), alpha=0.75, zorder=2,
                yerr=[[median - lower], [upper - median]], capsize=3, error_kw={"ecolor": "#212529", "elinewidth": 1.1},
            )  # fmt: skip
            beside = (np.arange(len(values)) - (len(values) - 1) / 2) / max(len(values), 1)  # side by side
            axis.plot(place + 0.5 * width * beside, scale * np.array(values), "o", markersize=3.5, color="white",
                      markeredgecolor="#212529", markeredgewidth=0.8, zorder=4)  # fmt: skip
        axis.set(title=title, xlim=(-0.5, len(roads) - 0.5), ylim=(0.0, None))
        axis.set_xticks(range(len(roads)), map(drawable, roads))
        axis.grid(axis="y", alpha=0.25, zorder=0)
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(
        bars.values(), map(drawable, bars), loc="outside lower center", ncols=len(learners), frameon=False,
        title_fontsize=9, title="bars: medians over seeds; whiskers: quartiles; dots: the seeds",
    )  # fmt: skip
    figure.savefig(path, dpi=100)
