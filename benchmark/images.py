"""Image files: half-float EXR for linear radiance, 8-bit PNG for masks and pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path

Float32 = NDArray[np.float32]


def write_exr(path: Path, image: Float32, t_us: float) -> None:
    """Write gray linear radiance [H, W] as half-float EXR (channel Y, ZIP), with its time as the attribute `t_us`.

    Raises UserError for values that are not finite or that half floats cannot hold.
    """
    import OpenEXR

    if image.ndim != 2 or not np.isfinite(image).all() or np.abs(image).max(initial=0) > 65504:
        found = f"shape {image.shape}, range {np.min(image):g} to {np.max(image):g}"
        raise problem(path, "a finite gray image within +-65504", found, "correct the method that rendered it")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "t_us": float(t_us)}
    with atomic_path(path) as part:
        OpenEXR.File(header, {"Y": np.ascontiguousarray(image, dtype=np.float16)}).write(str(part))


def read_exr(path: Path) -> Float32:
    """Read a gray EXR [H, W] as float32. Raises UserError where it is missing, damaged or has no channel Y."""
    import OpenEXR

    if not path.is_file():
        raise problem(path, "an EXR image", "no such file", "render or restore it")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as f:
            channels = f.channels()
            if "Y" not in channels:
                raise problem(
                    path, "a gray image (channel Y)", f"channels {sorted(channels)}", "write one gray channel"
                )
            return np.asarray(channels["Y"].pixels, dtype=np.float32)
    except (RuntimeError, ValueError) as e:  # cut-off files raise either
        raise problem(path, "an EXR image", f"damaged data ({e})", "render or restore it") from None


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Write a mask [H, W] as 8-bit PNG (0 and 255)."""
    from PIL import Image

    with atomic_path(path) as part:
        Image.fromarray(mask.astype(np.uint8) * 255).save(part)


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a mask [H, W]. Raises UserError where it is missing or damaged."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("L")) > 127
    except FileNotFoundError:
        raise problem(path, "a mask image", "no such file", "restore it or make the scene again") from None
    except OSError as e:
        raise problem(path, "a mask image", f"damaged data ({e})", "restore it or make the scene again") from None


def encode_srgb(image: Float32) -> NDArray[np.uint8]:
    """Linear radiance -> sRGB-encoded 8 bit, clipped to [0, 1]: how linear images are shown to people."""
    x = np.clip(np.nan_to_num(image), 0.0, 1.0)
    encoded = np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4, where=x > 0, out=np.zeros_like(x)) - 0.055
    )
    return np.asarray(np.rint(encoded * 255), dtype=np.uint8)
