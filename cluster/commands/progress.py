"""Live progress of a run: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

if TYPE_CHECKING:
    from cluster.runs.run import Session

LINE_S = 5.0  # between lines where there is no terminal
WINDOW = 10  # steps that the ETA is taken from


class Progress:
    """Shows how far a run is, distance, speed, car-steps per second and ETA."""

    def __init__(self, console: Console, session: Session, folder: str):
        self._console, self._learning = console, session.learning
        self._live = console.is_terminal
        done, total, _ = self._learning.way()
        self._ends: deque[tuple[float, float]] = deque([(time.perf_counter(), done)], WINDOW + 1)
        self._printed = 0.0
        self._text = ""
        self._bar = Bar(
            TextColumn("[bold]{task.fields[way]}"),
            BarColumn(bar_width=20),
            TaskProgressColumn(show_speed=False),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not self._live,
            transient=True,
        )
        self._task = self._bar.add_task(
            "learn", total=total or None, completed=int(done), text="starting the workers", way=self._way()
        )
        settings = session.run.settings
        verb = "continuing" if done else self._learning.verb
        console.print(f"{verb} {settings.policy} on {settings.scenario}, seed {settings.seed} -> {folder}")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _way(self) -> str:
        """How far it is, in words."""
        done, total, unit = self._learning.way()
        of = f"/{total:g}" if total else ""
        return f"{done:.1f}{of} {unit}" if unit.startswith("M") else f"{unit} {done:.0f}{of}"

    def row(self, step: int, row: dict[str, float]) -> None:
        """So many steps are done."""
        now = time.perf_counter()
        way, total, _ = self._learning.way()
        self._ends.append((now, way))
        begun, first = self._ends[0]
        champion = row["validation/success_rate"]
        self._text = self._learning.describe(row) + f"  {row['car_steps_per_s'] / 1e6:.2f} M car-steps/s"
        self._text += f"  champion {champion:.0%}" if champion else ""
        ends = [(now - begun) / max(way - first, 1e-9) * max(total - way, 0.0)] if total else []
        if limit := self._learning.settings.car_steps:
            ends.append(max(limit - row["car_steps"], 0.0) / row["car_steps_per_s"])
        if ends:
            self._text += f"  ETA {_clock(min(ends))} at most"
        self._bar.update(self._task, completed=int(way), text=self._text, way=self._way())
        if not self._live and (now - self._printed > LINE_S or self._learning.done()):
            self._printed = now
            self._console.print(f"{self._way()}  {self._text}", soft_wrap=True)

    def members(self, stage: str, done: int, total: int) -> None:
        """Part of a step is done."""
        if self._live:
            self._bar.update(self._task, text=f"{self._text}  [dim]{stage} {done}/{total}")

    def note(self, text: str) -> None:
        """What happens after the last step."""
        self._bar.update(self._task, text=text)
        if not self._live:
            self._console.print(text)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
