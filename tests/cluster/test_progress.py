"""The live line, as terminals of several widths show it."""

import dataclasses
import io
import time

import pytest
from rich.console import Console

from cluster.commands import progress
from cluster.commands.progress import Display, RunDisplay
from cluster.learn.learning import Event
from cluster.settings import DqnSettings, EvolveSettings

ROW = {
    "validation/success_rate": 0.37, "car_steps_per_s": 1_234_567.0, "car_steps": 12_300_000.0, "distance_m/best": 1812,
    "distance_m/mean": 1300.0, "target_m": 2000.0, "speed_mps/best": 7.1,
}  # fmt: skip
BY_CAR_STEPS, BY_GENERATIONS = EvolveSettings("curved", car_steps=30_000_000), EvolveSettings("curved", generations=480)
WIDTHS = [60, 80, 120]


def display(settings, width, terminal=True):
    console = Console(width=width, force_terminal=terminal, color_system=None, file=io.StringIO())
    return RunDisplay(console, settings), console


def drawn(shown, width):
    """The live line as such a terminal shows it."""
    console = Console(width=width, force_terminal=True, color_system=None, file=io.StringIO())
    lines = ["".join(segment.text for segment in line) for line in console.render_lines(shown.text(), pad=False)]
    assert len(lines) == 2 + shown.rest.count("\n")  # none is wrapped
    assert max(map(len, lines)) <= width
    return "\n".join(lines)


def after(monkeypatch, seconds):
    now = time.perf_counter()
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now + seconds)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(
    ("settings", "counters"),
    [
        (BY_CAR_STEPS, ["12.3/30 M car-steps", "18.4/30 M car-steps", "30.0/30 M car-steps"]),
        (BY_GENERATIONS, ["240/480 generations", "360/480 generations", "480/480 generations"]),
    ],
)
def test_counter_success_and_until_the_limit_is_reached_an_eta_are_always_there(settings, counters, width, monkeypatch):
    shown, _ = display(settings, width)
    shown.event(Event("starting the workers"))
    assert drawn(shown, width).endswith("\nstarting the workers")
    shown.row(240, ROW)
    assert drawn(shown, width).startswith(f"{counters[0]}  success 37%  ETA -:--  ━━")
    after(monkeypatch, 3700.0)
    shown.row(360, {**ROW, "car_steps": 12_300_000.0 * 1.5})
    shown.event(Event("evolve", 3, 128))
    line = drawn(shown, width)
    assert line.startswith(f"{counters[1]}  success 37%  ETA 1:" if settings is BY_GENERATIONS else counters[1])
    assert " at most  " in line
    assert "\nevolve   3/128  " in line
    shown.row(481, {**ROW, "car_steps": 31_000_000.0})
    assert drawn(shown, width).startswith(f"{counters[2]}  success 37%  ━")


def test_there_is_no_eta_before_it_means_something(monkeypatch):
    """The first step takes as long as all that is started for it."""
    shown, console = display(BY_CAR_STEPS, 120, terminal=False)
    shown.event(Event("compiling the simulator"))
    shown.event(Event("evolve", 1, 2))
    assert console.file.getvalue() == "compiling the simulator\n"
    after(monkeypatch, 60.0)
    shown.row(1, {**ROW, "car_steps_per_s": 500.0, "car_steps": 300_000.0})
    after(monkeypatch, 1.0)
    shown.row(2, {**ROW, "car_steps": 1_300_000.0})
    assert "ETA -:--" in drawn(shown, 120)
    after(monkeypatch, 10.5)
    shown.row(3, {**ROW, "car_steps": 4_000_000.0})
    assert "ETA 1:" in drawn(shown, 120)
    printed = (
        "\n0.3/30 M car-steps  success 37%  ETA -:--  1 generation  distance 1,812 m best, 1,300 mean of 2,000  7.1"
    )
    assert printed in console.file.getvalue()


def test_a_warning_is_a_line_of_its_own(capsys):
    display(BY_CAR_STEPS, 80)[0].event(Event("a worker is replaced", warning=True))
    assert capsys.readouterr().err == "gridsim-evolve: warning: a worker is replaced\n"


def test_each_learners_rows_are_said_in_words():
    assert progress.row_in_words(BY_GENERATIONS, 2, ROW) == "distance 1,812 m best, 1,300 mean of 2,000  7.1 m/s"
    row = {**ROW, "loss": 0.0123, "network/success_rate": 0.5, "updates": 1500.0, "episodes": 1e4}
    dqn = DqnSettings("curved", car_steps=0, episodes=20_000)
    assert progress.row_in_words(dqn, 2, row) == "distance 1,812 m, 50% succeed  7.1 m/s  loss 0.012  2 k updates"
    assert progress._progress(dqn, 2, row) == (0.5, "10000/20000 episodes")
    both = EvolveSettings("curved", car_steps=30_000_000, generations=10**15)
    assert progress._progress(both, 2, ROW)[1] == "12.3/30 M car-steps"
    assert progress._progress(dataclasses.replace(both, car_steps=0), 2, ROW) == (0.0, "2 generations")


def test_a_terminal_shows_it_live():
    file = io.StringIO()
    with Display(Console(width=60, force_terminal=True, color_system=None, file=file)) as line:
        line.head, line.facts, line.rest = "12/30 generations", "success 37%", "240 generations"
    assert "12/30 generations  success 37%  ━━━━━━━━━━  0:00\n240 generations" in file.getvalue()
