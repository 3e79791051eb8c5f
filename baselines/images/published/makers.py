"""The image makers `ssml`, `ssir`, `spikeclip` and `scflow-tfp`: networks with their authors' weights.

The weight files are not shipped. `spike4dgs download weights ssml` fetches one, and any other bytes are refused. A
method without its file has no value in a table, with that reason.

Networks return relative intensity. One factor a network, fitted on training variants, makes it spikes per tick. Two
were trained in dimmer light: of regular spikes, SSML returns the rate up to 0.2 a tick and too much above, SSIR less
and less above 0.3. They see every third and every second spike of a pixel, as a camera with a threshold so many times
as high would fire, and what they return is taken as many times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float32, UInt8
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.weights import WeightFile, find_weights, load_into, unreadable
from spike4dgs.method.images.base import ImageMaker, Learned, window

_GITHUB = "https://github.com"
_SPIKECV = f"{_GITHUB}/Zyj061/SpikeCV/raw/0c5f332b7877/SpikeCV/spkProc"
_NOT_STATED = "its repository states none: ask the authors"
_ALONG = 41  # ticks that `scflow-tfp` averages, as many as the other networks see


@dataclass(frozen=True)
class Published:
    """A network that other people trained.

    `scale`: spikes per tick of an output of 1; `keep_every`: of a pixel's spikes, the network sees one in so many. Both
    were chosen by least squares over the held-out views of car-10-tiny, turntable-10-tiny and bricks-10-tiny.
    `trained_on`: data sets.
    """

    file: WeightFile
    scale: float
    trained_on: tuple[str, ...]
    keep_every: int = 1
    prefix: str = ""  # of the names of its tensors in the file
    key: str | None = None  # of its tensors in the file

    @property
    def learned(self) -> Learned | None:
        """The weights in use; None where they are missing or others, which a fit will say."""
        try:
            return Learned(find_weights(self.file).sha256, self.trained_on)
        except UserError:
            return None


SSML = Published(
    WeightFile(
        "ssml_simple_nbsn_83000.pth",
        3624247,
        "f80278a31a57113dc6dfdb1b8906a590d6a71ddc7a863e26ce2b3367c0aa452c",
        "SSML's branch without a blind spot",
        f"{_SPIKECV}/reconstruction/SSML_Recon/pretrained/nbsn_83000_simple.pth",
        "Apache-2.0 (SpikeCV)",
        "nbsn_83000_simple.pth",
        "download weights ssml",
    ),
    scale=1.022,
    trained_on=("SSML-recordings",),
    keep_every=3,
)
SSIR = Published(
    WeightFile(
        "ssir_e80.pth",
        1551534,
        "8a03cf04f2496a67ef465fc74a1c6a4ea6e282382984868bb4a20da602112be9",
        "SSIR, a spiking network",
        f"{_GITHUB}/ruizhao26/SSIR/raw/3e3b282e9453/ckpt/SSIR_e80.pth",
        _NOT_STATED,
        "SSIR_e80.pth",
        "download weights ssir",
    ),
    scale=0.393,
    trained_on=("SREDS",),
    keep_every=2,
    prefix="module.",
)
SPIKECLIP = Published(
    WeightFile(
        "spikeclip_lrn_caltech.pth",
        746794,
        "68c20592c476affd190c8c5f717bb03f590586e6d6bfbff8a89d1d32b14a60b2",
        "SpikeCLIP's light reconstruction network",
        f"{_GITHUB}/chenkang455/SpikeCLIP/raw/b0a30a440908/models/LRN_CALTECH.pth",
        _NOT_STATED,
        "LRN_CALTECH.pth",
        "download weights spikeclip",
    ),
    scale=0.120,
    trained_on=("U-CALTECH",),
)
SCFLOW = Published(
    WeightFile(
        "scflow_dt10.pth",
        3227065,
        "56c5ffc2d816274b4a93fff0ea0abc3173543ec5db8bac3b600a1eb963bd5584",
        "SCFlow, optical flow ten ticks apart",
        f"{_SPIKECV}/optical_flow/SCFlow/pretrained/pretrained_dt10.pth.tar",
        "Apache-2.0 (SpikeCV)",
        "pretrained_dt10.pth.tar",
        "download weights scflow",
    ),
    scale=1.0,
    trained_on=("SPIFT",),
    key="state_dict",
)
FILES = {name: of.file for name, of in (("ssml", SSML), ("ssir", SSIR), ("spikeclip", SPIKECLIP), ("scflow", SCFLOW))}


def _network(name: str) -> Any:
    """Return a network without weights. torch is imported where it is used: reading spikes must not wait for it."""
    from spike4dgs.baselines.images.published import networks, scflow

    return {"ssml": networks.Ssml, "ssir": networks.Ssir, "spikeclip": networks.SpikeClip, "scflow": scflow.ScFlow}[
        name
    ]()


@cache
def load_network(name: str, published: Published, path: Path, device: str) -> Any:
    """Return a network with the tensors of a file, on `device`, ready to run.

    Raises UserError for a damaged or foreign file: every tensor of the network must be there, with its shape, and no
    other.
    """
    return load_into(_network(name), _tensors(published, path), path).to(device)


def _tensors(published: Published, path: Path) -> dict[str, Any]:
    import torch

    expected, fix = f"tensors of {published.file.purpose}", f"replace it by the one from {published.file.source}"
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        state = state if published.key is None else state[published.key]
        tensors = {str(name).removeprefix(published.prefix): tensor for name, tensor in state.items()}
    except Exception as e:  # whatever a reader of foreign files raises
        raise unreadable(path, expected, e, fix) from None
    if not all(isinstance(tensor, torch.Tensor) for tensor in tensors.values()):
        raise problem(path, expected, "other values", fix)
    return tensors


def _run(name: str, published: Published, stream: SpikeStream, tick: int, device: str) -> Float32:
    """Return a network's spikes per tick [H, W] at the start of a tick. Beyond its ends the clip is mirrored."""
    import torch

    from spike4dgs.baselines.images.published.networks import STEP

    network = load_network(name, published, find_weights(published.file).path, choose_device(device, rasterizes=False))
    on, earlier = next(network.parameters()).device, STEP * (network.windows - 1)
    spikes = window(stream, tick, (network.ticks | 1) + 2 * earlier)[: network.ticks + earlier]
    with torch.inference_mode():
        seen = torch.from_numpy(thinned(spikes, published.keep_every)).to(on, torch.float32)
        found = network(seen.unfold(0, network.ticks, STEP).permute(0, 3, 1, 2))[0, 0]
        rate: Float32 = (published.keep_every * published.scale * found).clamp(min=0).cpu().numpy()
    return rate


def thinned(spikes: UInt8, keep_every: int) -> UInt8:
    """Return every k-th spike of each pixel of a window [T, H, W]; pixels begin with different ones of the k.

    A pixel whose threshold is k times as high fires these spikes.
    """
    if keep_every == 1:
        return spikes
    pixels = np.arange(spikes[0].size, dtype=np.uint64).reshape(spikes.shape[1:])
    first = (pixels * np.uint64(2654435761) >> np.uint64(16)) % np.uint64(keep_every)  # as good as random
    number = np.cumsum(spikes, 0, dtype=np.uint64) + first
    return np.asarray((spikes > 0) & (number % np.uint64(keep_every) == 0), np.uint8)


def flow_at(stream: SpikeStream, tick: int, network: Callable[..., Any]) -> Any:
    """Return a network's flow in px per tick [2, H, W] from the start of a tick, of two windows [1, T, H, W] of spikes.

    The second is a little later or, where the clip ends before, as much earlier.
    """
    import torch

    from spike4dgs.baselines.images.published import scflow

    apart = scflow.APART if tick + scflow.APART < stream.n_ticks else -scflow.APART
    at = (window(stream, max(t, 0), scflow.TICKS) for t in (tick, tick + apart))
    return network(*(torch.from_numpy(spikes)[None] for spikes in at))[0] / apart


def scflow_image(stream: SpikeStream, tick: int, device: str) -> Float32:
    """Return spikes per tick [H, W]: the mean of 41 ticks along the flow from the start of a tick."""
    import torch

    from spike4dgs.baselines.images.published import scflow

    path = find_weights(SCFLOW.file).path
    network = load_network("scflow", SCFLOW, path, choose_device(device, rasterizes=False))
    on = next(network.parameters()).device
    with torch.inference_mode():
        flow = flow_at(stream, tick, lambda *windows: network(*(spikes.to(on, torch.float32) for spikes in windows)))
        spikes = torch.from_numpy(window(stream, tick, _ALONG)).to(on, torch.float32)
        rate: Float32 = scflow.mean_along(spikes, flow).cpu().numpy()
    return rate


def _maker(
    name: str,
    published: Published,
    definition: str,
    source: str,
    label: str,
    image: Callable[..., Float32],
    device: str,
) -> ImageMaker:
    return ImageMaker(
        name=name,
        definition=definition,
        source=source,
        rate=lambda stream, tick, _: image(stream, tick, device),
        learned=lambda: published.learned,
        made_on=lambda chosen: _maker(name, published, definition, source, label, image, chosen),
        label=label,
    )


def _network_maker(name: str, published: Published, definition: str, source: str, label: str) -> ImageMaker:
    def image(stream: SpikeStream, tick: int, device: str) -> Float32:
        return _run(name, published, stream, tick, device)

    return _maker(name, published, definition, source, label, image, "auto")


MAKERS = (
    _network_maker("ssml", SSML, "SSML's U-Net on the 41 ticks around tick t", "Chen et al., IJCAI 2022", "by SSML"),
    _network_maker(
        "ssir",
        SSIR,
        "SSIR on the 41 ticks around tick t, after three windows before",
        "Zhao et al., IEEE TCSVT 2023",
        "by SSIR",
    ),
    _network_maker(
        "spikeclip",
        SPIKECLIP,
        "SpikeCLIP's light reconstruction network on the 200 ticks around tick t, four at a time",
        "Chen et al., AAAI 2025",
        "by SpikeCLIP's network",
    ),
    _maker(
        "scflow-tfp",
        SCFLOW,
        "the mean of the 41 ticks around tick t, sampled along SCFlow's motion",
        "flow: Hu et al., CVPR 2022; averages along it: this project",
        "from spike counts along SCFlow's motion",
        scflow_image,
        "auto",
    ),
)
