"""The queue from which workers of one machine take their parcels."""

import threading
from pathlib import Path

from cluster.workers.tickets import Tickets


def test_each_parcel_is_taken_once_by_one_of_several_readers(tmp_path: Path) -> None:
    tickets = Tickets(str(tmp_path / "tickets"), new=True)
    readers = [Tickets(tickets.path) for _ in range(4)]
    taken: list[list[int]] = [[] for _ in readers]
    tickets.put(7, 9_999)
    threads = [
        threading.Thread(target=lambda mine=mine, reader=reader: mine.extend(reader.take(7)))
        for mine, reader in zip(taken, readers, strict=True)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(index for mine in taken for index in mine) == list(range(9_999))
    assert all(mine == sorted(mine) for mine in taken), "the largest parcels, which are the first, are taken first"


def test_tickets_that_an_interrupted_call_left_are_void(tmp_path: Path) -> None:
    tickets = Tickets(str(tmp_path / "tickets"), new=True)
    reader = Tickets(tickets.path)
    tickets.put(1, 10)
    assert next(reader.take(1)) == 0
    tickets.put(2, 3)
    assert list(reader.take(2)) == [0, 1, 2]
    tickets.put(3, 3)
    assert list(reader.take(2)) == [], "a worker that is late takes none of a later task as its own"
    assert list(reader.take(3)) == [1, 2], "all but the one that it read, which the coordinator will send"


def test_there_may_be_more_parcels_than_a_pipe_has_room_for(tmp_path: Path) -> None:
    tickets = Tickets(str(tmp_path / "tickets"), new=True)
    for serial in (65_535, 65_536):
        tickets.put(serial, 40_000)
        taken = list(tickets.take(serial))
        assert taken == list(range(len(taken)))
        assert len(taken) > 1_000
