"""Warming up compiles all that a fit runs, and leaves no trace in what the fit gives."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_scenes import random_splats, views
from toy_fits import WORLD, method
from toy_fits import request as request_for

from spike4dgs.baselines.recipes import PARTS, RECIPES
from spike4dgs.benchmark.method import Budget, FitRequest
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.splat import render

SHORT = Budget(scale=0.005)
CHILD = """
import gc
from splat_scenes import random_splats, views
from toy_world import ToyWorld
from spike4dgs.benchmark.method import Budget, FitRequest, find_methods
from spike4dgs.method.splat import render
from spike4dgs.method.splat.kernels import project
from spike4dgs.method.splat.kernels.raster import raster_kernels
from spike4dgs.method.splat.kernels.vector_ir import host_lanes

render(random_splats(5), views(1))
used = [project.project_forward, raster_kernels(host_lanes(), 1)[0]]
print([sum(k.stats.cache_misses.values()) for k in used])

def compiled():
    found = [d for d in gc.get_objects() if type(d).__module__ == "numba.core.registry" and hasattr(d, "py_func")]
    return {(d.py_func.__module__, d.py_func.__qualname__, str(s)) for d in found for s in d.overloads}

METHODS = find_methods()
world = ToyWorld(width=48, height=30, n_ticks=120, side=2)
_ = world.training.streams
for name in NAMES:
    METHODS[name].warm_up(FitRequest())
before = compiled()
assert before
for name in NAMES:
    METHODS[name].fit(world.training, FitRequest(Budget(scale=0.004))).render(world.held_out, 1000.0)
print(sorted(compiled() - before))
"""


@pytest.fixture(scope="module")
def second() -> subprocess.CompletedProcess[str]:
    """What a second process says of the kernels that the first has, and of a fit's after warming up."""
    render(random_splats(5), views(1))
    code = CHILD.replace("NAMES", repr(["tfi+4dgs", "tfp+d3dgs", "tfp+4dgs+spss", "spike4dgs-x"]))
    support = str(Path(__file__).resolve().parents[1] / "support")
    program = f"import sys; sys.path.insert(0, {support!r})\n{code}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done


def test_a_second_process_compiles_nothing(second: subprocess.CompletedProcess[str]) -> None:
    """The kernels come from numba's cache, also those that exist once per number of channels."""
    assert second.stdout.splitlines()[0] == "[0, 0]"


@pytest.mark.slow
def test_a_fit_compiles_nothing_after_it(second: subprocess.CompletedProcess[str]) -> None:
    assert second.stdout.splitlines()[1] == "[]" and "warm-up" not in second.stderr


@pytest.mark.parametrize("name", ["tfp+4dgs", "dy-spikegs", "tfp+d3dgs"])
def test_random_states_stay_as_they_are(name: str) -> None:
    recipe = RecipeMethod(next(r for r in RECIPES if r.name == name), PARTS)
    torch.manual_seed(3)
    np.random.seed(3)
    state, of_numpy = torch.get_rng_state(), np.random.get_state()[1].copy()
    recipe.warm_up(FitRequest())
    assert torch.equal(state, torch.get_rng_state())
    np.testing.assert_array_equal(np.random.get_state()[1], of_numpy)


def test_a_fit_gives_the_same_bits_with_it_and_without() -> None:
    images = []
    for warm in (False, True):
        fresh = method("hexplane")
        if warm:
            fresh.warm_up(request_for(1))
        images.append(fresh.fit(WORLD.training, request_for(1, budget=SHORT)).render(WORLD.held_out, 3000.0))
    np.testing.assert_array_equal(images[0], images[1])


def test_once_a_process_is_enough() -> None:
    notes: list[str] = []
    request = FitRequest(progress=lambda done, total, note="": notes.append(note))
    recipe = method("static")
    recipe.warm_up(request)
    recipe.warm_up(request)
    assert notes == ["compilation"]
