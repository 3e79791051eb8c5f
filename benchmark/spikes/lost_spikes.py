"""Lost spikes: what a pixel may have fired in ticks that the recording lacks and `repair` has filled.

What was filled is certain or in doubt, tick by tick (`likely_spikes`). A certain spike is as good as recorded. Let two
of a pixel's certain spikes be T ticks apart, with k - 1 others between them, and D lost ticks in doubt that were filled
with m spikes. The pixel gathered k thresholds or more, and no more than k + D, for a tick holds one spike at most. Of
its rate two estimates are known:

    (k + m) / T,    right under constant light, where hardly any gap is filled with a wrong number;
    k / (T - D),    what was recorded over the time of the recording, right on average whatever the light does.

Both spikes are known to the tick, and a spike too many or too few was filled now and then. So under constant light the
rate lies

    between max(k, k + m - 1) / (T + 1) and min(k + D, k + m + 1) / (T - 1).

A spike in doubt is known to no tick: it ends no span. Where no tick is lost all this is the rate of a whole recording,
to the last bit. In the kernels `lost`, `words` and `before` are those of `SpikeTrains`.
"""

from __future__ import annotations

from spike4dgs.benchmark.arrays import Int64, UInt32, UInt64
from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.trains import count_before


@kernel
def doubtful_between(lost: Int64, words: UInt64, before: UInt32, pixel: int, first: int, last: int) -> tuple[int, int]:
    """Return how many ticks in [first, last) are in doubt for a pixel, and with how many spikes they were filled.

    Kernels look at `lost` themselves first: where nothing is lost, a call would take longer than the rest.
    """
    a, b = lost[first], lost[last]
    if a == b:
        return 0, 0
    return (
        count_before(words[0], before[0], pixel, b) - count_before(words[0], before[0], pixel, a),
        count_before(words[1], before[1], pixel, b) - count_before(words[1], before[1], pixel, a),
    )


@kernel
def fewest(k: int, filled: int, doubtful: int) -> int:
    """Return the thresholds that a pixel gathered at least: k are certain, beside those filled in `doubtful` ticks."""
    return k + max(filled - 1, 0) if doubtful > 0 else k


@kernel
def most(k: int, filled: int, doubtful: int) -> int:
    """Return the thresholds that a pixel gathered at most."""
    return k + min(filled + 1, doubtful)
