"""Recipes and results as few bytes: whole numbers in as many bits as their limits need, and nothing is lost.

A generation sends one recipe a member and brings back one RESULT an episode. Their numbers are bounded by the mating
pool, the episode's target and its limit, and distances are multiples of a sixteenth of a metre (`rollout.RESULT`): 3
and 54 bytes a member where plain arrays take 8 and 144.
"""

from __future__ import annotations

import numpy as np

from evolution.breeding import RECIPE
from evolution.rollout import PER_METRE, RESULT, Limits, targets
from gridsim.config import SimConfig
from gridsim.ego import End
from gridsim.jit import njit
from gridsim.roads import freeze

_U = np.uint64
_FIELDS = 4  # of a RESULT: distance, paced, steps, end
_END_BITS = int(max(End)).bit_length()


@njit(nogil=True)
def _write(values, widths, packed):
    """Fill packed uint8 [n, bytes] from values uint32 [n, k], of which column j takes widths[j] bits, lowest first."""
    for i in range(values.shape[0]):
        word, filled, at = _U(0), 0, 0
        for j in range(values.shape[1]):
            word |= _U(values[i, j]) << _U(filled)
            filled += widths[j]
            while filled >= 8:
                packed[i, at] = word & _U(255)
                word >>= _U(8)
                filled -= 8
                at += 1
        if filled > 0:
            packed[i, at] = word


@njit(nogil=True)
def _read(packed, widths, values):
    """What `_write` was given."""
    for i in range(values.shape[0]):
        word, filled, at = _U(0), 0, 0
        for j in range(values.shape[1]):
            width = widths[j]
            while filled < width:
                word |= _U(packed[i, at]) << _U(filled)
                filled += 8
                at += 1
            values[i, j] = word & ((_U(1) << _U(width)) - _U(1))
            word >>= _U(width)
            filled -= width


def _bits(largest: np.ndarray) -> np.ndarray:
    """Bits int64 [k] that whole numbers up to these need."""
    return np.frexp(largest)[1].astype(np.int64)


def _row_bytes(widths: np.ndarray) -> int:
    return (int(widths.sum()) + 7) // 8


def pack_recipes(recipes: np.ndarray) -> bytes:
    """RECIPE [n] in as many bits as the largest of each number needs, which come first."""
    values = np.stack([recipes["a"], recipes["b"], recipes["seed"]], axis=1).astype(np.uint32)
    widths = np.maximum(_bits(values.max(axis=0, initial=0)), 1)
    packed = np.empty((len(values), _row_bytes(widths)), dtype=np.uint8)
    _write(values, widths, packed)
    return widths.astype(np.uint8).tobytes() + packed.tobytes()


def unpack_recipes(raw: bytes) -> np.ndarray:
    """RECIPE [n] that `pack_recipes` packed; read-only."""
    widths = np.frombuffer(raw, np.uint8, 3).astype(np.int64)
    packed = np.frombuffer(raw, np.uint8, offset=3).reshape(-1, _row_bytes(widths))
    values = np.empty((len(packed), 3), dtype=np.uint32)
    _read(packed, widths, values)
    recipes = np.zeros(len(values), dtype=RECIPE)
    recipes["a"], recipes["b"], recipes["seed"] = values.T
    return freeze(recipes)


def result_widths(episodes: np.ndarray, limits: Limits, config: SimConfig) -> np.ndarray:
    """Bits int64 [e, 4] of each number of a RESULT of EPISODE [e]: an episode ends in the step that takes it there."""
    farthest = targets(episodes, limits) + config.vehicle.speed_limit * config.episode.control_period
    metres = _bits(np.ceil(farthest * PER_METRE))
    steps = _bits(np.where(episodes["steps"] > 0, episodes["steps"], limits.steps))
    return np.stack([metres, metres, steps, np.full(len(episodes), _END_BITS)], axis=1)


def pack_results(results: np.ndarray, widths: np.ndarray) -> bytes | None:
    """RESULT [n, e] in so many bits (`result_widths`); None where one of its numbers does not fit into them."""
    values = np.empty((*results.shape, _FIELDS), dtype=np.uint32)
    for k, name in enumerate(("distance", "paced")):
        units = results[name] * np.float32(PER_METRE)
        # Checked as floats: what is no number, negative or too large has no whole number to become.
        if not ((units >= 0) & (units < 1 << 31)).all() or (units % 1).any():
            return None
        values[..., k] = units
    values[..., 2], values[..., 3] = results["steps"], results["end"]
    widths = widths.ravel()
    values = values.reshape(len(results), len(widths))
    if (_bits(values.max(axis=0, initial=0)) > widths).any() or results["pad"].any():
        return None
    packed = np.empty((len(values), _row_bytes(widths)), dtype=np.uint8)
    _write(values, widths, packed)
    return packed.tobytes()


def unpack_results(raw: bytes | memoryview, widths: np.ndarray) -> np.ndarray:
    """RESULT [n, e] that `pack_results` packed."""
    widths = widths.ravel()
    packed = np.frombuffer(raw, np.uint8).reshape(-1, _row_bytes(widths))
    values = np.empty((len(packed), len(widths)), dtype=np.uint32)
    _read(packed, widths, values)
    fields = values.reshape(len(packed), len(widths) // _FIELDS, _FIELDS)
    results = np.zeros(fields.shape[:2], dtype=RESULT)
    results["distance"], results["paced"] = fields[..., 0] / PER_METRE, fields[..., 1] / PER_METRE
    results["steps"], results["end"] = fields[..., 2], fields[..., 3]
    return results
