"""The Gaussian window of SSIM (Wang et al. 2004), which the metric and the training loss share."""

from __future__ import annotations

SSIM_WINDOW = 11  # pixels on each side; scikit-image cuts the Gaussian off at 3.5 sigma, which gives the same window
SSIM_SIGMA = 1.5  # pixels
