"""SpikeNeRF with the deformation of 4DGS (Dy-SpikeNeRF): a radiance field fitted to spikes by ray marching."""

from __future__ import annotations

from spike4dgs.method.radiance_field.fit import PUBLISHED, RADIANCE_FIELD, RadianceFieldSettings, fit_radiance_field

__all__ = ["PUBLISHED", "RADIANCE_FIELD", "RadianceFieldSettings", "fit_radiance_field"]
