"""What the process loads from which a comparison's runs at once are forked (`jobs`): all that is slow to import."""

import gc
import os

from cluster.commands.entry import GC_THRESHOLDS

os.setpgid(0, 0)  # a terminal's Ctrl-C and a signal to the command's group are for the command, which has runs saved
gc.set_threshold(*GC_THRESHOLDS)

import cluster.commands.jobs  # noqa: E402, F401
from cluster.tracking.mlflow_run import preload, quiet  # noqa: E402

quiet()
preload()
