"""`view`: a fitted model in the browser."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.viewing.content import open_content
from spike4dgs.method.viewing.viewer import Viewer, need_viser


def view(
    model: Positional[Path],
    *,
    scene: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    allow_gaps: bool = False,
    device: str = "cpu",
) -> int:
    """Show a fitted model in the browser, from any view and at any time; with --scene also its spikes. Ctrl-C ends it.

    Args:
        model: A model saved by run-benchmark, OUT/models/METHOD/SCENE.safetensors, or by fit, OUT/model.safetensors.
        scene: Folder of the model's scene, to show spike rates and errors at the training cameras too.
        host: Address to serve at; 0.0.0.0 lets other machines connect.
        port: Port to serve at, or the next free one if it is taken.
        allow_gaps: Accept a recording with gaps.
        device: auto, cpu or cuda.
    """
    need_viser()
    viewer = Viewer(open_content(load_model(model, choose_device(device)), scene, allow_gaps), host, port)
    print(f"{viewer.content.saved.title}: {viewer.url} (Ctrl-C ends it)", flush=True)
    try:
        viewer.run()
    except KeyboardInterrupt:
        return 0
    finally:
        viewer.stop()
    return 0
