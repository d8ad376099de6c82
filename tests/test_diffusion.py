import math

import pytest
import torch

from ditr_lite import diffusion as df
from ditr_lite.config import ScheduleConfig
from ditr_lite.schedule import eq8_weight, make_schedule

SCHEDULE = make_schedule()
T = SCHEDULE.timesteps
SHAPES = [(5,), (5, 1), (5, 3, 4, 6)]


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def start(*shape, seed=0):
    return torch.randn(shape, generator=generator(seed), dtype=torch.float64)


def draw(shape=(5, 3, 4, 6), seed=0, dtype=torch.float64):
    g = generator(seed)
    x0, eps = torch.randn(shape, generator=g, dtype=dtype), torch.randn(shape, generator=g, dtype=dtype)
    t = torch.randint(0, T, shape[:1], generator=g)
    return x0, eps, t, df.q_sample(x0, t, eps, SCHEDULE)


# ---- Eq. 7: the diffusion step --------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_q_sample_element_by_element(shape, dtype):
    x0, eps, t, x_t = draw(shape, dtype=dtype)
    assert x_t.shape == shape and x_t.dtype == dtype
    for b in range(shape[0]):
        abar = SCHEDULE.alphas_cumprod[t[b]].item()
        assert torch.allclose(x_t[b], math.sqrt(abar) * x0[b] + math.sqrt(1 - abar) * eps[b])


def test_q_sample_equals_t_small_steps():
    # the Markov chain x_s = sqrt(1 - beta_s) x_{s-1} + sqrt(beta_s) eps_s has the same mean and variance
    mean, variance, t = 1.0, 0.0, 300
    for beta in SCHEDULE.betas[: t + 1].tolist():
        mean, variance = math.sqrt(1 - beta) * mean, (1 - beta) * variance + beta
    step = torch.tensor([t])
    one, zero = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    assert df.q_sample(one, step, zero, SCHEDULE).item() == pytest.approx(mean, rel=1e-12)
    assert df.q_sample(zero, step, one, SCHEDULE).item() ** 2 == pytest.approx(variance, rel=1e-12)


def test_eq7_holds_at_the_end_and_only_there():
    x0 = 3 + torch.zeros(100_000, dtype=torch.float64)
    eps = torch.randn(x0.shape, generator=generator(), dtype=torch.float64)
    end, middle = (df.q_sample(x0, torch.full(x0.shape, t), eps, SCHEDULE) for t in (T - 1, T // 4))
    assert abs(end.mean()) < 0.05 and end.var().item() == pytest.approx(1, abs=0.02)
    assert middle.mean() > 2 and middle.var() < 0.5


# ---- Eq. 9: eps, x0, v ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_conversions_undo_each_other(shape):
    x0, eps, t, x_t = draw(shape)
    v = df.v_from_x0_eps(x0, t, eps, SCHEDULE)
    for found, true in [
        (df.eps_from_x0(x_t, t, x0, SCHEDULE), eps),
        (df.x0_from_eps(x_t, t, eps, SCHEDULE), x0),
        (df.x0_from_v(x_t, t, v, SCHEDULE), x0),
        (df.to_x0(eps, x_t, t, SCHEDULE, "eps"), x0),
        (df.to_x0(v, x_t, t, SCHEDULE, "v"), x0),
        (df.to_x0(x0, x_t, t, SCHEDULE, "x0"), x0),
    ]:
        assert torch.allclose(found, true, atol=1e-9)


def test_eq9_as_printed_is_not_unit_noise():
    x0, _, _, _ = draw((20_000,))
    eps, t = torch.randn(x0.shape, generator=generator(1), dtype=torch.float64), torch.full(x0.shape, 100)
    x_t = df.q_sample(x0, t, eps, SCHEDULE)
    signal, noise = SCHEDULE.signal_noise(t, x0)
    printed = x_t - signal * x0
    assert printed.var() < 0.3
    assert torch.allclose(printed, noise * df.eps_from_x0(x_t, t, x0, SCHEDULE))


def test_v_is_the_derivative_of_x_t_along_the_angle():
    x0, eps, t, _ = draw()
    phi = torch.atan2(*reversed(SCHEDULE.signal_noise(t, x0)))
    h = 1e-5
    at = [torch.cos(phi + d) * x0 + torch.sin(phi + d) * eps for d in (-h, h)]
    assert torch.allclose((at[1] - at[0]) / (2 * h), df.v_from_x0_eps(x0, t, eps, SCHEDULE), atol=1e-8)


# ---- Eq. 8: the loss ------------------------------------------------------------------------------------------------


def test_eps_loss_is_eq8():
    x0, eps, t, _ = draw()
    guess = torch.randn(x0.shape, generator=generator(9), dtype=torch.float64)
    squared_norm = sum(float((eps[b] - guess[b]).norm() ** 2) for b in range(5)) / 5
    assert df.loss(guess, x0, eps, t, SCHEDULE, "eps").item() == pytest.approx(squared_norm / x0[0].numel(), rel=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_x0_and_v_losses_with_eq8_weight_are_eq8(shape):
    x0, eps, t, x_t = draw(shape)
    pred_x0 = x0 + 0.1 * torch.randn(shape, generator=generator(3), dtype=torch.float64)
    pred_eps = df.eps_from_x0(x_t, t, pred_x0, SCHEDULE)
    pred_v = df.v_from_x0_eps(pred_x0, t, pred_eps, SCHEDULE)
    eq8 = df.loss(pred_eps, x0, eps, t, SCHEDULE, "eps")
    for name, output in {"eps": pred_eps, "x0": pred_x0, "v": pred_v}.items():
        assert torch.allclose(df.loss(output, x0, eps, t, SCHEDULE, name, weight=eq8_weight(SCHEDULE, name)), eq8)


def test_weight_as_callable_equals_weight_as_table():
    x0, eps, t, _ = draw()
    table = eq8_weight(SCHEDULE, "x0")
    by_call = df.loss(0 * x0, x0, eps, t, SCHEDULE, "x0", weight=lambda t: table[t])
    assert torch.equal(by_call, df.loss(0 * x0, x0, eps, t, SCHEDULE, "x0", weight=table))
    assert not torch.equal(by_call, df.loss(0 * x0, x0, eps, t, SCHEDULE, "x0"))


def test_masked_elements_have_no_loss_and_no_gradient():
    x0, eps, t, _ = draw()
    mask = torch.zeros(5, 1, 4, 6)
    mask[:, :, :2] = 1
    guess = torch.zeros_like(x0, requires_grad=True)
    value = df.loss(guess, x0, eps, t, SCHEDULE, "x0", mask=mask)
    value.backward()
    assert torch.allclose(value, (x0[:, :, :2] ** 2).mean())
    assert bool((guess.grad[:, :, 2:] == 0).all()) and bool((guess.grad[:, :, :2] != 0).all())
    assert df.loss(guess, x0, eps, t, SCHEDULE, "x0", mask=0 * mask) == 0


# ---- I1 and DDIM: the reverse ---------------------------------------------------------------------------------------


def test_posterior_is_bayes_rule():
    # q(x_{t-1} | x_t, x0) is proportional to q(x_t | x_{t-1}) q(x_{t-1} | x0): multiply the two Gaussians
    x0, _, _, _ = draw((4,))
    x_t, t = torch.linspace(-1, 2, 4).double(), torch.tensor([1, 50, 500, 999])
    mean, variance = df.posterior_mean_variance(x0, x_t, t, SCHEDULE)
    alpha, beta, abar_prev = SCHEDULE.alphas[t], SCHEDULE.betas[t], SCHEDULE.alphas_cumprod[t - 1]
    precision = alpha / beta + 1 / (1 - abar_prev)
    by_hand = (alpha.sqrt() / beta * x_t + abar_prev.sqrt() / (1 - abar_prev) * x0) / precision
    assert torch.allclose(variance, 1 / precision) and torch.allclose(mean, by_hand)


def test_ddpm_adds_no_noise_at_t_0_and_some_elsewhere():
    x0, _, _, x_t = draw()
    t = torch.tensor([0, 1, 0, 500, 999])
    a, b = (df.ddpm_step(x_t, t, x0, SCHEDULE, generator(seed)) for seed in (1, 2))
    assert torch.allclose(a[t == 0], x0[t == 0], atol=1e-12) and torch.equal(a[t == 0], b[t == 0])
    assert bool((a[t > 0] != b[t > 0]).all())


def test_ddim_with_eta_1_and_single_steps_is_ddpm():
    x0, _, _, x_t = draw()
    t = torch.tensor([0, 1, 7, 500, 999])
    ddim = df.ddim_step(x_t, t, t - 1, x0, SCHEDULE, eta=1.0, generator=generator(4))
    assert torch.allclose(ddim, df.ddpm_step(x_t, t, x0, SCHEDULE, generator(4)), atol=1e-10)


def test_ddim_with_the_true_x0_walks_along_q_sample():
    x0, eps, _, _ = draw()
    t, t_prev = torch.tensor([999, 500, 20, 3, 0]), torch.tensor([500, 30, 1, -1, -1])
    x_prev = df.ddim_step(df.q_sample(x0, t, eps, SCHEDULE), t, t_prev, x0, SCHEDULE)
    there = t_prev >= 0
    on_path = df.q_sample(x0[there], t_prev[there], eps[there], SCHEDULE)
    assert torch.allclose(x_prev[there], on_path, atol=1e-12) and torch.allclose(x_prev[~there], x0[~there], atol=1e-12)


@pytest.mark.parametrize("steps", [1, 2, 3, 7, 50, 999, 1000])
def test_timesteps_are_trailing(steps):
    ts = df.timesteps_for(SCHEDULE, steps)
    assert ts[0] == T - 1 and len(set(ts)) == steps and ts == sorted(ts, reverse=True) and ts[-1] >= 0
    gaps = [a - b for a, b in zip(ts, [*ts[1:], -1], strict=True)]
    assert max(gaps) - min(gaps) <= 1  # evenly spaced, the last jump to "clean" included


# ---- closed forms ---------------------------------------------------------------------------------------------------


def gaussian_denoiser(s):
    """E[x0 | x_t] for x0 ~ N(0, s^2)."""

    def pred_x0(x, t):
        abar = SCHEDULE.alphas_cumprod[t].to(x)
        return abar.sqrt() * s**2 / (abar * s**2 + 1 - abar) * x

    return pred_x0


def ddim_variance(s, steps):
    """Variance that deterministic DDIM returns for N(0, s^2) data and N(0, 1) starts.

    Step t has total variance V_t = abar_t s^2 + 1 - abar_t; let tan(phi_t) = sqrt(1 - abar_t) / (sqrt(abar_t) s).
    With the posterior mean as x0, DDIM multiplies x by
        (sqrt(abar_p abar_t) s^2 + sqrt((1 - abar_p)(1 - abar_t))) / V_t = sqrt(V_p / V_t) cos(phi_t - phi_p),
    so that x / sqrt(V) shrinks by the cosine of each jump: one long jump loses all, many short ones lose nothing.
    """
    abar = [SCHEDULE.alphas_cumprod[t].item() for t in df.timesteps_for(SCHEDULE, steps)] + [1.0]
    phi = [math.atan2(math.sqrt(1 - a), math.sqrt(a) * s) for a in abar]
    shrink = math.prod(math.cos(p - q) ** 2 for p, q in zip(phi[:-1], phi[1:], strict=True))
    return s**2 / (abar[0] * s**2 + 1 - abar[0]) * shrink


@pytest.mark.parametrize("s", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("steps", [1, 10, 100])
def test_ddim_reproduces_the_closed_form_variance(s, steps):
    noise = start(2000)
    noise = noise / noise.std()  # unit variance exactly, so that no luck of the draw is left to tolerate
    x = df.sample(gaussian_denoiser(s), noise.shape, SCHEDULE, steps, x_T=noise)
    assert x.var().item() == pytest.approx(ddim_variance(s, steps), rel=1e-9)


def test_ddim_variance_tends_to_the_datas():
    errors = [abs(ddim_variance(0.5, k) / 0.25 - 1) for k in (1, 10, 100, 1000)]
    assert errors == sorted(errors, reverse=True) and errors[0] > 0.99 and errors[-1] < 0.02


MIXTURE = {"w": (0.3, 0.7), "mean": (-1.0, 0.8), "s": (0.2, 0.3)}


def mixture_denoiser(x, t):  # t is (1,) or like x
    """E[x0 | x_t] for the two-component mixture: each component's linear estimate, weighed by its responsibility."""
    abar = SCHEDULE.alphas_cumprod[t].to(x)
    logs, estimates = [], []
    for w, m, s in zip(*MIXTURE.values(), strict=True):
        total, off = abar * s**2 + 1 - abar, x - abar.sqrt() * m
        logs.append(math.log(w) - 0.5 * total.log() - 0.5 * off**2 / total)
        estimates.append(m + abar.sqrt() * s**2 / total * off)
    return (torch.softmax(torch.stack(logs), 0) * torch.stack(estimates)).sum(0)


@pytest.mark.parametrize("steps, eta", [(200, 0.0), (200, 0.5), (250, 1.0)])
@pytest.mark.parametrize("prediction", ["x0", "eps"])
def test_samplers_reproduce_a_mixture(steps, eta, prediction):
    def model(x, t):
        pred_x0 = mixture_denoiser(x, t)
        return pred_x0 if prediction == "x0" else df.eps_from_x0(x, t, pred_x0, SCHEDULE)

    x = df.sample(model, (1, 8000), SCHEDULE, steps, prediction, eta, generator(5), x_T=start(1, 8000))
    mean = sum(w * m for w, m in zip(MIXTURE["w"], MIXTURE["mean"], strict=True))
    second = sum(w * (m**2 + s**2) for w, m, s in zip(*MIXTURE.values(), strict=True))
    assert x.mean().item() == pytest.approx(mean, abs=0.04)
    assert x.var().item() == pytest.approx(second - mean**2, rel=0.05)
    assert (x < 0).double().mean().item() == pytest.approx(0.3, abs=0.02)


def test_all_steps_with_eta_1_are_ddpms_chain():
    short = make_schedule(ScheduleConfig(name="linear", timesteps=6, beta_start=0.05, beta_end=0.7))
    start_at, g = start(32), generator(8)
    x = start_at
    for t in reversed(range(6)):
        x = df.ddpm_step(x, torch.full((32,), t), 0.5 * x, short, g)
    drawn = df.sample(lambda x, t: 0.5 * x, (32,), short, 6, eta=1.0, generator=generator(8), x_T=start_at)
    assert torch.allclose(drawn, x, atol=1e-12)
    assert not torch.allclose(drawn, df.sample(lambda x, t: 0.5 * x, (32,), short, 6, x_T=start_at), atol=0.1)


def test_one_step_returns_the_posterior_mean_not_a_sample():
    x = df.sample(mixture_denoiser, (1, 1000), SCHEDULE, 1, x_T=start(1, 1000))
    assert x.mean().item() == pytest.approx(0.26, abs=0.01) and x.std() < 0.05  # erratum 20: good RMSE, no spread


# ---- sample() -------------------------------------------------------------------------------------------------------


def test_same_seed_same_sample():
    run = [df.sample(mixture_denoiser, (64,), SCHEDULE, 5, eta=1.0, generator=generator(s)) for s in (1, 1, 2)]
    assert torch.equal(run[0], run[1]) and not torch.equal(run[0], run[2]) and run[0].dtype == torch.float32


def test_callback_sees_every_step_and_clipping_bounds_every_prediction():
    seen = []
    x = df.sample(
        lambda x, t: 10 * x, (4, 2), SCHEDULE, 3, generator=generator(), clip_x0=0.5, callback=lambda *a: seen.append(a)
    )
    assert [(i, t) for i, t, _, _ in seen] == [(0, 999), (1, 666), (2, 332)]
    assert all(pred.abs().max() <= 0.5 for _, _, _, pred in seen) and torch.allclose(x, seen[-1][3])


def test_start_can_be_given():
    ones = torch.ones(3, 2, dtype=torch.float64)
    x = df.sample(lambda x, t: 0.5 * x, (3, 2), SCHEDULE, 1, x_T=ones)
    assert torch.allclose(x, 0.5 * ones) and x.dtype == torch.float64


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x, t: df.q_sample(x, t, x[:, :1], SCHEDULE), "eps: expected"),
        (lambda x, t: df.q_sample(x, t, x.float(), SCHEDULE), "eps: expected"),
        (lambda x, t: df.q_sample(x, t[:2], x, SCHEDULE), "one entry per t"),
        (lambda x, t: df.q_sample(x.long(), t, x.long(), SCHEDULE), "expected floating"),
        (lambda x, t: df.q_sample(x, t + T, x, SCHEDULE), "t: expected steps"),
        (lambda x, t: df.ddim_step(x, t, t, x, SCHEDULE), "earlier step"),
        (lambda x, t: df.ddim_step(x, t, t - 1, x, SCHEDULE, eta=1.5), "eta"),
        (lambda x, t: df.to_x0(x, x, t, SCHEDULE, "score"), "choose one of"),
        (lambda x, t: df.loss(x, x, x, t, SCHEDULE, weight=torch.ones(3)), "weight: expected"),
        (lambda x, t: df.loss(x, x, x, t, SCHEDULE, weight=lambda t: torch.ones(3)), "weight: expected"),
        (lambda x, t: df.sample(lambda x, t: x, (2, 2), SCHEDULE, 0), "steps: expected"),
        (lambda x, t: df.sample(lambda x, t: x, (2, 2), SCHEDULE, 1, x_T=x), "x_T"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    x, _, t, _ = draw()
    with pytest.raises(ValueError, match=message):
        call(x, t.clamp(min=1))


# ---- the same as diffusers ------------------------------------------------------------------------------------------

KINDS = {"eps": "epsilon", "x0": "sample", "v": "v_prediction"}
SETTINGS = {"beta_start": 0.0015, "beta_end": 0.0195, "beta_schedule": "scaled_linear", "clip_sample": False}


def close(ours, theirs):
    return torch.allclose(ours, theirs, rtol=1e-3, atol=1e-4)  # theirs keeps its schedule in float32


def test_q_sample_and_v_equal_diffusers():
    diffusers = pytest.importorskip("diffusers")
    x0, eps, t, x_t = draw(dtype=torch.float32)
    d = diffusers.DDPMScheduler(T, **SETTINGS)
    assert close(x_t, d.add_noise(x0, eps, t)) and close(
        df.v_from_x0_eps(x0, t, eps, SCHEDULE), d.get_velocity(x0, eps, t)
    )


@pytest.mark.parametrize("prediction", KINDS)
@pytest.mark.parametrize("eta", [0.0, 0.7])
def test_ddim_equals_diffusers(prediction, eta):
    diffusers = pytest.importorskip("diffusers")
    d = diffusers.DDIMScheduler(T, **SETTINGS, prediction_type=KINDS[prediction], timestep_spacing="trailing")
    d.set_timesteps(20)
    assert d.timesteps.tolist() == df.timesteps_for(SCHEDULE, 20)
    x_t, output, fresh = (torch.randn(2, 3, 4, 4, generator=generator(k)) for k in range(3))
    for i in (0, 10, 19):
        now, then = d.timesteps[i].item(), d.timesteps[i + 1].item() if i < 19 else -1
        t, t_prev = torch.tensor([now, now]), torch.tensor([then, then])
        theirs = d.step(output, now, x_t, eta=eta, variance_noise=fresh if eta else None).prev_sample
        pred_x0 = df.to_x0(output, x_t, t, SCHEDULE, prediction)
        assert close(df.ddim_step(x_t, t, t_prev, pred_x0, SCHEDULE, eta, generator(2)), theirs)


@pytest.mark.parametrize("prediction", KINDS)
@pytest.mark.parametrize("now", [999, 400, 1, 0])
def test_ddpm_equals_diffusers(prediction, now):
    diffusers = pytest.importorskip("diffusers")
    d = diffusers.DDPMScheduler(T, **SETTINGS, prediction_type=KINDS[prediction])
    x_t, output = (torch.randn(2, 3, 4, 4, generator=generator(k)) for k in range(2))
    t = torch.tensor([now, now])
    theirs = d.step(output, now, x_t, generator=generator(7)).prev_sample
    pred_x0 = df.to_x0(output, x_t, t, SCHEDULE, prediction)
    assert close(df.ddpm_step(x_t, t, pred_x0, SCHEDULE, generator(7)), theirs)


def in_double(scheduler):
    """Give a scheduler of diffusers our tables, which are float64, so that nothing but the formulas is compared."""
    scheduler.betas, scheduler.alphas = SCHEDULE.betas, SCHEDULE.alphas
    scheduler.alphas_cumprod = SCHEDULE.alphas_cumprod
    scheduler.one = scheduler.final_alpha_cumprod = torch.ones((), dtype=torch.float64)
    return scheduler


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
@pytest.mark.parametrize("prediction", KINDS)
@pytest.mark.parametrize("eta", [0.0, 0.6])
def test_formulas_equal_diffusers_to_the_last_digits(prediction, dtype, tolerance, eta):
    diffusers = pytest.importorskip("diffusers")
    settings = {**SETTINGS, "prediction_type": KINDS[prediction]}
    ddim = in_double(diffusers.DDIMScheduler(T, **settings, timestep_spacing="trailing"))
    ddpm = in_double(diffusers.DDPMScheduler(T, **settings))
    ddim.set_timesteps(10)
    g = generator(3)
    x_t, output = (torch.randn(2, 3, 4, 4, generator=g, dtype=dtype) for _ in range(2))
    for now in (699, 299, 99):  # at t -> T an eps output is divided by almost nothing, in theirs and ours alike
        t = torch.tensor([now, now])
        pred_x0 = df.to_x0(output, x_t, t, SCHEDULE, prediction)
        noisy = df.q_sample(x_t, t, output, SCHEDULE)
        ours = [df.ddim_step(x_t, t, t - 100, pred_x0, SCHEDULE, eta, generator(7))]
        ours += [df.ddpm_step(x_t, t, pred_x0, SCHEDULE, generator(7))]
        theirs = [ddim.step(output, now, x_t, eta=eta, generator=generator(7))]
        theirs += [ddpm.step(output, now, x_t, generator=generator(7))]
        pairs = [(a, b.prev_sample) for a, b in zip(ours, theirs, strict=True)]
        for a, b in [*pairs, (noisy, ddpm.add_noise(x_t, output, t))]:
            assert a.dtype == dtype and (a - b).abs().max() <= tolerance * b.abs().max()


@pytest.mark.parametrize("steps", [1, 3, 4, 30, 999])
def test_timesteps_equal_diffusers(steps):
    diffusers = pytest.importorskip("diffusers")
    d = diffusers.DDIMScheduler(T, timestep_spacing="trailing")
    d.set_timesteps(steps)
    assert df.timesteps_for(SCHEDULE, steps) == d.timesteps.tolist()


def test_short_schedules_work():
    short = make_schedule(ScheduleConfig(name="linear", timesteps=4, beta_start=0.1, beta_end=0.9))
    assert df.timesteps_for(short, 4) == [3, 2, 1, 0]
    assert df.sample(lambda x, t: x, (2, 1, 2, 2), short, 4, generator=generator()).shape == (2, 1, 2, 2)
