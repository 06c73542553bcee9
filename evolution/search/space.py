"""The space that a search explores: vectors of genes, independent of networks and cars."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gridsim.errors import GridSimError
from gridsim.jit import freeze


class Symmetry(NamedTuple):
    """How the genes of a symmetric genome depend on each other: gene[bound] = factor * gene[source]."""

    free: np.ndarray  # int32 [f], genes with random numbers of their own
    bound: np.ndarray  # int32 [genes - f], all other genes
    source: np.ndarray  # int32 [genes - f], the mirror image of each bound gene: a free gene, unless the factor is 0
    factor: np.ndarray  # float32 [genes - f], such as 1, -1, or 0 for a gene that is its own opposite


@dataclass(frozen=True, eq=False)
class Space:
    """Vectors of `size` genes. Raises: GridSimError if the scales or the mirror do not fit the size."""

    size: int
    scales: np.ndarray  # float32 [size], above 0: relative spread of each gene in new genomes and mutations
    mirror: Symmetry | None = None  # None: all genes are free

    def __post_init__(self) -> None:
        scales = freeze(np.array(self.scales, dtype=np.float32))
        if scales.shape != (self.size,) or not (scales > 0.0).all():
            raise GridSimError(f"a space of {self.size} genes needs as many scales above 0, float32 [{self.size}]")
        object.__setattr__(self, "scales", scales)
        free, bound, source, factor = self.symmetry
        every = np.sort(np.concatenate([free, bound]))
        fits = np.array_equal(every, np.arange(self.size)) and len(bound) == len(source) == len(factor)
        if not fits or not np.isin(source, every).all():
            raise GridSimError(f"the mirror does not fit a space of {self.size} genes")

    @cached_property
    def symmetry(self) -> Symmetry:
        """`mirror` as kernels read it; without one, all genes are free."""
        none = np.zeros(0)
        free, bound, source, factor = self.mirror or Symmetry(np.arange(self.size), none, none, none)
        free, bound, source = (freeze(np.asarray(genes, dtype=np.int32)) for genes in (free, bound, source))
        return Symmetry(free, bound, source, freeze(np.asarray(factor, dtype=np.float32)))
