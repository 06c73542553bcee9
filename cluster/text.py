"""Words for people: numbers with nouns, names for folders, arguments for a shell."""

import re
import shlex
from collections.abc import Mapping
from pathlib import Path


def count(number: int, noun: str) -> str:
    """A number with its noun, as in `1 row` or `2 rows`."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def cars(traffic: int | str) -> str:
    """Traffic in words: `6 cars`, or `usual traffic`."""
    return f"{traffic} traffic" if isinstance(traffic, str) else f"{traffic} cars"


def km_per_collision(figures: Mapping[str, float]) -> str:
    """Kilometres per collision of `figures.summarise`; without a collision `more than` the kilometres driven."""
    km = figures["km_per_collision"]
    return ("" if figures["collision_rate"] else "more than ") + (f"{km:,.0f}" if km >= 100.0 else f"{km:.3g}")


def file_name(words: str) -> str:
    """Words, such as a scenario's label, as a file's name: all but letters, digits and `_.+=@-` becomes `_`."""
    return re.sub(r"[^\w.+=@-]", "_", words)


def as_argument(path: Path) -> str:
    """A path as an argument of a command that is pasted into a shell."""
    return shlex.quote(f"./{path}" if str(path).startswith("-") else str(path))
