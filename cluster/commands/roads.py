"""gridsim-map: what was read from a file of roads, and a picture of it."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from cluster.commands.common import main, parse, short_path
from cluster.settings import IN_WORDS
from gridsim.config import SimConfig
from gridsim.errors import GridSimError
from gridsim.maps.network import junctions
from gridsim.maps.parts import divided, files_of, is_map_file, roads_of
from gridsim.maps.real.load import described, split_name
from gridsim.maps.scenarios import build, check_name, full_name, has_lanes, label

MAP = "gridsim-map"


@dataclass(frozen=True)
class MapFlags:
    """Say what a file of roads or a map holds and what of it was left out, and draw it."""

    example: ClassVar[str] = "gridsim-map town.osm --crop 52.473,13.44,400 --output town.png"
    file: tyro.conf.Positional[str]
    """OpenStreetMap, OpenDRIVE, SUMO (.net.xml), CommonRoad, Lanelet2; a picture or a map's YAML; a folder of these; or
    a scenario. FILE@left or FILE@right: the side of the road, where the file does not say it rightly."""
    crop: Annotated[str, IN_WORDS] = ""
    """Read only a square: LAT,LON,METRES of its middle and its side; X,Y,METRES where a file is in metres."""
    sim: str = "default"
    """For which car: default, f1tenth, sedan, truck, lights, or a YAML file (docs/own.md)."""
    output: Annotated[str, IN_WORDS] = ""
    """Draw it to this .png."""


def _map() -> int:
    flags = parse(MapFlags, MAP, sys.argv[1:])
    if flags.output and Path(flags.output).suffix != ".png":
        raise GridSimError(f"--output {flags.output}: a picture is a .png")
    name = flags.file + (f"@{flags.crop}" if flags.crop else "")
    if len(roads_of(full_name(name))) > 1:
        raise GridSimError(f"{name} is several roads; name one of them, or a folder")
    check_name(name)
    if flags.crop and split_name(name)[1] is None:
        raise GridSimError(f"--crop {flags.crop}: give LAT,LON,METRES or X,Y,METRES")
    files = files_of(name)
    if flags.output and len(files) > 1:
        raise GridSimError(f"--output: name one of the {len(files)} files, not all")
    config = SimConfig.load(flags.sim)
    for file in files:
        _describe(file, config)
    if len(files) > 1:
        for what, part in zip(("learn on", "choose the champion on", "judge it on"), divided(name), strict=True):
            print(f"to {what}: {', '.join(Path(file).name for file in part)}")
    if flags.output:
        from cluster.report.pictures import road_map

        road_map(build(name, 0, config), Path(flags.output), label(name))
        print(f"picture: {short_path(Path(flags.output))}")
    if is_map_file(name):
        car = "" if flags.sim == "default" else f" --sim {shlex.quote(flags.sim)}"
        print(f"train a driver: gridsim-evolve --scenario {shlex.quote(name)}{car}")
    return 0


def _describe(name: str, config: SimConfig) -> None:
    """Print what a scenario's map or a file holds, and what was noted as a file was read."""
    here = build(name, 0, config)
    road, network = here.road, here.network
    is_road = is_map_file(name) and has_lanes(name)
    if is_road:
        found = described(name, config)
        print(f"{split_name(name)[0]}: {found.format}", *(f"  {note}" for note in found.notes), sep="\n")
    if len(network.steps):
        side, other = ("right", "left") if network.hand > 0.0 else ("left", "right")
        side += f" (if that is wrong: FILE@{other})" if is_road else ""
        print(f"{here.mileage[-1] / 1000:.1f} km of lanes, {junctions(network)} junctions, traffic keeps {side}")
        if len(network.lines):
            print(f"{len(network.lines)} stop lines of traffic lights (traffic.lights of --sim: docs/roads.md)")
    else:
        print(f"no lanes, {len(here.starts)} starts")
    print(f"{road.width:g} m x {road.height:g} m; speed counts from {road.speed_low:.1f} to {road.speed_high:.1f} m/s")


map_main = partial(main, MAP, _map)
