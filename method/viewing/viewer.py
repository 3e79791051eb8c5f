"""A fitted model in the browser. The project's own rasteriser renders the images, which are sent as JPEG.

While something changes, images have as many pixels as a training view; at rest they are rendered once more, with four
times as many. All browsers share the controls; each has its own camera.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.method.viewing.camera_paths import fixed, focus, resized
from spike4dgs.method.viewing.content import Content, free_camera, matching, padded
from spike4dgs.method.viewing.serving import free_port, own_origins, url_of

FREE = "free"
LOOP_S = 4.0  # duration of the clip when it plays
SHARP = 2.0  # times as many pixels each way at rest
JPEG = 85
MOVED = 1e-3  # of the distance to the focus: farther from the set position, a user has moved the camera


def need_viser() -> Any:
    """Return the package viser. Raises UserError if it is not installed."""
    try:
        import viser
    except ImportError:
        raise problem("view", "the package viser", "none", "pip install 'spike4dgs[viewer]'") from None
    return viser


class Window:
    """One connected browser."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.stale = True  # its image is out of date
        self.coarse = False  # it could be sharper
        self.set_center = np.zeros(3)  # of its camera, as last set here

    def set_camera(self, camera: Camera, target: np.ndarray) -> None:
        """Set the browser's camera to `camera`; it turns around what `camera` sees at the depth of `target`."""
        client, forward = self.client, camera.R[2]
        distance = max(float((target - camera.center) @ forward), 1e-3)
        self.set_center = camera.center
        with client.atomic():
            client.camera.position = camera.center
            client.camera.look_at = camera.center + distance * forward
            client.camera.up_direction = -camera.R[1]
            client.camera.fov = matching((camera,), camera.id, client.camera.aspect)[1]


class Viewer:
    """The controls and the render loop. `run` renders until `stop`; everything else happens in viser's threads."""

    def __init__(self, content: Content, host: str, port: int) -> None:
        self.content, self.target = content, focus(content.cameras)
        self.images = 0  # rendered so far
        self._windows: dict[int, Window] = {}
        self._wake, self._ended = threading.Event(), threading.Event()
        self._ms: list[float] = []  # of the last images
        self._shown_at = 0.0
        with own_origins(host):
            self.server = need_viser().ViserServer(host, free_port(host, port), label="Spike4DGS", verbose=False)
        self.url = url_of(host, self.server.get_port())
        about, gui = content.saved.provenance, self.server.gui
        gui.add_markdown(f"**{about.name}** on {about.scene}")
        tick_us = 1e6 / about.rate_hz
        self.time = gui.add_slider("time, us", 0.0, about.duration_us - tick_us, tick_us, 0.0)
        self.playing = gui.add_checkbox("play", False)
        self.mode = gui.add_dropdown("show", content.modes)
        self.camera = gui.add_dropdown("camera", (FREE, *(c.id for c in content.cameras)))
        self.speed = gui.add_text("speed", "", disabled=True)
        for control in (self.time, self.playing):
            control.on_update(lambda _: self.refresh())
        self.mode.on_update(lambda _: self._mode_changed())
        self.camera.on_update(lambda _: self._camera_changed())
        self.server.on_client_connect(self._arrived)
        self.server.on_client_disconnect(lambda client: self._windows.pop(client.client_id, None))

    def run(self) -> None:
        """Render the windows that are out of date, then those that could be sharper, until `stop` is called."""
        with one_torch_thread():
            while not self._ended.is_set():
                if self.playing.value:
                    share = time.monotonic() / LOOP_S % 1.0
                    self.time.value = share * self.time.max
                    self.refresh()
                windows = list(self._windows.values())
                stale = [w for w in windows if w.stale]
                for w in stale or [w for w in windows if w.coarse][:1]:
                    self._render(w, 1.0 if stale else SHARP)
                if not stale:
                    self._wake.wait(0.1)
                    self._wake.clear()

    def stop(self) -> None:
        """End the loop and the server."""
        self._ended.set()
        self._wake.set()
        self.server.stop()

    def refresh(self) -> None:
        """Render every window's image again."""
        for w in list(self._windows.values()):
            w.stale = True
        self._wake.set()

    def _render(self, w: Window, scale: float) -> None:
        start = time.perf_counter()
        w.stale, w.coarse = False, scale == 1.0
        seen, chosen, mode = w.client.camera, self.camera.value, self.mode.value
        if chosen == FREE:
            mode = "rendered"  # the controls change one after the other, and only training cameras have spikes
            first, turn = self.content.cameras[0], need_viser().transforms.SO3(seen.wxyz).as_matrix()
            camera = free_camera(turn, seen.position, seen.fov, seen.aspect, first.width * first.height)
        else:
            camera = matching(self.content.cameras, chosen, seen.aspect)[0]
        if mode == "rendered":
            camera = resized(camera, scale)
        image = self.content.image(mode, camera, self.time.value)
        w.client.scene.set_background_image(padded(image, seen.aspect), format="jpeg", jpeg_quality=JPEG)
        self.images += 1
        self._show_speed(1e3 * (time.perf_counter() - start), camera)

    def _show_speed(self, ms: float, camera: Camera) -> None:
        """Show the speed of the last images, twice a second at most."""
        self._ms = [*self._ms[-19:], ms]
        now = time.monotonic()
        if now - self._shown_at > 0.5:
            self._shown_at, median = now, float(np.median(self._ms))
            self.speed.value = f"{1e3 / median:.0f} frames/s ({median:.0f} ms, {camera.width}x{camera.height})"

    def _arrived(self, client: Any) -> None:
        w = Window(client)
        w.set_camera(fixed(self.content.cameras)(0.0), self.target)
        self._windows[client.client_id] = w
        client.camera.on_update(lambda _: self._moved(w))
        self._wake.set()

    def _moved(self, w: Window) -> None:
        """Respond to a moved camera: a user who moves it leaves the training camera."""
        away = float(np.linalg.norm(w.client.camera.position - w.set_center))
        if self.mode.value == "rendered" and self.camera.value != FREE:
            if away > MOVED * float(np.linalg.norm(self.target - w.set_center)):
                self.camera.value = FREE
        w.stale = True
        self._wake.set()

    def _mode_changed(self) -> None:
        """Go to the nearest training camera if the mode needs spikes, which only these have."""
        windows = list(self._windows.values())
        if self.mode.value != "rendered" and self.camera.value == FREE and windows:
            here = windows[0].client.camera.position
            nearest = min(self.content.cameras, key=lambda c: float(np.linalg.norm(c.center - here)))
            self.camera.value = nearest.id
        self.refresh()

    def _camera_changed(self) -> None:
        """Set every browser's camera to the chosen one; a free camera has no spikes to show."""
        if self.camera.value == FREE:
            self.mode.value = "rendered"
        else:
            camera = next(c for c in self.content.cameras if c.id == self.camera.value)
            for w in list(self._windows.values()):
                w.set_camera(camera, self.target)
        self.refresh()
