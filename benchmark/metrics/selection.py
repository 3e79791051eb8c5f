"""The metrics that a run computes, as `--metrics` names them, and the reasons why the others have no value."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.weights import WeightsError, find_weights

AUTO = "auto"


@dataclass(frozen=True)
class Selection:
    """Metrics to compute, each with the sha256 of the weights it uses (None: it uses none), and why not the others."""

    weights: Mapping[str, str | None]  # metric id -> sha256
    absent: Mapping[str, str]  # metric id -> reason

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The metrics to compute, in the table's order."""
        return tuple(METRICS[i] for i in self.weights)

    def among(self, ids: Collection[str]) -> Selection:
        """Return the selection without metrics that are not in `ids`."""
        return self.without(self.weights.keys() - set(ids), _NOT_ASKED)

    def without(self, ids: Collection[str], reason: str) -> Selection:
        """Return the selection without the metrics in `ids`, for a reason."""
        kept = {i: sha256 for i, sha256 in self.weights.items() if i not in ids}
        return Selection(kept, {**self.absent, **{i: reason for i in self.weights if i in ids}})


_NOT_ASKED = "not asked for"


def select_metrics(names: Sequence[str] = (AUTO,)) -> Selection:
    """Return the metrics that a command line names: `auto` for all that this machine can compute, and metric ids.

    The metrics of linear images are always computed: they need nothing and the ranks rest on them. Raises UserError for
    unknown names, and WeightsError where a metric that is named lacks its weights.
    """
    if unknown := [n for n in names if n not in METRICS and n != AUTO]:
        raise problem("--metrics", f"{AUTO} or ids among {', '.join(METRICS)}", ", ".join(unknown), "correct the ids")
    weights: dict[str, str | None] = {}
    absent: dict[str, str] = {}
    for m in METRICS.values():
        if m.takes != "linear" and m.id not in names and AUTO not in names:
            absent[m.id] = _NOT_ASKED
            continue
        try:
            weights[m.id] = find_weights(m.weights).sha256 if m.weights else None
        except WeightsError as e:
            if m.id in names:
                raise
            absent[m.id] = e.reason
    return Selection(weights, absent)
