"""Objects as an interpreter and a notebook show them: one short line, and a card with thumbnails."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping
from html import escape
from typing import TypeVar

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError

MOST = 400  # characters of a repr
_THUMBNAIL = 160  # pixels across
_QUALITY = 80  # of JPEG
V = TypeVar("V")


def shortened(text: str) -> str:
    """Return a text of at most `MOST` characters.

    >>> shortened(f"<{'a' * 1000}>")[-6:], len(shortened("a" * 1000))
    ('aaaa…>', 400)
    """
    return text if len(text) <= MOST else f"{text[: MOST - 2]}…>"


class Shown:
    """A base of objects that say what they are in a line, and show what they look like in a notebook."""

    @property
    def _kind(self) -> str:
        return type(self).__name__

    def _about(self) -> str:
        """Return a name, and facts after a colon."""
        raise NotImplementedError

    def _thumbnails(self) -> Iterable[tuple[str, UInt8]]:
        """Yield images [H, W] of 8-bit sRGB with a word for each."""
        return ()

    def __repr__(self) -> str:
        return shortened(f"<{self._kind} {self._about()}>")

    def _repr_html_(self) -> str:
        try:
            images = "".join(map(_figure, self._thumbnails()))
        except UserError as e:  # a damaged file, say
            images = escape(str(e))
        name, _, facts = self._about().partition(": ")
        return f"<div><b>{self._kind} {escape(name)}</b><br>{escape(facts)}</div><div>{images}</div>"


def _figure(shown: tuple[str, UInt8]) -> str:
    """Return an image of at most `_THUMBNAIL` pixels across as HTML, with its word."""
    from PIL import Image

    label, image = shown
    step = -(-image.shape[1] // _THUMBNAIL)
    data = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).reduce(step).save(data, "JPEG", quality=_QUALITY)
    source = f"data:image/jpeg;base64,{base64.b64encode(data.getvalue()).decode()}"
    style = "display:inline-block;margin:4px;text-align:center;font-size:small"
    word = escape(label)
    return f'<span style="{style}"><img src="{source}" width="{_THUMBNAIL}" alt="{word}"><br>{word}</span>'


class Table(dict[str, V]):
    """A mapping of named things that shows their names alone.

    >>> Table("cameras", {"cam_00": object(), "cam_01": object()})
    <2 cameras: cam_00, cam_01>
    """

    def __init__(self, kind: str, values: Mapping[str, V]) -> None:
        super().__init__(values)
        self.kind = kind

    def __repr__(self) -> str:
        return shortened(f"<{len(self)} {self.kind}: {', '.join(self)}>")

    def __reduce__(self) -> tuple[type[Table[V]], tuple[str, dict[str, V]]]:
        return type(self), (self.kind, dict(self))
