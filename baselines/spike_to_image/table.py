"""Spike-to-image methods: the table that a recipe's `images` part names an entry of."""

from __future__ import annotations

from spike4dgs.baselines.spike_to_image.adaptive import ADAPTIVE
from spike4dgs.baselines.spike_to_image.base import ImageMaker
from spike4dgs.baselines.spike_to_image.msdi import MSDI
from spike4dgs.baselines.spike_to_image.spk2img.maker import SPK2IMG
from spike4dgs.baselines.spike_to_image.tfi import TFI
from spike4dgs.baselines.spike_to_image.tfp import TFP
from spike4dgs.baselines.spike_to_image.tfstp import TFSTP

IMAGES: dict[str, ImageMaker] = {maker.name: maker for maker in (TFP, TFI, TFSTP, SPK2IMG, ADAPTIVE, MSDI)}

__all__ = ["IMAGES", "ImageMaker"]
