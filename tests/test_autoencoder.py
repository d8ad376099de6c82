from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from ditr_lite.autoencoder import ResidualBlock, VectorQuantizer, VQAutoencoder
from ditr_lite.config import AutoencoderConfig, preset

TINY = preset("tiny").autoencoder


def quantizer(codebook, **settings) -> VectorQuantizer:
    """A quantiser with a known codebook."""
    codebook = torch.as_tensor(codebook, dtype=torch.float32)
    vq = VectorQuantizer(*codebook.shape, **settings)
    vq.codebook.copy_(codebook)
    return vq


def trained_like(config: AutoencoderConfig, seed: int = 0) -> VQAutoencoder:
    """An autoencoder whose residual branches are not zero, as after training."""
    torch.manual_seed(seed)
    model = VQAutoencoder(config)
    for module in model.modules():
        if isinstance(module, ResidualBlock):
            nn.init.normal_(module.conv2.weight, std=0.03)
    return model.eval()


# ---- the quantiser


@pytest.mark.parametrize("codes", [1, 7, 96, 2048])
def test_nearest_agrees_with_pairwise_distances(codes):
    torch.manual_seed(0)
    vq = VectorQuantizer(codes, 4)
    vectors = torch.randn(1100, 4)
    assert torch.equal(vq.nearest(vectors), torch.cdist(vectors.double(), vq.codebook.double()).argmin(1))


def test_one_of_equally_near_codes_is_taken():
    vq = VectorQuantizer(128, 2)
    vq.codebook.fill_(1.0)
    vq.codebook[:70] = 5.0
    assert min(vq.nearest(torch.zeros(3, 2)).tolist()) >= 70


def naive(z, codebook, beta):
    """Quantise pixel by pixel with plain Python numbers: codes (B, C, h, w), loss, indices (B, h, w)."""
    b, c, h, w = z.shape
    codes, index, total = torch.empty_like(z), torch.empty(b, h, w, dtype=torch.int64), 0.0
    for i in range(b):
        for y in range(h):
            for x in range(w):
                vector = z[i, :, y, x].tolist()
                distance = [sum((p - q) ** 2 for p, q in zip(vector, code, strict=True)) for code in codebook.tolist()]
                index[i, y, x] = best = distance.index(min(distance))
                codes[i, :, y, x] = codebook[best]
                total += distance[best]
    return codes, beta * total / (b * c * h * w), index


@given(st.integers(1, 9), st.integers(1, 5), st.floats(0, 2), st.integers(0, 2**31))
def test_quantiser_agrees_with_a_naive_one(codes, channels, beta, seed):
    generator = torch.Generator().manual_seed(seed)
    vq = quantizer(torch.randn(codes, channels, generator=generator), beta=beta).double().eval()
    z = torch.randn(2, channels, 3, 4, generator=generator, dtype=torch.float64)
    z_q, loss, index = vq(z)
    want_codes, want_loss, want_index = naive(z, vq.codebook, beta)
    assert torch.equal(index, want_index)
    assert torch.allclose(z_q, want_codes, atol=1e-12) and float(loss) == pytest.approx(want_loss, rel=1e-9)


def test_quantising_by_hand():
    vq = quantizer([[0.0], [10.0]], beta=0.25).eval()
    z = torch.tensor([1.0, 7.0]).view(1, 1, 1, 2)
    z_q, loss, index = vq(z)
    assert z_q.flatten().tolist() == [0.0, 10.0]
    assert index.tolist() == [[[0, 1]]]
    assert loss == pytest.approx(0.25 * (1**2 + 3**2) / 2)


def test_quantising_twice_changes_nothing():
    torch.manual_seed(0)
    vq = VectorQuantizer(16, 3).eval()
    once, _, index = vq(torch.randn(2, 3, 4, 5))
    twice, loss, again = vq(once)
    assert torch.equal(index, again) and torch.allclose(once, twice, atol=1e-6)
    assert loss == pytest.approx(0, abs=1e-10)


def test_the_gradient_passes_straight_through():
    vq = quantizer([[0.0, 0.0], [4.0, 4.0]]).eval()
    z = torch.tensor([[1.0, 1.0], [3.0, 3.5]]).T.reshape(1, 2, 1, 2).requires_grad_()
    upstream = torch.tensor([1.0, -2.0, 3.0, 5.0]).view(1, 2, 1, 2)
    (vq(z)[0] * upstream).sum().backward()
    assert torch.equal(z.grad, upstream)


def test_straight_through_and_commitment_by_finite_differences():
    """The gradient is that of loss(z + constant), the constant being code - z at the start, plus the commitment's."""
    torch.manual_seed(0)
    vq = quantizer(torch.randn(6, 3), beta=0.7).double().eval()
    z, target = torch.randn(2, 1, 3, 2, 2, dtype=torch.float64)
    z = z.clone().requires_grad_()
    z_q, commitment, index = vq(z)
    ((z_q - target).sin().square().sum() + commitment).backward()
    codes = vq.codebook[index].permute(0, 3, 1, 2)
    shift = (codes - z).detach()

    def surrogate(z):  # the code does not move while z is nudged
        return (z + shift - target).sin().square().sum() + 0.7 * ((z - codes) ** 2).mean()

    with torch.no_grad():
        for place in range(z.numel()):
            nudge = torch.zeros(z.numel(), dtype=torch.float64)
            nudge[place] = 1e-5
            slope = (surrogate(z + nudge.view_as(z)) - surrogate(z - nudge.view_as(z))) / 2e-5
            assert float(z.grad.flatten()[place]) == pytest.approx(float(slope), rel=1e-6, abs=1e-9)
        staircase = float((vq(z + 1e-7)[0] - vq(z - 1e-7)[0]).abs().max())
    assert staircase == pytest.approx(0, abs=1e-12)  # the true slope, which trains nothing


def test_commitment_pulls_the_encoder_with_beta_and_leaves_the_codebook_alone():
    vq = quantizer([[0.0], [10.0]], beta=0.25).eval()
    z = torch.tensor([1.0, 7.0]).view(1, 1, 1, 2).requires_grad_()
    vq(z)[1].backward()
    # d/dz of beta * mean((z - e)^2) = beta * 2 (z - e) / N: would be all zero had beta met the other term
    assert torch.allclose(z.grad.flatten(), 0.25 * 2 * torch.tensor([1.0, -3.0]) / 2)
    assert not vq.codebook.requires_grad and list(vq.parameters()) == []


def test_codes_move_to_the_moving_average_of_their_vectors():
    vq = quantizer([[0.0], [10.0]], decay=0.9, restart_after=1000).train()
    vq.idle.zero_()
    vq(torch.tensor([1.0, 2.0, 8.0]).view(1, 1, 1, 3))
    assert vq.codebook.flatten().tolist() == pytest.approx([1.5, 8.0])  # the first step: plain means
    vq(torch.tensor([0.0, 0.0]).view(1, 1, 1, 2))
    # count 0.9 * 0.2 + 0.1 * 2 = 0.38, total 0.9 * 0.3 + 0 = 0.27; the code that nobody chose stays
    assert vq.codebook.flatten().tolist() == pytest.approx([0.27 / 0.38, 8.0], rel=1e-5)


def test_evaluation_does_not_touch_the_codebook():
    vq = VectorQuantizer(8, 2).eval()
    before = {k: v.clone() for k, v in vq.state_dict().items()}
    vq(torch.randn(2, 2, 4, 4))
    assert all(torch.equal(before[k], v) for k, v in vq.state_dict().items())


def test_the_first_batch_initialises_and_a_dead_code_restarts_on_a_batch_vector():
    torch.manual_seed(0)
    vq = VectorQuantizer(8, 2, restart_after=3).train()
    batch = 50 + torch.rand(1, 2, 6, 6)  # far from every initial code
    vq(batch)
    assert (vq.codebook > 49).all()
    vq.codebook[0] = -1000.0
    for step in range(3):
        assert (vq.codebook[0] == -1000).all(), f"restarted after {step} idle steps, not 3"
        vq(batch)
    vectors = batch.permute(0, 2, 3, 1).reshape(-1, 2)
    assert (vectors == vq.codebook[0]).all(dim=1).any()


def test_restarts_are_reproducible():
    def run() -> torch.Tensor:
        torch.manual_seed(3)
        vq = VectorQuantizer(32, 2, restart_after=2).train()
        for _ in range(4):
            vq(torch.randn(1, 2, 3, 3))
        return vq.codebook

    assert torch.equal(run(), run())


@pytest.mark.parametrize(("count", "usage"), [([1, 1, 1, 1], 1.0), ([4, 0, 0, 0], 0.25), ([2, 2, 0, 0], 0.5)])
def test_usage_is_perplexity_over_codes(count, usage):
    vq = VectorQuantizer(4, 2)
    vq.count.copy_(torch.tensor(count))
    assert vq.usage == pytest.approx(usage, abs=1e-5)


# ---- the autoencoder


def test_shapes_and_latents_before_quantisation():
    model = trained_like(TINY)
    x = torch.randn(2, 1, 32, 48)
    out = model(x)
    assert out["reconstruction"].shape == x.shape
    assert out["latents"].shape == (2, TINY.latent_channels, 8, 12)
    assert out["indices"].shape == (2, 8, 12) and out["commitment"].ndim == 0
    codes = model.quantizer.codebook[out["indices"]].permute(0, 3, 1, 2)
    assert not torch.allclose(out["latents"], codes)  # continuous
    assert torch.allclose(out["reconstruction"], model.decode(out["latents"]), atol=1e-5)
    assert torch.allclose(model.decode(codes), model.decode(codes, quantize=False), atol=1e-5)


@pytest.mark.parametrize(("multipliers", "factor"), [((1,), 2), ((1, 2), 4), ((1, 2, 4), 8), ((2, 1, 3, 1), 16)])
def test_every_level_halves(multipliers, factor):
    model = trained_like(replace(TINY, multipliers=multipliers))
    x = torch.randn(1, 1, 32, 48)
    out = model(x)
    assert model.factor == factor
    assert out["reconstruction"].shape == x.shape
    assert out["latents"].shape == (1, TINY.latent_channels, 32 // factor, 48 // factor)
    assert out["indices"].shape == (1, 32 // factor, 48 // factor)


def test_crops_and_whole_images_agree_in_the_interior():
    model = trained_like(TINY)
    x = torch.randn(1, 1, 96, 96)
    whole, crop = model.encode(x)[..., 4:20, 4:20], model.encode(x[..., 16:80, 16:80])  # both 16 x 16 latents
    inner = slice(6, 10)  # 24 px from the crop's border; the encoder sees 20 px to either side
    assert torch.allclose(whole[..., inner, inner], crop[..., inner, inner], atol=1e-5)
    assert not torch.allclose(whole, crop, atol=1e-3)  # the border does differ: the comparison can fail
    z = torch.randn(1, TINY.latent_channels, 24, 24)
    whole = model.decode(z, quantize=False)[..., 16:80, 16:80]
    crop = model.decode(z[..., 4:20, 4:20], quantize=False)
    inner = slice(28, 36)  # the decoder sees 28 px to either side
    assert torch.allclose(whole[..., inner, inner], crop[..., inner, inner], atol=1e-5)
    assert not torch.allclose(whole, crop, atol=1e-3)


def test_calibrated_latents_have_unit_statistics_and_decode_alike():
    model = trained_like(TINY)
    x = torch.randn(3, 1, 32, 32)
    before = model(x)
    model.calibrate(before["latents"])
    after = model(x)
    assert torch.allclose(after["latents"].mean(dim=(0, 2, 3)), torch.zeros(4), atol=1e-4)
    assert torch.allclose(after["latents"].std(dim=(0, 2, 3)), torch.ones(4), atol=1e-4)
    assert torch.allclose(before["reconstruction"], after["reconstruction"], atol=1e-4)
    assert torch.allclose(before["reconstruction"], model.decode(after["latents"]), atol=1e-4)
    model.calibrate(after["latents"])  # a second time changes nothing
    assert torch.allclose(model.encode(x), after["latents"], atol=1e-4)


def test_the_lite_preset_keeps_its_budget():
    from torch.utils.flop_counter import FlopCounterMode

    def gflop(function, x) -> float:
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            function(x)
        return counter.get_total_flops() / 1e9

    model = VQAutoencoder(preset("lite").autoencoder).eval()
    x = torch.zeros(1, 1, 192, 256)
    assert gflop(model.encode, x) <= 1.1
    assert gflop(model.decode, torch.zeros(1, 4, 48, 64)) <= 2.0
    assert sum(p.numel() for p in model.parameters()) <= 1_000_000


# ---- what is refused


@pytest.mark.parametrize(
    "call",
    [
        lambda: VectorQuantizer(0, 2),
        lambda: VectorQuantizer(4, 2)(torch.zeros(1, 3, 2, 2)),
        lambda: VQAutoencoder(AutoencoderConfig(multipliers=())),
        lambda: VQAutoencoder(TINY).encode(torch.zeros(1, 1, 30, 32)),
        lambda: VQAutoencoder(replace(TINY, multipliers=(1, 2, 4))).encode(torch.zeros(1, 1, 32, 36)),
        lambda: VQAutoencoder(TINY).decode(torch.zeros(1, 3, 8, 8)),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match="expected"):
        call()
