"""What Ray's errors say of a worker's death, in one short line, and whose fault it was, by names and texts."""

from __future__ import annotations

_ELSEWHERE = ("ActorUnavailableError", "NodeDiedError", "ObjectLostError", "OwnerDiedError", "ObjectFetchTimedOutError")


def is_to_blame(error: BaseException) -> bool:
    """Whether a worker may have died of what it did. Its host's end is not its fault, nor is being out of reach."""
    return type(error).__name__ not in _ELSEWHERE and "its node has died" not in str(error)


def failed_as_it_began(error: BaseException) -> bool:
    """Whether a worker's own beginning raised an exception: the next one's would, too."""
    return "raised in its creation task" in str(error)


def reason(error: BaseException) -> str:
    """What matters in Ray's long messages."""
    text = (str(error).strip() or type(error).__name__).splitlines()[-1].strip()
    if "its node has died" in str(error):
        text = "its host is gone"
    elif "Worker exit detail: " in text:
        text = text.split("Worker exit detail: ")[1].split(". Some common causes")[0]
        if "connection error" in text:
            text = "its process was killed, crashed, or ran out of memory"
    return text[:300]
