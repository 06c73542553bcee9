"""Live progress: two lines on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections import deque
from contextlib import AbstractContextManager
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cluster.commands.common import new_console
from cluster.learn.learning import Learning
from cluster.run import Reporter, Session

LINE_S = 5.0  # between lines without a terminal
WINDOW_S = 10.0  # the ETA is computed from the steps of at least this time
BAR = 10  # characters


class Line(Live):
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


class Progress(Line, Reporter):
    """Shows a run's progress, success and ETA, then distance, speed and car-steps per second.

    Args: the console; the command's name; the run's folder and the command that resumes it, as the user would type
    them.
    """

    def __init__(self, console: Console, prog: str, folder: str, resume: str):
        super().__init__(console)
        self._prog, self._folder, self.resume = prog, folder, resume
        self._steps: deque[tuple[float, float, float]] = deque()  # of each: end time, progress, car-steps
        self._printed = 0.0
        self._text = ""
        self.facts, self.rest = "success 0%  ETA -:--", "starting the workers"

    def warn(self, text: str) -> None:
        print(f"{self._prog}: warning: {text}", file=sys.stderr, flush=True)

    def compiling(self) -> AbstractContextManager[object]:
        text = "compiling the simulator for runs of this kind, once (some 20 s)"
        if not self.console.is_terminal:
            self.console.print(text)
        return self.console.status(text)

    def stopping(self) -> None:
        new_console(stderr=True).print("stopping; a moment ...", style="dim")

    def learning(self, session: Session) -> Self:
        self._learning = session.learning
        self._advance()
        settings = session.run.settings
        verb = "continuing" if self._learning.progress()[0] else self._learning.verb
        what = f"{settings.policy} on {settings.scenario}, seed {settings.seed}"
        self.console.print(f"{verb} {what} -> {self._folder}", soft_wrap=True)
        return self

    def _advance(self) -> None:
        done, total, _ = self._learning.progress()
        self.head = progress_of(self._learning)
        self.share = int(done) / total if total else None

    def row(self, step: int, row: dict[str, float]) -> None:
        self._advance()
        self.facts = f"success {row['validation/success_rate']:.0%}"
        if not self._learning.done():  # the champion is measured after the last step
            self.facts += f"  ETA {self._eta(row['car_steps'])}"
        self.rest = self._text = f"{self._learning.describe(row)}  {row['car_steps_per_s'] / 1e6:.2f} M car-steps/s"
        now = time.perf_counter()
        if not self.console.is_terminal and (now - self._printed > LINE_S or self._learning.done()):
            self._printed = now
            self.console.print(f"{self.head}  {self.facts}  {self._text}", soft_wrap=True)

    def _eta(self, car_steps: float) -> str:
        """Time until the run reaches its first limit at the pace of the latest steps. It may be solved before."""
        now, (done, total, _) = time.perf_counter(), self._learning.progress()
        self._steps.append((now, done, car_steps))
        while len(self._steps) > 2 and now - self._steps[1][0] >= WINDOW_S:
            self._steps.popleft()
        begun, *before = self._steps[0]
        bounds = zip((total, self._learning.settings.car_steps), (done, car_steps), before, strict=True)
        ends = [(bound - new) / (new - old) for bound, new, old in bounds if bound and new > old]
        if not ends or now - begun < WINDOW_S:
            return "-:--"
        return f"{clock(max(min(ends), 0.0) * (now - begun))} at most"

    def members(self, stage: str, done: int, total: int) -> None:
        self.rest = f"{stage} {done:{len(str(total))}}/{total}  {self._text}"

    def note(self, text: str) -> None:
        self.rest = text
        if not self.console.is_terminal:
            self.console.print(text)


def progress_of(learning: Learning, bound: bool = True) -> str:
    """A run's progress in words: what is done, not which step comes next."""
    done, total, unit = learning.progress()
    done = min(done, total or done)  # the last step may exceed the budget
    of = f"/{total:g}" if total and bound else ""
    return f"{done:.1f}{of} {unit}" if unit.startswith("M") else f"{done:.0f}{of} {unit}"


def clock(seconds: float) -> str:
    """Minutes and seconds, with hours if there are any."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
