"""STG's "Sandwich": three splatted channels and the pixel's ray become gray radiance.

    radiance = albedo + W2 relu(W1 [view feature, time feature, ray origin, ray direction])

without biases. The published decoder works on nine channels, three of each kind for RGB, with W1 [6, 12] and
W2 [3, 6]; images here are gray, so that one channel of each kind is left, W1 is [6, 8] and W2 [1, 6]. No activation
follows, as in the preset for linear images: radiance may exceed 1.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spike4dgs.method.splat import Views

HIDDEN = 6
CHANNELS = 3  # albedo, view feature, time feature


class Decoder(nn.Module):
    """The two layers. Ray origins count from `center` [3] in units of `scale` metres."""

    def __init__(self, center: Tensor, scale: float, generator: torch.Generator) -> None:
        super().__init__()
        self.scale = scale
        self.center: Tensor
        self.register_buffer("center", center.float().clone())
        first = torch.empty(HIDDEN, CHANNELS - 1 + 6)
        nn.init.kaiming_uniform_(first, a=5**0.5, generator=generator)  # what torch's convolutions start from
        self.first = nn.Parameter(first)
        # Zero: the first images are the albedo. The published layer starts at random.
        self.second = nn.Parameter(torch.zeros(1, HIDDEN))

    def forward(self, channels: Tensor, views: Views) -> Tensor:
        """Return gray radiance [V, H, W] of splatted channels [V, H, W, 3]."""
        planes = channels.permute(0, 3, 1, 2).flatten(2)  # [V, 3, H * W], which is how the CPU rasteriser keeps them
        rays = self._from_rays(views).to(planes.dtype)  # [V, 6, H * W]
        hidden = torch.baddbmm(rays, self.first[:, :2].expand(len(planes), -1, -1), planes[:, 1:]).relu()
        gray = planes[:, 0] + (self.second @ hidden)[:, 0]
        return gray.view(channels.shape[:3])

    def _from_rays(self, views: Views) -> Tensor:
        """Return the first layer's sums over ray origin and direction: [V, 6, H * W]."""
        origin, direction = rays(views)
        o = (origin.float() - self.center) / self.scale  # [V, 3]
        by_origin = o @ self.first[:, 2:5].T  # [V, 6]
        return self.first[:, 5:].expand(len(o), -1, -1) @ direction + by_origin[..., None]


def rays(views: Views) -> tuple[Tensor, Tensor]:
    """Return camera centres [V, 3] and float32 unit directions [V, 3, H * W] of the pixels' rays, in world coordinates.

    Directions are sums of a row's and a column's vector: a seventh of the time of a product with all pixels in float64.
    """
    R, t = views.w2c[:, :3, :3], views.w2c[:, :3, 3]
    back = (R.mT @ torch.linalg.inv(views.K.to(R)))[:, :, None, None]  # [V, 3, 1, 1, 3] pixel to ray
    down, across = (torch.arange(n, device=R.device) + 0.5 for n in (views.height, views.width))
    rows = back[..., 1] * down[:, None] + back[..., 2]  # [V, 3, H, 1]
    direction = rows.float() + (back[..., 0] * across).float()
    direction = direction * direction.square().sum(1, keepdim=True).rsqrt()
    return -(R.mT @ t[..., None])[..., 0], direction.flatten(2)
