"""Noise schedules: how fast the diffusion step drowns a latent in noise.

Paper: Sec. IV-C "Diffusion Step"; 1,000 steps, Sec. V-B. The paper does not say which schedule it used; as it
works in latent space after latent diffusion (LDM), the default here is LDM's, linear in the square root of beta.

Notation (t counts from 0 in code: t = 0 is the *least* noisy step, t = T - 1 the noisiest; t = -1 means clean):

=========================  =====================  ===========================================================
code name                  paper symbol           DDPM name (Ho et al. 2020; there t counts from 1 to T)
=========================  =====================  ===========================================================
``timesteps``              T                      T
``betas[t]``               (not given)            beta_t, variance of the noise added by step t
``alphas[t]``              (not given)            alpha_t = 1 - beta_t
``alphas_cumprod[t]``      (square of alpha_t)    alpha-bar_t = product of alpha_s for s <= t
``signal``                 alpha_t (Eq. 9)        sqrt(alpha-bar_t)
``noise``                  missing in Eq. 9       sqrt(1 - alpha-bar_t)
``snr()[t]``               (not given)            alpha-bar_t / (1 - alpha-bar_t)
=========================  =====================  ===========================================================

Erratum: the paper's alpha_t is "the desire of signal at step t", so DDPM's sqrt(alpha-bar_t), *not* DDPM's alpha_t.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from .config import PREDICTIONS, ScheduleConfig

MAX_BETA = 0.999  # a beta of 1 would erase the signal in one step


def linear_betas(timesteps: int, beta_start: float, beta_end: float) -> Tensor:
    """Return betas that grow linearly (Ho et al. 2020), float64 (T,)."""
    return torch.linspace(beta_start, beta_end, timesteps, dtype=torch.float64)


def scaled_linear_betas(timesteps: int, beta_start: float, beta_end: float) -> Tensor:
    """Return betas whose square roots grow linearly (LDM, whose code calls this one "linear"), float64 (T,)."""
    return torch.linspace(beta_start**0.5, beta_end**0.5, timesteps, dtype=torch.float64) ** 2


def cosine_betas(timesteps: int, beta_start: float = 0.0, beta_end: float = MAX_BETA) -> Tensor:
    """Return betas whose alpha-bar follows a squared cosine (Nichol and Dhariwal 2021), float64 (T,).

    The two bounds are there for a common call shape and are not used: the curve has no free end points.
    """
    s = 0.008  # keeps the first beta from vanishing
    u = torch.arange(timesteps + 1, dtype=torch.float64) / timesteps
    alpha_bar = torch.cos((u + s) / (1 + s) * math.pi / 2) ** 2  # (T + 1,)
    return (1 - alpha_bar[1:] / alpha_bar[:-1]).clamp(max=MAX_BETA)


SCHEDULES: dict[str, Callable[[int, float, float], Tensor]] = {
    "linear": linear_betas,
    "scaled_linear": scaled_linear_betas,
    "cosine": cosine_betas,
}


class NoiseSchedule:
    """Everything that follows from the betas, as float64 tensors (T,) on the CPU.

    Float64 because 1 - alpha-bar near t = 0 and alpha-bar near T are differences and products of a thousand factors;
    coefficients are cast to the dtype and device of the data only where they meet it.

    Args:
        betas: (T,) floating, each strictly between 0 and 1.

    Raises:
        ValueError: if ``betas`` is not a 1-D tensor of values strictly between 0 and 1.
    """

    def __init__(self, betas: Tensor):
        if betas.ndim != 1 or len(betas) == 0 or not betas.is_floating_point():
            raise ValueError(
                f"betas: expected a floating tensor of shape (T,), T >= 1, got {betas.dtype} {tuple(betas.shape)}"
            )
        if not bool(((betas > 0) & (betas < 1)).all()):
            raise ValueError(
                f"betas: expected values strictly between 0 and 1, got {betas.min():g} to {betas.max():g}; "
                "choose another beta_start or beta_end"
            )
        self.betas = betas.detach().to("cpu", torch.float64)  # (T,)
        self.alphas = 1 - self.betas  # (T,)
        self.alphas_cumprod = self.alphas.cumprod(0)  # (T,)

    @property
    def timesteps(self) -> int:
        """T, the number of diffusion steps."""
        return len(self.betas)

    def snr(self) -> Tensor:
        """Return the signal-to-noise ratio alpha-bar / (1 - alpha-bar) of every step, float64 (T,)."""
        return self.alphas_cumprod / (1 - self.alphas_cumprod)

    def alpha_bar(self, t: Tensor, ndim: int) -> Tensor:
        """Look up alpha-bar_t, shaped to broadcast against a batch of ``ndim``-dimensional data.

        Args:
            t: (B,) long in [-1, T - 1]; -1 stands for clean data, alpha-bar = 1.
            ndim: number of dimensions of the data, batch included.

        Returns:
            (B, 1, ..., 1) float64 on the CPU.

        Raises:
            ValueError: for a ``t`` of another shape, dtype or range.
        """
        check_steps(t, self.timesteps, lowest=-1)
        clean_first = torch.cat([torch.ones(1, dtype=torch.float64), self.alphas_cumprod])  # (T + 1,), entry 0: t = -1
        return clean_first[t.cpu() + 1].view(-1, *[1] * (ndim - 1))

    def signal_noise(self, t: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return sqrt(alpha-bar_t) and sqrt(1 - alpha-bar_t), ready to multiply ``like``.

        Args:
            t: (B,) long in [-1, T - 1].
            like: (B, ...) floating; gives number of dimensions, dtype and device.

        Returns:
            Two tensors (B, 1, ..., 1) of ``like``'s dtype, on its device.

        Raises:
            ValueError: for a ``t`` of another shape, dtype or range.
        """
        alpha_bar = self.alpha_bar(t, like.ndim)
        # root first, cast after: 1 - alpha-bar loses digits in float32
        return alpha_bar.sqrt().to(like), (1 - alpha_bar).sqrt().to(like)


def check_steps(t: Tensor, timesteps: int, lowest: int = 0) -> None:
    """Check that ``t`` is (B,) long within [lowest, timesteps - 1].

    Raises:
        ValueError: if it is not.
    """
    if not isinstance(t, Tensor) or t.ndim != 1 or t.dtype != torch.long:
        got = f"{t.dtype} {tuple(t.shape)}" if isinstance(t, Tensor) else repr(t)
        raise ValueError(f"t: expected a long tensor of shape (B,), got {got}; use torch.full((B,), step)")
    if t.numel() and not lowest <= int(t.min()) <= int(t.max()) < timesteps:
        raise ValueError(
            f"t: expected steps in [{lowest}, {timesteps - 1}], got {int(t.min())} to {int(t.max())}; "
            "t counts from 0 (least noise) to T - 1"
        )


def levels(t: Tensor, schedule: NoiseSchedule, **data: Tensor) -> tuple[Tensor, Tensor]:
    """Check that all data are floating, of one dtype and shape (B, ...); return ``signal`` and ``noise`` for them.

    Raises:
        ValueError: if they are not, or if ``t`` is not (B,) long in [0, T - 1].
    """
    check_steps(t, schedule.timesteps)
    first, ref = next(iter(data.items()))
    if ref.ndim < 1 or not ref.is_floating_point() or len(ref) != len(t):
        got = f"{ref.dtype} {tuple(ref.shape)}"
        raise ValueError(f"{first}: expected floating ({len(t)}, ...), one entry per t, got {got}")
    for name, x in data.items():
        if x.shape != ref.shape or x.dtype != ref.dtype:
            expected = f"{ref.dtype} {tuple(ref.shape)}"
            raise ValueError(f"{name}: expected {expected} like {first}, got {x.dtype} {tuple(x.shape)}")
    return schedule.signal_noise(t, ref)


def check_prediction(prediction: str) -> None:
    """Check that a denoiser may be trained to predict ``prediction``.

    Raises:
        ValueError: if it is none of ``PREDICTIONS``.
    """
    if prediction not in PREDICTIONS:
        raise ValueError(f"unknown prediction {prediction!r}; choose one of {', '.join(PREDICTIONS)}")


def make_schedule(config: ScheduleConfig | None = None) -> NoiseSchedule:
    """Build the noise schedule that ``config`` names (default: the paper's 1,000 steps with LDM's betas).

    Raises:
        ValueError: for an unknown name, fewer than one step, or bounds outside 0 < beta_start <= beta_end < 1.
    """
    config = config or ScheduleConfig()
    if config.name not in SCHEDULES:
        raise ValueError(f"unknown noise schedule {config.name!r}; choose one of {', '.join(SCHEDULES)}")
    if config.timesteps < 1:
        raise ValueError(f"timesteps: expected at least 1, got {config.timesteps}")
    if config.name != "cosine" and not 0 < config.beta_start <= config.beta_end < 1:
        raise ValueError(
            f"expected 0 < beta_start <= beta_end < 1, got beta_start={config.beta_start}, beta_end={config.beta_end}"
        )
    return NoiseSchedule(SCHEDULES[config.name](config.timesteps, config.beta_start, config.beta_end))


def eq8_weight(schedule: NoiseSchedule, prediction: str) -> Tensor:
    """Return the weight per step, float64 (T,), that makes a squared error on ``prediction`` equal to Eq. 8.

    On x0 it is SNR_t, which is in the hundreds at small t, where there is hardly anything to learn.

    Raises:
        ValueError: for an unknown prediction.
    """
    check_prediction(prediction)
    snr = schedule.snr()
    return {"x0": snr, "eps": torch.ones_like(snr), "v": snr / (snr + 1)}[prediction]
