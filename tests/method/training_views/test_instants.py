"""Corrections of means over time against closed forms: light that is a polynomial in time."""

import math
import threading
import weakref
from collections.abc import Iterator, Sequence

import pytest
import torch
from hard_case import HardCase
from torch import Tensor

from spike4dgs.method.training_views.instants import REACH, Corrections, correction, node, recount
from spike4dgs.method.training_views.training_images import Spans

SHAPE = (2, 12, 16)


def random(low: float, high: float, seed: int) -> Tensor:
    return low + (high - low) * torch.rand(SHAPE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def polynomial(*coefficients: float) -> list[Tensor]:
    """Polynomials in ticks from the instant, another at each pixel."""
    return [c * random(0.5, 1.5, seed) for seed, c in enumerate(coefficients)]


def light(p: list[Tensor], ticks: float) -> Tensor:
    return sum((c * ticks**k for k, c in enumerate(p)), torch.zeros(SHAPE, dtype=torch.float64))


def mean(p: list[Tensor], a: Tensor, b: Tensor) -> Tensor:
    """The exact mean over [a, b]."""
    return sum(((c * (b ** (k + 1) - a ** (k + 1)) / (k + 1)) for k, c in enumerate(p)), torch.zeros(())) / (b - a)


def corrected(p: list[Tensor], a: Tensor, b: Tensor, half: float) -> Tensor:
    far, spans = node(half), Spans(torch.stack([a, b], 1), half, 100)
    return mean(p, a, b) + correction(light(p, -far), light(p, 0.0), light(p, far), spans)


@pytest.mark.parametrize("half", [5.0, 10.0])
def test_quadratic_light_over_any_span_becomes_the_instant(half: float) -> None:
    p, a, b = polynomial(0.5, 0.01, -2e-3), random(-2, -0.2, 7) * half, random(0.1, 1.9, 8) * half
    torch.testing.assert_close(corrected(p, a, b, half), light(p, 0.0))
    assert (mean(p, a, b) - light(p, 0.0)).abs().max() > 1e-3, "without it they differ"


@pytest.mark.hard_case(
    asked="instants from means of light of the fifth power in time, over 10 and 20 ticks",
    twin="the light in closed form", unit="of radiance", tolerance=1e-8,
)  # fmt: skip
def test_light_of_the_fifth_power(hard_case: HardCase) -> None:
    p = polynomial(0.5, 0.01, -2e-3, 1e-4, 3e-5, -2e-6)
    for half in (5.0, 10.0):
        ends = torch.full(SHAPE, half, dtype=torch.float64)
        hard_case.close(corrected(p, -ends, ends, half).numpy(), light(p, 0.0).numpy(), f"{2 * half:g} ticks")


def test_a_span_that_reaches_far_is_not_followed_to_its_end() -> None:
    p, far = polynomial(0.5, 0.01), random(20, 60, 9)
    around = [light(p, t) for t in (-node(5.0), 0.0, node(5.0))]
    followed, at_most = (
        correction(*around, Spans(torch.stack([-end, end], 1), 5.0, 99))
        for end in (far, torch.full(SHAPE, 5.0 * REACH))
    )
    torch.testing.assert_close(followed, at_most)


def test_still_light_needs_no_correction() -> None:
    still = random(0, 1, 1)
    assert not correction(still, still, still, Spans(torch.stack([still - 9, still + 5], 1), 5.0, 99)).any()


def test_repeated_corrections_undo_the_mean() -> None:
    """Van Cittert: a model that follows its corrected images arrives where its mean is what was measured."""
    times = torch.arange(-40.0, 41.0, dtype=torch.float64)
    truth, spans = torch.exp(-((times / 14) ** 2)), Spans(torch.tensor([[-10.0, 10.0]]).view(1, 2, 1, 1), 10.0, 99)

    def blurred(signal: Tensor) -> Tensor:
        wide = torch.nn.functional.pad(signal[None], (10, 10), mode="replicate")[0].unfold(0, 21, 1)
        weights = torch.ones(21, dtype=torch.float64)
        weights[[0, -1]] = 0.5
        return wide @ weights / 20

    def instant(model: Tensor) -> Tensor:
        """What Corrections makes of the measured means, by a model [T] that is linear between whole ticks."""

        def around(index: int):
            def views(ticks: float, chosen: object) -> Tensor:
                at = (index + ticks) * torch.ones(1, dtype=torch.float64)
                low = at.floor().clamp(0, 79).long()
                share = (at - low).clamp(0, 1)
                return torch.lerp(model[low], model[low + 1], share).view(1, 1, 1)

            return views

        every = Spans(spans.ends.expand(81, 1, 2, 1, 1), 10.0, 99)
        corrections = Corrections(every, around)
        return measured + torch.stack([corrections.at(k, [0])[0, 0, 0] for k in range(81)])

    measured = blurred(truth)
    first, model = measured.clone(), measured
    for _ in range(4):
        model = instant(model)
    assert (model - truth).abs().max() < 0.3 * (first - truth).abs().max()


def test_corrections_made_ahead_are_those_made_when_asked_for() -> None:
    """Each image is rendered once, by whichever thread comes to it first."""
    rendered: list[tuple[int, int, float]] = []

    def around(index: int):
        def views(ticks: float, chosen: Sequence[int]) -> Tensor:
            rendered.extend((index, v, ticks) for v in chosen)
            return torch.stack([torch.full((2, 2), (index + 2.0) * (v + 1) + 0.01 * ticks**2) for v in chosen])

        return views

    def corrections() -> Corrections:
        lengths = torch.arange(40 * 4 * 2 * 4).view(40, 4, 2, 2, 2) % 13 - 6.0
        return Corrections(Spans(lengths, 5.0, 99), around)

    asked = [(7 * k % 40, [k % 4, (k + 1 + k % 3) % 4]) for k in range(300)]
    alone = corrections()
    expected = [alone.at(*request) for request in asked]
    images = {(index, v) for index, views in asked for v in views}
    once = sorted((*image, ticks) for image in images for ticks in (-node(5.0), 0.0, node(5.0)))
    assert sorted(rendered) == once
    rendered.clear()
    ahead = corrections()
    ahead.begin(iter(asked))
    assert all(torch.equal(ahead.at(*r), e) for r, e in zip(asked, expected, strict=True))
    ahead.stop()
    assert sorted(rendered) == once


def test_who_waits_for_a_correction_makes_the_next_ones() -> None:
    """The thread that works ahead cannot finish the first before the caller has made the others."""
    begun, made_rest = threading.Event(), threading.Event()
    makers: dict[int, str] = {}

    def around(index: int):
        def views(ticks: float, chosen: Sequence[int]) -> Tensor:
            makers[index] = threading.current_thread().name
            if index == 0:
                begun.set()
                assert made_rest.wait(60)
            elif index == 3:
                made_rest.set()
            return torch.full((len(chosen), 2, 2), float(index))

        return views

    corrections = Corrections(Spans(torch.zeros(4, 1, 2, 2, 2), 5.0, 99), around)
    corrections.begin((index, [0]) for index in range(4))
    assert begun.wait(60)
    assert corrections.at(0, [0]).shape == (1, 2, 2)
    caller = threading.current_thread().name
    assert makers == {0: "corrections", 1: caller, 2: caller, 3: caller}
    corrections.stop()


def test_no_more_is_made_ahead_once_stopped() -> None:
    begun, go_on = threading.Event(), threading.Event()
    rendered: list[int] = []

    def around(index: int):
        def views(ticks: float, chosen: Sequence[int]) -> Tensor:
            rendered.append(index)
            begun.set()
            go_on.wait(60)
            return torch.zeros(len(chosen), 2, 2)

        return views

    corrections = Corrections(Spans(torch.zeros(9, 1, 2, 2, 2), 5.0, 99), around)
    corrections.begin((index, [0]) for index in range(9))
    begun.wait(60)
    stopping = threading.Thread(target=corrections.stop)
    stopping.start()
    while not corrections._stopped.is_set():
        pass
    go_on.set()
    stopping.join(60)
    assert rendered == [0, 0, 0], "the one that was begun"
    assert corrections.at(4, [0]).shape == (1, 2, 2), "what was not made ahead is made when asked for"


def test_a_render_that_fails_ahead_fails_where_it_is_asked_for() -> None:
    failed: list[int] = []

    def around(index: int):
        def views(ticks: float, chosen: Sequence[int]) -> Tensor:
            failed.append(index)
            raise ArithmeticError("no such render")

        return views

    corrections = Corrections(Spans(torch.zeros(3, 1, 2, 2, 2), 5.0, 99), around)
    corrections.begin([(1, [0])])
    corrections._thread.join(60)
    assert failed == [1]
    with pytest.raises(ArithmeticError, match="no such render"):
        corrections.at(1, [0])


def test_a_span_holds_the_whole_number_of_spikes_that_comes_nearest_to_the_models_mean() -> None:
    most, one, without, counted = 3.0, 0.0625, 0.5, 0.1
    spikes = torch.tensor([-2.0, -0.2, 0.0, 0.29, 0.4, 0.6, 0.71, 2.0, 3.29, 3.4, 9.0])
    doubts = torch.tensor([most, one, without, counted]).view(1, 4, 1, 1).expand(1, 4, 1, len(spikes)).half()
    found = recount((without + one * spikes)[None, None], doubts)[0, 0]
    nan = math.nan
    expected = one * torch.tensor([nan, 0, 0, 0, nan, nan, 1, 2, 3, nan, nan]) - counted
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0, equal_nan=True)
    assert not recount(torch.full((1, 2, 2), 0.3), torch.zeros(1, 4, 2, 2).half()).any(), "nothing is in doubt"


def test_what_was_not_made_ahead_holds_nothing_after_the_end() -> None:
    """A fit hands in a generator that holds it, with all its images."""

    class Held:
        def requests(self) -> Iterator[tuple[int, list[int]]]:
            for index in range(9):
                yield index, [0]

    held = Held()
    gone = weakref.ref(held)
    corrections = Corrections(Spans(torch.zeros(9, 1, 2, 2, 2), 5.0, 99), lambda index: lambda views: None)  # type: ignore[arg-type,return-value]
    corrections._stopped.set()  # the helper thread makes nothing of it
    requests = held.requests()
    next(requests)
    corrections.begin(requests)
    corrections.stop()
    del held, requests
    assert gone() is None
