"""A browser without a window, driven by its devtools protocol: it loads a page, presses keys, takes screenshots."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
WIDTH, HEIGHT = 900, 540
GONE = "Inspected target navigated or closed"


def wait_for(what: str, check: Callable[[], Any], seconds: float = 180.0) -> Any:
    """Return the first true value of `check`."""
    end = time.monotonic() + seconds
    while not (found := check()):
        assert time.monotonic() < end, f"no {what} within {seconds:.0f} s"
        time.sleep(0.05)
    return found


class Page:
    """One page of a browser."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._calls = socket, 0
        self.events: list[dict[str, Any]] = []  # what the browser told between answers, of the domains enabled

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and wait for its answer."""
        self._calls += 1
        self._socket.send(json.dumps({"id": self._calls, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == self._calls:
                if answer.get("error", {}).get("message") == GONE:
                    raise LookupError(f"{method}: another page came while this one answered")
                assert "error" not in answer, answer
                return dict(answer["result"])
            self.events.append(answer)

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; None also where the page goes away before it has answered."""
        try:
            return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")
        except LookupError:
            return None

    def show(self, url: str, ready: str, width: int = WIDTH, height: int = HEIGHT) -> None:
        """Load a page in a window of that size and wait until the expression `ready` is true; errors are noted."""
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=url)
        wait_for(ready, lambda: self.value(ready))

    def errors(self) -> list[str]:
        """Return what went wrong in the page so far: exceptions, and errors and warnings on its console."""
        self.value("1")  # what came before this answer has been read
        found = []
        for event in self.events:
            p = event.get("params", {})
            if event["method"] == "Runtime.exceptionThrown":
                found.append(str(p["exceptionDetails"].get("exception", p["exceptionDetails"]).get("description")))
            elif event["method"] == "Runtime.consoleAPICalled" and p["type"] in ("error", "warning", "assert"):
                found.append(str([a.get("value", a.get("description")) for a in p["args"]]))
            elif event["method"] == "Log.entryAdded" and p["entry"]["level"] in ("error", "warning"):
                found.append(f"{p['entry']['text']} {p['entry'].get('url', '')}")
        return found

    def forget(self) -> None:
        """Drop what the browser has told so far."""
        self.value("1")  # what came before this answer has been read
        self.events.clear()

    def press(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=KEYS[key])

    def screenshot(self) -> np.ndarray:
        """Return the image of the page, gray [H, W] uint8."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE))


KEYS = {"End": 35, "Home": 36, "ArrowRight": 39, "Tab": 9, "Escape": 27}


@contextmanager
def browser(profile: Path, webgl: bool = False) -> Iterator[Page]:
    """Yield a page of a new browser, in software alone. The test is skipped if there is no browser."""
    binary = next(filter(None, map(shutil.which, NAMES)), None)
    if binary is None:
        pytest.skip("no Chromium here")
    from websockets.sync.client import connect

    flags = ("--headless=new", "--no-sandbox", "--no-first-run", "--disable-extensions", "--mute-audio")
    quiet = ("--disable-background-networking", "--disable-component-update", "--disable-sync")
    software = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader") if webgl else ("--disable-gpu",)
    options = (f"--user-data-dir={profile}", f"--window-size={WIDTH},{HEIGHT}", "--remote-debugging-port=0")
    options += ("--disable-dev-shm-usage",)
    command = [binary, *flags, *quiet, *software, *options, "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port_file = profile / "DevToolsActivePort"
        wait_for("devtools port", lambda: port_file.is_file() and port_file.read_text().count("\n"))
        port = port_file.read_text().split()[0]

        def page() -> Any:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                return [t for t in json.load(answer) if t["type"] == "page"]

        address = wait_for("page", page)[0]["webSocketDebuggerUrl"]
        with connect(address, max_size=None) as socket:
            shown = Page(socket)
            # --window-size counts the window's frame too.
            size = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
            shown.call("Emulation.setDeviceMetricsOverride", **size)
            yield shown
    finally:
        process.terminate()
        process.wait(timeout=30)
