"""The simulator's numbers: presets and files, limits, and cars of another size and control period."""

import dataclasses
import math

import numpy as np
import pytest
from pictures import picture, save, write_yaml

import gridsim
from gridsim.car.vehicle import Action
from gridsim.config import LIMITS, EpisodeConfig, SensorConfig, SimConfig, TrafficConfig, VehicleConfig, constants
from gridsim.envs.env import GridSimEnv
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import build
from gridsim.sensing.grid import grid_table
from gridsim.simulator import Simulator
from gridsim.state import DISTANCE, SPEED, STEPS, End, X, Y
from gridsim.view.render import Renderer

DEFAULT = SimConfig()


# --- Presets and files -----------------------------------------------------------------------------------------------


def test_presets_are_cars_that_can_be_driven():
    assert gridsim.SimConfig.load("default") == DEFAULT
    small, sedan, truck = map(SimConfig.load, ("f1tenth", "sedan", "truck"))
    assert (small.vehicle.length, small.vehicle.wheelbase, small.vehicle.rear_axle) == (
        0.58,
        0.15875 + 0.17145,
        0.17145,
    )
    assert (sedan.vehicle.length, sedan.vehicle.width, sedan.vehicle.speed_limit) == (4.508, 1.61, 50.8)
    assert (truck.vehicle.length, truck.vehicle.width, truck.vehicle.speed_limit) == (5.1, 2.55, 22.22)
    angles = np.array([0.4189, 1.066, 0.55])
    limits = [constants(config).steering_limit for config in (small, sedan, truck)]
    assert limits == pytest.approx(angles, abs=1e-4)
    assert [config.unit for config in (small, sedan, truck)] == [0.125, 1.0, 1.0]


def test_a_file_gives_any_numbers_and_the_others_are_its_bases(tmp_path):
    path = tmp_path / "car.yaml"
    path.write_text("base: f1tenth\nvehicle: {width: 0.3, lateral_grip: .inf}\nsensors:\nepisode: {patience: 1e-1}\n")
    base, read = SimConfig.load("f1tenth"), SimConfig.load(path)
    vehicle = dataclasses.replace(base.vehicle, width=0.3, lateral_grip=math.inf)
    episode = dataclasses.replace(base.episode, patience=0.1)
    assert read == dataclasses.replace(base, vehicle=vehicle, episode=episode)
    assert GridSimEnv(config=str(path)).cars.config == read
    path.write_text("sensors: {rays: 40}")
    assert SimConfig.load(path) == SimConfig(sensors=SensorConfig(rays=40))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "No such file"),
        ("vehicle: [", "not valid YAML, line 1"),
        ("- 1", "give some of vehicle, sensors, episode, traffic as keys with values, not"),
        ("vehicle: 4", "vehicle: give some of length, width"),
        ("vehicles: {}", "unknown key 'vehicles'; did you mean vehicle?"),
        ("vehicle: {wheel_base: 2}", "unknown key vehicle.'wheel_base'; did you mean wheelbase?"),
        ("vehicle: {colour: 2}", "unknown key vehicle.'colour'; there are: length"),
        ("base: f1tent", "unknown simulator 'f1tent'; did you mean f1tenth?"),
        ("vehicle: {length: long}", "vehicle.length must be a number from 0.2 to 30 m, not 'long'"),
        ("sensors: {rays: 31.5}", "sensors.rays must be a whole number, not 31.5"),
        ("randomise: {width: 3}", "randomise needs names with [least, most], not {'width': 3}"),
    ],
)
def test_a_file_that_is_wrong_is_refused_in_a_line_that_names_it(tmp_path, text, said):
    path = tmp_path / "car.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(GridSimError) as error:
        SimConfig.load(path)
    assert str(error.value).startswith(f"{path}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


# --- Limits ----------------------------------------------------------------------------------------------------------

FIELDS = [(part, f.name) for part in LIMITS for f in dataclasses.fields(getattr(DEFAULT, part))]
NUMBERS = [(part, name) for part, name in FIELDS if not isinstance(getattr(getattr(DEFAULT, part), name), (str, bool))]


@pytest.mark.parametrize(("part", "name"), NUMBERS)
def test_every_number_has_limits_and_a_unit(part, name):
    low, high, unit = LIMITS[part][name]
    for wrong in (math.nan, -1.0, low - 1e-6, 2.0 * high, "", None, True):
        if wrong == math.inf:  # any lateral grip
            continue
        config = dataclasses.replace(DEFAULT, **{part: dataclasses.replace(getattr(DEFAULT, part), **{name: wrong})})
        with pytest.raises(GridSimError, match=rf"^{part}\.{name} must be a number from .*{unit}, not .*$"):
            constants(config)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (SimConfig(VehicleConfig(steering_limit=-27.0)), "vehicle.steering_limit"),
        (SimConfig(VehicleConfig(rear_axle=2.5)), "vehicle.rear_axle must be below vehicle.wheelbase, 2.5 m"),
        (SimConfig(VehicleConfig(length=12.5)), "traffic.spawn_gap must be at least vehicle.length plus traffic.jam"),
        (SimConfig(traffic=TrafficConfig(spawn_gap_ego=5.0)), "traffic.spawn_gap_ego must be at least"),
        (SimConfig(episode=EpisodeConfig(time_limit=7e3)), "episode.time_limit must be 1 to 65,535 times"),
        (SimConfig(VehicleConfig(length=0.5)), "sensors.range must be at most 7.875 m for a car of 0.5 m"),
        (SimConfig(sensors=SensorConfig(rays=31.0)), "sensors.rays must be a whole number"),  # type: ignore[arg-type]
    ],
)
def test_numbers_that_do_not_fit_each_other_are_refused(config, said):
    with pytest.raises(GridSimError, match=said):
        constants(config)


# --- Other control periods and sizes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("action", "speed", "lasts"), [(Action.ACCELERATE, 0.0, 3.0), (Action.NONE, 0.0, 1.5), (Action.NONE, 0.9, 3.0)]
)
@pytest.mark.parametrize("period", [0.1, 0.05, 0.02])
def test_what_is_idle_does_not_depend_on_the_control_period(period, action, speed, lasts):
    """At 50 Hz, full throttle from rest was less than 0.05 m a step, and ended the episode after 0.3 s."""
    simulator = Simulator(1, SimConfig(episode=EpisodeConfig(control_period=period)))
    straight = build("highway", 0, simulator.config)
    simulator.reset(straight, np.array([[*straight.network.points[0], 0.0, speed, 0.0]], dtype=np.float32))
    while not simulator.ends[0] and simulator.cars[0, STEPS] * period < 3.0 - 1e-3:
        simulator.step(np.array([action]))
    assert simulator.cars[0, STEPS] * period == pytest.approx(lasts, abs=1e-3)


def eighth(config: SimConfig) -> SimConfig:
    """The same simulator of a car of an eighth of the size, at an eighth of the speed."""
    lengths = {"length", "width", "wheelbase", "rear_axle", "range", "target", "revisit"}
    rates = {"speed_limit", "reverse_limit", "acceleration", "braking", "lateral_grip", "progress"}
    parts = {}
    for part in ("vehicle", "sensors", "episode"):
        values = vars(getattr(config, part))
        parts[part] = type(getattr(config, part))(
            **{n: v / 8 if n in lengths | rates else v for n, v in values.items()}
        )
    return dataclasses.replace(config, **parts)


@pytest.mark.filterwarnings("ignore::gridsim.maps.files.MapWarning")
def test_a_car_of_an_eighth_on_a_map_of_an_eighth_drives_an_eighth_bit_for_bit(tmp_path):
    """Its starts, ranges, sub-steps, visits, ends and pictures: an eighth is exact in binary."""
    save(tmp_path / "map.png", picture())
    runs, patient = [], SimConfig(episode=EpisodeConfig(patience=100.0))
    there_and_back = [0] * 30 + [3] * 15 + [7] * 45 + [0] * 60
    for name, config, scale in (("large", patient, 1), ("small", eighth(patient), 8)):
        road_map = build(
            str(write_yaml(tmp_path, name=name, resolution=0.25 / scale, speed=[5 / scale, 12 / scale])), 0, config
        )
        simulator, rng, states = Simulator(100, config), np.random.default_rng(1), []
        simulator.reset(road_map, road_map.starts[rng.integers(len(road_map.starts), size=100)])
        for action in there_and_back:
            actions = rng.choice([0, 0, 0, 1, 2, 3, 4, 5, 6, 7], 100)
            actions[:30] = action
            simulator.step(actions)
            states.append(
                (simulator.cars[:, [X, Y, SPEED, DISTANCE]] * scale, simulator.ranges * scale, simulator.ends.copy())
            )
        renderer, path = Renderer(road_map, (160, 120), config), simulator.cars[1:9, :2]
        beside = simulator.cars[:1].copy()
        beside[:, X] += 4.0 / scale
        drawn = renderer.draw(simulator.cars[0], beside, simulator.ranges[0], path)
        runs.append((drawn, road_map.starts * [scale, scale, 1, 1, 1], *map(np.stack, zip(*states, strict=True))))
    for large, small in zip(*runs, strict=True):
        np.testing.assert_array_equal(large, small)
    assert {End.RUNNING, End.COLLISION} == set(runs[0][-1][-1, :30].tolist())


def test_generated_roads_are_as_small_as_the_car_and_slower():
    small = eighth(DEFAULT)
    for name in ("curved", "city"):
        usual, tiny = build(name, 3), build(name, 3, small)
        np.testing.assert_array_equal(tiny.road.field, usual.road.field)
        np.testing.assert_array_equal(tiny.network.points * 8, usual.network.points)
        assert tiny.size.tolist() == (usual.size / 8).tolist()
        assert tiny.road.speed_high == pytest.approx(usual.road.speed_high / math.sqrt(8))
        again = tiny.magnified()
        np.testing.assert_array_equal(again.strips.blocks, usual.strips.blocks)
        assert (again.size == usual.size).all()
    np.testing.assert_array_equal(grid_table(small).cells, grid_table(DEFAULT).cells)


def test_small_cars_have_no_traffic():
    assert GridSimEnv("city", config="f1tenth").cars.simulator.worlds.shape[1] == 0
    env = GridSimEnv("city", config="f1tenth", traffic=3)
    with pytest.raises(GridSimError, match="traffic is for cars of"):
        env.reset(seed=0)
