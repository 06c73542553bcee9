"""Runs of the learners in this process, without commands and without MLflow."""

import dataclasses
from typing import Any

from cluster import run as module
from cluster.learn.learning import finish
from cluster.workers.open import open_pool


class Untracked:
    """A run that MLflow knows nothing of."""

    uri, run_id = "http://me:secret@host", ""
    error: Any = None

    def start(self):
        pass

    def listen(self):
        pass

    def wait_id(self, timeout_s):
        return ""

    def close(self, status):
        return None


def pool_of(maps):
    return open_pool(0, None, 0.0, maps.build)


def session(run, maps, on_event=lambda event: None, on_row=lambda steps, row: None, **curriculum):
    """A run in its folder, with a short validation, and changes of its curriculum."""
    run.path.mkdir(parents=True, exist_ok=True)
    run.write_config()
    untracked: Any = Untracked()
    began, limit_s = module.perf_counter(), float("inf")
    made = module.Session(run, pool_of(maps), maps, untracked, on_event, on_row, began, limit_s, None)
    config = made.learning.curriculum.config
    made.learning.curriculum.config = dataclasses.replace(config, validation=8, **curriculum)
    return made


def step(learning):
    """One step, at a second each. Returns: its row."""
    finish(learning.step())
    learning.add_wall_clock(float(learning.steps))
    return learning.history[-1]
