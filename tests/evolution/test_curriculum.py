"""How the task grows with its leader, and what is remembered of the leader's crashes."""

import numpy as np
import pytest

from evolution.episodes.curriculum import Curriculum, CurriculumConfig
from evolution.episodes.rollout import RESULT
from gridsim.maps.scenarios import build
from gridsim.state import End

CONFIG = CurriculumConfig(maps=3, first_maps=2, groups=3, starts=2, crash_starts=2, crash_memory=10, leader_episodes=8)


@pytest.fixture
def curriculum():
    return Curriculum(CONFIG, 7, lambda seed: build("seamless", seed), traffic=2)


def led(curriculum, generation, ends, distance=0.0, steps=50):
    """Results of the leader's episodes with these ends; told to the curriculum."""
    episodes = curriculum.leader_episodes(generation)
    results = np.zeros(len(episodes.rows), dtype=RESULT)
    results["end"], results["distance"], results["steps"] = ends, distance, steps
    rewound = np.repeat(np.arange(len(results), dtype=np.float32)[:, None], 5, axis=1) + 100.0 * generation
    curriculum.learn_from_leader(episodes, results, rewound, episodes.worlds)
    return episodes, rewound


@pytest.mark.parametrize(("pace", "share"), [(0.5, 0.5), (1.0, 1.0), (2.0, 1.0)])
def test_a_validation_score_is_the_success_rate_and_less_for_slow_drivers_only(curriculum, pace, share):
    results = np.zeros((2, 4), dtype=RESULT)
    results["steps"], results["distance"] = 100, 100 * curriculum.period * pace * CONFIG.champion_pace
    results["end"] = [[End.SUCCESS] * 4, [End.SUCCESS, End.COLLISION, End.TIME, End.SUCCESS]]
    assert curriculum.validation_score(results) == pytest.approx([share, share / 2])


def test_only_who_crashed_or_stood_still_on_the_way_is_remembered(curriculum):
    ends = [End.COLLISION, End.SUCCESS, End.TIME, End.IDLE, End.COLLISION, End.IDLE, End.SUCCESS, End.TIME]
    steps = [50, 50, 50, 50, 10, 11, 50, 50]  # the fifth crashed at its start
    episodes, rewound = led(curriculum, 0, ends, steps=steps)
    kept = [0, 3, 5]
    assert curriculum.crashes["start"].tobytes() == rewound[kept].tobytes()
    assert curriculum.crash_worlds.tobytes() == episodes.worlds[kept].tobytes()
    seeds = [curriculum.map_seeds[m] for m in curriculum.crashes["map"]]
    assert seeds == [episodes.maps[m] for m in episodes.rows["map"][kept]]
    assert (curriculum.crashes["rewind"] == 0).all()
    latest, _ = led(curriculum, 1, End.COLLISION)
    assert len(curriculum.crashes) == len(curriculum.crash_worlds) == CONFIG.crash_memory  # the latest
    assert curriculum.crash_worlds[-8:].tobytes() == latest.worlds.tobytes()
    assert curriculum.crashes["start"][-1, 0] == 107.0
    assert curriculum.crashes["start"][0, 0] == 3.0


def test_the_task_doubles_as_the_leader_succeeds(curriculum):
    distance = np.array([150.0] * 4 + [149.0] * 4)
    led(curriculum, 0, End.TIME, distance)
    assert curriculum.target == 150.0  # 4 of 8 are less than 0.6
    distance[4] = 150.0
    led(curriculum, 1, End.TIME, distance)
    assert curriculum.target == 300.0
    for generation in (2, 3):
        led(curriculum, generation, End.TIME, 1e4)
        assert curriculum.target == CONFIG.last_target


def test_each_group_has_as_many_new_starts_and_crashes(curriculum):
    assert len(curriculum.episodes(0).rows) == 3 * 2
    led(curriculum, 0, End.COLLISION)
    remembered = {crash["start"].tobytes() for crash in curriculum.crashes}
    episodes = curriculum.episodes(1)
    assert len(episodes.rows) == len(episodes.worlds) == 3 * 4
    of_crash = [row["start"].tobytes() in remembered for row in episodes.rows]
    assert of_crash == [False, False, True, True] * 3
    assert (episodes.rows["target"][of_crash] == CONFIG.crash_target).all()
    assert (episodes.rows["steps"][of_crash] > 0).all()
    assert episodes.maps == sorted(set(episodes.maps))
    for row, world in zip(episodes.rows[of_crash], episodes.worlds[of_crash], strict=True):
        k = next(k for k, crash in enumerate(curriculum.crashes) if crash["start"].tobytes() == row["start"].tobytes())
        assert episodes.maps[row["map"]] == curriculum.map_seeds[curriculum.crashes["map"][k]]
        assert world.tobytes() == curriculum.crash_worlds[k].tobytes()
    assert curriculum.episodes(1).rows.tobytes() == episodes.rows.tobytes()
    assert curriculum.episodes(2).rows.tobytes() != episodes.rows.tobytes()


def test_crashes_that_all_members_avoid_are_seldom_driven_again(curriculum):
    led(curriculum, 0, End.COLLISION)
    easy = curriculum.crashes["start"][4:, 0]

    def crash_starts(generation):
        """Of each group: [3, 2]."""
        return curriculum.episodes(generation).rows["start"].reshape(3, 4, 5)[:, 2:, 0]

    for generation in range(1, 40):
        starts = crash_starts(generation)
        results = np.zeros((3, 6, 4), dtype=RESULT)  # of groups, members, episodes
        results["end"] = End.COLLISION
        results["end"][:, ::2, 2:] = End.SUCCESS  # half of the members avoid the hard ones
        results["end"][:, :, 2:][np.broadcast_to(np.isin(starts, easy)[:, None], (3, 6, 2))] = End.SUCCESS
        curriculum.learn_from_members(generation, list(results))
    assert curriculum.failures[:4] == pytest.approx(0.5)
    assert (curriculum.failures[4:] < 0.05).all()
    drawn = np.concatenate([crash_starts(generation) for generation in range(40, 90)])
    # Of 6 starts without repetition, 4 are hard ones nearly always.
    assert 0.58 < 1.0 - np.isin(drawn, easy).mean() < 0.67
    led(curriculum, 1, End.COLLISION)
    assert len(curriculum.failures) == len(curriculum.crashes) == CONFIG.crash_memory
    assert curriculum.failures[-8:] == pytest.approx(0.5)
