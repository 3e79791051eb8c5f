"""The package on systems other than Linux: what only Linux has is taken away, and the package is imported and used."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CHILD = r"""
import builtins, gc, importlib, io, os, pathlib, shutil, sys, traceback

gc.disable()  # thousands of modules are read, and none of them is garbage

# Libraries look at the system while they load; ours are loaded after it has changed.
import distributed, drjit, fsspec, jsonschema, matplotlib.pyplot, mitsuba, mujoco, numba, psutil, pycolmap, rich.console
import safetensors.torch, scipy.optimize, scipy.spatial, skimage.metrics, torch, tyro, usb.core, usb1, yaml, filelock
import concurrent.futures.process, multiprocessing.popen_fork, multiprocessing.popen_spawn_posix, platformdirs
import numba.cuda.nvvmutils

def use(system):
    only_linux = {"fcntl"} if system == "win32" else set()
    if system == "win32":
        only_linux |= {"resource", "termios", "pwd", "grp"}
    for name in only_linux:
        sys.modules[name] = None  # an import of it is an ImportError
    disk = shutil.disk_usage("/")  # which Windows tells in another way
    shutil.disk_usage = lambda path: disk
    for name in dir(os):
        if name.startswith(("sched_", "posix_")) or name in ("O_DIRECT", "fdatasync", "memfd_create"):
            delattr(os, name)
        elif system == "win32" and name in ("fork", "geteuid", "getuid", "pwrite", "pread", "mkfifo", "statvfs"):
            delattr(os, name)
    psutil.Process.__dict__.get("cpu_affinity") and delattr(psutil.Process, "cpu_affinity")
    if system == "win32":
        psutil.Process.cpu_affinity = lambda self, cpus=None: [0, 1]
    real_open = io.open

    def without_proc(file, *args, **kwargs):
        ours = "psutil" not in sys._getframe(1).f_code.co_filename  # which has other sources on other systems
        if ours and str(file).startswith(("/proc", "/sys")):
            raise FileNotFoundError(2, "No such file or directory", str(file))
        return real_open(file, *args, **kwargs)

    io.open = builtins.open = without_proc
    sys.platform = system

    root = pathlib.Path(sys.argv[1])
    for room in ("benchmark", "method", "baselines", "generators", "leaderboard", "studies", "cli"):
        for path in sorted((root / room).rglob("*.py")):
            name = ".".join(("spike4dgs", *path.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")
            # Mitsuba's variant comes first there; Blender's interpreter runs its script; `__main__` runs.
            tracers = "rendering.wavefront", "rendering.soft_map", "rendering.split_tracer"
            if not name.endswith((*tracers, "blender_script", "__main__")):
                importlib.import_module(name)

    import numpy as np
    from spike4dgs.baselines import make_image
    from spike4dgs.benchmark.environment import available_cores, cpu_name, environment, peak_memory_mb
    from spike4dgs.benchmark.files import locked
    from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
    from spike4dgs.method.splat.kernels.threads import get_threads

    folder = pathlib.Path(sys.argv[2])
    spikes = np.random.default_rng(0).random((60, 20, 24)) < 0.3
    stream = SpikeStream(pack(spikes), 24, 20, 20_000.0)
    assert (stream.window(0, 60) == spikes).all()
    assert np.isfinite(make_image("tfp", stream, 30, 0.3)).all()
    for temporary in (False, True):
        with locked(folder / "x.lock", "x", "free", temporary=temporary):
            pass
    assert not (folder / "x.lock").exists()

    from small_scenes import write_small_scene
    from spike4dgs.benchmark import open_scene
    from spike4dgs.benchmark.release.pack import pack
    from spike4dgs.benchmark.release.scenes import download, open_release
    from spike4dgs.benchmark.release.selection import Selection
    from spike4dgs.benchmark.release.source import Source
    pack([open_scene(write_small_scene(folder / system / "scene"))], folder / system / "release", "1", 10**9)
    source = Source(str(folder / system / "release"))
    for _ in range(2):
        (scene,) = download(source, open_release(source), Selection(), folder / system / "data").folders
    assert (scene / "manifest.json").read_bytes() == (folder / system / "scene/manifest.json").read_bytes()
    assert available_cores() >= 1 and get_threads() >= 1 and cpu_name() and environment("cpu")["cpu"]
    peak_memory_mb("cpu")
    print("imported and used", system, flush=True)

# One process for each system, after the libraries, which take most of the time. Their threads are not in a copy of the
# process: it must not wait for them at its end.
for system in ("darwin", "win32"):
    if (copy := os.fork()) == 0:
        try:
            use(system)
        except BaseException:
            traceback.print_exc()
        sys.stderr.flush()
        os._exit(0)
    os.waitpid(copy, 0)
"""


@pytest.mark.slow
def test_without_what_only_linux_has(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    command = [sys.executable, "-W", "ignore", "-c", CHILD, str(pytestconfig.rootpath), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(pytestconfig.rootpath / "tests/support")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    used = [f"imported and used {system}" for system in ("darwin", "win32")]
    assert done.stdout.splitlines() == used, done.stderr[-3000:]
