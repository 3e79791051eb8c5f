"""torchmetrics: PSNR, and SSIM with the window that is usual (11 x 11, sigma 1.5).

Its mean of the SSIM map has the border, where the window reaches into a reflected image; scikit-image, as ours,
leaves half a window out. So the map is compared inside.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.image import PeakSignalNoiseRatio

inputs, answer = map(Path, sys.argv[1:])
psnr = PeakSignalNoiseRatio(data_range=1.0)
usual = {"gaussian_kernel": True, "sigma": 1.5, "kernel_size": 11, "data_range": 1.0, "return_full_image": True}
values = {"psnr": [], "ssim, inside": []}
with np.load(inputs / "images.npz") as images:
    for truth, prediction in zip(images["truth"], images["prediction"], strict=True):
        pair = torch.as_tensor(prediction)[None, None], torch.as_tensor(truth)[None, None]
        values["psnr"].append(float(psnr(*pair)))
        values["ssim, inside"].append(
            float(structural_similarity_index_measure(*pair, **usual)[1][..., 5:-5, 5:-5].mean())
        )
answer.write_text(json.dumps(values))
