"""The live lines, as terminals of several widths show them."""

import dataclasses
import io
import time

import pytest
from rich.console import Console

from cluster.commands import progress
from cluster.commands.progress import RunDisplay
from cluster.learn.learning import Event
from cluster.settings import DqnSettings, EvolveSettings

ROW = {
    "validation/success_rate": 0.37, "car_steps_per_s": 1_234_567.0, "car_steps": 12_300_000.0, "distance_m/best": 1812,
    "distance_m/mean": 1300.0, "target_m": 2000.0, "speed_mps/best": 7.1,
}  # fmt: skip
BY_CAR_STEPS, BY_GENERATIONS = EvolveSettings("curved", car_steps=30_000_000), EvolveSettings("curved", generations=480)


def display(settings, width=120, terminal=True):
    return RunDisplay(Console(width=width, force_terminal=terminal, color_system=None, file=io.StringIO()), settings)


def drawn(shown):
    """The lines as its terminal shows them."""
    console = Console(width=shown.console.width, force_terminal=True, color_system=None, file=io.StringIO())
    lines = ["".join(segment.text for segment in line) for line in console.render_lines(shown.text(), pad=False)]
    assert len(lines) == 2 + shown.rest.count("\n")  # none is wrapped
    assert max(map(len, lines)) <= console.width
    return "\n".join(lines)


def after(monkeypatch, seconds):
    now = time.perf_counter()
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now + seconds)


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize(
    ("settings", "counters"),
    [
        (BY_CAR_STEPS, ["12.3/30 M car-steps", "18.4/30 M car-steps", "30.0/30 M car-steps"]),
        (BY_GENERATIONS, ["240/480 generations", "360/480 generations", "480/480 generations"]),
    ],
)
def test_counter_success_and_until_the_limit_is_reached_an_eta_are_always_there(settings, counters, width, monkeypatch):
    shown = display(settings, width)
    shown.event(Event("starting the workers"))
    assert drawn(shown).endswith("\nstarting the workers")
    shown.row(240, ROW)
    assert drawn(shown).startswith(f"{counters[0]}  success 37%  ETA -:--  ━━")
    after(monkeypatch, 3700.0)
    shown.row(360, {**ROW, "car_steps": 12_300_000.0 * 1.5})
    shown.event(Event("evolve", 3, 128))
    assert drawn(shown).startswith(f"{counters[1]}  success 37%  ETA 1:")
    assert " at most  " in drawn(shown)
    assert "\nevolve   3/128  " in drawn(shown)
    shown.row(481, {**ROW, "car_steps": 31_000_000.0})
    assert drawn(shown).startswith(f"{counters[2]}  success 37%  ━")


def test_without_a_terminal_there_are_lines_and_no_eta_before_it_means_something(monkeypatch, capsys):
    """The first step takes as long as all that is started for it."""
    shown = display(BY_CAR_STEPS, terminal=False)
    shown.event(Event("compiling the simulator"))
    shown.event(Event("evolve", 1, 2))
    shown.event(Event("a worker is replaced", warning=True))
    assert shown.console.file.getvalue() == "compiling the simulator\n"
    assert capsys.readouterr().err == "gridsim-evolve: warning: a worker is replaced\n"
    after(monkeypatch, 60.0)
    shown.row(1, {**ROW, "car_steps_per_s": 500.0, "car_steps": 300_000.0})
    after(monkeypatch, 1.0)
    shown.row(2, {**ROW, "car_steps": 1_300_000.0})
    assert "ETA -:--" in drawn(shown)
    after(monkeypatch, 10.5)
    shown.row(3, {**ROW, "car_steps": 4_000_000.0})
    assert "ETA 1:" in drawn(shown)
    driven = "1 generation  distance 1,812 m best, 1,300 mean of 2,000  7.1"
    assert f"\n0.3/30 M car-steps  success 37%  ETA -:--  {driven}" in shown.console.file.getvalue()


def test_each_learners_rows_are_said_in_words():
    assert progress.row_in_words(BY_GENERATIONS, 2, ROW) == "distance 1,812 m best, 1,300 mean of 2,000  7.1 m/s"
    row = {**ROW, "loss": 0.0123, "network/success_rate": 0.5, "updates": 1500.0, "episodes": 1e4}
    dqn = DqnSettings("curved", car_steps=0, episodes=20_000)
    assert progress.row_in_words(dqn, 2, row) == "distance 1,812 m, 50% succeed  7.1 m/s  loss 0.012  2 k updates"
    assert progress.progress(dqn, 2, row) == (0.5, "10000/20000 episodes")
    both = EvolveSettings("curved", car_steps=30_000_000, generations=10**15)
    assert progress.progress(both, 2, ROW)[1] == "12.3/30 M car-steps"
    assert progress.progress(dataclasses.replace(both, car_steps=0), 2, ROW) == (0.0, "2 generations")


def test_a_terminal_shows_it_live():
    with display(BY_GENERATIONS, 60) as shown:
        shown.head, shown.facts, shown.rest = "12/30 generations", "success 37%", "240 generations\nmore"
    assert "12/30 generations  success 37%  ━━━━━━━━━━  0:00\n240 generations\nmore" in shown.console.file.getvalue()
