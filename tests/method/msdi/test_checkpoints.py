"""Published weights of Fast3R and DUSt3R, and MSDI's own weight files."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from spike4dgs.baselines.starts.dust3r_network import Dust3r, Dust3rShape
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.variants import FIRST_TRAINING_VARIANT
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.method.msdi import PAPER, TINY, Msdi, MsdiConfig
from spike4dgs.method.msdi.checkpoints import renamed, source_of, transfer
from spike4dgs.method.msdi.train import start_from
from spike4dgs.method.msdi.weights import SHIPPED, WEIGHTS, Card, load_network

EMBED = replace(TINY, embed_channels=3)  # as the published patch embedding
DUST3R = Dust3rShape(2, 16, 2, 4, 24, 2, 16, (4, 6, 8, 12), 16)


def conv(name: str, *shape: int, bias: bool = True) -> dict[str, tuple[int, ...]]:
    parts: dict[str, tuple[int, ...]] = {f"{name}.weight": shape}
    return parts | ({f"{name}.bias": (shape[0],)} if bias else {})


def layer(w: int) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of a published transformer layer."""
    attention = conv("attn.qkv", 3 * w, w) | conv("attn.proj", w, w)
    return conv("norm1", w) | attention | conv("norm2", w) | conv("mlp.fc1", 4 * w, w) | conv("mlp.fc2", w, 4 * w)


def head(prefix: str, c: MsdiConfig) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of a published DPT head."""
    w, f, t = c.head_widths, c.head_features, (c.encoder_width, *[c.fusion_width] * 3)
    names: dict[str, tuple[int, ...]] = {}
    for k in range(4):
        names |= conv(f"act_postprocess.{k}.0", w[k], t[k], 1, 1)
        names |= conv(f"scratch.layer{k + 1}_rn", f, w[k], 3, 3, bias=False)
        for unit in (1, 2):
            for number in (1, 2):
                names |= conv(f"scratch.refinenet{k + 1}.resConfUnit{unit}.conv{number}", f, f, 3, 3)
        names |= conv(f"scratch.refinenet{k + 1}.out_conv", f, f, 1, 1)
    names |= conv("act_postprocess.0.1", w[0], w[0], 4, 4)
    names |= conv("act_postprocess.1.1", w[1], w[1], 2, 2)
    names |= conv("act_postprocess.3.1", w[3], w[3], 3, 3)
    names |= conv("head.0", f // 2, f, 3, 3) | conv("head.2", f // 2, f // 2, 3, 3) | conv("head.4", 4, f // 2, 1, 1)
    return {f"{prefix}.dpt.{name}": shape for name, shape in names.items()}


def fast3r_shapes(c: MsdiConfig) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of the published file of Fast3R at the sizes of a configuration."""
    names = conv("encoder.patch_embed.proj", c.encoder_width, 3, c.patch, c.patch)
    for k in range(c.encoder_layers):
        names |= {f"encoder.enc_blocks.{k}.{n}": s for n, s in layer(c.encoder_width).items()}
    names |= conv("encoder.enc_norm", c.encoder_width)
    names |= conv("decoder.decoder_embed", c.fusion_width, c.encoder_width)
    for k in range(c.fusion_layers):
        names |= {f"decoder.dec_blocks.{k}.{n}": s for n, s in layer(c.fusion_width).items()}
    names |= conv("decoder.dec_norm", c.fusion_width)
    return names | head("downstream_head", c) | head("downstream_head_local", c)


def random_state(shapes: dict[str, tuple[int, ...]], seed: int) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {name: torch.randn(*shape, generator=g) for name, shape in shapes.items()}


def fresh(config: MsdiConfig, seed: int = 0) -> Msdi:
    torch.manual_seed(seed)
    return Msdi(config).eval()


def test_the_papers_configuration_takes_all_of_fast3rs_published_shapes() -> None:
    shapes = fast3r_shapes(PAPER)
    with torch.device("meta"):
        network = Msdi(PAPER)
        state = {name: torch.empty(shape) for name, shape in shapes.items()}
    assert 640e6 < sum(t.numel() for t in state.values()) < 655e6
    transfer(network, state, Path("model.safetensors"))
    assert source_of(state) == "fast3r"
    taken = renamed(state, "fast3r")
    assert len(taken) == sum(not name.startswith("downstream_head_local.") for name in shapes)
    kept = network.state_dict().keys() - taken.keys()
    prefixes = {name.split(".")[0] for name in kept if not name.startswith("encoder.")}
    assert prefixes == {"extractor", "generator"}
    inside = {name for name in kept if name.startswith("encoder.")}
    assert inside == {"encoder.mix.weight", "encoder.mix.bias", "encoder.ray_embed.weight"}


def test_the_papers_configuration_takes_dust3rs_encoder() -> None:
    with torch.device("meta"):
        network, state = Msdi(PAPER), Dust3r().state_dict()
    transfer(network, {**state, "mask_token": torch.zeros(1, 1, 768)}, Path("model.safetensors"))
    encoder = [n for n in state if n.split(".")[0] in ("patch_embed", "enc_blocks", "enc_norm")]
    taken = renamed(state, "dust3r")
    assert source_of(state) == "dust3r" and len(taken) == len(encoder) == 24 * 12 + 4
    kept = network.state_dict().keys() - taken.keys()
    assert {n.split(".")[0] for n in kept} == {"encoder", "extractor", "fusion", "generator", "head"}


def test_values_have_the_right_names() -> None:
    state = random_state(fast3r_shapes(EMBED), 1)
    network, before = fresh(EMBED), fresh(EMBED).state_dict()
    transfer(network, state, Path("model.safetensors"))
    after = network.state_dict()
    for ours, theirs in {
        "encoder.patch_embed.weight": "encoder.patch_embed.proj.weight",
        "encoder.blocks.1.attn.qkv.bias": "encoder.enc_blocks.1.attn.qkv.bias",
        "encoder.norm.weight": "encoder.enc_norm.weight",
        "fusion.embed.weight": "decoder.decoder_embed.weight",
        "fusion.blocks.3.mlp.fc2.weight": "decoder.dec_blocks.3.mlp.fc2.weight",
        "fusion.norm.bias": "decoder.dec_norm.bias",
        "head.scratch.layer_rn.2.weight": "downstream_head.dpt.scratch.layer3_rn.weight",
        "head.act_postprocess.3.1.weight": "downstream_head.dpt.act_postprocess.3.1.weight",
        "head.scratch.refinenet2.resConfUnit1.conv2.bias": (
            "downstream_head.dpt.scratch.refinenet2.resConfUnit1.conv2.bias"
        ),
        "head.head.4.weight": "downstream_head.dpt.head.4.weight",
    }.items():
        assert torch.equal(after[ours], state[theirs]), ours
    taken = renamed(state, "fast3r")
    assert all(torch.equal(after[name], before[name]) != (name in taken) for name in after)
    out = network((torch.rand(1, 2, 9, 16, 32) < 0.3).float())
    assert out.points.isfinite().all()


def test_dust3rs_encoder_gives_the_same_tokens_here() -> None:
    torch.manual_seed(4)
    published = Dust3r(DUST3R).eval()
    network = fresh(EMBED)
    transfer(network, published.state_dict(), Path("model.safetensors"))
    images = torch.randn(2, 3, 32, 48)
    features = torch.cat([images, torch.randn(2, EMBED.features - 3, 32, 48)], dim=1)
    with torch.no_grad():
        network.encoder.mix.weight.copy_(torch.eye(3, EMBED.features)[:, :, None, None])
        torch.nn.init.zeros_(network.encoder.mix.bias)  # type: ignore[arg-type]
        tokens = network.encoder(features, torch.ones(2, 3, 32, 48))
        assert torch.allclose(tokens, published.encode(images), atol=1e-5)


def test_other_files_are_refused_and_nothing_is_unpickled(tmp_path: Path) -> None:
    path, network = tmp_path / "model.safetensors", fresh(EMBED)
    before = {k: v.clone() for k, v in network.state_dict().items()}
    torch.save({"model": {}}, path)
    with pytest.raises(UserError, match="expected weights in safetensors format"):
        start_from(network, path)
    with pytest.raises(UserError, match="expected weights in safetensors format"):
        start_from(network, tmp_path / "absent.safetensors")
    save_file({"weight": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="the tensors of Fast3R or DUSt3R, found others, such as weight"):
        start_from(network, path)
    state = random_state(fast3r_shapes(EMBED), 0)
    del state["encoder.enc_norm.bias"]
    save_file(state, path)
    with pytest.raises(UserError, match="found 1 other tensors, the first encoder.norm.bias missing"):
        start_from(network, path)
    save_file(random_state(fast3r_shapes(replace(EMBED, fusion_layers=5)), 0), path)
    with pytest.raises(UserError, match=r"found 12 other tensors, the first fusion.blocks.4.attn.proj.bias \(16,\)"):
        start_from(network, path)
    save_file(random_state(fast3r_shapes(EMBED), 0), path)
    with pytest.raises(UserError, match="encoder.patch_embed.weight"):
        start_from(fresh(TINY), path)  # embeds four channels
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    assert source_of({}) is None


CARD = Card("tiny", 12, 3, ("toy-1@abc",), {"psnr_db": 30.5})


def test_weights_come_back_with_their_card(tmp_path: Path) -> None:
    network, path = fresh(TINY, 5), tmp_path / "w.safetensors"
    digest = WEIGHTS.save(path, network, CARD)
    assert digest == WEIGHTS.save(tmp_path / "again.safetensors", network, CARD)
    assert WEIGHTS.read_card(path) == CARD
    loaded = load_network(path, "cpu")
    assert not loaded.training and not any(p.requires_grad for p in loaded.parameters())
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value.half().float()), name
    assert path.stat().st_size < 2.5 * sum(p.numel() for p in network.parameters()) + 20_000


def test_damaged_and_foreign_weights_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(b"\x80\x02pickle")
    with pytest.raises(UserError, match="weights of MSDI, found damaged data"):
        WEIGHTS.read_card(path)
    save_file({"weight": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="metadata spike4dgs-msdi/1, found none"):
        WEIGHTS.read_card(path)
    save_file({"weight": torch.zeros(1)}, path, metadata={"spike4dgs-msdi/1": json.dumps({"config": "tiny"})})
    with pytest.raises(UserError, match="damaged data"):
        WEIGHTS.read_card(path)
    WEIGHTS.save(path, fresh(TINY), replace(CARD, config="huge"))
    with pytest.raises(UserError, match="a configuration of paper, small, tiny, found 'huge'"):
        WEIGHTS.read_card(path)
    for key, value, message in (
        ("config", ["tiny"], r"a configuration of paper, small, tiny, found \['tiny'\]"),
        ("trained_on", "abc", "trained_on is 'abc', no list of texts"),
        ("trained_on", [1], r"trained_on is \[1\], no list of texts"),
        ("steps", "12", "whole numbers as steps and seed, found '12' and 3"),
        ("seed", None, "whole numbers as steps and seed, found 12 and None"),
    ):
        card = json.dumps({**asdict(CARD), key: value})
        save_file({"weight": torch.zeros(1)}, path, metadata={"spike4dgs-msdi/1": card})
        with pytest.raises(UserError, match=message):
            WEIGHTS.read_card(path)
    other = tmp_path / "other.safetensors"
    WEIGHTS.save(other, fresh(replace(TINY, fusion_width=8)), CARD)
    with pytest.raises(UserError, match="parameters of configuration tiny"):
        load_network(other, "cpu")
    broken = fresh(TINY)
    torch.nn.init.constant_(broken.encoder.norm.weight, torch.nan)
    with pytest.raises(UserError, match="found NaN or more than 65504 in encoder.norm.weight"):
        WEIGHTS.save(path, broken, CARD)


def test_the_environment_names_the_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SPIKE4DGS_MSDI", str(tmp_path / "absent.safetensors"))
    with pytest.raises(WeightsError, match="no such file"):
        WEIGHTS.in_use()
    (tmp_path / "absent.safetensors").touch()
    assert WEIGHTS.in_use().path == tmp_path / "absent.safetensors"


def test_the_shipped_weights_are_those_of_their_card() -> None:
    card = WEIGHTS.read_card(SHIPPED)
    text = (SHIPPED.parent / "README.md").read_text()
    assert sha256_file(SHIPPED) in text and f"Weights of step {card.steps}" in text
    assert load_network(SHIPPED, "cpu").config.name == card.config == "small"
    variants = [int(name.partition("@")[0].rpartition("-")[2]) for name in card.trained_on]
    assert min(variants) >= FIRST_TRAINING_VARIANT, "neither the benchmark's nor the hidden ones"
    assert card.measured["psnr_db"] > card.measured["tfp_psnr_db"] + 3
    assert SHIPPED.stat().st_size < 20e6
