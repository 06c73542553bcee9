"""What searches share: ranks within groups, tournaments in closed form, groups of pairs, the order of ask and tell."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from searching import state_of

from evolution.networks.policy import PolicySpec
from evolution.search.base import SearchConfig, ranks, split, tournament_weights, tournaments
from evolution.search.recombination import Recombination
from evolution.search.two_parents import TwoParents

SPEC = PolicySpec.parse("mlp:1")
SEARCHES = [Recombination, TwoParents]
few = st.integers(0, 4)  # scores that are often equal


@settings(max_examples=60, derandomize=True)
@given(scores=st.lists(few | st.just(-np.inf), min_size=2, max_size=40).map(np.array), data=st.data())
def test_a_rank_is_the_share_of_its_group_with_lower_scores_equals_by_half(scores, data):
    cuts = sorted(data.draw(st.sets(st.integers(1, len(scores) - 1), max_size=4)))
    groups = [slice(a, b) for a, b in itertools.pairwise([0, *cuts, len(scores)])]
    standing = ranks(scores, groups)
    for group in groups:
        for own, score in zip(standing[group], scores[group], strict=True):
            lower, equal = (scores[group] < score).sum(), (scores[group] == score).sum()
            assert own == pytest.approx((lower + equal / 2) / len(scores[group]))
    assert ((standing > 0.0) & (standing < 1.0)).all()


@given(scores=st.lists(few, min_size=1, max_size=5), size=st.integers(1, 4))
def test_weights_are_what_all_tournaments_come_to(scores, size):
    """Every tournament that can be, its equal winners sharing it."""
    scores, wins = np.array(scores), np.zeros(len(scores))
    for drawn in itertools.product(range(len(scores)), repeat=size):
        best = [k for k in drawn if scores[k] == scores[list(drawn)].max()]
        for k in best:
            wins[k] += 1.0 / len(best)
    np.testing.assert_allclose(tournament_weights(scores, size), wins / len(scores) ** size, atol=1e-12)


@pytest.mark.parametrize(("n", "size"), [(20, 1), (20, 3), (2, 2)])
def test_tournaments_are_won_at_their_weights(n, size):
    rng = np.random.default_rng(100 * n + size)
    scores, count = rng.permutation(n).astype(float), 60_000
    seen = np.bincount(tournaments(scores, size, count, rng), minlength=n)
    assert stats.chisquare(seen, count * tournament_weights(scores, size)).pvalue > 1e-3


@given(data=st.data())
def test_pairs_stay_together_in_groups_of_about_as_many(data):
    members = data.draw(st.integers(4, 300))
    groups = data.draw(st.integers(1, members // 2))
    first = data.draw(st.integers(0, 2))
    parts = split(members, groups, first)
    assert len(parts) == groups
    assert [k for part in parts for k in range(part.start, part.stop)] == list(range(members))
    assert all((part.start - first) % 2 == 0 for part in parts[1:])  # no pair is cut
    sizes = np.array([part.stop - part.start for part in parts])
    sizes[0] -= first
    assert np.ptp((sizes + 1) // 2) <= 1


@pytest.mark.parametrize("kind", SEARCHES)
def test_the_first_generation_is_new_and_each_has_a_key_of_its_own(kind):
    search, other = (kind(SPEC, SearchConfig(population=41, groups=3), seed) for seed in (4, 5))
    assert search.leader() is None
    asked = search.ask()
    assert asked.groups == split(41, 3)
    assert len({genome.tobytes() for genome in search.genomes(np.arange(41))}) == 41
    keys = {other.ask().key, asked.key}
    for _ in range(49):
        search.tell(np.arange(41.0))
        keys.add(search.ask().key)
    assert len(keys) == 51


@pytest.mark.parametrize("kind", SEARCHES)
def test_a_score_that_is_not_a_number_loses(kind):
    """The search goes as if it were lower than all others'."""
    states = []
    for spoilt in (np.nan, -np.inf, -1e300):
        search = kind(SPEC, SearchConfig(population=16, groups=2, tournament=4), seed=6)
        for generation in range(4):
            search.ask()
            scores = np.random.default_rng(generation).normal(size=16)
            scores[[2, 3, 11]] = spoilt
            search.tell(scores)
        states.append(state_of(search))
    assert states[0] == states[1] == states[2]
