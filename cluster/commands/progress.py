"""Live progress of a run: a line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections import deque
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import Progress as Live
from rich.progress import ProgressColumn, Task
from rich.text import Text

from cluster.runs.train import Reporter

if TYPE_CHECKING:
    from cluster.runs.train import Session
    from cluster.training.trainer import Learning

LINE_S = 5.0  # between lines where there is no terminal
WINDOW_S = 10.0  # that the ETA is taken from, at least
BAR = 10  # characters


class Line(ProgressColumn):
    """One line of the fields `head`, `facts` and `rest`. A terminal that is too narrow cuts off the rest first.

    A bar and the time stand between facts and rest where the task has a total.
    """

    def render(self, task: Task) -> Text:
        line = Text(no_wrap=True, overflow="ellipsis").append(task.fields["head"], "bold")
        line.append(f"  {task.fields['facts']}  ")
        if task.total:
            done = round(BAR * min(task.completed / task.total, 1.0))
            line.append("━" * done, "bar.complete").append("━" * (BAR - done), "bar.back")
            line.append(f"  {clock(task.elapsed or 0.0)}  ", "progress.elapsed")
        return line.append(task.fields["rest"])


class Progress(Reporter):
    """Shows how far a run is, its success and ETA, then distance, speed and car-steps per second.

    Args: the console; the command's name; the run's folder and how to resume it, as the user would type these.
    """

    def __init__(self, console: Console, prog: str, folder: str, resume: str):
        self._console, self._prog, self._folder, self._resume = console, prog, folder, resume

    def warn(self, text: str) -> None:
        print(f"{self._prog}: warning: {text}", file=sys.stderr, flush=True)

    def unsent(self, text: str, finished: bool) -> None:
        self.warn(f"{text}; send it later with: {self._resume}" if finished else text)

    def compiling(self) -> AbstractContextManager[object]:
        return self._console.status("compiling the simulator for this machine, once (some 10 s)")

    def stopping(self) -> None:
        Console(stderr=True).print("stopping; a moment ...", style="dim")

    def learning(self, session: Session) -> Progress:
        console, self._learning = self._console, session.learning
        self._live = console.is_terminal
        done, total, _ = self._learning.way()
        self._ends: deque[tuple[float, float, float]] = deque()  # of steps: when, how far, car-steps
        self._printed = 0.0
        self._facts, self._text = "success 0%  ETA -:--", ""
        self._bar = Live(Line(), console=console, disable=not self._live, transient=True)
        self._task = self._bar.add_task(
            "learn", total=total or None, completed=int(done), head=way(self._learning), facts=self._facts,
            rest="starting the workers",
        )  # fmt: skip
        settings = session.run.settings
        verb = "continuing" if done else self._learning.verb
        what = f"{settings.policy} on {settings.scenario}, seed {settings.seed}"
        console.print(f"{verb} {what} -> {self._folder}", soft_wrap=True)
        return self

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def row(self, step: int, row: dict[str, float]) -> None:
        """So many steps are done."""
        self._facts = f"success {row['validation/success_rate']:.0%}  ETA {self._eta(row['car_steps'])}"
        self._text = f"{self._learning.describe(row)}  {row['car_steps_per_s'] / 1e6:.2f} M car-steps/s"
        head, now = way(self._learning), time.perf_counter()
        done = int(self._learning.way()[0])
        self._bar.update(self._task, completed=done, head=head, facts=self._facts, rest=self._text)
        if not self._live and (now - self._printed > LINE_S or self._learning.done()):
            self._printed = now
            self._console.print(f"{head}  {self._facts}  {self._text}", soft_wrap=True)

    def _eta(self, car_steps: float) -> str:
        """When the first of the run's bounds is reached, as the latest steps went. It may be solved before."""
        now, (done, total, _) = time.perf_counter(), self._learning.way()
        self._ends.append((now, done, car_steps))
        while len(self._ends) > 2 and now - self._ends[1][0] >= WINDOW_S:
            self._ends.popleft()
        begun, *before = self._ends[0]
        bounds = zip((total, self._learning.settings.car_steps), (done, car_steps), before, strict=True)
        ends = [(bound - here) / (here - there) for bound, here, there in bounds if bound and here > there]
        if not ends or now - begun < WINDOW_S:
            return "-:--"
        return f"{clock(max(min(ends), 0.0) * (now - begun))} at most"

    def members(self, stage: str, done: int, total: int) -> None:
        """Part of a step is done."""
        if self._live:
            self._bar.update(self._task, rest=f"{stage} {done:{len(str(total))}}/{total}  {self._text}")

    def note(self, text: str) -> None:
        """What happens after the last step."""
        self._bar.update(self._task, rest=text)
        if not self._live:
            self._console.print(text)


def way(learning: Learning, bound: bool = True) -> str:
    """How far a run is, in words: what is done, not which step is the next."""
    done, total, unit = learning.way()
    of = f"/{total:g}" if total and bound else ""
    return f"{done:.1f}{of} {unit}" if unit.startswith("M") else f"{done:.0f}{of} {unit}"


def clock(seconds: float) -> str:
    """Minutes and seconds, and hours where there are some."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
