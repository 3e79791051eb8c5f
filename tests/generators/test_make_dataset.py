"""make-dataset: whole scenes, resumed after any interruption; wrong arguments and damaged scenes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from changes import files_in, flip_bit
from fake_renderer import FakeRenderer, render_fakes

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked
from spike4dgs.benchmark.scene.images import read_geometry
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli import main
from spike4dgs.cli.make_dataset import make_dataset as command
from spike4dgs.cli.make_dataset import physics_of
from spike4dgs.generators import make_dataset as dataset
from spike4dgs.generators import scene_maker, shared_rendering, streams
from spike4dgs.generators.make_dataset import SceneSettings, make_dataset, track_jobs
from spike4dgs.generators.physics import PhysicsOptions
from spike4dgs.generators.profiles import PROFILES, TRACKS, Job
from spike4dgs.generators.scene_maker import Maker
from spike4dgs.generators.shared_rendering import SharingMaker
from spike4dgs.generators.worlds import HARD, OURS

JOB = Job("car", 0, 0, "tiny", PROFILES["tiny"], PROFILES["tiny"].seconds)


@pytest.fixture
def fake(monkeypatch):
    render_fakes(monkeypatch)


def make(*worlds, out, **settings):
    options = {name: settings.pop(name) for name in ("audit", "check", "replace") if name in settings}
    return make_dataset([tiny(world, **settings) for world in worlds], out, **options)


def tiny(world="car", options="", **settings):
    """Return the job of a scene with further options of camera and light."""
    given = {"profile": "tiny", "physics": physics_of(options)} | settings
    return SceneSettings(**given).job(world)


def plain(stage, steps, total):
    yield from steps


def test_a_scene_is_whole_and_true(monkeypatch, tmp_path):
    render_fakes(monkeypatch, sheets=True)
    folder = Maker(JOB, tmp_path, plain).make()
    scene = open_scene(folder)
    assert (scene.id, scene.train, scene.test) == ("car-0-tiny", ("cam_00", "cam_02", "cam_07"), ("cam_04",))
    assert [t.tick for t in scene.targets] == [20, 40, 60]
    assert not list(scene.manifest.problems())
    assert scene.meta["source"]["seed"] == 0
    assert scene.meta["source"]["versions"]["mitsuba_variant"] == "fake"
    assert set(scene.meta["splits"]) == {"center", "corner", "views-3"}
    assert [t.tick for t in open_scene(folder, split="corner").targets] == [40]
    assert scene.meta["instances"]["1"] == "body" and set(scene.meta["instances"].values()) >= {"rim0", "rim3"}
    renderer = FakeRenderer(None, [scene.cameras["cam_04"]], seed=1, spp=0, background_spp=0)
    for target in scene.targets:
        truth = renderer.keys(target.tick / 20_000)[0]
        assert np.abs(scene.ground_truth(target) - truth).max() < 1e-3  # half floats
        geometry = read_geometry(scene.manifest.path(f"geometry/{target.name}.exr"))
        assert np.array_equal(geometry.ids > 0, renderer.object_masks(target.tick / 20_000)[0])
        mask = scene.moving(target)
        assert mask[renderer.object_masks(target.tick / 20_000)[0]].all()
        assert mask.mean() < 0.2
    counts = scene.stream("cam_00").counts(0, 80)
    fake_camera = FakeRenderer(None, [scene.cameras["cam_00"]], seed=0, spp=0, background_spp=0)
    background = fake_camera.static.background[0, ..., 0]
    assert np.abs(counts[:10] / 80 / 0.6 - background[:10]).mean() < 0.05
    for name in ("sheet.png", "preview.webp", "croissant.json", "events/cam_00.npz", "calibration/dark/cam_02.dat"):
        assert name in scene.manifest.files
    with np.load(folder / "truth/cam_00.npz") as maps:
        assert set(maps) == {"gain", "dark"}
    assert not (tmp_path / ".work").exists()


class Stop(Exception):
    pass


def test_resumes_after_an_interruption_at_every_step(fake, tmp_path):
    whole = files_in(Maker(JOB, tmp_path / "whole", plain).make())
    assert "manifest.json" in whole

    def one_step(stage, steps, total):
        for k, step in enumerate(steps):
            if k == (stops + 1 if stage == "background" else 1):  # the background starts anew each time
                raise Stop
            yield step
        if total and stage != "background":
            raise Stop

    stops = 0
    while stops < 80:
        try:
            folder = Maker(JOB, tmp_path / "cut", one_step).make()
            break
        except Stop:
            stops += 1
            assert not (tmp_path / "cut" / JOB.id).exists()
            hidden = tmp_path / "cut" / ".work" / JOB.id / "scene" / "images"
            hidden.mkdir(parents=True, exist_ok=True)
            (hidden / ".000020.99.part.exr").write_bytes(b"left by a killed process")
    assert stops >= 8
    assert files_in(folder) == whole


ALSO = ("light=0.25 pose-noise-deg=0.1 lost-ticks=0.05 warming-k=8 read-noise=0.01", "flicker=0.08")


def count_keys(monkeypatch):
    """Return a list that grows by each key that is rendered."""
    rendered, before = [], FakeRenderer.key_arrays
    monkeypatch.setattr(FakeRenderer, "key_arrays", lambda *args: (rendered.append(args[1]), before(*args))[1])
    return rendered


def test_scenes_of_one_rendering_are_rendered_once_and_equal_those_made_alone(fake, monkeypatch, tmp_path):
    rendered = count_keys(monkeypatch)
    alone = [tiny(options=options) for options in ("", *ALSO)]
    for job in alone:
        make_dataset([job], tmp_path / "alone")
    each = len(rendered) // len(alone)
    assert each and len(rendered) == each * len(alone)
    rendered.clear()
    command(("car",), settings=SceneSettings(profile="tiny"), also=ALSO, out=tmp_path / "together")
    assert len(rendered) == each
    assert {path.name for path in (tmp_path / "together").glob("car*") if path.is_dir()} == {job.id for job in alone}
    for job in alone:
        assert files_in(tmp_path / "together" / job.id) == files_in(tmp_path / "alone" / job.id)
    assert not (tmp_path / "together" / ".work").exists()


def test_streams_of_a_scene_that_was_begun_alone_are_not_those_of_the_next(fake, monkeypatch, tmp_path):
    """A rendering is shared as far as it is one: no stream of the scene's own light."""
    simulate, written = streams.write_camera, []

    def cut(scene, job, *others):
        if written:
            raise Stop
        written.append(simulate(scene, job, *others))

    with monkeypatch.context() as patch:
        patch.setattr(streams, "write_camera", cut)
        with pytest.raises(Stop):
            make_dataset([tiny()], tmp_path / "begun")
    dim = tiny(options="light=0.25")
    command(("car",), settings=SceneSettings("tiny"), also=("light=0.25",), out=tmp_path / "begun")
    make_dataset([dim], tmp_path / "alone")
    assert files_in(tmp_path / "begun" / dim.id) == files_in(tmp_path / "alone" / dim.id)


def test_what_changes_the_radiance_is_rendered_anew_and_a_killed_run_goes_on_with_what_is_shared(
    fake, monkeypatch, tmp_path
):
    rendered, simulate = count_keys(monkeypatch), streams.write_camera
    jobs = [tiny(options=options) for options in ("psf-px=0.5", "", "light=2")]

    def cut(scene, job, *others):
        if job.physics.light == 2:
            raise Stop
        simulate(scene, job, *others)

    with monkeypatch.context() as patch:
        patch.setattr(streams, "write_camera", cut)
        with pytest.raises(Stop):
            make_dataset(jobs, tmp_path)
    assert len(rendered) == len(set(rendered)) * 2, "the blur is rendered, the light is not"
    rendered.clear()
    make_dataset(jobs, tmp_path)
    assert not rendered and not (tmp_path / ".work").exists()
    assert not list(open_scene(tmp_path / "car-0-tiny-light2").manifest.problems())


def test_options_of_further_scenes_are_those_of_camera_and_light(fake, tmp_path):
    lens, flag = physics_of("lens=-0.2,0.03 lens-spread=0.5"), physics_of("noisy-others")
    assert lens == PhysicsOptions(lens=(-0.2, 0.03), lens_spread=0.5) and flag == PhysicsOptions(noisy_others=True)
    for wrong in ("seconds=0.1", "--light=2", "0.25"):
        with pytest.raises(UserError, match=f"--also: expected options of camera and light.*found '{wrong}'"):
            command(("car",), settings=SceneSettings(profile="tiny"), also=(wrong,), out=tmp_path)
    with pytest.raises(UserError, match="--light"):
        command(("car",), settings=SceneSettings(profile="tiny"), also=("light=-1",), out=tmp_path)
    with pytest.raises(UserError, match="car-0-tiny twice"):
        command(("car",), settings=SceneSettings(profile="tiny"), also=("light=1",), out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_code_of_unfinished_work_is_this_room_the_benchmark_and_another_packages_world(monkeypatch):
    def hashed(world):
        names = []
        monkeypatch.setattr(scene_maker, "sources_sha256", lambda found: names.extend(m.__name__ for m in found))
        scene_maker._sources.__wrapped__(world)
        return names

    ours = ["spike4dgs.generators", "spike4dgs.benchmark"]
    assert hashed("car") == ours
    car = scene_maker.WORLDS["car"]
    for theirs in (files_in, partial(files_in), partial(partial(files_in))):
        monkeypatch.setattr(scene_maker, "WORLDS", {"theirs": replace(car, build=theirs)})
        assert hashed("theirs") == [*ours, files_in.__module__]


def test_unfinished_work_of_other_settings_or_code_is_made_anew(fake, monkeypatch, tmp_path):
    rendered = count_keys(monkeypatch)

    def stop_at_truth(stage, steps, total):
        if stage == "ground truth":
            raise Stop
        yield from steps

    def keys_and_shared(job):
        rendered.clear()
        maker = SharingMaker(job, tmp_path, stop_at_truth)
        with pytest.raises(Stop):
            maker.make()
        return len(rendered), maker._shared

    (keys, shared), again, (anew, other) = (keys_and_shared(job) for job in (JOB, JOB, replace(JOB, seed=7)))
    assert keys and again == (0, shared)
    assert anew == keys and other != shared
    monkeypatch.setattr(scene_maker, "_sources", lambda world: "of a world that was edited")
    anew, other = keys_and_shared(JOB)
    assert anew == keys and other != shared


def test_maps_and_seeds_change_the_stream_and_maps_that_are_off_leave_no_file(fake, tmp_path):
    others = {"on": {}, "off": {"gain_map": False, "dark_map": False}, "seven": {"seed": 7}}
    on, off, seven = (files_in(Maker(replace(JOB, **o), tmp_path / name, plain).make()) for name, o in others.items())
    assert len({made["spikes/cam_00.dat"] for made in (on, off, seven)}) == 3
    assert "truth/cam_00.npz" in on and not [name for name in off if name.startswith("truth/")]


def test_two_processes_do_not_make_one_scene(fake, monkeypatch, tmp_path):
    message = "car-0-tiny: expected a scene that nobody else makes, found a run in progress"
    with locked(tmp_path / ".work/car-0-tiny.lock", "x", "free"), pytest.raises(UserError, match=message):
        make("car", out=tmp_path)
    maker, message = SharingMaker(JOB, tmp_path, plain), "expected a rendering that nobody else copies"
    monkeypatch.setattr(shared_rendering, "_WAIT_S", 0.0)
    with locked(maker._shared.with_suffix(".lock"), "x", "free"):
        for touch in (maker.make, maker.forget):
            with pytest.raises(UserError, match=message):
                touch()
    assert not (tmp_path / "car-0-tiny").exists()


def test_a_lock_is_removed_while_it_is_held(fake, monkeypatch, tmp_path):
    """Else another process may have taken it, and a third one would find no lock."""
    lock, removed = tmp_path / "x.lock", []

    def unlink(path, missing_ok=False):
        with pytest.raises(UserError, match="nobody"), locked(path, path, "a lock that nobody has"):
            pass
        removed.append(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        with scene_maker._alone(lock):
            pass
    assert removed == [lock]


def test_scenes_in_flickering_light_are_made_after_those_that_they_share_with():
    jobs = [tiny(options=options) for options in ("flicker=0.08", "", "psf-px=0.5", "light=2")]
    groups = [[one.job for one in plan] for plan in dataset._planned(jobs, jobs)]
    assert groups == [[jobs[1], jobs[3], jobs[0]], [jobs[2]]]


def test_the_last_of_several_processes_may_have_tidied_up(fake, tmp_path):
    lock = tmp_path / ".work/car-0-tiny.lock"
    with scene_maker._alone(lock):
        shutil.rmtree(lock.parent)
    SharingMaker(JOB, tmp_path, plain).forget()
    with scene_maker._alone(lock):
        (lock.parent / "van-0-tiny.lock").touch()
    SharingMaker(JOB, tmp_path, plain).forget()
    assert [path.name for path in lock.parent.iterdir()] == ["van-0-tiny.lock"]


def test_a_complete_scene_is_kept_checked_or_refused(fake, tmp_path, capsys):
    assert make("car", out=tmp_path) == 0
    before, revision = files_in(tmp_path / "car-0-tiny"), open_scene(tmp_path / "car-0-tiny").revision
    report = json.loads((tmp_path / "car-0-tiny.report.json").read_text())
    assert set(report["stages_s"]) == {"background", "key frames", "ground truth", "streams", "description"}
    capsys.readouterr()
    assert make("car", out=tmp_path) == 0
    assert "kept" in capsys.readouterr().out
    with pytest.raises(UserError, match="seed 0 instead of 1; pass --replace"):
        make("car", out=tmp_path, seed=1)
    flip_bit(tmp_path / "car-0-tiny/spikes/cam_02.dat", 100)
    with pytest.raises(UserError, match=r"cam_02\.dat.*--replace"):
        make("car", out=tmp_path)
    reference = Path(shutil.copytree(tmp_path / "car-0-tiny", tmp_path / "reference/car-0-tiny"))
    write_manifest(reference)  # as another scene
    noise = tmp_path / ".noise/car-0-tiny" / revision[:16] / "car-0-tiny"
    shutil.copytree(reference, noise)  # which is none
    assert make("car", out=tmp_path, replace=True, check=reference) == 1
    assert files_in(tmp_path / "car-0-tiny") == before
    assert open_scene(noise).meta["source"]["noise"] == 1


def test_a_foreign_folder_is_never_touched(fake, tmp_path):
    folder = tmp_path / "car-0-tiny"
    folder.mkdir()
    (folder / "thesis.txt").write_text("three years of work")
    for over in (False, True):
        with pytest.raises(UserError, match="move them away"):
            make("car", out=tmp_path, replace=over)
    (folder / "scene.json").write_text("{}")
    with pytest.raises(UserError, match="other files"):
        make("car", out=tmp_path, replace=True)
    assert (folder / "thesis.txt").exists()


@pytest.mark.parametrize(
    ("world", "options", "words"),
    [
        ("moon", {}, "world: expected one of jaywalk, bicycle, "),
        ("car", {"profile": "huge"}, "--profile: expected one of tiny, small, paper"),
        ("car", {"seconds": 0.0}, "--seconds"),
        ("car", {"seconds": -0.02}, "--seconds"),
        ("car", {"seconds": 0.0205}, "--seconds"),
        ("car", {"seconds": float("nan")}, "--seconds"),
        ("car", {"seed": -1}, "--seed"),
        ("car", {"variant": -1}, "--seed and --variant"),
        ("car", {"physics": PhysicsOptions(lens=(0.1,) * 6)}, "--lens: expected at most 5 numbers: k1, k2, p1, p2, k3"),
        ("car", {"physics": PhysicsOptions(lens=(float("nan"),))}, "--lens"),
        ("car", {"physics": PhysicsOptions(lens=(-9.0,))}, "whose model holds up to the image's corners"),
        ("car", {"options": "lens=-0.1 lens-spread=1"}, "--lens-spread: expected a share from 0 to below 1"),
        ("car", {"physics": PhysicsOptions(lens_spread=0.2)}, "--lens-spread: expected the mean lens"),
        ("car", {"physics": PhysicsOptions(flicker_hz=120.0)}, "--flicker-hz and --flicker-duty: expected the depth"),
        ("car", {"seconds": 11.0}, "--seconds: expected whole milliseconds, from 0.002 to 10"),
        ("car", {"options": "lost-ticks=0.5", "seconds": 6.0}, "--lost-ticks: expected at most 100000 gaps"),
    ],
)
def test_bad_arguments_are_one_line(world, options, words, tmp_path):
    with pytest.raises(UserError, match=words) as e:
        make(world, out=tmp_path, **options)
    assert "\n" not in str(e.value)
    assert not list(tmp_path.iterdir())


def test_a_number_that_is_none_is_named_as_the_command_line_has_it(tmp_path, capsys):
    assert main(["make-dataset", "car", "--light", "nan", "--out", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err.startswith("error: --light: expected a number from")


def test_a_full_disk_is_noticed_before_work_begins(fake, tmp_path, monkeypatch):
    monkeypatch.setattr(scene_maker.shutil, "disk_usage", lambda path: SimpleNamespace(free=10_000))
    with pytest.raises(UserError, match="free disk space"):
        make("car", out=tmp_path)
    shared = SharingMaker(JOB, tmp_path, plain)
    assert shared._bytes_needed == 2 * Maker(JOB, tmp_path, plain)._bytes_needed


@pytest.mark.parametrize("worlds", [("car",), ()])
def test_folders_that_cannot_be_written_are_one_error(worlds, fake, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UserError, match="file"):
        command(worlds, all=not worlds, settings=SceneSettings("tiny"), out=tmp_path / "file" / "data")
    assert (tmp_path / "file").read_text() == "no folder"


def test_a_variant_of_seasons_is_named_as_such(tmp_path, capsys):
    for variant, kept in ((8999, False), (9000, True)):
        (tmp_path / f"car-{variant}-tiny").mkdir()
        with pytest.raises(UserError, match="move them away"):  # it is said before any work
            make("car", variant=variant, out=tmp_path)
        assert (f"variant {variant} is kept for hidden seasons" in capsys.readouterr().out) is kept


def test_a_track_has_its_variants_of_every_world_and_its_camera(tmp_path):
    worlds = list(OURS)
    ids = {name: [job.id for job in track_jobs(name, worlds, SceneSettings())] for name in TRACKS}
    assert len(ids["small"]) == 27 and ids["small"][:3] == [f"jaywalk-{v}-small-realistic" for v in (0, 3, 4)]
    assert len(ids["dev-small"]) == 18 and not set(ids["small"]) & set(ids["dev-small"])
    assert ids["ideal"] == [f"{world}-0-small" for world in worlds]  # as in release 1
    assert ids["paper"] == [f"{world}-0-paper" for world in worlds]
    jobs = [job for name in TRACKS for job in track_jobs(name, worlds, SceneSettings())]
    assert all(job.profile.soft and job.profile.target_soft for job in jobs)  # rendered by --rendering split
    finer = {job.id for job in jobs if job.profile.spp > 128}
    assert finer == {f"{w}-{v}-small-realistic" for w in (*worlds[:5], "chips") for v in (0, 3, 4, 10, 11)}
    for settings, track, words in (
        (SceneSettings(), "large", "--track: expected one of small, dev-small, ideal, paper"),
        (SceneSettings(variant=1), "small", "its own profile, variants and camera"),
    ):
        with pytest.raises(UserError, match=words):
            command(("car",), track=track, settings=settings, out=tmp_path)


def test_all_are_the_benchmarks_worlds_and_others_are_named(tmp_path, monkeypatch):
    made, name = [], "spike4dgs.generators.make_dataset.make_dataset"
    monkeypatch.setattr(name, lambda jobs, *_, **__: made.append([job.world for job in jobs]))
    command(all=True, out=tmp_path)
    command(track="ideal", out=tmp_path)
    command(tuple(HARD), out=tmp_path)
    assert made == [list(OURS), list(OURS), list(HARD)] and len(OURS) == 9


def test_worlds_are_named_or_all(tmp_path):
    with pytest.raises(UserError, match="names or --all"):
        command(("car",), all=True, out=tmp_path)
    with pytest.raises(UserError, match="at least one world, or --all, found none; choose among jaywalk, "):
        command(out=tmp_path)
