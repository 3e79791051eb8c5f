"""Weights of the networks that are trained here: half-float safetensors with a card of what they were trained on.

Each network states its facts as a `WeightKind`. Files are found, checked and read by `benchmark.weights`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, sha256_file
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.untrusted import shown
from spike4dgs.benchmark.weights import FoundWeights, NamedWeights, find_weights, load_into, read_header, read_tensors

if TYPE_CHECKING:
    from torch import nn

    NetworkT = TypeVar("NetworkT", bound=nn.Module)

CardT = TypeVar("CardT")


@dataclass(frozen=True)
class WeightKind(Generic[CardT]):
    """The facts that tell one network's weight files from another's, and their reading and writing."""

    network: str  # its name in messages
    schema: str  # the only key of the metadata: two would be written in any order
    card: type[CardT]  # dataclass of plain values, and the tuple `trained_on`: where weights come from
    variable: str  # the environment variable that names a file in place of the shipped one
    shipped: Path
    command: str  # the command that trains it

    @property
    def fix(self) -> str:
        """The advice about a file that is missing, damaged or foreign."""
        return f"train it with `spike4dgs {self.command}`, or set {self.variable} to a file that this command wrote"

    @property
    def description(self) -> str:
        """The phrase for such a file in messages."""
        return f"weights of {self.network}"

    def in_use(self) -> FoundWeights:
        """Return the file that the environment variable names, else the shipped one.

        Raises WeightsError where there is no such file.
        """
        return find_weights(NamedWeights(self.description, self.variable, self.fix, self.shipped))

    def check(self) -> Path:
        """Return the path of the file in use, its card read. Raises UserError where it is missing or damaged."""
        path = self.in_use().path
        self.read_card(path)
        return path

    def save(self, path: Path, network: nn.Module, card: CardT) -> str:
        """Write the network's parameters as half floats, atomically, and return the file's SHA-256.

        Raises UserError where a parameter is not finite as a half float: the file would give NaN.
        """
        import safetensors.torch
        import torch

        tensors = {k: v.detach().to("cpu", torch.float16).contiguous() for k, v in network.state_dict().items()}
        if bad := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
            raise problem(
                path, "finite parameters", f"NaN or more than 65504 in {bad[0]}", "go back to an earlier step"
            )
        fields: dict[str, Any] = asdict(card)  # type: ignore[call-overload]
        with atomic_path(path) as part:
            safetensors.torch.save_file(tensors, part, metadata={self.schema: json.dumps(fields, sort_keys=True)})
        return sha256_file(path)

    def read_card(self, path: Path) -> CardT:
        """Return the file's card. Raises UserError for a damaged or foreign file. torch is not imported."""
        text = read_header(path, self.schema, self.description, self.fix)
        try:
            fields: dict[str, Any] = parse_json(text)
            seen = fields["trained_on"]
            if not isinstance(seen, list) or not all(isinstance(name, str) for name in seen):
                raise ValueError(f"trained_on is {shown(seen)}, no list of texts")
            card = self.card(**{**fields, "trained_on": tuple(seen)})
        except (LookupError, TypeError, ValueError) as e:
            raise problem(path, self.description, f"damaged data in its card ({e})", self.fix) from None
        return card

    def fill(self, path: Path, network: NetworkT, shape: str) -> NetworkT:
        """Give `network`, which may be on torch's device `meta`, the file's parameters as float32 on the CPU.

        It is left ready to run, without gradients. Raises UserError where the file is damaged or its tensors are not
        those of a network of this `shape`, such as "width 8".
        """
        state = read_tensors(path, self.description, self.fix)
        return load_into(network, state, path, f"parameters of {shape}", self.fix)


@dataclass(frozen=True)
class ConfigCard:
    """The card of a network that has named configurations."""

    config: str  # name of the configuration
    steps: int
    seed: int
    trained_on: tuple[str, ...]  # shards, as ID@SHA256


ConfigCardT = TypeVar("ConfigCardT", bound=ConfigCard)


@dataclass(frozen=True)
class ConfigWeights(WeightKind[ConfigCardT]):
    """The weight files of a network that has named configurations."""

    configs: Collection[str] = ()  # their names

    def read_card(self, path: Path) -> ConfigCardT:
        """Return the file's card. Raises UserError also for an unknown configuration, and steps that are no number."""
        card = super().read_card(path)
        if card.config not in tuple(self.configs):  # a foreign one may be no key
            raise problem(path, f"a configuration of {', '.join(self.configs)}", shown(card.config), self.fix)
        if type(card.steps) is not int or type(card.seed) is not int:
            found = f"{shown(card.steps)} and {shown(card.seed)}"
            raise problem(path, "whole numbers as steps and seed", found, self.fix)
        return card

    def load(self, path: Path, device: str, build: Callable[[str], NetworkT]) -> NetworkT:
        """Return the file's network, which `build` makes of its configuration, on `device`, ready to run.

        Raises UserError for a damaged or foreign file.
        """
        import torch

        config = self.read_card(path).config
        with torch.device("meta"):  # parameters need not be drawn at random first
            network = build(config)
        return self.fill(path, network, f"configuration {config}").to(device)
