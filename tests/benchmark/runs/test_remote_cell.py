"""Cells in other processes: the records of a serial run, whoever is killed on the way."""

import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cluster
import pytest
from cluster import dask_cluster
from dummy_methods import (
    CountMethod,
    FailingMethod,
    WaitingMethod,
    WorkerKiller,
    prediction_bytes,
    run,
    wait_for,
    without_timings,
)
from nosy_methods import Refines
from small_scenes import write_small_scene

from spike4dgs.benchmark import Budget, UserError, get_method, open_scene
from spike4dgs.benchmark.files import locked
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.cell import Failure, Job
from spike4dgs.benchmark.runs.remote_cell import Fitted, Order, SharedFolder, fit_order, make_order, store

PSNR: dict[str, Any] = {"metrics": ("psnr",)}


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with dask_cluster(tmp_path_factory.mktemp("dask"), 2) as (address, _):
        yield address


def same(found: list[dict[str, Any]], expected: list[dict[str, Any]]) -> bool:
    return [without_timings(r) for r in found] == [without_timings(r) for r in expected]


def in_background(function: Any) -> threading.Thread:
    thread = threading.Thread(target=function, daemon=True)
    thread.start()
    return thread


def test_a_killed_worker_loses_nothing(tmp_path: Path, scheduler: str) -> None:
    scenes = [write_small_scene(tmp_path / f"scene-{k}", seed=k) for k in range(2)]
    methods = [CountMethod("few", steps=2), WorkerKiller("killer", tmp_path)]
    whole = run(tmp_path / "whole", scenes, *methods, seeds=2, seed=4, **PSNR)
    assert len({r["mean"]["psnr"] for r in whole}) == len(whole) == 4, "two ways to fit, two seeds"
    (tmp_path / "begins.txt").unlink()
    (tmp_path / "bullet").touch()
    found = run(tmp_path / "spread", scenes, *methods, seeds=2, seed=4, scheduler=scheduler, **PSNR)
    assert same(found, whole)
    assert prediction_bytes(tmp_path / "spread") == prediction_bytes(tmp_path / "whole")
    assert sorted((tmp_path / "begins.txt").read_text().split()) == ["0"] * 4 + ["2"], "another one goes on with it"
    for record in found:
        method = record["method"]
        folder = tmp_path / "spread" / (f"seed-{method['seed']}" if method["seed"] > 4 else "")
        assert json.loads((folder / f"results/{method['name']}.json").read_text()) == record
        for cell in record["scenes"].values():
            assert cell["fitted_with"]["environment"]["cpu"] == record["environment"]["cpu"], "workers of this machine"
    assert not list((tmp_path / "spread").glob("**/work/*"))


def test_a_killed_caller_loses_nothing_that_came_back(tmp_path: Path, small_scene: Path, scheduler: str) -> None:
    quick, waiting = CountMethod("quick"), WaitingMethod("waiting", tmp_path)
    caller = subprocess.Popen(
        [sys.executable, cluster.__file__, str(tmp_path / "out"), str(small_scene), scheduler, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )
    kept = tmp_path / "out/predictions/quick/pattern-0/prediction.json"
    try:
        wait_for(lambda: kept.exists() and (tmp_path / "begun").exists() or caller.poll() is not None)
    finally:
        caller.kill()
    assert caller.wait(30) == -signal.SIGKILL
    before = kept.read_bytes()
    (tmp_path / "go").touch()
    found = run(tmp_path / "out", [small_scene], quick, waiting, scheduler=scheduler, **PSNR)
    assert kept.read_bytes() == before and quick.fits == 0
    assert same(found, run(tmp_path / "whole", [small_scene], quick, waiting, **PSNR))
    assert prediction_bytes(tmp_path / "out") == prediction_bytes(tmp_path / "whole")


def test_a_lost_scheduler_is_one_error_and_what_came_back_is_kept(tmp_path: Path, small_scene: Path) -> None:
    quick, waiting = CountMethod("quick"), WaitingMethod("waiting", tmp_path)
    (tmp_path / "bullet").touch()
    (tmp_path / "dask").mkdir()
    with dask_cluster(tmp_path / "dask", 2, nanny=False, SCHEDULER__ALLOWED_FAILURES="0") as (address, process):
        (killer,) = run(tmp_path / "out", [small_scene], WorkerKiller("killer", tmp_path), scheduler=address, **PSNR)
        cell = killer["scenes"]["pattern-0"]
        assert cell["status"] == "failed" and "its workers died one after another" in cell["error"]

        def lose() -> None:
            kept = tmp_path / "out/results/quick.json"
            wait_for(lambda: kept.exists() and (tmp_path / "begun").exists())
            process.kill()

        thread = in_background(lose)
        with pytest.raises(UserError, match="--scheduler: expected a scheduler that runs to the end") as e:
            run(tmp_path / "out", [small_scene], quick, waiting, scheduler=address, **PSNR)
        assert "give the same command again" in str(e.value)
        (tmp_path / "go").touch()
        thread.join()
    found = run(tmp_path / "out", [small_scene], quick, waiting, **PSNR)
    assert quick.fits == 0 and waiting.fits == 1
    assert same(found, run(tmp_path / "whole", [small_scene], CountMethod("quick"), waiting, **PSNR))


def test_processes_of_this_machine_give_the_same_records(tmp_path: Path, small_scene: Path) -> None:
    bad, stuck = FailingMethod("bad", ValueError("no luck")), CountMethod("stuck")
    stuck.fit = lambda *_: None  # type: ignore[method-assign]  # does not travel
    found = run(tmp_path / "out", [small_scene], CountMethod(), bad, stuck, seeds=2, workers=2, **PSNR)
    whole = run(tmp_path / "whole", [small_scene], CountMethod(), bad, seeds=2, **PSNR)
    assert same([r for r in found if r["method"]["name"] != "stuck"], whole)
    (cell,) = found[2]["scenes"].values()
    assert found[2]["method"]["name"] == "stuck" and cell["status"] == "failed" and "pickle" in cell["error"]
    assert "ValueError: no luck" in (tmp_path / "out/seed-1/logs/bad__pattern-0.log").read_text()
    again = CountMethod()
    assert run(tmp_path / "out", [small_scene], again, seeds=2, **PSNR)[1]["scenes"] == found[3]["scenes"]
    assert again.fits == 0


def test_the_same_command_finds_bad_settings_before_any_work(tmp_path: Path, small_scene: Path) -> None:
    for settings, message in (
        ({"seeds": 0}, "--seeds: expected a number from 1 up"),
        ({"workers": 0}, "--workers: expected a number from 1 up"),
        ({"workers": 2, "scheduler": "tcp://127.0.0.1:1"}, "--workers and --scheduler: expected one of them"),
        ({"scheduler": "foo"}, "--scheduler: expected an address such as tcp://HOST:8786, found 'foo'"),
    ):
        method = CountMethod()
        with pytest.raises(UserError, match=message):
            run(tmp_path / "out", [small_scene], method, **settings)  # type: ignore[arg-type]
        assert method.fits == 0 and not (tmp_path / "out").exists()


@pytest.fixture
def order(tmp_path: Path, small_scene: Path) -> Order:
    job = Job(CountMethod(), open_scene(small_scene), 0, "cpu", Budget())
    folder = SharedFolder(tmp_path / "out", "token")
    folder.root.mkdir()
    folder.token_file.write_text("token")
    return make_order(job, folder, folder.root / "work/key")


def test_an_order_gives_the_files_of_a_fit(tmp_path: Path, small_scene: Path, order: Order) -> None:
    fitted = fit_order(pickle.loads(pickle.dumps(order)))
    assert isinstance(fitted, Fitted) and fitted.model is None
    store(fitted, [tmp_path / "stored/counts"], tmp_path / "model.safetensors")
    run(tmp_path / "here", [small_scene], CountMethod(), **PSNR)
    stored, here = tmp_path / "stored/counts", tmp_path / "here/predictions/counts/pattern-0"
    assert (stored / "SHA256SUMS").read_bytes() == (here / "SHA256SUMS").read_bytes()
    assert not list(order.folder.root.glob("work/*")), "neither a checkpoint nor a lock stays"


def test_a_model_comes_back_where_the_worker_has_its_own_files_on_another_disk(
    tmp_path: Path, small_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = Path("/dev/shm")
    if not os.access(memory, os.W_OK) or memory.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("one disk")
    monkeypatch.setattr(tempfile, "tempdir", str(memory))
    (folder := SharedFolder(tmp_path, "token")).token_file.write_text("token")
    job = Job(Refines(tmp_path / "seen.json"), open_scene(small_scene), 0, "cpu", Budget())
    fitted = fit_order(make_order(job, folder, tmp_path / "work/key", Apart()))
    assert isinstance(fitted, Fitted) and fitted.model


def test_an_order_says_whether_held_out_views_are_refined(tmp_path: Path, small_scene: Path) -> None:
    """Refined images are brighter; the method itself does not ask for them here."""
    method = Refines(tmp_path / "seen.json")
    method.refines_views = False
    folder = SharedFolder(tmp_path / "out", "token")
    for refined, count in ((False, 1), (True, 2)):
        job = Job(method, open_scene(small_scene), 0, "cpu", Budget(), refined=refined)
        fitted = fit_order(pickle.loads(pickle.dumps(make_order(job, folder, tmp_path / "work"))))
        assert isinstance(fitted, Fitted) and len(fitted.predictions) == len(job.variants) == count
    plain, brighter = fitted.predictions
    assert plain != brighter and [v.name for v in job.variants] == ["refines", "refines.refined"]


def test_methods_that_cannot_be_pickled_travel_by_their_names(tmp_path: Path, small_scene: Path) -> None:
    method = get_method("tfp+static")
    with pytest.raises((pickle.PicklingError, AttributeError)):
        pickle.dumps(method)
    job = Job(method, open_scene(small_scene), 0, "cpu", Budget())
    assert make_order(job, SharedFolder(tmp_path, ""), tmp_path / "work").method == "tfp+static"


@pytest.mark.parametrize("seen", ["the same folder", "another folder", "a folder in use"])
def test_a_checkpoint_lies_with_the_caller_where_the_worker_sees_the_folder(order: Order, seen: str) -> None:
    order.work.mkdir(parents=True)
    weights = {"weights": [0.0, 0.0, 0.0], "step": 4}  # of a fit that is over but for its images
    (order.work / "checkpoint.safetensors").write_text(json.dumps(weights))
    expected = seen == "the same folder"
    if seen == "another folder":
        order.folder.token_file.write_text("of another run")
    if seen == "a folder in use":
        with locked(order.work.with_suffix(".lock"), "work", "a test"):
            fitted = fit_order(order)
    else:
        fitted = fit_order(order)
    plain = fit_order(replace(order, folder=SharedFolder(order.folder.root / "nowhere", "")))
    assert isinstance(fitted, Fitted) and isinstance(plain, Fitted)
    assert (fitted.predictions[0]["SHA256SUMS"] != plain.predictions[0]["SHA256SUMS"]) == expected
    assert order.work.exists() != expected


def test_a_worker_with_other_inputs_is_one_error_that_names_it(order: Order, tmp_path: Path) -> None:
    worker = f"worker {os.getpid()} on "
    other = write_small_scene(tmp_path / "other", seed=1)
    damaged = write_small_scene(tmp_path / "damaged")
    (damaged / "spikes/cam_01.dat").write_bytes(b"")
    for change, message in (
        ({"scene": tmp_path / "nowhere"}, f"nowhere on {worker}.*no such folder; .*copy or mount the scenes"),
        ({"scene": other}, f"other on {worker}.*found revision"),
        ({"scene": damaged, "revision": open_scene(damaged).revision}, f"damaged on {worker}.*truncated"),
        ({"key": "0" * 64}, f"{worker}.*another version of it or of spike4dgs; install the same there"),
        ({"method": b"cno_such_package\nMethod\n."}, f"{worker}.*No module named 'no_such_package'"),
        ({"method": "no-such-method"}, f"{worker}.*: --methods: expected a name .*found 'no-such-method'"),
        ({"device": "cuda:99"}, f"{worker}.*: --device: expected a CUDA device"),
    ):
        with pytest.raises(UserError, match=message):
            fit_order(replace(order, **change))  # type: ignore[arg-type]


def test_a_failure_of_the_method_comes_back_with_its_traceback(order: Order) -> None:
    method = FailingMethod("counts", MemoryError("too small"))
    method.params = CountMethod().params
    failure = fit_order(replace(order, method=pickle.dumps(method)))
    assert isinstance(failure, Failure) and failure.status == "failed"
    assert failure.reason == "MemoryError: too small" and "Traceback" in failure.traceback
