"""Ray itself: one of our own on this machine, or a cluster that is joined. With `ray_pool` all that imports Ray."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
from collections.abc import Iterator
from functools import partial
from typing import Any

from cluster.workers import shipping
from cluster.workers.pool import PoolError
from cluster.workers.ray_address import (
    AUTH_ENVIRONMENT,
    OWN_ENVIRONMENT,
    TOKEN,
    environment,
    has_token,
    probe,
)


def check_address(address: str) -> str:
    """The `host:port` of the Ray cluster meant by `address` (`host:port`, or `auto`: RAY_ADDRESS, else this machine's).

    Raises PoolError, one line, within 3 s where no Ray answers or it would not let us in. (Ray itself would try for
    20 s to minutes, and print a warning for each second.)
    """
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS") or "auto"
    if address == "auto":
        logging.getLogger("ray").setLevel(logging.CRITICAL)
        services = _private("services")
        try:
            address = services.canonicalize_bootstrap_address("auto")
        except ConnectionError:
            raise PoolError(
                "no Ray cluster runs on this machine; start one with `ray start --head`, or give its host:port"
            ) from None
    probe(address)
    return address


def start_own(workers: int, store_bytes: int) -> str:
    """Start Ray on this machine with one CPU for each worker; returns the folder of its logs."""
    import ray

    if not any(name in os.environ for name in AUTH_ENVIRONMENT):
        # Ray listens on all interfaces and lets in who has its token. One of our own need not outlive the run in
        # ~/.ray, where it would change what `ray start` does from then on.
        os.environ["RAY_AUTH_TOKEN"] = TOKEN
    with environment(OWN_ENVIRONMENT), _lean_head():
        context: Any = ray.init(
            address="local",  # whatever RAY_ADDRESS says
            num_cpus=workers,
            num_gpus=0,
            object_store_memory=store_bytes,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.CRITICAL,
        )
    return context.address_info["session_dir"]


def join(address: str) -> None:
    """Connect to a cluster that was found to let us in."""
    import ray

    if has_token(address.rpartition(":")[0]):
        with contextlib.suppress(ImportError, AttributeError):  # what Ray does where it is asked to find the cluster
            setup = importlib.import_module("ray._private.authentication.authentication_token_setup")
            setup.maybe_enable_token_auth_if_token_available(warn_if_disabled=False)
    with environment(shipping.ENVIRONMENT):
        env = shipping.runtime_env()
        ray.init(address=address, runtime_env=env, log_to_driver=False, logging_level=logging.CRITICAL)


def _private(name: str) -> Any:
    return importlib.import_module(f"ray._private.{name}")


@contextlib.contextmanager
def _lean_head() -> Iterator[None]:
    """Start Ray's head without the helpers that only its dashboard, autoscaler and terminal output need.

    Ray has no setting for that, so this replaces private names while `ray.init` runs; not in a version without them.
    """
    try:
        node, parameter = map(_private, ("node", "parameter"))
        before = node.Node.start_api_server, parameter.RayParams
        lean = partial(parameter.RayParams, no_monitor=True, include_log_monitor=False)
        lean()
    except (ImportError, AttributeError, TypeError):
        yield
        return

    def no_api_server(self: Any, **_: Any) -> None:
        self._webui_url = ""

    node.Node.start_api_server, parameter.RayParams = no_api_server, lean
    try:
        yield
    finally:
        node.Node.start_api_server, parameter.RayParams = before


def forget_token() -> None:
    """Leave Ray and the environment as they were: with our token, a cluster that is joined next could not call us."""
    if os.environ.get("RAY_AUTH_TOKEN") == TOKEN:
        del os.environ["RAY_AUTH_TOKEN"]
        os.environ.pop("RAY_AUTH_MODE", None)  # Ray's own doing
        with contextlib.suppress(ImportError, AttributeError):
            raylet = importlib.import_module("ray._raylet")
            raylet.Config.initialize("")
            raylet.AuthenticationTokenLoader.instance().reset_cache()


def capacity() -> str:
    """What the cluster has to offer, in words."""
    import ray

    free, total = ray.available_resources().get("CPU", 0), ray.cluster_resources().get("CPU", 0)
    return f"Ray has {total:g} CPUs, {free:g} of them free, and a worker needs 1"
