"""The imports of the process from which jobs are forked (`jobs`), so that each job does not repeat them."""

import gc
import os

from cluster.commands.entry import GC_THRESHOLDS

os.setpgid(0, 0)  # Ctrl-C and signals to the command's group reach the command alone, which stops its jobs
gc.set_threshold(*GC_THRESHOLDS)

import cluster.commands.jobs  # noqa: E402, F401
from cluster.tracking.mlflow_run import preload, quiet  # noqa: E402

quiet()
preload()
