"""The diffusion step and its reversal, equation by equation.

Paper: Sec. III (the reverse transition) and Sec. IV-C, Eq. 7 to 9. Everything works on data of any shape (B, ...), in
float32 or float64: what is a latent (B, C, h, w) in the system may be a single number (B,) in an experiment.

Notation (DDPM: Ho et al. 2020; DDIM: Song et al. 2021; abar is alpha-bar, see ``schedule``):

====================  =====================  ===================================================================
code name             paper symbol           DDPM / DDIM name
====================  =====================  ===================================================================
``x0``                L_0 = Enc(D)           x_0
``x_t``               L_t                    x_t
``eps``               epsilon                epsilon, the noise that was mixed in
``pred_eps``          epsilon_theta, Eq. 8   epsilon_theta
``pred_x0``           x_theta, Eq. 9         predicted x_0
``v``                 (not in the paper)     v = sqrt(abar_t) eps - sqrt(1 - abar_t) x0 (Salimans and Ho 2022)
``signal``            alpha_t, Eq. 9         sqrt(abar_t)
``noise``             missing in Eq. 9       sqrt(1 - abar_t)
``mean, variance``    mu_theta, Sigma_theta  mu-tilde_t, beta-tilde_t
``sigma``             (not in the paper)     sigma_t(eta), DDIM Eq. 16
====================  =====================  ===================================================================

``t`` counts from 0 to T - 1 here and from 1 to T in both papers; ``t_prev = -1`` is the clean end.
Every function raises ValueError when shapes, dtypes or ranges do not fit.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .schedule import NoiseSchedule, check_prediction, check_steps, levels


def q_sample(x0: Tensor, t: Tensor, eps: Tensor, schedule: NoiseSchedule) -> Tensor:
    """Mix data with noise: x_t = sqrt(abar_t) x0 + sqrt(1 - abar_t) eps, a draw from q(x_t given x0).

    Paper: Eq. 7. Erratum: Eq. 7 says N(0, I) for every t, which holds only in the limit t -> T. The distribution is
    N(sqrt(abar_t) L_0, (1 - abar_t) I); it is q (nothing is learnt), not p_theta.

    Args:
        x0: (B, ...) floating, clean data.
        t: (B,) long in [0, T - 1].
        eps: like x0, standard normal.
        schedule: the noise schedule.

    Returns:
        x_t, like x0.
    """
    signal, noise = levels(t, schedule, x0=x0, eps=eps)
    return signal * x0 + noise * eps


def eps_from_x0(x_t: Tensor, t: Tensor, x0: Tensor, schedule: NoiseSchedule) -> Tensor:
    """Turn (predicted) data into noise: eps = (x_t - sqrt(abar_t) x0) / sqrt(1 - abar_t).

    Paper: Eq. 9. Erratum: as printed, epsilon_theta = L_t - alpha_t x_theta lacks the division by the noise level
    sqrt(1 - abar_t); without it the "noise" has variance 1 - abar_t instead of 1.
    """
    signal, noise = levels(t, schedule, x_t=x_t, x0=x0)
    return (x_t - signal * x0) / noise


def x0_from_eps(x_t: Tensor, t: Tensor, eps: Tensor, schedule: NoiseSchedule) -> Tensor:
    """Turn (predicted) noise into data, Eq. 9 solved for x_theta: x0 = (x_t - sqrt(1 - abar_t) eps) / sqrt(abar_t)."""
    signal, noise = levels(t, schedule, x_t=x_t, eps=eps)
    return (x_t - noise * eps) / signal


def v_from_x0_eps(x0: Tensor, t: Tensor, eps: Tensor, schedule: NoiseSchedule) -> Tensor:
    """Return the velocity v = sqrt(abar_t) eps - sqrt(1 - abar_t) x0: x_t turned by a right angle."""
    signal, noise = levels(t, schedule, x0=x0, eps=eps)
    return signal * eps - noise * x0


def x0_from_v(x_t: Tensor, t: Tensor, v: Tensor, schedule: NoiseSchedule) -> Tensor:
    """Turn (predicted) velocity into data: x0 = sqrt(abar_t) x_t - sqrt(1 - abar_t) v. No division, at any t."""
    signal, noise = levels(t, schedule, x_t=x_t, v=v)
    return signal * x_t - noise * v


def to_x0(model_output: Tensor, x_t: Tensor, t: Tensor, schedule: NoiseSchedule, prediction: str) -> Tensor:
    """Read a model output as ``pred_x0``, whatever ("eps", "x0", "v") the model was trained to predict."""
    levels(t, schedule, x_t=x_t, model_output=model_output)
    check_prediction(prediction)
    convert = {"eps": x0_from_eps, "v": x0_from_v, "x0": lambda x_t, t, x0, schedule: x0}[prediction]
    return convert(x_t, t, model_output, schedule)


def loss(
    model_output: Tensor,
    x0: Tensor,
    eps: Tensor,
    t: Tensor,
    schedule: NoiseSchedule,
    prediction: str = "eps",
    weight: Tensor | Callable[[Tensor], Tensor] | None = None,
    mask: Tensor | None = None,
) -> Tensor:
    """Score a prediction: its squared distance to the target, averaged over elements, then over the batch.

    Paper: Eq. 8, E ||eps - eps_theta(L_t, t, F(x))||^2, for ``prediction="eps"``, up to the constant 1 / (number of
    elements) by which the mean differs from the squared norm. Erratum: the text calls eps_theta "the pre-trained
    autoencoders"; it is the denoiser. The same x_t links the predictions, so their squared distances are proportional:
    ||eps - pred_eps||^2 = SNR_t ||x0 - pred_x0||^2 = SNR_t / (SNR_t + 1) ||v - pred_v||^2. So a loss on x0 or v *is*
    Eq. 8 with ``weight=eq8_weight(schedule, prediction)``, and a reweighted Eq. 8 without.

    Args:
        model_output: (B, ...) prediction of what ``prediction`` names.
        x0: (B, ...) clean data.
        eps: (B, ...) the noise in q_sample(x0, t, eps).
        t: (B,) long in [0, T - 1].
        schedule: the noise schedule.
        prediction: "eps", "x0" or "v".
        weight: factor per step: a tensor (T,) looked up at t, or a callable from t to (B,). None means 1.
        mask: broadcasts to x0; elements count by their mask (0 = ignore); an image without any scores 0.
    """
    signal, noise = levels(t, schedule, x0=x0, model_output=model_output, eps=eps)
    check_prediction(prediction)
    target = {"eps": eps, "x0": x0, "v": signal * eps - noise * x0}[prediction]
    m = torch.ones_like(x0) if mask is None else mask.to(x0).expand_as(x0)
    m = m.reshape(len(t), -1)  # (B, ...) -> (B, N)
    squared = ((target - model_output) ** 2).reshape(len(t), -1)  # (B, ...) -> (B, N)
    each = (m * squared).sum(1) / m.sum(1).clamp(min=1e-8)  # (B,)
    if weight is None:
        return each.mean()
    if isinstance(weight, Tensor) and weight.shape != (schedule.timesteps,):
        raise ValueError(f"weight: expected ({schedule.timesteps},), one per step, got {tuple(weight.shape)}")
    w = weight[t.to(weight.device)] if isinstance(weight, Tensor) else weight(t)
    if w.shape != t.shape:
        raise ValueError(f"weight: expected a callable from t to {tuple(t.shape)}, it returned {tuple(w.shape)}")
    return (w.to(each) * each).mean()


def posterior_mean_variance(x0: Tensor, x_t: Tensor, t: Tensor, schedule: NoiseSchedule) -> tuple[Tensor, Tensor]:
    """Return mean (like x_t) and variance (B, 1, ..., 1) of q(x_{t-1} given x_t, x0), which a reverse step imitates.

    DDPM Eq. 6 and 7, with abar_prev = 1 at t = 0, so that the last step returns x0 with variance exactly 0.
    """
    levels(t, schedule, x_t=x_t, x0=x0)  # checks
    abar = schedule.alpha_bar(t, x_t.ndim)  # (B, 1, ..., 1) float64
    abar_prev = schedule.alpha_bar(t - 1, x_t.ndim)
    beta = 1 - abar / abar_prev
    on_x0 = abar_prev.sqrt() * beta / (1 - abar)
    on_x_t = (1 - beta).sqrt() * (1 - abar_prev) / (1 - abar)
    variance = beta * (1 - abar_prev) / (1 - abar)
    return on_x0.to(x_t) * x0 + on_x_t.to(x_t) * x_t, variance.to(x_t)


def ddpm_step(
    x_t: Tensor, t: Tensor, pred_x0: Tensor, schedule: NoiseSchedule, generator: torch.Generator | None = None
) -> Tensor:
    """Draw x_{t-1}, like x_t, from p_theta(x_{t-1} given x_t) = N(mu_theta, Sigma_theta). No noise is added at t = 0.

    Paper: Sec. III, unnumbered ("for 1 < t < T"; the first and the last step are left open there). mu_theta is the
    posterior mean with pred_x0 in place of x0, Sigma_theta the posterior variance (DDPM's "fixed small").
    """
    mean, variance = posterior_mean_variance(pred_x0, x_t, t, schedule)
    return mean + variance.sqrt() * _randn(x_t, generator)  # variance is 0 at t = 0


def ddim_step(
    x_t: Tensor,
    t: Tensor,
    t_prev: Tensor,
    pred_x0: Tensor,
    schedule: NoiseSchedule,
    eta: float = 0.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Jump from step t to any earlier t_prev (DDIM Eq. 12 and 16).

    x_prev = sqrt(abar_prev) pred_x0 + sqrt(1 - abar_prev - sigma^2) pred_eps + sigma * fresh noise. Each t_prev is less
    than its t; -1 is the clean end. ``eta`` runs from 0 (deterministic, nothing is drawn) to 1 (where a jump to t - 1
    is ddpm_step). pred_eps is always derived from pred_x0 (Eq. 9), so a clipped pred_x0 stays consistent.
    """
    if not 0 <= eta <= 1:
        raise ValueError(f"eta: expected a number in [0, 1], got {eta}")
    pred_eps = eps_from_x0(x_t, t, pred_x0, schedule)  # checks x_t, t and pred_x0
    check_steps(t_prev, schedule.timesteps, lowest=-1)
    if t_prev.shape != t.shape or not bool((t_prev < t).all()):
        raise ValueError("t_prev: expected one earlier step for each t; steps run from T - 1 down to -1 (clean)")
    abar = schedule.alpha_bar(t, x_t.ndim)  # (B, 1, ..., 1) float64
    abar_prev = schedule.alpha_bar(t_prev, x_t.ndim)
    sigma = eta * ((1 - abar_prev) / (1 - abar) * (1 - abar / abar_prev)).sqrt()
    toward_x_t = (1 - abar_prev - sigma**2).clamp(min=0).sqrt()  # clamp: rounding may leave -1e-17
    x_prev = abar_prev.sqrt().to(x_t) * pred_x0 + toward_x_t.to(x_t) * pred_eps
    return x_prev + sigma.to(x_t) * _randn(x_t, generator) if eta > 0 else x_prev


def timesteps_for(schedule: NoiseSchedule, steps: int) -> list[int]:
    """Choose ``steps`` evenly spaced steps, noisiest first ("trailing": the first is always T - 1).

    A spacing that starts lower, like the common "leading" one, would be handed pure noise and told that it is less.
    """
    if not 1 <= steps <= schedule.timesteps:
        raise ValueError(f"steps: expected 1 to {schedule.timesteps} (the schedule's length), got {steps}")
    return [round(schedule.timesteps * k / steps) - 1 for k in range(steps, 0, -1)]


@torch.no_grad()
def sample(
    denoise_fn: Callable[[Tensor, Tensor], Tensor],
    shape: Sequence[int],
    schedule: NoiseSchedule,
    steps: int,
    prediction: str = "x0",
    eta: float = 0.0,
    generator: torch.Generator | None = None,
    callback: Callable[[int, int, Tensor, Tensor], None] | None = None,
    *,
    clip_x0: float | None = None,
    x_T: Tensor | None = None,
) -> Tensor:
    """Draw data x0 from noise by ``steps`` DDIM steps. DDPM's ancestral sampler is ``steps=T, eta=1``.

    Args:
        denoise_fn: (x_t (B, ...), t (B,) long) -> prediction (B, ...).
        shape: (B, ...) of the data.
        schedule: the noise schedule.
        steps: 1 to T.
        prediction: what denoise_fn predicts: "eps", "x0" or "v".
        eta: 0 (deterministic given the start) to 1.
        generator: source of all noise; the same seed gives the same sample.
        callback: called after each step with (index, t, x after the step, pred_x0).
        clip_x0: clamp pred_x0 to [-clip_x0, clip_x0]; off by default (latents have no hard bounds).
        x_T: start from this (B, ...), on any device and of any dtype, instead of float32 noise on the CPU.
    """
    check_prediction(prediction)
    if x_T is not None and tuple(x_T.shape) != tuple(shape):
        raise ValueError(f"x_T: expected shape {tuple(shape)}, got {tuple(x_T.shape)}")
    x = _randn(torch.empty(*shape), generator) if x_T is None else x_T
    ts = timesteps_for(schedule, steps)
    for i, (t, t_prev) in enumerate(zip(ts, [*ts[1:], -1], strict=True)):
        t_batch = torch.full((len(x),), t, dtype=torch.long, device=x.device)  # (B,)
        prev_batch = torch.full_like(t_batch, t_prev)
        pred_x0 = to_x0(denoise_fn(x, t_batch), x, t_batch, schedule, prediction)
        if clip_x0 is not None:
            pred_x0 = pred_x0.clamp(-clip_x0, clip_x0)
        x = ddim_step(x, t_batch, prev_batch, pred_x0, schedule, eta, generator)
        if callback is not None:
            callback(i, t, x, pred_x0)
    return x


def _randn(like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw standard normal noise where the generator lives, so that a CPU seed means the same on every device."""
    device = like.device if generator is None else generator.device
    return torch.randn(like.shape, generator=generator, device=device, dtype=like.dtype).to(like.device)
