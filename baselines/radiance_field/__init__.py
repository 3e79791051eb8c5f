"""SpikeNeRF with the deformation of 4DGS (Dy-SpikeNeRF): a radiance field fitted to spikes by ray marching."""

from __future__ import annotations

from spike4dgs.baselines.radiance_field.fit import RADIANCE_FIELD, fit_radiance_field
from spike4dgs.baselines.radiance_field.settings import PUBLISHED, FieldSpikeSettings, RadianceFieldSettings

__all__ = ["PUBLISHED", "RADIANCE_FIELD", "FieldSpikeSettings", "RadianceFieldSettings", "fit_radiance_field"]
