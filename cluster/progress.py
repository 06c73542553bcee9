"""Live progress of a run: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

if TYPE_CHECKING:
    from cluster.run import Session

LINE_S = 5.0  # between lines where there is no terminal
WINDOW = 10  # generations that the ETA is taken from


class Progress:
    """Shows generation, best and mean distance, speed, car-steps per second and ETA."""

    def __init__(self, console: Console, session: Session, folder: str):
        self._console, self._session = console, session
        self._live = console.is_terminal
        self._ends: deque[float] = deque([time.perf_counter()], WINDOW + 1)
        self._printed = 0.0
        self._text = ""
        self._generations = session.run.settings.generations
        self._bar = Bar(
            TextColumn("[bold]generation {task.completed:.0f}/{task.total:.0f}"),
            BarColumn(bar_width=20),
            TaskProgressColumn(show_speed=False),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not self._live,
            transient=True,
        )
        self._task = self._bar.add_task(
            "evolve", total=self._generations, completed=session.evolution.generation, text="starting the workers"
        )
        settings = session.run.settings
        begun = "continuing" if session.evolution.generation else "evolving"
        console.print(
            f"{begun} {settings.policy} on {settings.scenario}, seed {settings.seed}, "
            f"population {settings.population:,} -> {folder}"
        )

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def row(self, generation: int, row: dict[str, float]) -> None:
        """A generation is done."""
        now = time.perf_counter()
        self._ends.append(now)
        pace = (self._ends[-1] - self._ends[0]) / max(len(self._ends) - 1, 1)
        eta = pace * (self._generations - generation)
        champion = row["validation/success_rate"]
        self._text = (
            f"distance {row['distance_m/best']:,.0f} m best, {row['distance_m/mean']:,.0f} mean of "
            f"{row['target_m']:,.0f}  {row['speed_mps/best']:.1f} m/s  {row['car_steps_per_s'] / 1e6:.2f} M car-steps/s"
            + (f"  champion {champion:.0%}" if champion else "")
            + f"  ETA {_clock(eta)} at most"
        )
        self._bar.update(self._task, completed=generation, text=self._text)
        if not self._live and (now - self._printed > LINE_S or generation == self._generations):
            self._printed = now
            self._console.print(f"generation {generation}/{self._generations}  {self._text}", soft_wrap=True)

    def members(self, stage: str, done: int, total: int) -> None:
        """Part of a generation is done."""
        if self._live:
            self._bar.update(self._task, text=f"{self._text}  [dim]{stage} {done}/{total}")

    def note(self, text: str) -> None:
        """What happens after the last generation."""
        self._bar.update(self._task, text=text)
        if not self._live:
            self._console.print(text)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
