"""What the commands share: reading the command line, failing in one clear line, stopping when told to."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import gc
import inspect
import io
import os
import re
import shutil
import signal
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NoReturn, TypeVar

import tyro
from docstring_parser import attrdoc

from gridsim.errors import GridSimError

T = TypeVar("T")
FAILED, WRONG_USE, INTERRUPTED, TERMINATED = 1, 2, 130, 143
CROWDED = 4  # workers to a core that are more than anybody means

# tyro wraps a docstring as a whole only where its lines are not indented, as those of fields are.
_constant = attrdoc.ast_get_constant_value
attrdoc.ast_get_constant_value = lambda node: (
    " ".join(value.split()) if isinstance(value := _constant(node), str) else value
)


class UsageError(GridSimError):
    """Wrong use; the message is shown in one line."""


def parse(kind: type[T], prog: str, arguments: Sequence[str], default: T | None = None) -> T:
    """Read the command line. Ends the process: 0 after --help, 2 with a clear line for wrong use."""
    _check_flags(kind, prog, arguments)
    config = (tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone)
    read = partial(tyro.cli, kind, prog=prog, description=_about(kind), args=arguments, config=config)
    printed = io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stderr(printed))
        if not {"-h", "--help"} & set(arguments):  # no terminal: tyro draws no box then, and uses no colours
            stack.enter_context(contextlib.redirect_stdout(printed))
        try:
            return read() if default is None else read(default=default)
        except SystemExit as stop:
            if not stop.code:
                raise
    # A title, what is wrong, and where to read more, with rules in between.
    parts = re.split(r"-{9,}", printed.getvalue())
    fail(prog, parts[1] if len(parts) > 1 else "cannot read these flags", f"see {called(prog)} --help")


def _check_flags(kind: type, prog: str, arguments: Sequence[str]) -> None:
    """Fail where a flag is none, with the one that is most like it."""
    fields = dataclasses.fields(kind)
    known = [f"--{f.name.replace('_', '-')}" for f in fields if "Positional" not in str(f.type)]
    for argument in arguments:
        flag = argument.partition("=")[0].replace("_", "-")
        if flag.startswith("--") and not {flag, flag.replace("--no-", "--")} & {"--", "--help", *known}:
            like = difflib.get_close_matches(flag, known, 1)
            meant = f"; did you mean {like[0]}?" if like else ""
            fail(prog, f"unrecognized {flag}{meant}", f"see {called(prog)} --help")


def _about(kind: type) -> str:
    """A command's description as --help shows it. tyro leaves lines alone that begin with a space."""
    paragraphs = [*inspect.cleandoc(kind.__doc__ or "").split("\n\n"), "--version prints GridSim's version."]
    width = shutil.get_terminal_size().columns
    return "\n".join(textwrap.fill(text, width, initial_indent=" ", subsequent_indent=" ") for text in paragraphs)


def fail(prog: str, message: str, hint: str = "", code: int = WRONG_USE) -> NoReturn:
    """End with one clear line, and perhaps a second one that says what to do."""
    line = " ".join(message.split())
    print(f"{prog}: error: {line}", *([hint] if hint else []), sep="\n", file=sys.stderr, flush=True)
    raise SystemExit(code)


def typed(path: Path) -> str:
    """A path as the user would type it."""
    with contextlib.suppress(ValueError):
        return str(path.resolve().relative_to(Path.cwd()))
    return str(path)


def called(prog: str) -> str:
    """One of the commands as the user would type it: with its folder, where that is not on the PATH."""
    folder = Path(sys.argv[0]).parent
    on_path = folder.resolve() in (Path(name).resolve() for name in os.get_exec_path())
    return prog if on_path or not (folder / prog).is_file() else typed(folder / prog)


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def warn_of_crowd(prog: str, workers: int, address: str) -> None:
    """One line where so many workers are started on this machine that they only wait for each other."""
    if workers > CROWDED * cores() and not (address or os.environ.get("RAY_ADDRESS")):
        print(
            f"{prog}: warning: {workers:,} workers on {cores()} cores: more than one a core are no faster, and each "
            "takes some 200 MB",
            file=sys.stderr,
        )


class Stopped(BaseException):
    """SIGTERM."""


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """SIGTERM raises Stopped in the main thread, as Ctrl-C raises KeyboardInterrupt."""

    def stop(*_: object) -> None:
        raise Stopped

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except SystemError as error:  # what Ray makes of it where it waits
        raise error.__cause__ or error from None
    finally:
        signal.signal(signal.SIGTERM, before)


def main(prog: str, body: Callable[[], int]) -> NoReturn:
    """Run a command, which Ctrl-C and SIGTERM stop, and end this process with the code that `body` returns."""
    try:
        with stoppable():
            code = body()
    except KeyboardInterrupt:  # before there was anything to save, or for the second time
        print(f"{prog}: stopped", file=sys.stderr)
        code = INTERRUPTED
    except Stopped:
        code = TERMINATED
    if code in (INTERRUPTED, TERMINATED):  # without waiting for threads that are still compiling, or starting Ray
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    gc.freeze()  # otherwise the final garbage collection traverses all PyTorch objects, which takes two seconds
    sys.exit(code)
