"""What the tests of searches do with one, and those of experience."""

import numpy as np

from evolution.networks.symmetry import space
from evolution.search.breeding import RECIPE, Kind, Mutation, breed


def told(search, score):
    """One generation: asked for, and told `score(genomes)`; returns the genomes."""
    search.ask()
    genomes = search.genomes()
    search.tell(score(genomes))
    return genomes


def state_of(search):
    return {name: array.tobytes() for name, array in search.state().items()}


def to_bytes(experience):
    return b"".join(array.tobytes() for array in experience)


def first_gene(genomes):
    return genomes[:, 0].astype(float)


def new_genomes(spec, n=1, seed=0):
    recipes = np.zeros(n, dtype=RECIPE)
    recipes["kind"], recipes["seed"] = Kind.NEW, np.arange(n)
    return breed(np.zeros((0, spec.size), dtype=np.float32), recipes, seed, space(spec), Mutation())
