"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

From = Annotated[str | None, arg(name="from")]  # where a release or a weight file is fetched from
