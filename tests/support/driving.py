"""What the tests of experience look at."""

from evolution.dqn.experience import Experience


def to_bytes(experience: Experience) -> bytes:
    return b"".join(array.tobytes() for array in experience)
