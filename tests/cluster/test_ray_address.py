"""The addresses of clusters that a RayPool is given."""

import http.server
import socket
import threading
import time

import pytest
from test_pool import never_built
from tracked import free_port

from cluster.workers.pool import PoolError
from cluster.workers.ray_pool import RayPool
from cluster.workers.ray_session import check_address

pytestmark = pytest.mark.e2e


@pytest.mark.parametrize("address", ["nowhere", "host:0", "host:99999", ":6379", "ray://127.0.0.1:10001", "a/b:1"])
def test_what_is_no_address(address: str) -> None:
    with pytest.raises(PoolError, match="is not a Ray address; give host:port"):
        RayPool(2, never_built, address)


def test_an_address_where_nothing_answers() -> None:
    address = f"127.0.0.1:{free_port()}"
    started = time.perf_counter()
    with pytest.raises(PoolError, match=rf"^no Ray cluster answers at {address}: Connection refused; is `ray start"):
        RayPool(2, never_built, address)
    assert time.perf_counter() - started < 2


def test_an_address_where_something_else_answers() -> None:
    class Quiet(http.server.BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(PoolError, match="is not a Ray cluster; is that its head's port"):
            check_address(f"127.0.0.1:{server.server_port}")
        server.shutdown()


def test_an_address_that_accepts_and_says_nothing() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        started = time.perf_counter()
        with pytest.raises(PoolError, match="is not a Ray cluster"):
            check_address(f"127.0.0.1:{server.getsockname()[1]}")
        assert time.perf_counter() - started < 5
