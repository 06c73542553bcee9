"""What the commands share: parsing the command line, failing with one clear line."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import inspect
import io
import math
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar, get_type_hints

import tyro
from docstring_parser import attrdoc
from rich.console import Console

from cluster.settings import IN_WORDS
from cluster.stopping import INTERRUPTED
from cluster.store.checkpoint import WriteError
from cluster.text import as_argument
from cluster.workers.cores import cores
from gridsim.errors import GridSimError
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import AMOUNTS, Traffic

T = TypeVar("T")
FAILED, WRONG_USE = 1, 2  # exit codes
MANY_WORKERS = 4  # per core; more cause a warning

# tyro wraps a field's docstring as one paragraph only if its lines are not indented. It has no setting for this, so the
# function that reads docstrings is replaced; no other part of a command uses it.
_constant = attrdoc.ast_get_constant_value
attrdoc.ast_get_constant_value = lambda node: (
    " ".join(value.split()) if isinstance(value := _constant(node), str) else value
)

registry = tyro.constructors.ConstructorRegistry()


@registry.primitive_rule
def _whole_number(field: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[int] | None:
    """Integers, which may also be written as 1e6."""
    if field.type is not int:
        return None

    def read(words: list[str]) -> int:
        with contextlib.suppress(ValueError):
            return int(words[0])
        with contextlib.suppress(ValueError):
            if (number := float(words[0])).is_integer():
                return int(number)
        raise ValueError(f"'{words[0]}' is not a whole number")

    return tyro.constructors.PrimitiveConstructorSpec(1, "INT", read, lambda x: isinstance(x, int), lambda x: [str(x)])


@registry.primitive_rule
def _traffic(field: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Traffic] | None:
    """Traffic: its name, or a whole number."""
    if field.type != Traffic:
        return None

    def read(words: list[str]) -> Traffic:
        if words[0] not in AMOUNTS and not re.fullmatch(r"[+-]?\d+", words[0]):
            raise ValueError(f"'{words[0]}' is neither {', '.join(AMOUNTS)} nor a whole number")
        return words[0] if words[0] in AMOUNTS else int(words[0])  # type: ignore[return-value]

    return tyro.constructors.PrimitiveConstructorSpec(1, "CARS", read, lambda x: True, lambda x: [str(x)])


@dataclass(frozen=True)
class WorkFlags:
    """Where runs are computed, kept and logged."""

    workers: Annotated[int, IN_WORDS] = 0
    """Ray workers. By default none: this process evaluates on all its cores; with --address one for each free CPU."""
    output: str = "runs"
    """Folder in which the run's folder is created."""
    address: Annotated[str, IN_WORDS] = ""
    """An existing Ray cluster: auto, or host:port; local stays on this machine. By default RAY_ADDRESS, else local."""
    patience: Annotated[float, IN_WORDS] = 0.0
    """Of Ray workers: seconds until one that does not answer is replaced, by default 60 on this machine, 300 on a
    cluster; and until a run without any worker stops, by default 300. It can be resumed."""
    tracking_uri: Annotated[str, IN_WORDS] = ""
    """Where MLflow keeps runs. By default where a resumed run is, else MLFLOW_TRACKING_URI, else sqlite:///mlflow.db."""
    experiment: Annotated[str, IN_WORDS] = ""
    """MLflow's experiment; by default that of a run that is continued, else MLFLOW_EXPERIMENT_NAME, else gridsim."""


@dataclass(frozen=True, kw_only=True)
class RoadFlags:
    """Which road a champion drives on."""

    scenario: Annotated[str, IN_WORDS] = ""
    """Road to drive on, or several, separated by commas, or all; by default as it learned."""
    sim: Annotated[str, IN_WORDS] = ""
    """Car, sensor, episode and traffic: default, f1tenth, sedan, truck, lights, or a YAML file; by default as it
    learned."""
    traffic: Annotated[Traffic, IN_WORDS] = -1
    """Other cars on the road: usual, heavy or a number; by default as many as it learned among, on another road as many
    as that has by default."""
    seed: int = HELD_OUT_SEED
    """Seed of the first map; held-out maps have seeds from 2,000,000 on."""

    @property
    def asked(self) -> Traffic | None:
        """The traffic that is asked for, None for the default."""
        return None if self.traffic == -1 else self.traffic


def parse(kind: type[T], prog: str, arguments: Sequence[str], default: T | None = None) -> T:
    """Parse the command line. Exits with 0 after --help, and with 2 and one clear line for wrong use."""
    see, known = f"see {command_path(prog)} --help", [as_flag(name) for name in _names(kind)]
    for argument in arguments:  # tyro would take what follows an unknown flag for its value
        flag = as_flag(argument.partition("=")[0].removeprefix("--"))
        if argument.startswith("--") and flag.replace("--no-", "--") not in ("--", "--help", *known):
            like = difflib.get_close_matches(flag, known, 1)
            fail(prog, f"unrecognized {flag}{f'; did you mean {like[0]}?' if like else ''}", see)
    paragraphs = [f"Example: {kind.example}", *(inspect.getdoc(kind) or "").split("\n\n")]  # type: ignore[attr-defined]
    fill = textwrap.TextWrapper(shutil.get_terminal_size().columns, " ", " ").fill  # tyro keeps lines with an indent
    about = "\n".join(map(fill, [*paragraphs, "--version prints GridSim's version."]))
    config = (tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone, tyro.conf.OmitArgPrefixes)
    given: dict[str, Any] = {} if default is None else {"default": default}
    printed = io.StringIO()
    # Unless it writes to a terminal, tyro draws no box and uses no colours: its error is parsed below.
    out = sys.stdout if {"-h", "--help"} & set(arguments) else printed
    with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(out):
        try:
            return tyro.cli(
                kind, prog=prog, description=about, args=arguments, config=config, registry=registry, **given
            )
        except BrokenPipeError:  # the reader has left, as in `--help | head`
            raise SystemExit(0) from None
        except SystemExit as stop:
            if not stop.code:
                raise
    # tyro prints a title, what is wrong, and where to read more, separated by rules.
    reason = re.split(r"-{9,}", printed.getvalue())[1]
    fail(prog, " ".join(reason.split()).removeprefix("Error parsing "), see)


def _names(kind: Any) -> Iterator[str]:
    """Names of the fields of a command's flags, including those of nested dataclasses."""
    types = get_type_hints(kind)
    for f in dataclasses.fields(kind):
        if dataclasses.is_dataclass(types[f.name]):
            yield from _names(types[f.name])
        else:
            yield f.name


def as_flag(name: str) -> str:
    """A field's name as a flag."""
    return f"--{name.replace('_', '-')}"


def check_unchanged(flags: Any, before: Any, free: Collection[str], may_grow: Collection[str], what: str) -> None:
    """Raises GridSimError if flags contradict `before`, those of the run or comparison that is resumed.

    Args: `free` fields may differ; fields that `may_grow` may be greater, where 0 means unlimited; `what`, the word
    "run" or "comparison".
    """
    for f in dataclasses.fields(before):
        new, old = getattr(flags, f.name), getattr(before, f.name)
        if f.name == "output":
            new, old = Path(new).resolve(), Path(old).resolve()
        if new == old or f.name in free or (f.name in may_grow and (new or math.inf) >= (old or math.inf)):
            continue
        new, old = (" ".join(value) if isinstance(value, tuple) else value for value in (new, old))
        problem, remedy = f"contradicts the {what}'s {'default' if old == '' else old}", "leave it out"
        if f.name in may_grow:
            problem = problem if old else f"is a new limit for the {what}"
            remedy = f"give a greater {' or '.join(as_flag(name) for name in may_grow if getattr(before, name))}"
        raise GridSimError(f"{as_flag(f.name)} {new} {problem}; {remedy}, or start a new {what}")


def select(kind: type[T], flags: Any) -> T:
    """An instance of the dataclass `kind`; its fields have the values of the same fields of a command's flags."""
    return kind(**{f.name: getattr(flags, f.name) for f in dataclasses.fields(kind)})  # type: ignore[arg-type]


def fail(prog: str, message: str, hint: str = "", code: int = WRONG_USE) -> NoReturn:
    """Exit with one clear line, and perhaps a second one that says what to do."""
    line = " ".join(part.strip() for part in message.splitlines())
    line = re.sub(r"(?<![\w./-])gridsim-[a-z]+(?= --)", lambda name: command_path(name[0]), line)
    print(f"{prog}: error: {line}", *([hint] if hint else []), sep="\n", file=sys.stderr, flush=True)
    raise SystemExit(code)


def new_console(stderr: bool = False) -> Console:
    """A console that prints names as they are: brackets and colons in them mean nothing.

    In a notebook (`!gridsim-evolve`), output claims to be a terminal, but a line cannot be written over: there the
    console writes as to a file.
    """
    plain = False if "JPY_PARENT_PID" in os.environ else None  # Jupyter's kernels set it, in Colab, too
    return Console(stderr=stderr, markup=False, emoji=False, force_terminal=plain)


def short_path(path: Path) -> str:
    """A path as the user would type it in a shell: relative to the working directory if it is inside."""
    absolute, here = path.resolve(), Path.cwd()
    return as_argument(absolute.relative_to(here) if absolute.is_relative_to(here) else path)


def command_path(prog: str) -> str:
    """A command as the user would type it: with this program's folder if it lies there and that is not on the PATH."""
    folder = Path(sys.argv[0]).parent
    on_path = folder.resolve() in (Path(name).resolve() for name in os.get_exec_path())
    return prog if on_path or not (folder / prog).is_file() else short_path(folder / prog)


def warn_of_many_workers(prog: str, workers: int, address: str | None) -> None:
    """Warn in one line if this machine has far fewer cores than workers, and no cluster is used."""
    if workers > MANY_WORKERS * cores() and not address:
        print(
            f"{prog}: warning: {workers:,} workers on {cores()} cores: more than one per core is no faster, and each "
            "takes some 200 MB",
            file=sys.stderr,
        )


def main(prog: str, body: Callable[[], int], hints: Mapping[type[GridSimError], str] | None = None) -> NoReturn:
    """Run a command and exit with the code that `body` returns.

    Errors for the user are shown in one line, followed by the hint for their type, if any.
    """
    for stream in (sys.stdout, sys.stderr):  # characters that the terminal lacks are no error
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="surrogateescape" if stream.encoding.lower() == "utf-8" else "backslashreplace")
    try:
        sys.exit(body())
    except KeyboardInterrupt:  # after Ctrl-C or a signal, where nothing is left to save
        print(f"{prog}: stopped", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except GridSimError as error:
        code = FAILED if isinstance(error, WriteError) else WRONG_USE
        fail(prog, str(error), (hints or {}).get(type(error), ""), code)
    except OSError as error:  # as from `Path.exists`, if a name is too long or a folder may not be read
        if error.filename is None:
            raise
        fail(prog, f"{error.filename}: {error.strerror}")
