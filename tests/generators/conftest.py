"""Fixtures of the tests of `generators`."""

import pytest
from built_worlds import forget_scenes


@pytest.fixture(scope="module", autouse=True)
def no_scenes_of_other_files() -> None:
    """Kernels are those of the file's own scenes, whatever ran before: else each order of files compiles its own."""
    forget_scenes()
