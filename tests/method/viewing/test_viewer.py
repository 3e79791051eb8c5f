"""The viewer's content without a browser; then the viewer in a real one."""

import socket
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from devtools import HEIGHT, WIDTH, Page, browser, wait_for
from saved_models import DURATION_US, WORLD, model, provenance
from small_scenes import array_cameras

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.reports.error_map import ERROR_MAX, error_colors
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli import main
from spike4dgs.method.models.saved_model import SavedModel
from spike4dgs.method.viewing.camera_paths import fixed
from spike4dgs.method.viewing.content import BORDER, MODES, Content, free_camera, matching, open_content, padded, window
from spike4dgs.method.viewing.serving import free_port, is_own, url_of
from spike4dgs.method.viewing.viewer import FREE, Viewer

TRAINED = WORLD.training.cameras


def content(with_scene: bool = True) -> Content:
    saved = SavedModel(model("spacetime-lite"), provenance(cameras=TRAINED))
    return Content(saved, WORLD.training if with_scene else None)


def test_the_three_images() -> None:
    shown, camera, t_us = content(), TRAINED[1], 0.5 * DURATION_US
    rendered = model("spacetime-lite").render(camera, t_us)
    np.testing.assert_array_equal(shown.image("rendered", camera, t_us)[..., 0], encode_srgb(rendered))
    truth = WORLD.trace(camera, 0.5)[0]
    rate = shown.spike_rate(camera.id, t_us)
    assert np.abs(rate - truth).mean() < 0.03, "40 ticks resolve radiance to 1/24, and the board moves"
    np.testing.assert_array_equal(shown.image("spike rate", camera, t_us)[..., 2], encode_srgb(rate))
    error = np.minimum(np.abs(np.clip(rendered, 0, 1) - np.clip(rate, 0, 1)), ERROR_MAX)
    colors = error_colors()[np.rint(error / ERROR_MAX * 255).astype(int)]
    assert np.abs(shown.image("error", camera, t_us).astype(int) - colors).max() <= 3
    assert error_colors()[0].sum() < 10 and error_colors()[-1].sum() > 600, "from black to nearly white"


def test_ticks_in_which_no_light_is_gathered_are_counted_out() -> None:
    """A pixel that gathers nothing for half a tick after each spike has seen x = r / (1 - r / 2)."""
    camera, t_us, scene = TRAINED[1], 0.5 * DURATION_US, WORLD.training
    rate = content().spike_rate(camera.id, t_us) * scene.radiance_gain
    slow = replace(scene, streams=tuple(replace(stream, dead_ticks=0.5) for stream in scene.streams))
    found = replace(content(), scene=slow).spike_rate(camera.id, t_us)
    np.testing.assert_allclose(found, rate / (1 - rate / 2) / scene.radiance_gain, rtol=1e-5)


def test_without_the_scene_there_is_only_the_model() -> None:
    assert content(False).modes == ("rendered",) and content().modes == MODES
    with pytest.raises(UserError, match="none: no scene is given"):
        content(False).image("error", TRAINED[0], 0.0)
    with pytest.raises(UserError, match="expected a training camera of the scene .*found 'free'"):
        content().spike_rate("free", 0.0)


@pytest.mark.parametrize(("tick", "expected"), [(0, (0, 40)), (50, (30, 70)), (99, (60, 100))])
def test_windows_stay_whole_at_the_ends(tick: int, expected: tuple[int, int]) -> None:
    assert window(tick, 100) == expected and window(tick, 30) == (0, 30)


def test_another_scene_is_refused(small_scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    about = provenance(scene="pattern-0")
    with pytest.raises(UserError, match="expected toy, which the model was fitted to, found pattern-0"):
        open_content(SavedModel(model("static"), provenance()), small_scene)
    with pytest.raises(UserError, match="expected 100 ticks at 20000 Hz, cameras .*found 80 ticks"):
        open_content(SavedModel(model("static"), about), small_scene)
    fitting = provenance(scene="pattern-0", n_ticks=80, cameras=array_cameras()[:3])
    opened = open_content(SavedModel(model("static"), fitting), small_scene)
    assert "the model was fitted to revision 0000000000000000" in capsys.readouterr().out
    same = replace(fitting, scene_revision=open_scene(small_scene).revision)
    open_content(SavedModel(model("static"), same), small_scene)
    assert not capsys.readouterr().out
    assert opened.scene is not None and opened.image("spike rate", opened.scene.cameras[2], 1e9).shape == (24, 40, 3)


def test_a_free_camera_at_a_training_cameras_position_sees_its_image() -> None:
    camera = TRAINED[0]
    aspect = camera.width / camera.height
    _, fov = matching(TRAINED, camera.id, aspect)
    found = free_camera(camera.R.T, camera.center, fov, aspect, camera.width * camera.height)
    assert (found.width, found.height) == (camera.width, camera.height)
    np.testing.assert_allclose(found.K, camera.K, atol=1e-9)
    np.testing.assert_allclose(found.w2c, camera.w2c, atol=1e-9)
    wide = free_camera(camera.R.T, camera.center, 0.8, 2.5, 4000)
    assert (wide.width, wide.height) == (100, 40) and 2 * np.arctan(20 / wide.fy) == pytest.approx(0.8)


@pytest.mark.parametrize(("aspect", "shape"), [(1.0, (40, 40)), (40 / 24, (24, 40)), (3.0, (24, 72))])
def test_an_image_is_padded_to_the_window(aspect: float, shape: tuple[int, int]) -> None:
    image = np.full((24, 40, 3), 200, np.uint8)
    found = padded(image, aspect)
    assert found.shape == (*shape, 3) and (found == 200).sum() == image.size and set(np.unique(found)) <= {200, BORDER}
    camera, fov = matching(TRAINED, TRAINED[0].id, aspect)
    assert 2 * camera.fy * np.tan(fov / 2) == pytest.approx(shape[0]), "the window's angle is the padded image's"


def test_without_viser_the_command_says_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", "any.safetensors"]) == 2
    expected = "error: view: expected the package viser, found none; pip install 'spike4dgs[viewer]'\n"
    assert capsys.readouterr().err == expected


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("port", "0", "a port, 1 to 65535, found 0"),
        ("port", "65536", "a port, 1 to 65535, found 65536"),
        ("host", "203.0.113.7", "an address of this machine, found '203.0.113.7'"),
        ("host", "no such host", "an address of this machine, found 'no such host'"),
    ],
)
def test_a_bad_host_or_port_is_an_error(option: str, value: str, expected: str, tmp_path: Path, capsys) -> None:
    with pytest.raises(UserError) as e:
        free_port(**{"host": "127.0.0.1", "port": 8080, option: int(value) if option == "port" else value})
    assert str(e.value).startswith(f"--{option}: expected {expected}")
    pytest.importorskip("viser", reason="viser is not installed (extra: viewer)")
    model("static").save(path := tmp_path / "m.safetensors", provenance())
    assert main(["view", str(path), f"--{option}", value]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: --{option}: expected") and error.count("\n") == 1


def test_a_port_that_is_taken_is_passed_over() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) < port + 1000


@pytest.mark.parametrize(
    ("host", "origin", "asked", "own"),
    [
        ("127.0.0.1", "http://localhost:8080", "localhost:8080", True),
        ("127.0.0.1", "http://127.0.0.1:9000", "127.0.0.1:9000", True),  # through a tunnel
        ("127.0.0.1", None, "localhost:8080", True),  # a program
        ("127.0.0.1", "https://a.example", "localhost:8080", False),
        ("127.0.0.1", "http://localhost:3000", "localhost:8080", False),
        ("127.0.0.1", "null", "localhost:8080", False),
        ("127.0.0.1", "http://a.example:8080", "a.example:8080", False),  # a name that points at this machine
        ("0.0.0.0", "http://lab:8080", "lab:8080", True),
        ("0.0.0.0", "https://a.example", "lab:8080", False),
        ("127.0.0.1", "http://localhost:8080", "LOCALHOST:8080", True),
        ("::1", "http://[::1]:8080", "[::1]:8080", True),
        ("127.0.0.1", None, "[::1", False),  # half an address
        ("0.0.0.0", "http://[", "lab:8080", False),
    ],
)
def test_whose_pages_are_the_viewers_own(host: str, origin: str | None, asked: str, own: bool) -> None:
    assert is_own(origin, asked, host) == own


@pytest.mark.parametrize(
    ("host", "expected"), [("127.0.0.1", "localhost"), ("::", "localhost"), ("::1", "[::1]"), ("lab", "lab")]
)
def test_the_address_that_is_printed(host: str, expected: str) -> None:
    assert url_of(host, 8080) == f"http://{expected}:8080"


def test_a_page_of_another_origin_gets_no_socket(viewer: Viewer) -> None:
    def status(origin: str) -> bytes:
        host, _, port = viewer.url.removeprefix("http://").partition(":")
        lines = ["GET / HTTP/1.1", f"Host: {host}:{port}", f"Origin: {origin}", "Upgrade: websocket"]
        lines += ["Connection: Upgrade", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13"]
        with socket.create_connection(("127.0.0.1", int(port)), 30) as connection:
            connection.sendall("\r\n".join([*lines, "", ""]).encode())
            return connection.recv(12)

    assert status("https://a.example") == b"HTTP/1.1 403"
    assert status(viewer.url) == b"HTTP/1.1 101"


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    pytest.importorskip("viser", reason="viser is not installed (extra: viewer)")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made = Viewer(content(), "127.0.0.1", port)
    loop = threading.Thread(target=made.run)
    loop.start()
    yield made
    made.stop()
    loop.join(60)
    assert not loop.is_alive()


def difference(page: Page, image: UInt8) -> float:
    """Return the mean difference, of 255, of the page from a gray image that fills it.

    It counts the middle, beside the controls and viser's own notes.
    """
    shot = page.screenshot().astype(float)
    wanted = cv2.resize(image[:, :, 0], shot.shape[::-1], interpolation=cv2.INTER_LINEAR)
    free = slice(int(0.36 * shot.shape[1]), int(0.64 * shot.shape[1]))
    return float(np.abs(shot[:, free] - wanted[:, free]).mean())


def shows(page: Page, image: UInt8, other: UInt8) -> bool:
    """Return whether the page shows the one image and not the other; the image is a JPEG, and coarse at first."""
    return difference(page, image) < difference(page, other) / 2


def test_a_browser_shows_the_model_at_the_time_of_the_slider(viewer: Viewer, tmp_path: Path) -> None:
    with browser(tmp_path, webgl=True) as page:
        page.call("Page.navigate", url=viewer.url)
        wait_for("slider", lambda: page.value("!!document.querySelector('[role=slider]')"))
        wait_for("sharp image", lambda: viewer.images >= 2)
        # The window opens at the middle camera, as wide as the browser.
        camera = fixed(TRAINED)(0.0)
        _, fov = matching(TRAINED, camera.id, WIDTH / HEIGHT)
        free = free_camera(camera.R.T, camera.center, fov, WIDTH / HEIGHT, 4 * camera.width * camera.height)
        first, last = (viewer.content.image("rendered", free, t) for t in (0.0, viewer.time.max))
        assert np.abs(first.astype(float) - last).mean() > 4, "the two images must differ"
        wait_for("image at the start", lambda: shows(page, first, last))
        page.value("document.querySelector('[role=slider]').focus()")
        page.press("End")
        wait_for("image at the end", lambda: shows(page, last, first))
        assert viewer.time.value == viewer.time.max
        assert "frames/s" in viewer.speed.value

        # Only training cameras have spikes: the nearest one is chosen, and the image keeps its shape.
        viewer.mode.value = "spike rate"
        wait_for("camera", lambda: viewer.camera.value == camera.id)
        rate = padded(viewer.content.image("spike rate", camera, viewer.time.max), WIDTH / HEIGHT)
        wait_for("spike rate", lambda: difference(page, rate) < 4)
        viewer.camera.value = FREE
        wait_for("rendered again", lambda: viewer.mode.value == "rendered" and shows(page, last, first))
