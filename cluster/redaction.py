"""Addresses and error texts without secrets: all that prints or writes an address goes through here."""

import re
import urllib.parse

from gridsim.errors import GridSimError

UNCLEAR = "..."
"""Stands for an address that can be read in two ways, one of which would show a password."""
_HARMLESS = (
    "application_name", "charset", "connect_timeout", "dbname", "driver", "host", "mode", "port", "sslmode", "timeout",
    "unix_socket", "user",
)  # fmt: skip
"""Parameters of a query that are shown; no list of the secret ones would be complete."""
_SECRET = "pass|pw|token|secret|key|cred|sig|auth|odbc_connect"  # parts of the names of secrets in error texts


def redacted(uri: str) -> str:
    """An address without user and password, with only `_HARMLESS` query parameters; of http also without a fragment.

    A password may hold an @ or a slash, so all between the scheme and the last @ is left out, except in a file's path.
    An @ behind a question mark may belong to a password or to a parameter: then the address is shown as its scheme and
    `UNCLEAR`.
    """
    start, rest = re.fullmatch(r"((?:[\w.+-]*:)?//|)(.*)", uri, re.DOTALL).groups()  # type: ignore[union-attr]
    head, mark, query = rest.partition("?")
    if "@" in query:
        return f"{start}{UNCLEAR}"
    if not head.startswith("/"):  # the path of a file has no user, and may have an @
        head = head.rpartition("@")[2]
    if start.lower().startswith("http"):
        head = re.split("[#;]", head, maxsplit=1)[0]
    parts = query.partition("#")[0].split("&")
    kept = "&".join(part for part in parts if urllib.parse.unquote_plus(part.partition("=")[0]).lower() in _HARMLESS)
    return start + head + (mark + kept if kept or not query else "")


def one_line(error: BaseException, uri: str = "") -> str:
    """An error in one line, without secrets; of an operating system's error (`[Errno ...]`) only the reason.

    A GridSimError's text is returned as it is.
    Args: `uri` is the address that was used: the error's text may hold it, with its password.
    """
    text = str(error) or type(error).__name__
    if isinstance(error, GridSimError):
        return text
    if uri:
        text = text.replace(uri, redacted(uri))
    if reasons := re.findall(r"\[Errno -?\d+\] ([^'\")\]>:]+)", text):
        return reasons[-1].strip()
    if "timed out" in text.lower():
        return "no answer in time"
    # Remove user and password: all from // to the last @ of the line, since a password may hold spaces.
    line = re.sub(r"([\w.+-]*:?//)[^@]*:.*@", r"\1", text.splitlines()[0])
    line = re.sub(r"[\w.+-]*:?//\S+|\S*:\S*@\S*", lambda address: redacted(address[0]), line)
    return re.sub(rf"([\w.%-]*(?:{_SECRET})[\w.%-]*['\"]?)(\s*[=:]\s*)\S+", r"\1\2...", line, flags=re.IGNORECASE)[:200]
