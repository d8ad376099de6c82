import math
from dataclasses import replace

import pytest
import torch

from ditr_lite.config import UNetConfig, preset
from ditr_lite.evaluation.costs import count_flops
from ditr_lite.unet import (
    Attention,
    CrossAttentionFeatureQuery,
    CrossAttentionLatentQuery,
    DenoisingUNet,
    FeatureExtractor,
    Level,
    grid_code,
    norm,
    sinusoid,
)

TINY = preset("tiny").unet
VARIANTS = [(block, query) for block in ("residual", "plain") for query in ("feature", "latent")]


def build(config=TINY, seed=0):
    """A network whose zero-initialised output is woken up, and inputs for it: all levels see more than one cell."""
    torch.manual_seed(seed)
    net = DenoisingUNet(config, latent_channels=4, cond_in_channels=4)
    torch.nn.init.normal_(net.out.weight, std=0.1)
    inputs = {
        "latents": torch.randn(2, 4, 16, 24),
        "t": torch.tensor([3, 800]),
        "masked_latents": torch.randn(2, 4, 16, 24),
        "mask": (torch.rand(2, 1, 16, 24) > 0.5).float(),
    }
    return net, torch.randn(2, 4, 64, 96), inputs


def run(net, cond, inputs):
    return net(features=net.features(cond), **inputs)


@pytest.mark.parametrize("block, query", VARIANTS)
def test_shape_and_gradient_to_every_parameter(block, query):
    net, cond, inputs = build(replace(TINY, block=block, query=query))
    out = run(net, cond, inputs)
    assert out.shape == inputs["latents"].shape
    (out**2).sum().backward()
    asleep = [name for name, p in net.named_parameters() if p.grad is None or not bool(p.grad.abs().max() > 0)]
    assert not asleep


def test_untrained_network_predicts_zero():
    net = DenoisingUNet(TINY, 4, 4)
    assert bool((net(torch.randn(1, 4, 16, 24), torch.tensor([5]), net.features(torch.randn(1, 4, 64, 96))) == 0).all())


@pytest.mark.parametrize("name", ["latents", "t", "masked_latents", "mask", "cond"])
def test_every_input_matters(name):
    net, cond, inputs = build()
    before = run(net, cond, inputs)
    if name == "cond":
        cond = cond.flip(3)
    else:
        inputs[name] = inputs[name].flip(0)
    assert not torch.allclose(before, run(net, cond, inputs), atol=1e-4)


def test_time_embedding_tells_neighbouring_steps_apart():
    code = sinusoid(torch.arange(1000), 32, longest=10_000.0)
    distance = torch.cdist(code, code) + 10 * torch.eye(1000)
    assert distance.min() > 0.1
    net, cond, inputs = build()
    outs = [run(net, cond, inputs | {"t": torch.full((2,), t)}) for t in (0, 1, 999)]
    assert (outs[0] - outs[1]).abs().max() > 1e-4 and (outs[0] - outs[2]).norm() > 2 * (outs[0] - outs[1]).norm()


def test_samples_of_a_batch_do_not_mix():
    net, cond, inputs = build()
    together = run(net, cond, inputs)
    alone = [run(net, cond[b : b + 1], {k: v[b : b + 1] for k, v in inputs.items()}) for b in range(2)]
    assert torch.allclose(together, torch.cat(alone), atol=1e-5)


def test_no_conditioning_means_zeros():
    net, cond, inputs = build()
    zeros = inputs | {"masked_latents": torch.zeros(2, 4, 16, 24), "mask": torch.zeros(2, 1, 16, 24)}
    bare = {k: inputs[k] for k in ("latents", "t")}
    assert torch.equal(run(net, cond, bare), run(net, cond, zeros))


def test_float64_and_channels_last():
    net, cond, inputs = build()
    want = run(net, cond, inputs)
    last = run(net.to(memory_format=torch.channels_last), cond.to(memory_format=torch.channels_last), inputs)
    assert torch.allclose(want, last, atol=1e-5) and last.is_contiguous(memory_format=torch.channels_last)
    double = {k: v.double() if v.is_floating_point() else v for k, v in inputs.items()}
    out = run(net.double(), cond.double(), double)
    assert out.dtype == torch.float64 and torch.allclose(out.float(), want, atol=1e-5)


# ---- attention ------------------------------------------------------------------------------------------------------


def naive_attention(module, query, source):
    """One head, one query cell at a time, as on paper."""
    b, _, h, w = query.shape
    tokens_q = module.norm_query(query).flatten(2).transpose(1, 2)
    tokens_s = module.norm_source(source).flatten(2).transpose(1, 2)
    q, k, v = module.to_q(tokens_q), module.to_k(tokens_s), module.to_v(tokens_s)
    d = q.shape[2] // module.heads
    place = grid_code(h, w, d, q.device).to(q.dtype)
    out = torch.empty_like(q)
    for n in range(module.heads):
        part = slice(n * d, (n + 1) * d)
        for i in range(h * w):
            scores = ((q[:, i, None, part] + place[i]) * (k[:, :, part] + place)).sum(2) / math.sqrt(d)  # (B, HW)
            weights = scores.exp() / scores.exp().sum(1, keepdim=True)
            out[:, i, part] = (weights[:, :, None] * v[:, :, part]).sum(1)
    return module.out(out).transpose(1, 2).reshape(b, -1, h, w)


@pytest.mark.parametrize("heads", [1, 4])
def test_attention_equals_naive_attention(heads):
    torch.manual_seed(0)
    module = Attention(24, 16, 32, heads).double()
    query, source = torch.randn(2, 24, 3, 5).double(), torch.randn(2, 16, 3, 5).double()
    assert torch.allclose(module(query, source), naive_attention(module, query, source), atol=1e-10)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
@pytest.mark.parametrize("query", ["feature", "latent"])
def test_cross_attention_equals_torchs(query, dtype, tolerance):
    torch.manual_seed(0)
    module = {"feature": CrossAttentionFeatureQuery, "latent": CrossAttentionLatentQuery}[query](32, 16, 4).to(dtype)
    maps = {"latent": torch.randn(2, 32, 3, 5, dtype=dtype), "feature": torch.randn(2, 16, 3, 5, dtype=dtype)}
    asks, answers = maps[query], maps["latent" if query == "feature" else "feature"]
    tokens = [n(x).flatten(2).mT for n, x in ((module.norm_query, asks), (module.norm_source, answers))]
    place = grid_code(3, 5, 8, torch.device("cpu")).to(dtype).repeat(1, 4)  # (15, 32): the same for each of 4 heads
    q, k, v = module.to_q(tokens[0]) + place, module.to_k(tokens[1]) + place, module.to_v(tokens[1])
    q, k, v = (x.reshape(2, 15, 4, 8).permute(0, 2, 1, 3) for x in (q, k, v))
    mixed = torch.nn.functional.scaled_dot_product_attention(q, k, v).permute(0, 2, 1, 3).reshape(2, 15, 32)
    want = module.out(mixed).mT.reshape(2, 32, 3, 5)
    assert (module(maps["latent"], maps["feature"]) - want).abs().max() <= tolerance * want.abs().max()


def test_single_query_attention_gathers_latents_and_its_reverse_gathers_features():
    torch.manual_seed(0)
    latent, feature = torch.randn(1, 32, 4, 4), torch.randn(1, 16, 4, 4)
    ours, reverse = CrossAttentionFeatureQuery(32, 16, 4), CrossAttentionLatentQuery(32, 16, 4)
    for module, gathered in ((ours, "latent"), (reverse, "feature")):
        torch.nn.init.zeros_(module.to_v.weight)  # what is gathered now carries nothing ...
        torch.nn.init.zeros_(module.to_v.bias)
        assert torch.allclose(module(latent, feature), module.out.bias[:, None, None].expand(1, 32, 4, 4))
        assert module.to_v.in_features == {"latent": 32, "feature": 16}[gathered]  # ... and is this stream
        assert module.to_q.in_features == {"latent": 16, "feature": 32}[gathered]


def test_query_order_changes_the_result():
    net, cond, inputs = build(replace(TINY, cond_channels=TINY.width))  # equal channels: the same weights fit both
    other = DenoisingUNet(replace(net.config, query="latent"), 4, 4)
    other.load_state_dict(net.state_dict())
    assert not torch.allclose(run(net, cond, inputs), run(other, cond, inputs), atol=1e-4)


@pytest.mark.parametrize("query", ["feature", "latent"])
def test_attention_adds_to_what_the_convolutions_found(query):
    torch.manual_seed(0)
    level = Level(2, 16, replace(TINY, query=query))
    x, time, feature = torch.randn(2, 16, 4, 6), torch.randn(2, 4 * TINY.width), torch.randn(2, 32, 4, 6)
    assert not torch.allclose(level(x, time, feature), level.block(x, time), atol=1e-3)
    for attention in (level.self_attention, level.cross_attention):
        torch.nn.init.zeros_(attention.out.weight)
        torch.nn.init.zeros_(attention.out.bias)
    assert torch.equal(level(x, time, feature), level.block(x, time))


def test_attention_starts_out_looking_at_its_own_place():
    code = grid_code(6, 8, 32, torch.device("cpu"))
    closeness = code @ code.T
    assert torch.equal(closeness.argmax(1), torch.arange(48))
    assert torch.allclose(closeness[0, 1], closeness[17, 18], atol=1e-4)  # depends on the offset alone
    assert torch.allclose(closeness[0, 8], closeness[30, 38], atol=1e-4)


def test_attention_sees_the_whole_grid():
    net, cond, inputs = build()
    inputs["latents"].requires_grad_()
    run(net, cond, inputs)[0, :, 0, 0].sum().backward()
    assert inputs["latents"].grad[0, :, -1, -1].abs().max() > 0 and inputs["latents"].grad[1].abs().max() == 0


# ---- sizes and cost -------------------------------------------------------------------------------------------------


def meta_cost(name, height, width):
    """Parameters, FLOPs of one step and of F(x), without allocating anything."""
    config = preset(name)
    c = config.autoencoder.latent_channels
    with torch.device("meta"):
        net = DenoisingUNet(config.unet, c, cond_in_channels=4)
        cond, latents, t = (
            torch.zeros(1, 4, height, width),
            torch.zeros(1, c, height // 4, width // 4),
            torch.zeros(1).long(),
        )
        channels = config.unet.colour_channels
        colour = [torch.zeros(1, c, height // (4 * 2**k), width // (4 * 2**k)) for k, c in enumerate(channels)]
        features = net.features(cond, colour)
        step = count_flops(net, latents, t, features, latents, latents[:, :1])
        return net, step, count_flops(net.features, cond, colour)


def test_lite_meets_its_budget():
    net, step, once = meta_cost("lite", 192, 256)
    assert sum(p.numel() for p in net.parameters()) < 4.5e6
    assert 1.0e9 < step <= 1.5e9 and once < 0.5e9


def test_paper_preset_can_be_counted_without_memory():
    net, step, _ = meta_cost("paper", 736, 1280)
    assert [level.block.conv2.out_channels for level in net.down] == [64, 128, 256, 512]
    assert step > 1e11 and all(p.is_meta for p in net.parameters())


def test_flops_are_two_per_multiply_add_and_attention_counts_on_the_cpu():
    conv = torch.nn.Conv2d(8, 16, 3, padding=1)
    assert count_flops(conv, torch.zeros(1, 8, 10, 12)) == 2 * 9 * 8 * 16 * 120
    module = Attention(16, 16, 16, 2)
    linear, products = 4 * 2 * 16 * 16 * 15, 2 * 2 * 15 * 15 * 16
    assert count_flops(module, torch.zeros(1, 16, 3, 5), torch.zeros(1, 16, 3, 5)) == linear + products


def test_features_are_at_latent_size_and_coarser():
    shapes = [tuple(f.shape) for f in FeatureExtractor(4, UNetConfig(colour_channels=()))(torch.zeros(1, 4, 64, 96))]
    assert shapes == [(1, 32, 16, 24), (1, 64, 8, 12), (1, 128, 4, 6), (1, 256, 2, 3)]


def test_pretrained_features_are_added_level_by_level():
    torch.manual_seed(0)
    net = DenoisingUNet(replace(TINY, colour_channels=(3, 5)), 4, 4)
    cond = torch.randn(1, 4, 64, 96)
    colour = [torch.randn(1, c, 64 // s, 96 // s) for c, s in ((3, 4), (5, 8))]
    plain = net.features(cond, [0 * c for c in colour])
    for level in range(2):
        given = [c if i == level else 0 * c for i, c in enumerate(colour)]
        changed = [not torch.equal(a, b) for a, b in zip(net.features(cond, given), plain, strict=True)]
        assert changed.index(True) == level
    for wrong in ((), colour[:1]):
        with pytest.raises(ValueError, match="colour: expected 2 maps"):
            net.features(cond, wrong)


def test_works_without_attention():
    net, cond, inputs = build(replace(TINY, attention_levels=()))
    assert run(net, cond, inputs).shape == (2, 4, 16, 24) and len(net.features(cond)) == 1


@pytest.mark.parametrize(
    "change, message",
    [
        ({"block": "dense"}, "unknown block"),
        ({"query": "image"}, "unknown query"),
        ({"attention_levels": (4,)}, "levels exist"),
        ({"heads": 5}, "heads"),
    ],
)
def test_bad_configurations_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        DenoisingUNet(replace(TINY, **change), 4, 4)


@pytest.mark.parametrize(
    "change", [{"latents": torch.zeros(2, 4, 12, 24)}, {"latents": torch.zeros(2, 3, 16, 24)}, {"t": torch.tensor([1])}]
)
def test_bad_inputs_are_refused(change):
    net, cond, inputs = build()
    with pytest.raises(ValueError, match="expected latents"):
        run(net, cond, inputs | change)
    with pytest.raises(ValueError, match="cond: expected"):
        net.features(cond[..., :-1])


@pytest.mark.parametrize(("channels", "groups"), [(4, 1), (32, 4), (28, 2), (20, 2), (9, 1)])
def test_groups_divide_the_channels_and_hold_eight_or_the_next_number_more(channels, groups):
    assert norm(channels).num_groups == groups


def test_a_step_is_written_in_pairs_of_sine_and_cosine():
    with pytest.raises(ValueError, match="unet.width: expected an even number, got 9"):
        replace(TINY, width=9)
