"""What the tests of searches do with one."""

import numpy as np


def told(search, score):
    """One generation: asked for, and told `score(genomes)`; returns the genomes."""
    search.ask()
    genomes = search.genomes(np.arange(search.config.population))
    search.tell(score(genomes))
    return genomes


def leader(search):
    """The leader of a search that has one."""
    found = search.leader()
    assert found is not None
    return found


def first_gene(genomes):
    """A score: the first gene of each genome."""
    return genomes[:, 0].astype(float)
