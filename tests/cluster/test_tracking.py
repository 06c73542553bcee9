"""A run's folder reaches MLflow whole and once, whatever fails in between; read back through MLflow's own client."""

import json
import os
import re
import shutil
import subprocess
import time

import pytest
from commands import finish, start, wait_until
from tracked import MODEL, PYTHONPATH, QUIET, client, read_run, row, runs, send, steps, tracking, write_run

import cluster.tracking.commit
from cluster.tracking import logged
from cluster.tracking.address import check_uri
from cluster.tracking.tracking import Tracking, saved_uri

pytestmark = pytest.mark.usefixtures("in_this_process")


def test_a_run_read_back(uri, tmp_path, monkeypatch, impatient):
    monkeypatch.setattr(logged, "git_commit", lambda: "c0ffee-dirty")
    monkeypatch.setenv("MLFLOW_RUN_CONTEXT", '{"mlflow.parentRunId": "of a comparison"}')
    folder = write_run(tmp_path / "a run", 3)
    with (folder / "history.csv").open("a") as file:
        file.write("3,30.0,31")  # a line that is being written waits
    run = tracking(folder, uri)
    run_id = run.wait_id(30)
    assert client(uri).get_run(run_id).info.status == "RUNNING"
    assert run.sent["row"] == 3
    write_run(folder, 2000)
    wait_until(lambda: run.sent["row"] == 2000)
    (folder / "notes.txt").write_text("of the user's own")
    write_run(folder, 2000, success_rate=0.95)
    assert run.close("FINISHED") is None
    assert (run.run_id, run.error) == (run_id, None)

    assert steps(uri, run_id) == list(range(2000))
    found = client(uri).get_run(run_id)
    assert (found.info.status, found.info.run_name) == ("FINISHED", "a run")
    assert found.data.params["population"] == "256"
    tags = {"algorithm": "evolution", "scenario": "curved", "git_commit": "c0ffee-dirty"}
    assert found.data.tags.items() >= {**tags, "mlflow.parentRunId": "of a comparison"}.items()
    assert {"mlflow.user", "mlflow.source.name", "mlflow.source.type"} <= found.data.tags.keys()
    assert not [name for name in found.data.tags if name.startswith("resumed/")]
    assert found.data.metrics["held_out/success_rate"] == 0.95
    assert "target_m" not in found.data.metrics
    # The last candidate is validated after the last step.
    assert [each.step for each in client(uri).get_metric_history(run_id, "validation/success_rate")] == [2000]
    first, last = (each.timestamp for each in client(uri).get_metric_history(run_id, "wall_s")[::1999])
    assert last - first == 1000.0 * (row(1999)["wall_s"] - row(0)["wall_s"])
    assert found.info.end_time - found.info.start_time == 20_000_000  # summary.json's wall_s in ms

    artifacts = tmp_path / "store/mlartifacts" / run_id / "artifacts"
    assert found.info.artifact_uri == artifacts.as_uri()
    stored = {each.path for each in client(uri).list_artifacts(run_id) if not each.is_dir}
    assert stored == {path.name for path in folder.iterdir()} - {"mlflow.json", "notes.txt"}
    assert (artifacts / "curves.png").read_bytes() == b"png"
    assert send(folder, uri) == ("", run_id)
    assert sorted(os.listdir(tmp_path)) == ["a run", "store"]


def test_lost_answers_double_nothing(uri, tmp_path, impatient, monkeypatch):
    from mlflow.tracking import MlflowClient

    lost = set()

    def losing(name):
        real = getattr(MlflowClient, name)

        def call(*arguments, **options):
            answer = real(*arguments, **options)
            what = "rows" if options.get("metrics") else name
            if what not in lost:
                lost.add(what)
                raise ConnectionError("the answer never came")
            return answer

        monkeypatch.setattr(MlflowClient, name, call)

    names = {"create_run", "log_batch", "rows", "log_artifact", "create_model_version", "set_terminated"}
    for name in names - {"rows"}:
        losing(name)
    run = tracking(write_run(tmp_path / "a", 5, success_rate=0.5), uri)
    wait_until(lambda: "rows" in lost and run.error is None, 60)
    assert run.close("FINISHED") is None
    assert lost == names
    assert steps(uri, run.run_id) == list(range(5))
    assert [each.info.run_id for each in runs(uri)] == [run.run_id]
    assert len(client(uri).search_model_versions()) == 1
    assert client(uri).get_model_version_by_alias(MODEL, "best").run_id == run.run_id


def test_a_run_that_is_killed_at_any_moment_is_found_again(uri, tmp_path, monkeypatch):
    from mlflow.tracking import MlflowClient

    folder = write_run(tmp_path / "a", 2)
    with monkeypatch.context() as patch:
        real = MlflowClient.create_run

        def create_run(*arguments):
            real(*arguments)
            raise SystemExit  # before its id is saved

        patch.setattr(MlflowClient, "create_run", create_run)
        tracking(folder, uri)._listener.join()
    link = json.loads((folder / "mlflow.json").read_text())
    assert link["run_id"] == ""
    (found,) = runs(uri)
    shutil.move(folder, tmp_path / "moved")
    run = tracking(tmp_path / "moved", uri)
    assert run.close("KILLED") is None
    assert run.run_id == found.info.run_id
    assert json.loads((tmp_path / "moved/mlflow.json").read_text()) == link | {"run_id": run.run_id}
    assert client(uri).get_run(run.run_id).info.status == "KILLED"


def test_resume_logs_what_is_missing_and_notes_what_is_different(uri, tmp_path, monkeypatch):
    folder = write_run(tmp_path / "a", 9)
    first = tracking(folder, uri)
    assert first.close("KILLED") is None
    from mlflow.tracking import MlflowClient

    monkeypatch.setattr(MlflowClient, "search_experiments", lambda *_, **__: pytest.fail("scans all experiments"))
    for generations in (90, 120):
        resumed = tracking(write_run(folder, 15, generations=generations), uri, experiment="other")
        assert resumed.wait_id(30) == first.run_id
        assert client(uri).get_run(first.run_id).info.status == "RUNNING"
        assert resumed.close("FINISHED") is None
        assert resumed.sent["row"] == (6 if generations == 90 else 0)
    data = client(uri).get_run(first.run_id).data
    assert data.params["generations"] == "0"
    resumed_tags = {name: tag for name, tag in data.tags.items() if name.startswith("resumed/")}
    assert resumed_tags == {"resumed/generations": "120", "resumed/car_steps": "0"}
    assert steps(uri, first.run_id) == list(range(15))


def test_files_of_an_extended_run_are_sent_again_though_they_have_the_same_size(uri, tmp_path):
    folder = write_run(tmp_path / "a", 2, success_rate=0.5, seed=1)
    _, run_id = send(folder, uri)
    write_run(folder, 3, success_rate=0.5, seed=2)
    assert send(folder, uri) == ("2 rows, 6 files, 1 model", run_id)
    stored = tmp_path / "store/mlartifacts" / run_id / "artifacts/champion.npz"
    assert stored.read_bytes() == (folder / "champion.npz").read_bytes()


def test_what_mlflow_has_of_a_finished_run_stays_as_it_is(uri, tmp_path):
    folder, note = write_run(tmp_path / "a", 2), "mlflow.note.content"
    run = tracking(folder, uri)
    client(uri).set_tag(run.wait_id(30), note, "my own words")
    write_run(folder, 2, success_rate=0.5)
    assert run.close("FINISHED") is None
    assert run.sent == {"row": 4, "file": 6, "model": 1}
    before = client(uri).get_run(run.run_id)
    assert before.data.tags[note].startswith("my own words\n\nSolved after 2 generations")
    client(uri).set_tag(run.run_id, note, "other words")
    (folder / "trajectory.png").write_bytes(b"a picture that was missing")
    assert send(folder, uri) == ("1 file", run.run_id)
    after = client(uri).get_run(run.run_id)
    assert after.data.tags[note] == "other words"
    assert (after.info.end_time, after.info.status) == (before.info.end_time, "FINISHED")


def test_a_run_that_mlflow_does_not_know_gets_every_row(uri, tmp_path):
    """It was thrown away; it is in another store; mlflow.json is lost, or damaged."""
    folder = write_run(tmp_path / "a", 4, success_rate=0.5)
    _, run_id = send(folder, uri)
    client(uri).delete_run(run_id)
    other = check_uri(f"sqlite:///{tmp_path}/mlflow.db")
    for there in (uri, other):
        _, again = send(folder, there, "")
        assert again != run_id
        assert steps(there, again) == list(range(4))
        assert saved_uri(folder) == there
    for text in ("", "{}", '{"uri": 1}', "[]"):
        (folder / "mlflow.json").write_text(text)
        assert send(folder, other)[0] == "5 rows, 6 files, 1 model"


def test_before_its_first_row_a_run_leaves_nothing(tmp_path):
    folder = write_run(tmp_path / "a", 0)
    before = sorted(os.listdir(folder))
    run, started = tracking(folder, check_uri(f"sqlite:///{tmp_path}/mlflow.db")), time.perf_counter()
    assert run.close("KILLED") is None
    assert time.perf_counter() - started < 1.0, "it waits for MLflow's import"
    assert Tracking(folder, "never started", "", read_run).close("FINISHED") is None
    assert sorted(os.listdir(folder)) == before
    assert os.listdir(tmp_path) == ["a"]


def test_two_at_once_create_one_database_and_print_nothing(tmp_path):
    command = ["python", "-W", "default", "-c", QUIET, f"sqlite:///{tmp_path}/mlflow.db"]
    started = [start(*command, tmp_path / "runs" / name, "good", cwd="/", PYTHONPATH=PYTHONPATH) for name in "ab"]
    for process in started:
        output = "".join(process.communicate(timeout=600))
        # -W default shows what a user never sees; of that nothing may be ours.
        assert process.returncode == 0, output
        assert "cluster" not in output
    uri = check_uri(f"sqlite:///{tmp_path}/mlflow.db")
    assert [steps(uri, run.info.run_id) for run in runs(uri)] == [list(range(20))] * 2
    assert sorted(os.listdir(tmp_path)) == ["mlartifacts", "mlflow.db", "runs"]


def test_git_commit(tmp_path):
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main", "-C", str(tmp_path)]

    def told(*steps, **environment):
        """Of a file in this folder, once git has done these."""
        for step in steps:
            subprocess.run([*git, *step.split()], check=True, capture_output=True)
        script = "from commit import git_commit; print(git_commit())"
        done = finish("python", "-c", script, cwd="/", PYTHONPATH=str(tmp_path), **environment)
        assert done.stderr == ""
        return done.stdout.strip()

    file = shutil.copy(cluster.tracking.commit.__file__, tmp_path)
    assert told() == told("init", "add commit.py") == "unknown"
    commit = told("commit -m first")
    assert re.fullmatch("[0-9a-f]{40}", commit)
    assert told(PATH="/nowhere") == "unknown"
    with open(file, "a") as changed:
        changed.write("changed = True\n")
    assert told() == f"{commit}-dirty"
