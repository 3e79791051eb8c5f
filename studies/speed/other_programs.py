"""The makers that ours are timed beside: TFSTP in plain numpy, and the models of the package spikezoo.

spikezoo gets its window of 41 ticks as a ready-made float array, centred on the middle of the tick: taking the window
out of the stream does not count for it, and its images are half a tick late. numpy gets an unpacked clip likewise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.baselines.images.tfstp import TfstpSettings, tfstp_image
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.studies.speed.rows import OURS, MakeImage, Row, measured, timed_stream
from spike4dgs.studies.speed.timing import module_of, time_ms

SPIKEZOO = {  # ours -> its folder and class
    "tfi": ("tfi", "TFIModel"),
    "tfp": ("tfp", "TFPModel"),
    "tfstp": ("tfstp", "TFSTP"),
    "spk2img": ("spk2imgnet", "SpikeNet"),
}
UNTRAINED = {"spk2img": "no weights in the package: only its time counts"}
_WINDOW = 41  # ticks that spikezoo's models see


def measure_numpy(repeats: int) -> Row:
    """Return the row of TFSTP in plain numpy, with the difference to ours in its note."""
    stream = timed_stream()
    tick = stream.n_ticks // 2
    spikes = stream.window(0, stream.n_ticks).astype(bool)
    plain = tfstp_plainly(spikes, tick)
    error = float(np.nanmax(np.abs(plain - tfstp_image(stream, tick))))
    ms = time_ms(lambda: tfstp_plainly(spikes, tick), repeats)[1]
    return Row("tfstp", "numpy", ms, note=f"whole history, float64; {OURS} is within {error:.0e} spikes per tick")


def tfstp_plainly(spikes: NDArray[np.bool_], tick: int) -> NDArray[np.float64]:
    """Return TFSTP from the published equations, all pixels of [T, H, W] at once.

    It is NaN where no interval contains `tick`.
    """
    s = TfstpSettings()
    last = np.full(spikes.shape[1:], -1)
    u, q = np.full(last.shape, s.u0), np.zeros(last.shape)  # q = 1 - R, which float64 could not hold as R
    done = np.zeros(last.shape, bool)
    for t, fired in enumerate(spikes):
        now = fired & ~done & (last >= 0)
        gap, u_now, q_now = (t - last)[now], u[now], q[now]
        q[now] = (q_now + u_now - q_now * u_now) * np.exp(-gap / s.d_ticks)
        u[now] = s.u0 + (u_now + s.jump * (1 - u_now) - s.u0) * np.exp(-gap / s.f_ticks)
        last[fired] = t
        done |= now & (t >= tick)
        if done.all():
            break
    with np.errstate(divide="ignore", invalid="ignore"):
        interval_r = -s.d_ticks * np.log(q / (q + u - q * u))
        interval_u = -s.f_ticks * np.log((u - s.u0) / (s.jump - s.u0 + u * (1 - s.jump)))
        return np.where(done, (1 / interval_r + 1 / interval_u) / 2, np.nan)


def measure_spikezoo(name: str, scenes: Sequence[Scene], repeats: int) -> Row:
    """Return the row of spikezoo's model, which may lack packages, ask for a device that is not there, or fail."""
    folder, model = SPIKEZOO[name]
    row = Row(name, "spikezoo", note=UNTRAINED.get(name, ""))
    try:
        if (module := module_of("spikezoo", f"archs/{folder}/nets.py")) is None:
            return replace(row, note="not installed")
        net = getattr(module, model)().eval()
        return measured(row, partial(_prepare, net), scenes, repeats, scored=name not in UNTRAINED)
    except Exception as e:  # somebody else's package
        return replace(row, note=f"does not run here: {type(e).__name__}: {e}")


def _prepare(net: Any, stream: SpikeStream, tick: int, gain: float) -> MakeImage:
    """Return a run of a spikezoo model on the 41 ticks around `tick`, or the nearest ones that the clip has."""
    import torch

    start = max(0, min(tick - _WINDOW // 2, stream.n_ticks - _WINDOW))
    spikes = torch.from_numpy(stream.window(start, start + _WINDOW)).float()[None]  # [1, T, H, W]
    spikes = torch.nn.functional.pad(spikes, (0, -stream.width % 4, 0, -stream.height % 4), mode="replicate")

    def make() -> Float32:
        with torch.no_grad():
            image = net(spikes)[0, 0, : stream.height, : stream.width].numpy()
        return np.asarray(image / gain, np.float32)

    return make
