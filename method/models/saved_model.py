"""`load_model`: a model that a run saved, ready to render the images that it rendered then, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import Model
from spike4dgs.benchmark.plugins import find_plugins
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.models.model_file import FIX, ModelFile, read_model
from spike4dgs.method.torch_state import check_device

# Entry points, of this package too: mappings from kind to a reader (file, device) -> model. Its class writes that kind
# in `save`.
GROUP = "spike4dgs.models"
_SHOWN_TIMES = (0.1, 0.5, 0.9)  # of a clip
KINDS: dict[str, Callable[[ModelFile, str], Model]] = {FittedModel.KIND: FittedModel.from_file}


@dataclass(frozen=True, eq=False, repr=False)
class SavedModel(Shown):
    """A model from a file, and its provenance."""

    model: Model
    provenance: Provenance

    @property
    def title(self) -> str:
        """Method and scene."""
        return f"{self.provenance.name} on {self.provenance.scene}"

    def _about(self) -> str:
        about = self.provenance
        made = f"budget {about.budget}, fitted in {about.fit_seconds:.1f} s on {about.device}"
        return f"{self.title}: {made}; {self.model!r}"

    def _thumbnails(self) -> Iterator[tuple[str, UInt8]]:
        """Yield renders of the first training camera at three times of the clip."""
        if self.provenance.cameras:
            for share in _SHOWN_TIMES:
                t_us = share * self.provenance.duration_us
                image = self.model.render(self.provenance.cameras[0], t_us)
                yield f"{self.provenance.cameras[0].id} at {t_us / 1e3:.3g} ms", encode_srgb(image)


def load_model(path: Path | str, device: str = "cpu") -> SavedModel:
    """Return the model of a file, on `device`.

    Raises UserError where the file is missing, damaged, foreign, or of a version that this one cannot read, and where
    the device is not there.
    """
    check_device(device)
    file = read_model(Path(path))
    readers = find_plugins(GROUP, "model", lambda *_: None)
    if file.kind not in readers:
        raise problem(path, f"a model of kind {', '.join(readers)}", repr(file.kind), FIX)
    try:
        return SavedModel(readers[file.kind].value(file, device), file.provenance)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as e:  # another version
        found = f"one that this version cannot read ({type(e).__name__}: {e})"
        raise problem(path, "a fitted model", found[:400], FIX) from None
