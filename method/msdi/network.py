"""MSDI: multi-view spike-based dense initialisation (the paper's section 3.3, eqs. 5-12).

Spikes of V cameras go through one extractor (eqs. 6, 7). From its features, BCONV makes an image of each view
(eq. 12); a ViT encodes each view (eq. 9), a transformer of 24 layers fuses all views' tokens (eq. 10), and a DPT head
gives the point that each pixel sees, in the frame of view 0, with a confidence (eq. 11). Poses follow from the points,
by `pose.solve_poses`. Encoder, fusion and head are those of DUSt3R and Fast3R; `checkpoints` loads their weights.

Known intrinsics enter as the direction of each pixel's ray, embedded beside the features. Known sensors enter as
spikes of an ideal one (`inputs`), before any layer combines neighbours. The sides of the streams are padded to whole
patches with zeros, and the outputs are cut back; nothing is cropped or resized.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from llvmlite.binding import get_host_cpu_features
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.msdi.config import MsdiConfig
from spike4dgs.method.msdi.extractor import ImageGenerator, SpikeExtractor
from spike4dgs.method.msdi.inputs import Sensors, network_inputs
from spike4dgs.method.msdi.layers import NORM_EPS, Block, Dpt, grid, initialize, unpack, widened

VIEW_IDS = 1000  # numbers that views may have, as in Fast3R; view 0 has number 0
_FUSION_EPS = 1e-5  # of Fast3R's fusion layers, unlike the encoder's


@dataclass(frozen=True, eq=False)
class Estimate:
    """The output of MSDI for B samples of V views of H x W pixels."""

    points: Tensor  # [B, V, H, W, 3] what each pixel sees, in view 0's camera frame (OpenCV), at an arbitrary scale
    confidence: Tensor  # [B, V, H, W] more than 1
    images: Tensor  # [B, V, H, W] spikes per tick at the middle of the window


@dataclass(frozen=True)
class Margins:
    """Rows and columns of zeros around a stream that make its sides whole patches."""

    top: int
    bottom: int
    left: int
    right: int

    def pad(self, x: Tensor) -> Tensor:
        """Return [..., H, W] with the margins."""
        return functional.pad(x, (self.left, self.right, self.top, self.bottom))

    def cut(self, x: Tensor) -> Tensor:
        """Return [N, H', W', ...] without the margins."""
        return x[:, self.top : x.shape[1] - self.bottom, self.left : x.shape[2] - self.right]


def margins(height: int, width: int, patch: int) -> Margins:
    """Return the margins that make the sides multiples of `patch`, half of them (rounded down) above and left."""
    rows, columns = -height % patch, -width % patch
    return Margins(rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)


class Encoder(nn.Module):
    """Eq. 9: a ViT with rotary positions, with one set of weights for all views."""

    def __init__(self, config: MsdiConfig) -> None:
        super().__init__()
        width, patch = config.encoder_width, config.patch
        self.mix = nn.Conv2d(config.features, config.embed_channels, 1)
        self.patch_embed = nn.Conv2d(config.embed_channels, width, patch, stride=patch)
        self.ray_embed = nn.Conv2d(3, width, patch, stride=patch, bias=False)
        nn.init.zeros_(self.ray_embed.weight)  # pre-trained layers start undisturbed
        self.blocks = nn.ModuleList(Block(width, config.encoder_heads) for _ in range(config.encoder_layers))
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)
        initialize(self.blocks)

    def forward(self, features: Tensor, rays: Tensor) -> Tensor:
        """Return tokens [N, patches, C], row by row, from features [N, F, H, W] and rays [N, 3, H, W]."""
        x = self.patch_embed(self.mix(features)) + self.ray_embed(rays)  # [N, C, rows, columns]
        positions = grid(x.shape[2], x.shape[3], x.device)
        x = x.flatten(2).transpose(1, 2)
        for block in self.blocks:
            x = block(x, positions)
        out: Tensor = self.norm(x)
        return out


class FusionTransformer(nn.Module):
    """Eq. 10: all tokens of all views attend to each other (Fast3R). Views differ by the embedding of their number."""

    def __init__(self, config: MsdiConfig) -> None:
        super().__init__()
        self.width = width = config.fusion_width
        self.hooks = config.hooks
        self.embed = nn.Linear(config.encoder_width, width)
        self.blocks = nn.ModuleList(Block(width, config.fusion_heads, _FUSION_EPS) for _ in range(config.fusion_layers))
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)
        initialize(self.blocks)

    def forward(self, tokens: Tensor) -> list[Tensor]:
        """Return the tokens of the four hooks, each [B V, n, C'], from tokens [B, V, n, C]."""
        batch, views = tokens.shape[:2]
        numbers = view_numbers(batch, views, shuffled=self.training).to(tokens.device)
        x = (self.embed(tokens) + sinusoids(numbers, self.width)[:, :, None]).flatten(1, 2)  # [B, V n, C']
        layers = [tokens.flatten(0, 1)]
        for k, block in enumerate(self.blocks, start=1):
            x = block(x)
            if k in self.hooks:
                seen = self.norm(x) if k == len(self.blocks) else x
                layers.append(seen.unflatten(1, (views, -1)).flatten(0, 1))
        return layers


def view_numbers(batch: int, views: int, *, shuffled: bool) -> Tensor:
    """Return the views' numbers [B, V], which distinguish them in the network: view 0 has 0.

    In training the others are distinct random numbers, by torch's generator, so that all numbers are seen and no order
    is learnt; in inference they are spread evenly. Raises UserError for more views than numbers.
    """
    if not 1 <= views <= VIEW_IDS:
        raise problem("MSDI", f"1 to {VIEW_IDS} views", str(views), "give it fewer views at a time")
    others = views - 1
    if shuffled:
        rows = [torch.randperm(VIEW_IDS - 1)[:others] for _ in range(batch)]
    else:
        rows = [(torch.arange(others) * 2 + 1) * (VIEW_IDS - 1) // (2 * max(others, 1))] * batch
    return torch.stack([functional.pad(row + 1, (1, 0)) for row in rows])


def sinusoids(numbers: Tensor, width: int) -> Tensor:
    """Return sines, then cosines, of the numbers [...] at width / 2 falling frequencies: [..., width] float32."""
    half = width // 2
    angle = numbers[..., None] * 10000.0 ** (-torch.arange(half, device=numbers.device) / half)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


class Msdi(nn.Module):
    """The networks of MSDI: see the module."""

    def __init__(self, config: MsdiConfig) -> None:
        super().__init__()
        self.config = c = config
        self.extractor = SpikeExtractor(c.ticks, c.extractor_widths)
        self.generator = ImageGenerator(c.features, c.generator_widths, c.own_channels)
        self.encoder = Encoder(c)
        self.fusion = FusionTransformer(c)
        self.head = Dpt((c.encoder_width, *[c.fusion_width] * 3), c.head_widths, c.head_features, c.patch)
        with torch.no_grad():  # points begin in front of the camera
            self.head.head["4"].bias.copy_(torch.tensor([0.0, 0.0, 1.0, 0.0]))  # type: ignore[operator, union-attr]

    def forward(self, spikes: Tensor, intrinsics: Tensor | None = None, sensors: Sensors | None = None) -> Estimate:
        """Return points, confidence and images of `spikes` [B, V, T, H, W] of 0 and 1; see `Estimate`.

        `intrinsics` [B, V, 3, 3] in pixels, pixel centres at +0.5, and `sensors` [B, V, H, W] are None where they
        are unknown. Raises UserError for spikes, intrinsics or sensors of another shape.
        """
        _check_shapes(spikes.shape, None if intrinsics is None else intrinsics.shape, self.config.ticks)
        batch, views, _, height, width = spikes.shape
        around = margins(height, width, self.config.patch)
        padded = around.pad(self._seen(spikes.flatten(0, 1), sensors))
        features = self.extractor(padded[:, : self.config.ticks])
        images = around.cut(self.generator(features, padded))
        rays = around.pad(ray_map(intrinsics, batch * views, height, width, padded))
        # The images alone teach the extractor: the points' gradients, larger and noisier, would cost them several dB.
        tokens = self.encoder(features.detach(), rays)
        layers = self.fusion(tokens.unflatten(0, (batch, views)))
        patch = self.config.patch
        points, confidence = unpack(self.head(layers, padded.shape[2] // patch, padded.shape[3] // patch))
        split = (batch, views)
        return Estimate(
            points=around.cut(points).unflatten(0, split),
            confidence=around.cut(confidence).unflatten(0, split),
            images=widened(images).unflatten(0, split),
        )

    def images(self, spikes: Tensor) -> Tensor:
        """Return the images alone, in spikes per tick [N, H, W], of `spikes` [N, T, H, W]; raises as `forward`."""
        _check_shapes((1, *spikes.shape), None, self.config.ticks)
        around = margins(spikes.shape[2], spikes.shape[3], self.config.patch)
        padded = around.pad(self._seen(spikes, None))
        return around.cut(self.generator(self.extractor(padded[:, : self.config.ticks]), padded))

    def _seen(self, spikes: Tensor, sensors: Sensors | None) -> Tensor:
        """Return the networks' inputs [N, T and rates, H, W]."""
        n, _, height, width = spikes.shape
        flat = None if sensors is None else sensors.flat()
        if flat and {flat.sensitivity.shape, flat.dark.shape} != {(n, height, width)}:
            found = f"{list(flat.sensitivity.shape)} and {list(flat.dark.shape)}"
            raise problem("MSDI", f"sensors {[n, height, width]}", found, "give one pair of maps for each view")
        return network_inputs(_clean(spikes), flat, self.config.rate_windows)


@cache
def has_bfloat16(device: torch.device) -> bool:
    """Return whether a device has instructions that multiply bfloat16: a GPU from compute capability 8.0 on."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    return device.type != "cpu" or bool(get_host_cpu_features().get("avx512bf16"))


def _check_shapes(spikes: Sequence[int], intrinsics: Sequence[int] | None, ticks: int) -> None:
    if len(spikes) != 5 or spikes[2] != ticks or min(spikes) < 1:
        what = f"spikes [samples, views, {ticks}, height, width]"
        raise problem("MSDI", what, str(list(spikes)), f"cut windows of {ticks} ticks")
    if intrinsics is not None and tuple(intrinsics) != (*spikes[:2], 3, 3):
        raise problem(
            "MSDI", f"intrinsics {[*spikes[:2], 3, 3]}", str(list(intrinsics)), "give one matrix for each view"
        )


def _clean(spikes: Tensor) -> Tensor:
    """Return float spikes; a value that is not finite counts as no spike."""
    return spikes.nan_to_num(0.0, 0.0, 0.0) if spikes.is_floating_point() else spikes.float()


def ray_map(intrinsics: Tensor | None, count: int, height: int, width: int, like: Tensor) -> Tensor:
    """Return the pixels' rays x / z, y / z and 1, [N, 3, H, W], of the type and on the device of `like`.

    Where `intrinsics` are None, the focal length is the longer side and the third channel is 0: positions remain.
    """
    v, u = torch.meshgrid(
        torch.arange(height, device=like.device) + 0.5, torch.arange(width, device=like.device) + 0.5, indexing="ij"
    )
    if intrinsics is None:
        longer = float(max(height, width))
        rays = torch.stack([(u - width / 2) / longer, (v - height / 2) / longer, torch.zeros_like(u)])
        return rays.to(like.dtype).expand(count, -1, -1, -1)
    K = intrinsics.reshape(count, 3, 3).to(like.device)[:, :, :, None, None]
    x, y = (u - K[:, 0, 2]) / K[:, 0, 0], (v - K[:, 1, 2]) / K[:, 1, 1]
    return torch.stack([x, y, torch.ones_like(x)], dim=1).to(like.dtype)
