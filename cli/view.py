"""`view`: a fitted model in the browser."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

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
    """Show a fitted model in the browser: camera, time, and the spikes beside it. Ctrl-C ends it.

    Args:
        model: A model that run-benchmark has saved, OUT/models/METHOD/SCENE.safetensors, or fit, OUT/model.safetensors.
        scene: The folder of its scene: also shows spike rates and errors at the training cameras.
        host: Address to serve at; 0.0.0.0 admits other machines.
        port: Port to serve at; the next free one where it is taken.
        allow_gaps: Accept a recording with gaps.
        device: cpu or cuda.
    """
    need_viser()
    viewer = Viewer(open_content(load_model(model, device), scene, allow_gaps), host, port)
    print(f"{viewer.content.saved.title}: {viewer.url} (Ctrl-C ends it)", flush=True)
    try:
        viewer.run()
    except KeyboardInterrupt:
        return 0
    finally:
        viewer.stop()
    return 0
