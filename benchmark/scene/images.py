"""Image files: half-float EXR for linear radiance, EXR for geometry, 8-bit PNG for masks and images."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Mask, UInt8, UInt32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.untrusted import MAX_SIDE

GRAY = (0.212671, 0.715160, 0.072169)  # luminance of linear R, G, B (CIE XYZ's Y of sRGB primaries, as Mitsuba has it)
Shape = tuple[int, int]  # H, W
_AGAIN = "render or restore it"
_MOST_CHANNELS = 16  # of an EXR: renderers write colour, depth, ids, flow and normals
_MOST_SAMPLES = 1 << 27  # pixels times channels: 512 MB as floats
_BITS_PER_SAMPLE = 258  # number of the tag in a TIFF
_PNG_ERRORS = (SyntaxError, ValueError, LookupError, TypeError, EOFError, struct.error, zlib.error)  # beside OSError


@dataclass(frozen=True, eq=False)
class Geometry:
    """Depth, object ids and flow of a view at an instant."""

    depth: Float32  # [H, W] metres along the optical axis; inf where there is nothing
    ids: UInt32  # [H, W] 0 where nothing moves, otherwise the moving object (scene.json: "instances")
    flow: Float32  # [H, W, 2] motion of the surface point in pixels (x right, y down)


def gray(image: Float32) -> Float32:
    """Return the gray values [...] of linear RGB [..., 3], float32."""
    r, g, b = (np.float32(weight) * image[..., i].astype(np.float32) for i, weight in enumerate(GRAY))
    return np.asarray(r + g + b)  # not a matrix product: its last bit would depend on the machine


def write_exr(path: Path, image: Float32, t_us: float) -> None:
    """Write linear radiance as half-float EXR (ZIP), with its time as the attribute `t_us`.

    Gray [H, W] becomes the channel Y. RGB [H, W, 3] becomes R, G, B and their `gray` Y, so that `read_exr` reads both.
    Raises UserError for values that are not finite or that half floats cannot hold.
    """
    is_image = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not is_image or not np.isfinite(image).all() or np.abs(image).max(initial=0) > 65504:
        found = f"shape {image.shape}, range {np.min(image):g} to {np.max(image):g}"
        kind = "RGB" if image.ndim == 3 else "gray"
        raise problem(path, f"a finite {kind} image within +-65504", found, "correct the method that rendered it")
    colours = {} if image.ndim == 2 else {c: image[..., i] for i, c in enumerate("RGB")}
    channels = colours | {"Y": image if image.ndim == 2 else gray(image)}
    _write_channels(path, {name: values.astype(np.float16) for name, values in channels.items()}, t_us)


def read_exr(path: Path, shape: Shape | None = None) -> Float32:
    """Read the gray channel of an EXR [H, W] as float32.

    Raises UserError where the file is missing, damaged, not of that `shape` (if given) or has no channel Y.
    """
    found = _read_channels(path, ("Y",), "a gray image (channel Y)", "write one gray channel", shape)
    return found["Y"].astype(np.float32)


def read_rgb(path: Path, shape: Shape | None = None) -> Float32:
    """Read a colour EXR as linear RGB [H, W, 3] float32.

    Raises UserError where the file is missing, damaged, not of that `shape` (if given) or has no channels R, G, B.
    """
    fix = "read a gray image's channel Y"
    found = _read_channels(path, tuple("RGB"), "a colour image (channels R, G, B)", fix, shape)
    return np.stack([found[name].astype(np.float32) for name in "RGB"], axis=-1)


def write_geometry(path: Path, depth: Float32, ids: UInt32, flow: Float32, t_us: float) -> None:
    """Write depth [H, W], ids [H, W] and flow [H, W, 2] as EXR (ZIP): Z, flow.x, flow.y float32, id uint32.

    Raises UserError where the shapes differ, for NaN, and for flow that is not finite.
    """
    shape = np.shape(depth)
    if len(shape) != 2 or np.shape(ids) != shape or np.shape(flow) != (*shape, 2):
        found = f"{shape}, {np.shape(ids)}, {np.shape(flow)}"
        raise problem(path, "shapes (H, W), (H, W), (H, W, 2)", found, "correct the program that made it")
    if np.isnan(depth).any() or not np.isfinite(flow).all():
        raise problem(path, "depth that is no NaN, finite flow", "other values", "correct the program that made it")
    floats = {"Z": depth, "flow.x": flow[..., 0], "flow.y": flow[..., 1]}
    channels: dict[str, NDArray[Any]] = {name: values.astype(np.float32) for name, values in floats.items()}
    _write_channels(path, {**channels, "id": ids.astype(np.uint32)}, t_us)


def read_geometry(path: Path) -> Geometry:
    """Read the file that `write_geometry` wrote. Raises UserError where it is missing, damaged or lacks a channel."""
    names = ("Z", "id", "flow.x", "flow.y")
    found = _read_channels(path, names, f"geometry (channels {', '.join(names)})", "make the scene again", None)
    flow = np.stack([found["flow.x"], found["flow.y"]], axis=-1)
    return Geometry(found["Z"].astype(np.float32), found["id"].astype(np.uint32), flow.astype(np.float32))


def _write_channels(path: Path, channels: Mapping[str, NDArray[Any]], t_us: float) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "t_us": float(t_us)}
    with atomic_path(path) as part:
        file = OpenEXR.File(header, {name: np.ascontiguousarray(v) for name, v in channels.items()})
        try:
            file.write(str(part))
        except RuntimeError as e:  # what the system said is in the text only
            fix = "free some disk space, or choose another folder"
            raise problem(path, "a file that can be written", str(e), fix) from e


def read_channels(path: Path) -> dict[str, NDArray[Any]]:
    """Read all channels of an EXR by name, each [H, W] in the type that the file has.

    Raises UserError where the file is missing or damaged.
    """
    return _read_channels(path, (), "an EXR image", _AGAIN, None)


def _read_channels(
    path: Path, names: tuple[str, ...], what: str, fix: str, shape: Shape | None
) -> dict[str, NDArray[Any]]:
    """Return channels by name [H, W], in the type that the file has; all of them if there are no `names`."""
    import OpenEXR

    if not path.is_file():
        raise problem(path, "an EXR image", "no such file", _AGAIN)
    try:
        with OpenEXR.File(str(path), header_only=True) as f:
            _check_headers(path, [part.header for part in f.parts], shape)
        with OpenEXR.File(str(path), separate_channels=True) as f:
            channels = f.channels()
            if not set(names) <= set(channels):
                raise problem(path, what, f"channels {sorted(channels)}"[:200], fix)
            found = {name: np.asarray(channels[name].pixels) for name in names or channels}
    except (RuntimeError, ValueError, TypeError, LookupError, MemoryError) as e:  # cut-off files raise the first two
        raise problem(path, "an EXR image", f"damaged data ({str(e)[:200]})", _AGAIN) from None
    for name, values in found.items():
        if values.shape != next(iter(found.values())).shape or shape not in (None, values.shape):
            raise problem(path, what, f"{name} of shape {values.shape}, another than the image's", fix)
    return found


def _check_headers(path: Path, headers: Sequence[Mapping[str, Any]], shape: Shape | None) -> None:
    """Raise UserError unless the first part has that shape, and none is too large to decode: all of them are.

    A window that is shifted, or another one to display, says that the pixels belong elsewhere: other programs would
    show another image than the one that is scored.
    """
    samples = 0
    for i, header in enumerate(headers):
        data, display = (_window(header[f"{name}Window"]) for name in ("data", "display"))
        (x0, y0), (x1, y1) = data
        found = y1 - y0 + 1, x1 - x0 + 1
        _check_size(path, found, None if i else shape)
        if data != display or (x0, y0) != (0, 0):
            expected = f"a data window and a display window from (0, 0) to ({found[1] - 1}, {found[0] - 1})"
            fix = "write the image without an offset or a crop"
            raise problem(path, expected, f"{data[0]} to {data[1]} and {display[0]} to {display[1]}", fix)
        if (channels := len(header["channels"])) > _MOST_CHANNELS:
            fix = "write the channel Y alone"
            raise problem(path, f"an image of at most {_MOST_CHANNELS} channels", str(channels), fix)
        samples += found[0] * found[1] * channels
    _check_samples(path, samples)


def _window(corners: Any) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first and the last pixel (x, y) of a header's window."""
    (x0, y0), (x1, y1) = (map(int, corner) for corner in corners)
    return (x0, y0), (x1, y1)


def _check_size(path: Path, found: Shape, shape: Shape | None) -> None:
    if not all(0 < side <= MAX_SIDE for side in found):
        raise problem(path, f"an image of at most {MAX_SIDE}x{MAX_SIDE} pixels", _size(found), _AGAIN)
    if shape is not None and found != shape:
        raise problem(path, f"an image of {_size(shape)} pixels", _size(found), _AGAIN)


def _check_samples(path: Path, samples: int) -> None:
    if samples > _MOST_SAMPLES:
        raise problem(path, f"an image of at most {_MOST_SAMPLES} samples in all its channels", str(samples), _AGAIN)


def _size(shape: Shape) -> str:
    return f"{shape[1]}x{shape[0]}"


def write_png(path: Path, image: UInt8) -> None:
    """Write 8-bit gray [H, W] or RGB [H, W, 3] as PNG."""
    from PIL import Image

    with atomic_path(path) as part:
        Image.fromarray(image).save(part)


def read_png(path: Path, shape: Shape | None = None) -> UInt8:
    """Read an 8-bit PNG, gray [H, W] or RGB [H, W, 3].

    Raises UserError where it is missing, damaged, foreign, or not of that `shape` [H, W] (if given).
    """
    return _read_png(path, "an 8-bit gray or RGB PNG image", shape, ("L", "RGB"))


def _read_png(path: Path, what: str, shape: Shape | None, modes: tuple[str, ...] = ()) -> UInt8:
    """Return a PNG of one of `modes`, or without them any as 8-bit gray. Its size is checked before it is decoded."""
    from PIL import Image

    try:
        with Image.open(path, formats=("PNG",)) as image:
            _check_size(path, (image.height, image.width), shape)
            _check_samples(path, image.height * image.width * len(image.getbands()))
            if modes and ((deep := is_deep(image)) or image.mode not in modes):
                raise problem(path, what, f"mode {image.mode}" + (", of more bits" if deep else ""), _AGAIN)
            return np.asarray(image if modes else image.convert("L"))
    except FileNotFoundError:
        raise problem(path, what, "no such file", _AGAIN) from None
    except (OSError, *_PNG_ERRORS, Image.DecompressionBombError, Image.DecompressionBombWarning) as e:
        raise problem(path, what, f"damaged data ({str(e)[:200]})", _AGAIN) from None


def is_deep(image: Any) -> bool:
    """Return whether an opened image has more than 8 bits a channel: Pillow gives 16 of RGB the mode of 8, and cuts."""
    bits = getattr(image, "tag_v2", {}).get(_BITS_PER_SAMPLE, ())  # of a TIFF; a PNG's are in the format of its data
    return max(bits, default=8) > 8 or ";16B" in str(image.tile)


def write_mask(path: Path, mask: Mask) -> None:
    """Write a mask [H, W] as 8-bit PNG (0 and 255)."""
    write_png(path, mask.astype(np.uint8) * 255)


def read_mask(path: Path, shape: Shape | None = None) -> Mask:
    """Read a mask [H, W]. Raises UserError where it is missing, damaged, or not of that `shape` (if given)."""
    return _read_png(path, "a mask image", shape) > 127


def encode_srgb(image: NDArray[np.floating[Any]]) -> UInt8:
    """Return linear radiance as sRGB-encoded 8 bit, clipped to [0, 1]: linear images are shown to people this way."""
    x = np.clip(np.nan_to_num(image), 0.0, 1.0)
    encoded = np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4, where=x > 0, out=np.zeros_like(x)) - 0.055
    )
    return np.asarray(np.rint(encoded * 255), dtype=np.uint8)


def decode_srgb(image: UInt8) -> Float32:
    """Return the linear radiance of an sRGB-encoded 8-bit image: the inverse of `encode_srgb`."""
    x = image / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)
