"""The live line, as terminals of several widths show it."""

import io
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from cluster.commands import compare, progress
from cluster.commands.progress import Progress
from cluster.compare.plan import ComparisonFolder, Plan

ROW = {"validation/success_rate": 0.37, "car_steps_per_s": 1_234_567.0, "car_steps": 12_300_000.0}
WORDS = "240 generations  distance 1,812 m best, 1,300 mean of 2,000  7.1 m/s"
WIDTHS = [60, 80, 120]


def learning(done=(12.3, 30.0, "M car-steps")):
    found: Any = SimpleNamespace(verb="evolving", describe=lambda row: WORDS, done=lambda: False)
    found.progress = lambda: done
    found.settings = SimpleNamespace(policy="mlp:4", scenario="curved", seed=0, car_steps=30_000_000)
    return found


def begun(learner, width, terminal=True):
    console = Console(width=width, force_terminal=terminal, color_system=None, file=io.StringIO())
    session: Any = SimpleNamespace(learning=learner, run=SimpleNamespace(settings=learner.settings))
    return Progress(console, "gridsim-evolve", "runs/x", "gridsim-evolve --resume runs/x").learning(session), console


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
    ("done", "counter"),
    [((12.3, 30.0, "M car-steps"), "12.3/30 M car-steps"), ((240, 1200, "generations"), "240/1200 generations")],
)
def test_counter_success_and_until_the_bound_is_reached_an_eta_are_always_there(done, counter, width, monkeypatch):
    learner = learning(done)
    shown, _ = begun(learner, width)
    assert drawn(shown, width).startswith(f"{counter}  success 0%  ETA -:--  ━━")
    shown.note("measuring the champion on held-out drives")
    assert drawn(shown, width).endswith("\nmeasuring the champion on held-out drives")
    shown.row(1, ROW)
    learner.progress = lambda: (done[0] * 1.5, *done[1:])
    after(monkeypatch, 3700.0)
    shown.row(2, {**ROW, "car_steps": 12_300_000.0 * 1.5})
    shown.members("validate", 3, 128)
    line = drawn(shown, width)
    assert line.startswith(f"{progress.progress_of(learner)}  success 37%  ETA 1:")
    assert " at most  " in line
    assert "\nvalidate   3/128  240 generations" in line
    learner.done, learner.progress = lambda: True, lambda: (1.04 * done[1], *done[1:])
    shown.row(3, ROW)
    assert drawn(shown, width).startswith(f"{counter.replace('12.3', '30.0').replace('240', '1200')}  success 37%  ━")


def test_there_is_no_eta_before_it_means_something(monkeypatch):
    """The first step takes as long as all that is started for it."""
    shown, console = begun(learning(), 120, terminal=False)
    with shown.compiling():
        assert "compiling the simulator for runs of this kind, once (some 20 s)" in console.file.getvalue()
    after(monkeypatch, 60.0)
    shown.row(1, {**ROW, "car_steps_per_s": 500.0, "car_steps": 300_000.0})
    after(monkeypatch, 1.0)
    shown.row(2, {**ROW, "car_steps": 1_300_000.0})
    assert "ETA -:--" in drawn(shown, 120)
    after(monkeypatch, 10.5)
    shown.row(3, {**ROW, "car_steps": 4_000_000.0})
    assert "ETA 1:" in drawn(shown, 120)
    assert "\n12.3/30 M car-steps  success 37%  ETA -:--  240 generations" in console.file.getvalue()


@pytest.mark.parametrize("width", WIDTHS)
def test_a_comparison_shows_the_same(width, monkeypatch):
    plan = Plan(("roundabout",), ("two-parents",), 3, budget="3700s")
    cells = plan.cells(Path("runs/c"))
    console = Console(width=width, force_terminal=True, color_system=None, file=io.StringIO())
    folder = ComparisonFolder(Path("runs/c"), plan)
    shown = compare.Progress(console, folder, cells, 2, compare.Results(folder.path, plan))
    learner = learning((12, 10**15, "generations"))
    note = f"{progress.progress_of(learner, bound=False)}  success 37%  {learner.describe(ROW)}"
    for cell in cells[:2]:
        shown.show(cell, "begin", None)
        shown.show(cell, "note", note)
    line = drawn(shown, width)
    assert line.startswith("run 0/3  ETA 1:3")
    assert "\nroundabout-two-parents-s0  12 generations  success 37%" in line
    assert "\nroundabout-two-parents-s1  12 generations  success 37%" in line
    after(monkeypatch, 600.0)
    shown.show(cells[0], "note", note)
    assert drawn(shown, width).startswith("run 0/3  ETA 1:22:")


def test_a_terminal_shows_it_live():
    file = io.StringIO()
    with progress.Line(Console(width=40, force_terminal=True, color_system=None, file=file)) as line:
        line.head, line.facts, line.rest = "12/30 generations", "success 37%", WORDS
    assert "12/30 generations  success 37%  \n240 generations" in file.getvalue()
