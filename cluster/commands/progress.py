"""Live progress: two lines on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cluster.learn.learning import Event
from cluster.settings import RunSettings

LINE_S = 5.0  # between lines without a terminal
WINDOW_S = 10.0  # the ETA is computed from the steps of at least this time
BAR = 10  # characters


class Display(Live):
    """On a terminal: `head`, `facts`, a bar and the elapsed time if `share` is known, and `rest` on a second line."""

    def __init__(self, console: Console):
        self.head = self.facts = self.rest = ""
        self.share: float | None = None
        self._since = time.perf_counter()
        super().__init__(console=console, auto_refresh=console.is_terminal, transient=True, get_renderable=self.text)

    def text(self) -> Text:
        """Both lines as they are now."""
        line = Text(no_wrap=True, overflow="ellipsis").append(self.head, "bold").append(f"  {self.facts}  ")
        if self.share is not None:
            done = round(BAR * min(self.share, 1.0))
            line.append("━" * done, "bar.complete").append("━" * (BAR - done), "bar.back")
            line.append(f"  {clock(time.perf_counter() - self._since)}", "progress.elapsed")
        return line.append(f"\n{self.rest}")


class Progress(Display):
    """Shows a run's progress, success and ETA, then distance, speed and car-steps per second."""

    def __init__(self, console: Console, settings: RunSettings):
        super().__init__(console)
        self._settings = settings
        self._steps: deque[tuple[float, float, float]] = deque()  # of each: end time, progress, car-steps
        self._printed, self._last = 0.0, ""

    def event(self, event: Event) -> None:
        """Show what the run is doing, or warn."""
        if event.warning:
            print(f"{self._settings.command}: warning: {event.text}", file=sys.stderr, flush=True)
        elif event.total:
            done = min(event.done, event.total)
            self.rest = f"{event.text} {done:{len(str(event.total))}}/{event.total}  {self._last}"
        else:
            self.rest = event.text
            if not self.console.is_terminal:
                self.console.print(event.text)

    def row(self, steps: int, row: Mapping[str, float]) -> None:
        """Show a step that is done: the number of steps, and the row of the history."""
        settings = self._settings
        done, total, _ = progress(settings, steps, row)
        self.head = progress_in_words(settings, steps, row)
        self.share = int(done) / total if total else None
        self.facts = f"success {row['validation/success_rate']:.0%}"
        ended = 0 < total <= done
        if not ended:
            self.facts += f"  ETA {self._eta(done, total, row['car_steps'])}"
        self._last = f"{row_in_words(settings, steps, row)}  {row['car_steps_per_s'] / 1e6:.2f} M car-steps/s"
        self.rest = self._last
        now = time.perf_counter()
        if not self.console.is_terminal and (now - self._printed > LINE_S or ended):
            self._printed = now
            self.console.print(f"{self.head}  {self.facts}  {self._last}", soft_wrap=True)

    def _eta(self, done: float, total: float, car_steps: float) -> str:
        """Time until the run reaches its first limit at the pace of the latest steps. It may be solved before."""
        now = time.perf_counter()
        self._steps.append((now, done, car_steps))
        while len(self._steps) > 2 and now - self._steps[1][0] >= WINDOW_S:
            self._steps.popleft()
        begun, *before = self._steps[0]
        limits = zip((total, self._settings.car_steps), (done, car_steps), before, strict=True)
        ends = [(limit - new) / (new - old) for limit, new, old in limits if limit and new > old]
        if not ends or now - begun < WINDOW_S:
            return "-:--"
        return f"{clock(max(min(ends), 0.0) * (now - begun))} at most"


def progress(settings: RunSettings, steps: int, row: Mapping[str, float]) -> tuple[float, float, str]:
    """How far a run is, how far it goes at most (0: unknown), and in what unit: that of its first limit.

    Args: the number of its steps, and the latest one's row of the history.
    """
    limits = settings.extendable
    name = next((name for name in limits if getattr(settings, name)), limits[0])
    done, most = steps if name == "generations" else row[name], getattr(settings, name)
    return (done / 1e6, most / 1e6, "M car-steps") if name == "car_steps" else (done, most, name)


def progress_in_words(settings: RunSettings, steps: int, row: Mapping[str, float], bounded: bool = True) -> str:
    """A run's progress in words: what is done, not which step comes next; `bounded`: also how far it goes at most."""
    done, total, unit = progress(settings, steps, row)
    done = min(done, total or done)  # the last step may exceed the limit
    of = f"/{total:g}" if total and bounded else ""
    return f"{done:.1f}{of} {unit}" if unit.startswith("M") else f"{done:.0f}{of} {unit}"


def row_in_words(settings: RunSettings, steps: int, row: Mapping[str, float]) -> str:
    """A row of the history in words."""
    if "loss" in row:
        return (
            f"distance {row['distance_m/best']:,.0f} m, {row['network/success_rate']:.0%} succeed  "
            f"{row['speed_mps/best']:.1f} m/s  loss {row['loss']:.3f}  {row['updates'] / 1e3:.0f} k updates"
        )
    plural = "" if steps == 1 else "s"
    done = "" if progress(settings, steps, row)[2] == "generations" else f"{steps} generation{plural}  "
    return (
        f"{done}distance {row['distance_m/best']:,.0f} m best, {row['distance_m/mean']:,.0f} mean of "
        f"{row['target_m']:,.0f}  {row['speed_mps/best']:.1f} m/s"
    )


def clock(seconds: float) -> str:
    """Minutes and seconds, with hours if there are any."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
