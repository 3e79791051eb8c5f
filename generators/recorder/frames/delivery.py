"""Delivery of frames to the sink of continuous mode, by a thread of its own.

A sink may wait for long, for a disk that stalls. Only this thread waits then: reads continue into the rings, and the
capturing thread still reacts to Ctrl-C and reports rates.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping

from spike4dgs.generators.recorder.frames.clip import Sink
from spike4dgs.generators.recorder.frames.cutting import Cutter
from spike4dgs.generators.recorder.frames.ring import Ring

_POLL_S = 0.005  # interval at which empty rings are looked at again
# Passed on at once. Nine cameras with reads of 62 kB, beside busy programs: one read at a time fell behind by 380 MB/s.
_BYTES = 4 << 20
_SHARE = 8  # of a ring: no more of it is kept from further reads meanwhile


class Delivery:
    """Passes the frames of every ring to the sink until `finish`, `abandon` or an error, which is kept in `error`."""

    def __init__(self, sink: Sink, rings: Mapping[str, Ring], cutters: Mapping[str, Cutter], n_ticks: int) -> None:
        self.error: Exception | None = None
        self._sink, self._rings, self._cutters, self._n_ticks = sink, rings, cutters, n_ticks
        self._last, self._abandoned = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="delivery", daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Wait until the sink has received every block of the rings, which no thread fills any more.

        Raises the error of the sink.
        """
        self._last.set()
        self._thread.join()
        if self.error is not None:
            raise self.error

    def abandon(self) -> None:
        """End the thread after the blocks that the sink has now."""
        self._abandoned.set()
        self._last.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._abandoned.is_set():
                last = self._last.is_set()  # before looking into the rings: none is filled after it
                if not self._pass_on():
                    if last:
                        break
                    self._last.wait(_POLL_S)
        except Exception as e:  # raised again by the capturing thread
            self.error = e

    def _pass_on(self) -> bool:
        """Pass the next blocks of each camera to the sink. Return whether there were any."""
        busy = False
        for camera, cutter in self._cutters.items():
            ring = self._rings[camera]
            if blocks := ring.pop(max(min(_BYTES // ring.slot_bytes, ring.slots // _SHARE), 1)):
                busy = True
                for run in cutter.cut(blocks):
                    frames = run.frames[: max(self._n_ticks - run.first_tick, 0)]
                    if len(frames):
                        self._sink(camera, run.first_tick, frames)
                ring.release()
        return busy
