import math

import pytest
import torch

from ditr_lite.config import ScheduleConfig
from ditr_lite.schedule import SCHEDULES, NoiseSchedule, eq8_weight, make_schedule

NAMES = sorted(SCHEDULES)


@pytest.mark.parametrize("name", NAMES)
def test_alpha_bar_is_the_product_of_alphas(name):
    s = make_schedule(ScheduleConfig(name=name))
    assert s.timesteps == 1000 and s.betas.dtype == s.alphas_cumprod.dtype == torch.float64
    by_hand = math.exp(sum(math.log1p(-float(b)) for b in s.betas[:500]))
    assert s.alphas_cumprod[499].item() == pytest.approx(by_hand, rel=1e-12)
    assert bool((s.alphas_cumprod.diff() < 0).all())


@pytest.mark.parametrize("name", NAMES)
def test_signal_is_nearly_whole_at_the_start_and_nearly_gone_at_the_end(name):
    s = make_schedule(ScheduleConfig(name=name))
    assert s.alphas_cumprod[0] > 0.995
    assert s.alphas_cumprod[-1] < 1e-3  # the sense in which Eq. 7 holds: t -> T only


def test_scaled_linear_has_the_stated_ends_and_linear_roots():
    roots = make_schedule().betas.sqrt()
    assert float(roots[0] ** 2) == pytest.approx(0.0015) and float(roots[-1] ** 2) == pytest.approx(0.0195)
    assert torch.allclose(roots.diff(), roots.diff()[0].expand(999), rtol=1e-9)


def test_cosine_alpha_bar_is_a_squared_cosine():
    s = make_schedule(ScheduleConfig(name="cosine"))
    u = (500 / 1000 + 0.008) / 1.008 * math.pi / 2
    u0 = 0.008 / 1.008 * math.pi / 2
    assert s.alphas_cumprod[499].item() == pytest.approx(math.cos(u) ** 2 / math.cos(u0) ** 2, rel=1e-9)
    assert float(s.betas[-1]) == 0.999


def test_snr_and_levels_agree():
    s = make_schedule()
    t = torch.tensor([0, 10, 999])
    signal, noise = s.signal_noise(t, torch.zeros(3, 2, 4, 4, dtype=torch.float64))
    assert signal.shape == (3, 1, 1, 1)
    assert torch.allclose((signal / noise).flatten() ** 2, s.snr()[t])
    assert torch.allclose(signal**2 + noise**2, torch.ones(()).double())


def test_levels_take_dtype_from_data_and_round_once():
    s = make_schedule(ScheduleConfig(beta_start=1e-7, name="linear"))
    t = torch.tensor([0])
    _, noise32 = s.signal_noise(t, torch.zeros(1, 3))
    assert noise32.dtype == torch.float32
    assert noise32.item() == pytest.approx(1e-7**0.5, rel=1e-6)  # 1 - alpha-bar in float32 would be 19 % off
    assert s.alpha_bar(torch.tensor([-1]), ndim=1).item() == 1.0


@pytest.mark.parametrize("prediction", ["eps", "x0", "v"])
def test_weights_on_each_prediction(prediction):
    s = make_schedule()
    snr = s.snr()
    in_eps_units = {"eps": 1, "x0": snr, "v": snr / (snr + 1)}[prediction]
    assert torch.allclose(eq8_weight(s, prediction), in_eps_units * torch.ones_like(snr))


@pytest.mark.parametrize(
    "betas", [torch.zeros(3), torch.ones(3), torch.rand(2, 2), torch.tensor([1, 2]), torch.tensor([float("nan")])]
)
def test_bad_betas_are_refused(betas):
    with pytest.raises(ValueError, match="betas"):
        NoiseSchedule(betas)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "sigmoid"}, "choose one of"),
        ({"timesteps": 0}, "at least 1"),
        ({"beta_start": 0.5, "beta_end": 0.1}, "beta_start <= beta_end"),
    ],
)
def test_bad_configurations_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        make_schedule(ScheduleConfig(**settings))


@pytest.mark.parametrize("t", [torch.tensor([1000]), torch.tensor([-2]), torch.tensor([1.0]), torch.tensor(3), 3])
def test_bad_steps_are_refused(t):
    with pytest.raises(ValueError, match="^t: expected"):
        make_schedule().alpha_bar(t, ndim=2)


def test_bad_weights_are_refused():
    with pytest.raises(ValueError, match="choose one of"):
        eq8_weight(make_schedule(), "score")


@pytest.mark.parametrize(
    "ours, theirs", [("linear", "linear"), ("scaled_linear", "scaled_linear"), ("cosine", "squaredcos_cap_v2")]
)
def test_equals_diffusers(ours, theirs):
    diffusers = pytest.importorskip("diffusers")
    s = make_schedule(ScheduleConfig(name=ours))
    d = diffusers.DDPMScheduler(1000, beta_start=0.0015, beta_end=0.0195, beta_schedule=theirs)
    assert torch.allclose(s.betas.float(), d.betas, rtol=1e-5, atol=1e-8)
    assert torch.allclose(s.alphas_cumprod.float(), d.alphas_cumprod, rtol=2e-4, atol=1e-8)
    assert (s.alphas_cumprod - d.alphas_cumprod.double()).abs().max() < 1e-5  # theirs multiplies a thousand float32
    exact = s.betas.neg().log1p().cumsum(0).exp()  # the product by another way, in float64
    assert torch.allclose(s.alphas_cumprod, exact, rtol=1e-10, atol=0)
