"""The pictures and the page that a finished run leaves in its folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cluster import stopping
from cluster.report import film, page, pictures
from cluster.store.champion import Champion
from cluster.store.folder import CURVES, PAGE, TRAJECTORY, RunFolder
from evolution.episodes.starts import Episodes
from gridsim.maps.map import Map
from gridsim.maps.parts import is_map_file
from gridsim.maps.scenarios import label
from gridsim.state import DISTANCE

ELITES_SHOWN = 24  # elites on the page at most, besides the champion; mostly early ones, which show the learning


def write_report(
    run: RunFolder,
    champion: Champion,
    history: Sequence[Mapping[str, float]],
    elites: np.ndarray,
    get_map: Callable[[int], Map],
    episodes: Episodes,
) -> None:
    """Write curves.png (history), trajectory.png (champion's drive) and drive.html (champion's and elites' drives).

    All drives are of one episode, the last road's first one in `episodes`. Args: `history`, the run's rows; `elites`,
    the network of each step, float32 [steps, genes]; `get_map`, a map by its seed; `episodes`, the held-out ones.
    """
    path, settings, limit = run.path, run.settings, champion.sim.episode.time_limit
    row = len(episodes.rows) - len(episodes.rows) // len(settings.crowds)
    road_map, start = get_map(episodes.maps[int(episodes.rows[row]["map"])]), episodes.rows[row]["start"]
    pictures.curves(history, path / CURVES, settings.step_name)
    drive = film.record(champion, road_map, start, limit, episodes.worlds[row])
    where = "" if is_map_file(road_map.name) else f", held-out map {road_map.seed:,}"
    title = f"{label(road_map.name)}{where}: {drive.cars[-1, DISTANCE]:,.0f} m"
    pictures.trajectory(road_map, drive.cars, path / TRAJECTORY, title)
    shown = [page.Shown("champion", "champion", drive)]
    for k in (np.unique(np.geomspace(1, len(elites), ELITES_SHOWN).round().astype(int))[::-1] - 1).tolist():
        stopping.check()
        elite = dataclasses.replace(champion, genome=elites[k])
        drive = film.record(elite, road_map, start, limit, episodes.worlds[row])
        shown.insert(0, page.Shown(f"elite of {settings.step_name} {k}", str(k), drive, stride=2))
    page.write_page(path / PAGE, f"GridSim: {run.name}, {title}", shown)
