"""Live progress: some lines on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Mapping

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cluster.learn.learning import Event
from cluster.settings import MAX_STEPS, RunSettings
from cluster.text import count

LINE_S = 5.0  # least time between printed steps, if the output is no terminal; the last step is always printed
WINDOW_S = 10.0  # the ETA is computed from the latest steps, which took at least this time
BAR = 10  # characters


class Display(Live):
    """On a terminal: what is done (`head`), an ETA and more (`facts`), a bar, the elapsed time, and `rest` below."""

    def __init__(self, console: Console):
        self.head = self.facts = self.rest = ""
        self.share = 0.0  # share of the work that is done, 0 if unknown
        self.began = time.perf_counter()
        super().__init__(console=console, auto_refresh=console.is_terminal, transient=True, get_renderable=self.text)

    def text(self) -> Text:
        """The lines as they are now."""
        done = round(BAR * min(self.share, 1.0))
        line = Text(no_wrap=True, overflow="ellipsis").append(self.head, "bold").append(f"  {self.facts}  ")
        line.append("━" * done, "bar.complete").append("━" * (BAR - done), "bar.back")
        return line.append(f"  {clock(time.perf_counter() - self.began)}", "progress.elapsed").append(f"\n{self.rest}")


class RunDisplay(Display):
    """Shows a run's progress, success and ETA, then distance, speed and car-steps per second."""

    def __init__(self, console: Console, settings: RunSettings):
        super().__init__(console)
        self._settings = settings
        self._steps: deque[tuple[float, float]] = deque()  # of the latest steps: end time, share done by then
        self._printed, self._row = 0.0, ""

    def event(self, event: Event) -> None:
        """Show what the run is doing, or warn."""
        if event.warning:
            print(f"{self._settings.command}: warning: {event.text}", file=sys.stderr, flush=True)
        elif event.total:
            self.rest = f"{event.text} {event.done:{len(str(event.total))}}/{event.total}  {self._row}"
        else:
            self.rest = event.text
            if not self.console.is_terminal:
                self.console.print(event.text)

    def row(self, steps: int, row: Mapping[str, float]) -> None:
        """Show a step that is done, by its row of the history; `steps` is the number of steps done so far."""
        self.share, self.head = progress(self._settings, steps, row)
        self.facts = f"success {row['validation/success_rate']:.0%}"
        if self.share < 1.0:
            self.facts += f"  ETA {self._eta()}"
        self._row = f"{row_in_words(self._settings, steps, row)}  {row['car_steps_per_s'] / 1e6:.2f} M car-steps/s"
        self.rest = self._row
        now = time.perf_counter()
        if not self.console.is_terminal and (now - self._printed > LINE_S or self.share >= 1.0):
            self._printed = now
            self.console.print(f"{self.head}  {self.facts}  {self._row}", soft_wrap=True)

    def _eta(self) -> str:
        """Add a step that ends now, and return the time until the run's limit if steps take as long as the latest ones.

        The run may be solved before. The time is "-:--" until WINDOW_S after the first step, and without a limit.
        """
        now = time.perf_counter()
        self._steps.append((now, self.share))
        while len(self._steps) > 2 and now - self._steps[1][0] >= WINDOW_S:
            self._steps.popleft()
        begun, before = self._steps[0]
        if now - begun < WINDOW_S or self.share <= before:
            return "-:--"
        return f"{clock((1.0 - self.share) / (self.share - before) * (now - begun))} at most"


def progress(settings: RunSettings, steps: int, row: Mapping[str, float]) -> tuple[float, str]:
    """How far a run is, by the limit that it reaches first: the share (0 without a limit), and what is done, in words.

    Args: `steps`, the number of the run's steps so far; `row`, the latest step's row of the history.
    """
    done = {**row, "generations": steps}
    limits = {name: getattr(settings, name) for name in settings.extendable}
    shares = {name: done[name] / limit if 0 < limit < MAX_STEPS else 0.0 for name, limit in limits.items()}
    name = max(shares, key=lambda name: shares[name])
    unit, scale, digits = ("M car-steps", 1e-6, 1) if name == "car_steps" else (name, 1.0, 0)
    number, most = done[name], ""
    if shares[name]:  # the last step may exceed the limit
        number, most = min(number, limits[name]), f"/{scale * limits[name]:g}"
    return shares[name], f"{scale * number:.{digits}f}{most} {unit}"


def row_in_words(settings: RunSettings, steps: int, row: Mapping[str, float]) -> str:
    """A row of the history in words."""
    if "loss" in row:
        return (
            f"distance {row['distance_m/best']:,.0f} m, {row['network/success_rate']:.0%} succeed  "
            f"{row['speed_mps/best']:.1f} m/s  loss {row['loss']:.3f}  {row['updates'] / 1e3:.0f} k updates"
        )
    done = "" if progress(settings, steps, row)[1].endswith("generations") else f"{count(steps, 'generation')}  "
    return (
        f"{done}distance {row['distance_m/best']:,.0f} m best, {row['distance_m/mean']:,.0f} mean of "
        f"{row['target_m']:,.0f}  {row['speed_mps/best']:.1f} m/s"
    )


def clock(seconds: float) -> str:
    """A time as `m:ss`, or `h:mm:ss` from an hour on; `-:--` for nan."""
    if math.isnan(seconds):
        return "-:--"
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
