"""MSDI: from the spike streams of an array to points, camera poses and images, by one network."""

from __future__ import annotations

from spike4dgs.method.msdi.config import CONFIGS, PAPER, SMALL, TINY, MsdiConfig
from spike4dgs.method.msdi.network import Estimate, Msdi

__all__ = ["CONFIGS", "PAPER", "SMALL", "TINY", "Estimate", "Msdi", "MsdiConfig"]
