"""What type checkers and editors see; at run time these are looked up when they are first used."""

from cluster.api import Champion as Champion
from cluster.api import DqnSettings as DqnSettings
from cluster.api import Evaluator as Evaluator
from cluster.api import EvolveSettings as EvolveSettings
from cluster.api import compare as compare
from cluster.api import evaluate as evaluate
from cluster.api import evolve as evolve
from cluster.api import load_champion as load_champion
from cluster.api import train_dqn as train_dqn
from gridsim.config import SimConfig as SimConfig

ENVIRONMENTS: dict[str, str]
