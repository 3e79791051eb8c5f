"""The clients: what each opens, its pins, its script, our values and how far its may differ from them.

Pins are exact for the client and for what decides whether it runs. `bare` is installed without what it requires: the
lists of SpikeCV and nerfstudio cannot be installed everywhere, and their readers need little of them.
"""

import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import inputs as ours
from inputs import Values

ROOT = Path(__file__).resolve().parents[2]
_LINES = (ROOT / "constraints.txt").read_text().splitlines()
TORCH = next(line for line in _LINES if line.startswith("torch=="))
TORCHVISION = "torchvision==0.28.0"  # goes with TORCH

# float32 of a client for float64 of ours: pixels of images of 40 x 24, rays of a scene of 3 m, values of about 1
_PIXEL, _RAY, _UNIT = 1e-4, 1e-5, 1e-5
_SPIKECV = "https://github.com/Zyj061/SpikeCV"
_COMMIT = "0c5f332b78772dc2c220293c09084b834764f1db"


@dataclass(frozen=True)
class Client:
    """A program that opens our files."""

    name: str
    version: str
    opens: str
    script: str
    ours: Callable[[Path], Values]
    values: dict[str, float]  # what is compared -> the largest difference allowed
    packages: tuple[str, ...] = ()
    bare: tuple[str, ...] = ()
    npm: tuple[str, ...] = ()
    prepare: Callable[[Path, Path, dict[str, str]], tuple[str, dict[str, str]]] | None = None


class Skipped(Exception):
    """A client that this machine cannot have, and why."""


def spikecv_source(inputs: Path, homes: Path, env: dict[str, str]) -> tuple[str, dict[str, str]]:
    """Find SpikeCV's source, which is in no registry: the checkout that SPIKECV names, or a new one from GitHub.

    Return its version and an environment that imports it. One of its own descriptions is copied to the inputs.
    """
    checkout = Path(env["SPIKECV"]) if env.get("SPIKECV") else _clone(homes / "SpikeCV-source", env)
    if not (checkout / "SpikeCV/spkData/load_dat.py").is_file():
        raise Skipped(f"SPIKECV={checkout} is no checkout of {_SPIKECV}")
    head = subprocess.run(["git", "-C", str(checkout), "rev-parse", "HEAD"], capture_output=True, text=True)
    ours.add_sample(inputs, checkout)
    path = f"{checkout}{os.pathsep}{env['PYTHONPATH']}"
    return f"0.1a, commit {head.stdout[:7] or 'unknown'}", {**env, "PYTHONPATH": path}


def _clone(source: Path, env: dict[str, str]) -> Path:
    """Get what its reader needs of SpikeCV, without its data sets and images."""
    if (source / "SpikeCV/spkData/load_dat.py").is_file():
        return source
    git = ["git", "-c", "advice.detachedHead=false"]
    quiet = {**env, "GIT_TERMINAL_PROMPT": "0"}
    for command in (
        [*git, "clone", "--quiet", "--filter=blob:none", "--no-checkout", _SPIKECV, str(source)],
        [*git, "-C", str(source), "sparse-checkout", "set", "--no-cone", "*.py", "*.yaml"],
        [*git, "-C", str(source), "checkout", "--quiet", _COMMIT],
    ):
        done = subprocess.run(command, env=quiet, capture_output=True, text=True, timeout=300)
        if done.returncode != 0:
            shutil.rmtree(source, ignore_errors=True)
            raise Skipped(f"no {_SPIKECV} here; SPIKECV=FOLDER names a checkout ({done.stderr.strip()[-120:]})")
    return source


_SPLATS = {name: _UNIT for name in ("positions", "scales", "opacities", "grays", "rotations")}

CLIENTS = (
    Client(
        "SpikeCV",
        "0.1a",
        "a camera of `export-spikecv`; a stream that lies as in its own data sets, against `import-spikecv`",
        "read_spikecv.py",
        ours.spikecv,
        {"export": 0, "import": 0},
        packages=("numpy==1.26.4", TORCH, "pyyaml==6.0.3", "anyio==4.16.0", "pillow==12.0.0"),
        bare=(TORCHVISION,),
        prepare=spikecv_source,
    ),
    Client(
        "spikezoo",
        "0.2.3.7",
        "a stream of a scene folder",
        "read_spikezoo.py",
        ours.spikezoo,
        {"spikes": 0, "tfp": 1e-6},
        packages=("spikezoo==0.2.3.7", TORCH, TORCHVISION),
    ),
    Client(
        "nerfstudio",
        "1.1.5",
        "`export-nerfstudio`: transforms_*.json by the D-NeRF parser, transforms.json by the other",
        "read_nerfstudio.py",
        ours.d_nerf,
        {"times": 1e-6, "rays": _RAY, "rays, per-image intrinsics": _RAY},
        packages=(
            *("numpy==1.26.4", TORCH, "jaxtyping==0.2.38", "opencv-python-headless==4.10.0.84", "imageio==2.37.0"),
            *("rich==13.9.4", "tensorboard==2.20.0", "viser==0.2.7"),
        ),
        bare=("nerfstudio==1.1.5",),
    ),
    Client(
        "nerfbaselines",
        "1.2.12",
        "`export-nerfstudio` by `load_dataset`",
        "read_nerfbaselines.py",
        ours.nerfbaselines,
        {"points": _PIXEL, "images": 1e-9},
        packages=("nerfbaselines==1.2.12",),
    ),
    *(
        Client(
            f"pycolmap-{version}",
            version,
            "the model of `export-colmap`",
            "read_colmap.py",
            ours.colmap,
            {"points": 1e-9},
            packages=(f"pycolmap=={version}", "numpy==2.4.6"),
        )
        for version in ("4.2.1", "3.11.1")
    ),
    Client(
        "gsply", "0.4.6", "the files of `export-ply`", "read_gsply.py", ours.splats, _SPLATS, packages=("gsply==0.4.6",)
    ),
    Client(
        "fourdgs",
        "0.6.0",
        "the files of `export-ply`, converted to a .4dgs, written and read",
        "read_fourdgs.py",
        ours.container,
        # Its container rounds: positions (profile `fine`) to 0.02 of the median radius, 0.29 m here; alpha to 8 bits.
        {
            "positions": _UNIT,
            "opacities": _UNIT,
            "positions, written and read": 0.02 * 0.29,
            "opacities, written and read": 1 / 255,
        },
        packages=("fourdgs==0.6.0",),
    ),
    Client(
        "splat-transform",
        "2.7.1",
        "the files of `export-ply`, converted to .csv",
        "read_splat_transform.py",
        ours.splats,
        _SPLATS,
        npm=("@playcanvas/splat-transform@2.7.1",),
    ),
    Client(
        "torchmetrics",
        "1.9.0",
        "pairs of images",
        "read_torchmetrics.py",
        ours.metrics,
        {"psnr": 1e-5, "ssim, inside": 1e-6},
        packages=("torchmetrics==1.9.0", TORCH),
    ),
    Client(
        "mlcroissant",
        "1.1.1",
        "croissant.json of a scene folder",
        "read_mlcroissant.py",
        ours.croissant,
        {"targets": 0, "images": 0, "times": 0, "errors": 0},
        packages=("mlcroissant==1.1.1",),
    ),
)
