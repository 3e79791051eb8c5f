from __future__ import annotations

from dataclasses import replace

import pytest

from spike4dgs.generators.scene_check import (
    CHANGE,
    EQUAL,
    MOST_OF_BLOCKS,
    MOST_OF_CAMERA,
    NOISE,
    Comparison,
    beyond_noise,
    to_markdown,
)
from spike4dgs.generators.scene_differences import Difference

FLOOR = Difference(0.17, 1e-3, 4e-3, 5e-3, 1e-3, 4e-3)


def compared(
    found: Difference, noise: Difference = FLOOR, facts: tuple[str, ...] = (), same: bool = False
) -> Comparison:
    return Comparison("car-0-tiny", "a" * 64, ("a" if same else "b") * 64, facts, {"cam_00": found}, {"cam_00": noise})


def test_the_verdict_is_by_revision_then_facts_then_noise() -> None:
    assert compared(FLOOR, same=True).verdict == EQUAL
    assert compared(FLOOR).verdict == NOISE and compared(FLOOR).reasons == []
    assert compared(FLOOR, facts=("n_ticks: 80, reference 400",)).verdict == CHANGE
    assert compared(Difference(0, 0, 0, 0, 0, 0)).verdict == NOISE


LIMITS = MOST_OF_CAMERA | MOST_OF_BLOCKS


@pytest.mark.parametrize("name", LIMITS)
def test_each_measure_alone_tells_a_change(name: str) -> None:
    values = {field: getattr(FLOOR, field) for field in LIMITS}
    for factor, verdict in ((0.99, NOISE), (1.01, CHANGE)):
        found = compared(Difference(**{**values, name: values[name] * LIMITS[name] * factor}))
        assert found.verdict == verdict and len(found.reasons) == (verdict == CHANGE)


def test_blocks_count_over_all_cameras_and_bits_by_camera() -> None:
    def of_three(name: str, factor: float) -> list[str]:
        noise = {f"cam_{i}": FLOOR for i in range(3)}
        return beyond_noise(noise | {"cam_1": replace(FLOOR, **{name: factor * getattr(FLOOR, name)})}, noise)

    assert of_three("bits", 1.3) == [
        "cam_1: spike bits differ 1.3 times as much as by noise; up to 1.25 times is noise"
    ]
    assert of_three("truth_block_rms", 2.6) == []  # sqrt((1 + 1 + 2.6^2) / 3) = 1.71
    (line,) = of_three("truth_block_rms", 2.8)
    assert line.startswith("all cameras: truths in blocks differ 1.81 times")
    (line,) = of_three("spikes_block_max", 2.6)
    assert line.startswith("all cameras: spikes per tick in the worst block differ 2.6 times")


def test_without_noise_any_difference_is_a_change() -> None:
    still = Difference(0, 0, 0, 0, 0, 0)
    found = compared(Difference(1e-4, 0, 0, 0, 0, 0), still)
    assert found.verdict == CHANGE and "spike bits differ and not by noise" in found.reasons[0]
    assert compared(Difference(0, 0, 0), Difference(0, 0, 0)).verdict == NOISE


def test_the_report_has_the_figures_beside_those_of_noise() -> None:
    text = to_markdown([compared(Difference(0.5, 1e-3, 4e-3, 0.1, 1e-3, 4e-3))])
    assert "| car-0-tiny | change of the world | aaaaaaaaaaaaaaaa | bbbbbbbbbbbbbbbb |" in text
    assert "| cam_00 | 50.000% | 17.000% | 20.0 | 46.0 | 1.00e-03 | 1.00e-03 | 1.00e-03 | 1.00e-03 |" in text
    assert "- cam_00: spike bits differ 2.94 times as much as by noise; up to 1.25 times is noise" in text
    assert to_markdown([compared(FLOOR, same=True)]).count("## car-0-tiny: equal") == 1
