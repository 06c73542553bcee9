"""MLflow's UI as `make ui` shows it: the link that is printed leads to the runs, their figures and their curves."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import urllib.request

import psutil  # type: ignore[import-untyped]
import pytest
from browser import Browser, needs_chromium
from commands import finish
from tracked import MODEL, client, free_port, row, send, tracking, write_run

from cluster.tracking.content import Content
from cluster.tracking.database import run_tables

pytestmark = pytest.mark.usefixtures("in_this_process")


def logged(uri, folder, name, success_rate):
    """A run with three rows, of 83 s; returns what its command says of MLflow in the end."""
    rows = [(step, row(step) | {"validation/success_rate": 0.25 * step}, float(step)) for step in range(3)]
    rows.append((2, {"held_out/success_rate": success_rate, "held_out/speed_mps": 7.5}, 83.0))
    (folder / name).mkdir()
    begun = tracking(folder / name, uri, "gridsim", Content(name, {}, {}, rows, wall_s=83.0))
    assert begun.close("FINISHED") is None
    return begun.where("bin/mlflow")


def test_a_run_says_where_its_table_is_and_keeps_a_view_that_was_changed(uri, tmp_path, monkeypatch):
    tag, experiment = "mlflow.sharedViewState.gridsim", client(uri).create_experiment("gridsim")
    said = logged(uri, tmp_path, "first", 0.875)
    table = run_tables(uri, "http://127.0.0.1:5000")["gridsim"]
    page = f"#/experiments/{experiment}/runs?workflowType=machine_learning&viewStateShareKey=gridsim"
    assert table == f"http://127.0.0.1:5000/{page}"
    assert said == f"MLFLOW_DISABLE_TELEMETRY=true bin/mlflow ui --backend-store-uri {uri}; then open\n{table}"
    assert "held_out/success_rate" in client(uri).get_experiment(experiment).tags[tag]
    client(uri).set_experiment_tag(experiment, tag, "mine")
    monkeypatch.chdir(tmp_path / "store")  # whose mlflow.db `make ui` shows
    assert logged(uri, tmp_path, "second", 0.875) == f"make ui, or {said}"
    assert client(uri).get_experiment(experiment).tags[tag] == "mine"


@contextlib.contextmanager
def make_ui(root, folder, port):
    """`make ui` in a folder; what is yielded is the link that it prints for the experiment `gridsim`."""
    command = ["make", "-f", str(root / "Makefile"), "-o", f"{sys.prefix}/.installed", f"VENV={sys.prefix}", "ui"]
    silent = ("CI", "DO_NOT_TRACK", "MLFLOW_DISABLE_TELEMETRY", "PYTEST_CURRENT_TEST")  # each turns telemetry off
    env = {name: value for name, value in os.environ.items() if name not in silent}
    with subprocess.Popen(
        [*command, f"PORT={port}"], cwd=folder, env=env, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as ui:
        try:
            assert ui.stdout
            yield next(line.split()[-1] for line in ui.stdout if line.startswith("runs of gridsim: "))
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(ui.pid, signal.SIGINT)


def check_end(port, tell):
    """All processes of `make ui` end within seconds once `make` is told to."""
    (made,) = [each for each in psutil.process_iter(["cmdline"]) if (each.info["cmdline"] or [])[:1] == ["make"]
               and f"PORT={port}" in each.info["cmdline"]]  # fmt: skip
    left = made.children(recursive=True)
    assert len(left) >= 3  # the command, MLflow, and its workers
    tell(made)
    assert not psutil.wait_procs(left, 15)[1]


@pytest.mark.e2e
@needs_chromium
def test_the_link_leads_to_the_run_table_and_its_curves_until_make_is_ended(uri, root, tmp_path):
    folder = tmp_path / "store"
    logged(uri, tmp_path, "first", 0.875)
    logged(uri, tmp_path, "second", 0.625)
    send(write_run(tmp_path / "third", 1, success_rate=0.5), uri, "other")
    with make_ui(root, folder, port := free_port()) as link:
        with Browser(link, tmp_path / "profile") as browser:
            for words in (
                ">first<", ">second<", "held_out/success_rate", "validation/success_rate", "held_out/speed_mps",
                "car_steps", ">0.875<", ">0.625<", ">1.4min<", "Model registry",
            ):  # fmt: skip
                browser.wait_for_text(words)
            width = browser.run("document.querySelector('[col-id*=\"Run Name\"]').clientWidth")
            assert width > 230  # pixels, so that names show their seeds
            browser.run("document.querySelector('input[value=CHART]').click()")  # the second button above the table
            for words in ("first (distance_m/mean)", "second (distance_m/mean)"):
                browser.wait_for_text(words)
            browser.wait_for("document.querySelector('.xtitle')?.textContent == 'car_steps'")
            curves = "new Set(document.querySelector('.js-plotly-plot').data.map(line => line.name)).size"
            browser.wait_for(f"{curves} == 2")
            browser.run("document.querySelector('.is-visibility-toggle-checkbox').click()")  # the eye in front of a run
            browser.wait_for(f"{curves} == 1")
        page = f"http://127.0.0.1:{port}/#/models/{MODEL}/versions/1?workflowType=machine_learning"
        with Browser(page, tmp_path / "another profile") as browser:
            for words in ("champion_sha256", "Inputs (1)", "Outputs (2)", "50.0% of the held-out drives"):
                browser.wait_for_text(words)
        address = f"http://127.0.0.1:{port}/ajax-api/3.0/mlflow/ui-telemetry"
        events = urllib.request.Request(address, b'{"records": []}', {"Content-Type": "application/json"})
        with urllib.request.urlopen(events, timeout=20) as answer:
            assert json.load(answer) == {"status": "disabled"}
        check_end(port, lambda made: made.send_signal(signal.SIGTERM))


def test_a_port_in_use_is_one_line(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = finish("python", "-m", "cluster.commands.ui", port, cwd=tmp_path, code=1)
    assert done.stderr == f"make ui: port {port} is in use or not a port; choose another with make ui PORT=...\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.e2e
def test_a_closed_terminal_ends_it_within_seconds_also_behind_a_proxy(uri, root, tmp_path, monkeypatch):
    for name in ("http_proxy", "https_proxy", "ALL_PROXY"):  # where nobody answers
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    logged(uri, tmp_path, "first", 0.875)
    with make_ui(root, tmp_path / "store", port := free_port()) as link:
        assert link.startswith(f"http://127.0.0.1:{port}/#/experiments/")
        check_end(port, lambda made: os.killpg(made.pid, signal.SIGHUP))
