"""The pictures that runs leave are the same whatever the user's Matplotlib is set to."""

from typing import Any

import matplotlib
import numpy as np
import pytest
from commands import finish
from finished_runs import run
from pictures import small_map

from cluster.compare import picture
from cluster.compare.tables import group
from cluster.report import page, pictures
from gridsim.state import CAR_FIELDS as FIELDS


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_a_run_ends_well_whatever_the_plotting_variables_of_a_notebook_say(tmp_path):
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nbackend: module://nonsense\n")
    (tmp_path / "mine").write_text("lines.linewidth: thick\n")
    asked = ["--workers", "0", "--population", "32", "--generations", "1", "--scenario", "curved", "--name", "one"]
    own = {"MPLBACKEND": "module://matplotlib_inline.backend_inline", "MATPLOTLIBRC": str(tmp_path / "mine")}
    assert finish("gridsim-evolve", *asked, cwd=tmp_path, **own).stderr == ""
    found = {path.name for path in (tmp_path / "runs/one").iterdir()}
    assert {"curves.png", "trajectory.png", "drive.html", "summary.json"} <= found


def test_pictures_do_not_depend_on_settings_of_matplotlib(tmp_path):
    road_map = small_map([[0, 32, 64, 32, 4.0]])
    states = np.zeros((20, FIELDS), dtype=np.float32)
    names = ("q/mean", "loss", "distance_m/best", "distance_m/mean", "speed_mps/best", "speed_mps/mean")
    history = [dict.fromkeys((*names, "validation/success_rate", "network/success_rate"), 0.5)] * 3

    def drawn():
        pictures.curves(history, tmp_path / "curves.png", "evaluation")
        pictures.trajectory(road_map, states, tmp_path / "trajectory.png", "a drive")
        picture.comparison(group([run("dqn", "curved", 0, 5.0)]), tmp_path / "comparison.png")
        return [page._picture(road_map), *(path.read_bytes() for path in sorted(tmp_path.iterdir()))]

    usual = drawn()
    assert len(usual) == 4
    odd: dict[Any, Any] = {"text.usetex": True, "image.origin": "lower", "lines.linewidth": 9.0, "axes.grid": True}
    with matplotlib.rc_context({**odd, "savefig.bbox": "tight", "savefig.format": "pdf", "figure.facecolor": "black"}):
        assert drawn() == usual
        assert matplotlib.rcParams["lines.linewidth"] == 9.0, "the user's stay for the user"
