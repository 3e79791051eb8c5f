"""Sizes of MSDI's networks: one code, three frozen configurations."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MsdiConfig:
    """Sizes of the networks of `Msdi`. Widths are channels."""

    name: str
    ticks: int  # T, length of the network's window; the image is that of its middle
    extractor_widths: tuple[int, ...]  # of each level, the first at full size, each next at half; one: a single layer
    generator_widths: tuple[int, int]  # of the first two of BCONV's three layers
    generator_sees_pixel: bool  # BCONV also gets the spikes of its own pixel, to which the features are blind
    rate_windows: tuple[int, ...]  # ticks on either side, for the rates that BCONV gets with them
    embed_channels: int  # inputs of the patch embedding, mixed from the extractor's features
    patch: int  # px, 16 or 8
    encoder_layers: int
    encoder_width: int
    encoder_heads: int
    fusion_layers: int
    fusion_width: int
    fusion_heads: int
    head_widths: tuple[int, int, int, int]  # of the head's four levels, finest first
    head_features: int

    @property
    def own_channels(self) -> int:
        """Channels that BCONV gets of its own pixel: the spikes, and `inputs.own_rates`."""
        if not self.generator_sees_pixel:
            return 0
        return self.ticks + (2 * len(self.rate_windows) + 1 if self.rate_windows else 0)

    @property
    def features(self) -> int:
        """Channels of the extractor's features: four directions."""
        return 4 * self.extractor_widths[0]

    @property
    def hooks(self) -> tuple[int, int, int, int]:
        """The head's inputs: 0 is the encoder's output, k that of the fusion's k-th layer."""
        n = self.fusion_layers
        return 0, n // 2, 3 * n // 4, n


# The paper: ViT encoders, a transformer of 24 layers as in Fast3R, a DPT head, one shift-based layer and three
# convolutions for images. The sizes are those of the systems that it cites: DUSt3R's ViT-L and Fast3R's published
# weights (1024 wide), and 96 channels a direction as in the blind-spot network. Three embedded channels are what the
# pre-trained patch embedding takes.
PAPER = MsdiConfig(
    name="paper",
    ticks=41,
    extractor_widths=(96,),
    generator_widths=(384, 96),
    generator_sees_pixel=False,
    rate_windows=(),
    embed_channels=3,
    patch=16,
    encoder_layers=24,
    encoder_width=1024,
    encoder_heads=16,
    fusion_layers=24,
    fusion_width=1024,
    fusion_heads=16,
    head_widths=(96, 192, 384, 768),
    head_features=256,
)

# For two CPU cores, at 64x104 px: patches of 8 give as many tokens there as patches of 16 at twice the size, for a
# quarter of the pixels. The extractor is a pyramid, because one layer sees only three rows and columns; the image also
# takes the pixel's own spikes, which say more about it than any neighbour.
SMALL = MsdiConfig(
    name="small",
    ticks=41,
    extractor_widths=(16, 32, 64),
    generator_widths=(64, 32),
    generator_sees_pixel=True,
    rate_windows=(2, 4, 7, 11, 15, 20),
    embed_channels=16,
    patch=8,
    encoder_layers=6,
    encoder_width=192,
    encoder_heads=6,
    fusion_layers=24,
    fusion_width=128,
    fusion_heads=4,
    head_widths=(48, 64, 96, 128),
    head_features=64,
)

TINY = MsdiConfig(  # for tests
    name="tiny",
    ticks=9,
    extractor_widths=(4, 6),
    generator_widths=(8, 6),
    generator_sees_pixel=True,
    rate_windows=(2, 4),
    embed_channels=4,
    patch=16,
    encoder_layers=2,
    encoder_width=16,
    encoder_heads=2,
    fusion_layers=4,
    fusion_width=16,
    fusion_heads=2,
    head_widths=(4, 6, 8, 8),
    head_features=8,
)

CONFIGS = {config.name: config for config in (PAPER, SMALL, TINY)}
