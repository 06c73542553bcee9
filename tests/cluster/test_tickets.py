"""The queue from which workers of one machine take their parcels."""

import subprocess
import sys
import threading
from pathlib import Path

from commands import wait_until

from cluster.workers.tickets import Tickets, abandoned


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


def test_a_queue_is_abandoned_once_all_that_had_it_open_are_gone(tmp_path: Path) -> None:
    path = tmp_path / "tickets"
    code = "import sys; from cluster.workers.tickets import Tickets; t = Tickets(sys.argv[1], new=True); input()"
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE) as owner:
        wait_until(path.exists)
        assert not abandoned(path)
        owner.kill()
    assert abandoned(path)
    assert not abandoned(tmp_path / "no queue")
    reader = Tickets(str(path))
    assert not abandoned(path)
    reader.close()
    assert abandoned(path)


def test_there_may_be_more_parcels_than_a_pipe_has_room_for(tmp_path: Path) -> None:
    tickets = Tickets(str(tmp_path / "tickets"), new=True)
    for serial in (65_535, 65_536):
        tickets.put(serial, 40_000)
        taken = list(tickets.take(serial))
        assert taken == list(range(len(taken)))
        assert len(taken) > 1_000
