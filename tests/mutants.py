"""Break every formula on purpose and see a test fail: ``python tests/mutants.py`` (minutes), ``make mutants``.

A test that cannot fail protects nothing. Each mutant changes one sign, root, index or factor in a temporary copy of the
package, on which the fast tests of that formula then run until the first one fails. A mutant that no test notices has
*survived*: a test is missing. The list is checked against the code by ``tests/test_mutants.py`` in an instant.

    python tests/mutants.py [--only WORD] [--jobs N]
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
HELPER, SCENES = "tests/made_scenes.py", "data_samples/val"  # what tests import and look at


class Mutant(NamedTuple):
    """One planted mistake: ``old`` becomes ``new`` in ``ditr_lite/<file>.py``; ``formula`` groups the table."""

    formula: str
    mistake: str
    file: str
    old: str
    new: str

    @property
    def tests(self) -> str:
        """The test file that must notice."""
        room, _, leaf = self.file.rpartition("/")
        return str(Path("tests", room, f"test_{leaf}.py"))


def family(formula: str, file: str, *rows: tuple[str, str, str]) -> list[Mutant]:
    """Return the mutants of one formula from rows (mistake, old, new)."""
    return [Mutant(formula, mistake, file, old, new) for mistake, old, new in rows]


SCHEDULE = [
    *family(
        "schedule",
        "schedule",
        ("linear: ends swapped", "torch.linspace(beta_start, beta_end,", "torch.linspace(beta_end, beta_start,"),
        ("scaled linear: not squared", "timesteps, dtype=torch.float64) ** 2", "timesteps, dtype=torch.float64)"),
        ("scaled linear: root of the start dropped", "linspace(beta_start**0.5,", "linspace(beta_start,"),
        ("cosine: not squared", "/ (1 + s) * math.pi / 2) ** 2", "/ (1 + s) * math.pi / 2)"),
        ("cosine: offset dropped", "(u + s) / (1 + s)", "u"),
        ("cosine: offset subtracted", "(u + s) / (1 + s)", "(u - s) / (1 + s)"),
        ("cosine: half the angle", "* math.pi / 2) ** 2", "* math.pi / 4) ** 2"),
        ("cosine: last step left unbounded", "clamp(max=MAX_BETA)", "clamp(max=1 - 1e-12)"),
        ("alpha = 1 + beta", "self.alphas = 1 - self.betas", "self.alphas = 1 + self.betas"),
        ("alpha-bar: sum for product", "self.alphas.cumprod(0)", "self.alphas.cumsum(0)"),
        ("alpha-bar: of beta", "self.alphas.cumprod(0)", "self.betas.cumprod(0)"),
        ("alpha-bar: off by one in t", "clean_first[t.cpu() + 1]", "clean_first[t.cpu()]"),
        ("alpha-bar: clean end is 0", "torch.cat([torch.ones(1,", "torch.cat([torch.zeros(1,"),
        ("SNR: noise not 1 - alpha-bar", "self.alphas_cumprod / (1 - self.alphas_cumprod)", "self.alphas_cumprod"),
        ("SNR: rooted", "(1 - self.alphas_cumprod)\n", "(1 - self.alphas_cumprod) ** 0.5\n"),
        ("signal: root dropped", "return alpha_bar.sqrt().to(like)", "return alpha_bar.to(like)"),
        ("noise: root dropped", ", (1 - alpha_bar).sqrt().to(like)", ", (1 - alpha_bar).to(like)"),
        ("noise: 1 - root", ", (1 - alpha_bar).sqrt().to(like)", ", (1 - alpha_bar.sqrt()).to(like)"),
        ("noise: rounded before the root", "(1 - alpha_bar).sqrt().to(like)", "(1 - alpha_bar.to(like)).sqrt()"),
        ("weight: eps not divided by SNR", '"eps": torch.ones_like(snr)', '"eps": snr'),
        ("weight: v divided by SNR alone", "snr / (snr + 1)", "snr / snr"),
    ),
]

DIFFUSION = [
    *family(
        "forward (Eq. 7)",
        "diffusion",
        ("as printed: N(0, I) at every t", "return signal * x0 + noise * eps", "return eps"),
        ("sign", "return signal * x0 + noise * eps", "return signal * x0 - noise * eps"),
        ("signal dropped", "return signal * x0 + noise * eps", "return x0 + noise * eps"),
        ("noise level dropped", "return signal * x0 + noise * eps", "return signal * x0 + eps"),
        ("levels swapped", "return signal * x0 + noise * eps", "return noise * x0 + signal * eps"),
        ("signal not rooted", "return signal * x0 + noise * eps", "return signal**2 * x0 + noise * eps"),
    ),
    *family(
        "conversions (Eq. 9)",
        "diffusion",
        ("eps as printed: no division", "return (x_t - signal * x0) / noise", "return x_t - signal * x0"),
        ("eps: sign", "return (x_t - signal * x0) / noise", "return (x_t + signal * x0) / noise"),
        ("eps: divided by the variance", "return (x_t - signal * x0) / noise", "return (x_t - signal * x0) / noise**2"),
        ("x0: no division", "return (x_t - noise * eps) / signal", "return x_t - noise * eps"),
        ("x0: sign", "return (x_t - noise * eps) / signal", "return (x_t + noise * eps) / signal"),
        ("x0: noise level dropped", "return (x_t - noise * eps) / signal", "return (x_t - eps) / signal"),
        ("v: sign", "    return signal * eps - noise * x0", "    return noise * x0 - signal * eps"),
        ("v: levels swapped", "    return signal * eps - noise * x0", "    return noise * eps - signal * x0"),
        ("x0 of v: sign", "return signal * x_t - noise * v", "return signal * x_t + noise * v"),
        ("x0 of v: levels swapped", "return signal * x_t - noise * v", "return noise * x_t - signal * v"),
        ("v read as eps", '"v": x0_from_v, "x0": lambda', '"v": x0_from_eps, "x0": lambda'),
    ),
    *family(
        "loss (Eq. 8)",
        "diffusion",
        ("not squared", "((target - model_output) ** 2)", "((target - model_output).abs())"),
        ("target of v: sign", '"v": signal * eps - noise * x0}', '"v": signal * eps + noise * x0}'),
        ("target of eps is x0", 'target = {"eps": eps,', 'target = {"eps": x0,'),
        ("mask not divided by", "/ m.sum(1).clamp(min=1e-8)", "/ m.shape[1]"),
        ("mask not applied", "(m * squared).sum(1)", "squared.sum(1)"),
        ("weight at the wrong step", "weight[t.to(weight.device)]", "weight[t.to(weight.device) - 1]"),
        ("weight dropped", "return (w.to(each) * each).mean()", "return each.mean()"),
        ("batch summed", "return each.mean()", "return each.sum()"),
    ),
    *family(
        "posterior mean",
        "diffusion",
        ("t - 1 is t", "schedule.alpha_bar(t - 1, x_t.ndim)", "schedule.alpha_bar(t, x_t.ndim)"),
        ("root of alpha-bar dropped", "on_x0 = abar_prev.sqrt() * beta", "on_x0 = abar_prev * beta"),
        ("alpha-bar of t, not t - 1", "on_x0 = abar_prev.sqrt() * beta", "on_x0 = abar.sqrt() * beta"),
        ("beta dropped", "on_x0 = abar_prev.sqrt() * beta / (1 - abar)", "on_x0 = abar_prev.sqrt() / (1 - abar)"),
        ("root of alpha dropped", "on_x_t = (1 - beta).sqrt()", "on_x_t = (1 - beta)"),
        ("1 - alpha-bar of t", "(1 - beta).sqrt() * (1 - abar_prev)", "(1 - beta).sqrt() * (1 - abar)"),
        ("sign", "on_x0.to(x_t) * x0 + on_x_t", "on_x0.to(x_t) * x0 - on_x_t"),
        ("beta is 1 - alpha-bar", "beta = 1 - abar / abar_prev", "beta = 1 - abar"),
    ),
    *family(
        "posterior variance",
        "diffusion",
        ("plain beta", "variance = beta * (1 - abar_prev) / (1 - abar)", "variance = beta + 0 * abar"),
        ("beta dropped", "variance = beta * (1 - abar_prev)", "variance = (1 - abar_prev)"),
        ("upside down", "variance = beta * (1 - abar_prev) / (1 - abar)", "variance = beta * (1 - abar)"),
    ),
    *family(
        "DDPM step (I1)",
        "diffusion",
        ("variance for deviation", "mean + variance.sqrt() * _randn", "mean + variance * _randn"),
        ("no noise", "return mean + variance.sqrt() * _randn(x_t, generator)", "return mean"),
        ("noise at t = 0", "variance.sqrt() * _randn", "variance.clamp(min=1e-4).sqrt() * _randn"),
        ("x0 and x_t swapped", "posterior_mean_variance(pred_x0, x_t, t", "posterior_mean_variance(x_t, pred_x0, t"),
    ),
    *family(
        "DDIM step",
        "diffusion",
        ("sigma not rooted", "* (1 - abar / abar_prev)).sqrt()", "* (1 - abar / abar_prev))"),
        ("sigma: eta dropped", "sigma = eta * ((1 - abar_prev)", "sigma = 1.0 * ((1 - abar_prev)"),
        ("sigma: upside down", "((1 - abar_prev) / (1 - abar) *", "((1 - abar) / (1 - abar_prev).clamp(min=1e-9) *"),
        ("sigma: ratio upside down", "(1 - abar / abar_prev)).sqrt()", "(abar_prev / abar - 1)).sqrt()"),
        ("direction: root dropped", ".clamp(min=0).sqrt()  # clamp", ".clamp(min=0)  # clamp"),
        ("direction: sigma not taken off", "(1 - abar_prev - sigma**2)", "(1 - abar_prev)"),
        ("direction: sigma not squared", "(1 - abar_prev - sigma**2)", "(1 - abar_prev - sigma)"),
        ("direction: sign", "* pred_x0 + toward_x_t", "* pred_x0 - toward_x_t"),
        ("signal: root dropped", "x_prev = abar_prev.sqrt()", "x_prev = abar_prev"),
        ("signal of t", "x_prev = abar_prev.sqrt()", "x_prev = abar.sqrt()"),
        ("fresh noise dropped", "x_prev + sigma.to(x_t) * _randn(x_t, generator) if", "x_prev if"),
        ("goes to t, not t_prev", "schedule.alpha_bar(t_prev, x_t.ndim)", "schedule.alpha_bar(t, x_t.ndim)"),
        ("steps: leading, not trailing", "for k in range(steps, 0, -1)]", "for k in range(steps - 1, -1, -1)]"),
        ("steps: off by one", "* k / steps) - 1 for", "* k / steps) - 2 for"),
        ("last jump stops at t = 0", "zip(ts, [*ts[1:], -1], strict=True)", "zip(ts, [*ts[1:], 0], strict=True)"),
        ("eta not handed on", "schedule, eta, generator)\n        if", "schedule, 0.0, generator)\n        if"),
    ),
]

AUTOENCODER = [
    *family(
        "quantiser",
        "autoencoder",
        ("second nearest code", "numpy())[1]).to", "numpy(), k=[2])[1][:, 0]).to"),
        (
            "average: decay for 1 - decay",
            "self.count.lerp_(hits.to(self.count.dtype), 1 - ",
            "self.count.lerp_(hits.to(self.count.dtype), ",
        ),
        ("average: total not divided", "self.total[chosen] / self.count[chosen, None]", "self.total[chosen]"),
        ("average: idle codes move too", "chosen = hits > 0", "chosen = hits >= 0"),
        ("restart: one step late", "self.idle >= self.restart_after", "self.idle > self.restart_after"),
        ("usage: not per code", ".sum()) / len(p))", ".sum()))"),
        (
            "scale: wrong way out",
            "z = latents / self.latent_scale + self.latent_shift\n        return",
            "z = latents * self.latent_scale + self.latent_shift\n        return",
        ),
        ("scale: shift added", "(self.encoder(x) - self.latent_shift)", "(self.encoder(x) + self.latent_shift)"),
        ("scale: variance for deviation", "1 / z.std(dim=(0, 2, 3)", "1 / z.var(dim=(0, 2, 3)"),
    ),
    *family(
        "straight-through",
        "autoencoder",
        ("no gradient", "return z + (codes - z).detach(), loss", "return codes, loss"),
        ("detach dropped", "return z + (codes - z).detach(), loss", "return z + (codes - z), loss"),
        ("sign", "return z + (codes - z).detach(), loss", "return z - (codes - z).detach(), loss"),
        ("gradient doubled", "return z + (codes - z).detach(), loss", "return 2 * z + (codes - 2 * z).detach(), loss"),
    ),
    *family(
        "commitment",
        "autoencoder",
        ("beta dropped", "loss = self.beta * F.mse_loss(z, codes)", "loss = F.mse_loss(z, codes)"),
        (
            "beta on the codebook's term",
            "self.beta * F.mse_loss(z, codes)",
            "self.beta * F.mse_loss(z.detach(), codes)",
        ),
        ("not squared", "self.beta * F.mse_loss(z, codes)", "self.beta * F.l1_loss(z, codes)"),
        ("sign", "loss = self.beta * F.mse_loss", "loss = -self.beta * F.mse_loss"),
    ),
]

ATTENTION = [
    *family(
        "attention",
        "unet",
        ("root of d dropped", "(q + place, k + place, v)", "(q + place, k + place, v, scale=1 / q.shape[-1])"),
        ("no scale", "(q + place, k + place, v)", "(q + place, k + place, v, scale=1.0)"),
        ("key and value swapped", "(q + place, k + place, v)", "(q + place, v + place, k)"),
        ("place not on the key", "(q + place, k + place, v)", "(q + place, k, v)"),
        ("place in the value", "(q + place, k + place, v)", "(q + place, k + place, v + place)"),
        ("heads left in front", "mixed.transpose(1, 2).flatten(2)", "mixed.reshape(mixed.shape[0], h * w, -1)"),
        (
            "place: rows and columns swapped",
            "rows.repeat_interleave(width, 0), columns.repeat(height, 1)",
            "rows.repeat(width, 1), columns.repeat_interleave(height, 0)",
        ),
        ("cross: the latent asks itself", "query=feature, source=latent", "query=latent, source=latent"),
        ("cross: query and source swapped", "query=feature, source=latent", "query=latent, source=feature"),
        ("cross: both kinds alike", '"latent": CrossAttentionLatentQuery}', '"latent": CrossAttentionFeatureQuery}'),
        ("self: input not added", "x = x + self.self_attention(x, x)", "x = self.self_attention(x, x)"),
        ("cross: input not added", "x = x + self.cross_attention(x, feature)", "x = self.cross_attention(x, feature)"),
        (
            "time: sines only",
            "torch.cat([angle.sin(), angle.cos()], dim=1)",
            "torch.cat([angle.sin(), angle.sin()], dim=1)",
        ),
        ("time: one frequency", "torch.exp(-math.log(longest) * torch", "torch.exp(0 * torch"),
    ),
]

METRICS = [
    *family(
        "metrics (Eq. 4-6, I2)",
        "metrics",
        ("RMSE: root dropped", "np.sqrt(np.mean((p - g) ** 2))", "np.mean((p - g) ** 2)"),
        ("RMSE: not squared", "np.sqrt(np.mean((p - g) ** 2))", "np.sqrt(np.mean(np.abs(p - g)))"),
        ("RMSE: sign", "np.mean((p - g) ** 2)", "np.mean((p + g) ** 2)"),
        ("RMSE: sum for mean", "np.sqrt(np.mean((p - g) ** 2))", "np.sqrt(np.sum((p - g) ** 2))"),
        ("MAE: signed", "float(np.mean(np.abs(p - g)))", "float(np.mean(p - g))"),
        ("REL: by the prediction", "np.mean(np.abs(p - g) / g)", "np.mean(np.abs(p - g) / p)"),
        ("delta: not strict", "np.maximum(p / g, g / p) < threshold", "np.maximum(p / g, g / p) <= threshold"),
        ("delta: the smaller ratio", "np.maximum(p / g, g / p)", "np.minimum(p / g, g / p)"),
        ("delta: as worded in the paper", "np.maximum(p / g, g / p) < threshold", "np.abs(p - g) / g < threshold - 1"),
        ("delta: not per cent", "100.0 * np.mean", "1.0 * np.mean"),
        ("CRPS: unfair", "max(size * (size - 1), 1)", "max(size * size, 1)"),
        ("CRPS: sign", "np.mean(error - spread)", "np.mean(error + spread)"),
        ("CRPS: rank weights off by one", "np.arange(size) - (size - 1)", "np.arange(size) - size"),
        ("unknown truth scored", "chosen = gt > 0 if mask", "chosen = gt >= 0 if mask"),
        ("sets: geometric where measured", "~region & (raw == 0)", "~region & (raw > 0)"),
        ("sets: geometric inside", "known & ~region & (raw == 0)", "known & region & (raw == 0)"),
        ("sets: outside is inside", '"outside": known & ~region}', '"outside": known & region}'),
        ("IoU: union for intersection", "_ratio((pred & true).sum(), (pred", "_ratio((pred | true).sum(), (pred"),
        ("miss rate: false alarms", "_ratio((true & ~pred).sum()", "_ratio((pred & ~true).sum()"),
        ("area ratio: upside down", "_ratio(pred.sum(), true.sum())", "_ratio(true.sum(), pred.sum())"),
    ),
    *family(
        "averages and intervals",
        "metrics",
        ("pooled RMSE: of roots", 'columns["rmse"] ** 2 / total', 'columns["rmse"] / total'),
        ("pooled: not weighed", "float(n @ values / total)", "float(values.mean())"),
    ),
    *family(
        "averages and intervals",
        "evaluation/statistics",
        ("interval: 90 per cent", "[2.5 / among, 100 - 2.5 / among]", "[5.0 / among, 100 - 5.0 / among]"),
        ("ratio: mean of ratios", "x.mean(axis=axis) / y.mean(axis=axis)", "(x / y).mean(axis=axis)"),
        ("pairs are torn apart", '"paired": paired,', '"paired": False,'),
    ),
    *family(
        "averages and intervals",
        "evaluation/uncertainty",
        ("kept: doubt forgotten", "np.ones_like(square), doubt], axis=1)", "np.ones_like(square), 0 * doubt], axis=1)"),
        ("temperature: upside down", "logs * np.exp(-log)", "logs * np.exp(log)"),
        ("risk: the worst are kept", 'np.argsort(score, kind="stable")', 'np.argsort(-score, kind="stable")'),
    ),
    *family(
        "audit of tables",
        "paper/audit",
        ("RMSE and MAE swapped", 'v["mae"] - v["rmse"] > 2', 'v["rmse"] - v["mae"] > 2'),
        ("rounding: not allowed for", 'v["rmse"] > 2 * half + TINY', 'v["rmse"] > TINY'),
        ("shares: direction", "if a - b > 2 * half_share", "if b - a > 2 * half_share"),
        ("floor: the worded one always", "(t - 1) if worded else (1 - 1 / t)", "(t - 1) if worded else (t - 1)"),
        ("floor: the field's one always", "(t - 1) if worded else (1 - 1 / t)", "(1 - 1 / t)"),
        ("floor: a band forgotten", " + (100 - d125) * c", ""),
        ("floor: not a ratio", "(floor - c * rounding) / 100", "(floor - c * rounding)"),
        ("weight: not a square", "None) ** power for x", "None) for x"),
        ("weight: parts swapped", "whole**power - outside**power", "whole**power - inside**power"),
        ("weight: rounding of nothing", "np.clip(x + s, 0, None)", "np.clip(x, 0, None)"),
        ("between: at or above both", "<= whole <= max(parts)", "<= whole >= max(parts)"),
        ("best: larger errors are better", "sign = 1 if metric", "sign = -1 if metric"),
        ("best: a tie is a defeat", "[metric] < sign * rows[name]", "[metric] <= sign * rows[name]"),
    ),
    *family(
        "protocols",
        "evaluation/protocols",
        ("input: dropped, not clipped", "if self.clip else np", "if not self.clip else np"),
        ("input: near readings kept", "np.where(depth < self.near_m, 0, far)", "far"),
        ("truth: range ignored", "(truth > self.truth_m[0]) & (truth < self.truth_m[1])", "(truth > 0)"),
        ("resizing: blends depths", "interpolation=cv2.INTER_NEAREST", "interpolation=cv2.INTER_LINEAR"),
        ("median is a mean", "float(np.median(error", "float(np.mean(error"),
        ("pooled column: per image", '{m: row["pooled"][m] for m in self.pooled}', "{m: row[m] for m in self.pooled}"),
        ("alignment: no shift", "np.ones(known.sum())", "np.zeros(known.sum())"),
        ("instances are the region", "sample.instances > 0", "sample.region"),
    ),
]

PARTITION = [
    *family(
        "partition (Eq. 1-2)",
        "loss_types",
        ("rgb: parts swapped", "rgb_op=np.where(inside, rgb, zero)", "rgb_op=np.where(inside, zero, rgb)"),
        ("rgb: not disjoint", "rgb_geo=np.where(inside, zero, rgb)", "rgb_geo=rgb"),
        ("depth: not disjoint", "depth_op=np.where(region, depth, np.float32(0))", "depth_op=depth"),
        ("depth: parts swapped", "np.where(region, np.float32(0), depth)", "np.where(region, depth, np.float32(0))"),
        ("union: inverted", "np.where(self.region, self.depth_op", "np.where(~self.region, self.depth_op"),
    ),
    *family(
        "labels and parallax",
        "loss_types",
        ("wrong: either threshold", "np.maximum(WRONG_ABS_M, WRONG_REL", "np.minimum(WRONG_ABS_M, WRONG_REL"),
        ("wrong: signed", "wrong = np.abs(depth - depth_gt)", "wrong = (depth_gt - depth)"),
        ("wrong: 2 mm", "WRONG_ABS_M = 0.010", "WRONG_ABS_M = 0.002"),
        ("missing counts as wrong", "np.where(depth == 0, 2, wrong)", "np.where(depth == 0, 1, wrong)"),
        ("unknown truth labelled", "codes[depth_gt == 0]", "codes[depth_gt < 0]"),
    ),
    *family(
        "labels and parallax",
        "camera",
        ("shadow: sign", "(1 / z_near - 1 / z_far)", "(1 / z_far - 1 / z_near)"),
        ("shadow: focal length dropped", "return fx * baseline_m *", "return baseline_m *"),
        ("reprojection: farthest wins", "np.minimum.at(nearest", "np.maximum.at(nearest"),
    ),
    *family(
        "shadows measured",
        "studies/shadows",
        ("moved the other way", "motion[0, 3] = offset_m", "motion[0, 3] = -offset_m"),
        ("raster not divided by", "(end - int(filled[-1])) / FINE", "(end - int(filled[-1]))"),
        ("near and far swapped", "shadow_width_px(near, far, offset_m", "shadow_width_px(near, 2 * far, offset_m"),
        ("principal point of the coarse raster", "(camera.cx + 0.5) * FINE - 0.5", "camera.cx * FINE"),
        ("thin objects count as clear", "(right < (near + far) / 2).all()", "(right > 0).all()"),
        ("second surfaces count as clear", "(np.abs(left - far) <= FACET_STEP * far).all()", "left.all()"),
        ("tolerance signed", "np.abs(self.measured_px - wanted)", "(self.measured_px - wanted)"),
    ),
    *family(
        "loss types guessed",
        "studies/loss_estimate",
        ("inside: every reading believed", "depth > (1 - IN_FRONT) * surroundings", "depth < 0"),
        (
            "inside: in front means wrong",
            "depth > (1 - IN_FRONT) * surroundings",
            "depth < (1 - IN_FRONT) * surroundings",
        ),
        ("outside: holes count as jumps", "np.where(valid, depth, np.float32(np.inf))", "np.where(valid, depth, 0)"),
        ("baseline added", "-= stereo.baseline_m", "+= stereo.baseline_m"),
        ("baseline dropped", "-= stereo.baseline_m", "-= 0"),
        ("a shadow falls on the near surface", "np.maximum(depth[rows, left]", "np.minimum(depth[rows, left]"),
        ("farther surfaces hide", "(before < (1 - FACET_STEP) * z)", "(before > (1 - FACET_STEP) * z)"),
        ("mirror and glass swapped", "Cause.REFLECTION if mirror else", "Cause.REFLECTION if not mirror else"),
        (
            "confusion transposed",
            "index[truth[counted]] * len(values) + index[guess",
            "index[guess[counted]] * len(values) + index[truth",
        ),
    ),
]

REGION = [
    *family(
        "learning rates (S3)",
        "training/loop",
        ("cosine: whole period", "math.cos(math.pi * p)", "math.cos(2 * math.pi * p)"),
        ("cosine: not halved", "(1 + math.cos(math.pi * p)) / 2", "(1 + math.cos(math.pi * p))"),
        ("exponential: rises", "math.exp(-fall * p)", "math.exp(fall * p)"),
        ("exponential: dropped", " * math.exp(-fall * p)", ""),
    ),
    *family(
        "learning rates (S3)",
        "training/as_the_paper",
        ("TROSNet: sign of the fall", "0.001 - 0.0004 * fallen", "0.001 + 0.0004 * fallen"),
        ("TROSNet: period", "iteration / 228", "iteration / 150"),
        ("deep supervision of nothing", "drawn.material, weight)", "0 * drawn.material, weight)"),
    ),
    *family(
        "the first look",
        "training/recipes",
        (
            "stage one: trained at the working size",
            "recipe.batch, config.look(), rng",
            "recipe.batch, config.size, rng",
        ),
    ),
    *family(
        "the first look",
        "training/parts",
        ("stage one: validated at the working size", "scenes, config.look())", "scenes, config.size)"),
        ("one folder: any looks", '"refine.looks", ', ""),
    ),
    *family(
        "the first look",
        "evaluation/training_costs",
        ("stage one: costs the working size", 'config.look() if part == "region" else', ""),
    ),
    *family(
        "the first look",
        "training/finetune",
        ("fine-tuning: at the working size", "size = config.look()", "size = config.size"),
    ),
    *family(
        "the first look",
        "config",
        ("a look: of the first alone", "self.refine.looks[0] if scale is None else scale", "self.refine.looks[0]"),
    ),
    *family(
        "glass that is read as it is",
        "training/views",
        ("read truly: opaque things, too", "true = lossy(view.material) & (", "true = (view.material >= 0) & ("),
        ("read truly: all of it", "rng.uniform(0, 0.8)))", "0))"),
        ("read truly: holes are always filled", "read &= view.depth > 0", "pass"),
        ("read truly: half a metre too near", "view.depth_gt * (1 + bias", "view.depth_gt * (0.5 + bias"),
    ),
    *family(
        "glass that is read as it is",
        "training/batches",
        ("read truly: never", "READ_TRULY = 0.4", "READ_TRULY = 0.0"),
    ),
    *family(
        "soft region (S4)",
        "training/finetune",
        ("threshold: at 0", "torch.sigmoid(steepness * (x - at))", "torch.sigmoid(steepness * x)"),
        ("threshold: always a half", "step(x, refine.threshold)", "step(x, 0.5)"),
        (
            "vote: no threshold",
            'x = step(F.avg_pool2d(F.pad(x, (pad,) * 4, mode="replicate"), refine.median, 1), 0.5)',
            'x = F.avg_pool2d(F.pad(x, (pad,) * 4, mode="replicate"), refine.median, 1)',
        ),
        ("vote: of another share", "refine.median, 1), 0.5)", "refine.median, 1), refine.threshold)"),
        ("vote: border of zeros", 'mode="replicate"', 'mode="constant"'),
        ("dilation: once", "range(refine.iterations if", "range(1 if"),
        ("straight-through: soft values", "return hard + (soft - soft.detach())", "return soft"),
        ("straight-through: no gradient", "return hard + (soft - soft.detach())", "return hard"),
        ("composition: parts swapped", "region * optical + (1 - region)", "(1 - region) * optical + region"),
        ("composition: holes kept", "torch.where(valid > 0, depth, geometric)", "depth"),
        (
            "composition: not in metres",
            "readings = batch.bounds.denormalise(batch.depth_n)",
            "readings = batch.depth_n",
        ),
        ("RMSE: not in metres", "(depth_m - batch.truth_m)", "(depth_m - batch.gt_n)"),
        ("RMSE: unknown truth scored", ".square() * batch.gt_known", ".square()"),
        ("weight dropped", "segmentation + rmse_weight * rmse,", "segmentation + rmse,"),
        ("painted for the found region alone", "torch.maximum(hard, batch.region)", "hard"),
        ("branches swapped", "return drawn[0], drawn[1]", "return drawn[1], drawn[0]"),
    ),
    *family(
        "prices of mistakes",
        "studies/regions",
        ("missed: false alarms", "known & sample.region & ~region\n", "known & ~sample.region & region\n"),
        ("discarded: holes too", "~sample.region & (sample.depth > 0)", "~sample.region"),
        ("price: sign", "(error - base)[pixels]", "(base - error)[pixels]"),
    ),
    *family(
        "prices of mistakes",
        "studies/robustness",
        ("distance: not relative", "frame.depth_gt[scored]) / scale, 6)", "frame.depth_gt[scored]) * scale, 6)"),
        ("strays: on glass", "(sample.depth > 0) & ~sample.region)", "(sample.depth > 0) & sample.region)"),
        ("room: its glass counts", "sample.region & (column > share + BORDER)", "sample.region"),
    ),
    *family(
        "prices of mistakes",
        "evaluation/stage_one",
        ("recall: by name", "metrics.miss_rate(found > 0,", "metrics.miss_rate(found == code,"),
    ),
]

BOUNDARY = [
    *family(
        "depth-aware map (I4)",
        "boundary/maps",
        (
            "as printed: no tolerance",
            "boundary_rgb & within(boundary_depth, tolerance)",
            "boundary_rgb & boundary_depth",
        ),
        ("the other map is grown", "boundary_rgb & within(boundary_depth,", "boundary_depth & within(boundary_rgb,"),
        ("union for intersection", "return boundary_rgb & within(", "return boundary_rgb | within("),
        ("distance: equal is too far", "distance <= tolerance + 1e-4", "distance < tolerance - 1e-4"),
        ("distance: city blocks", "cv2.DIST_L2, cv2.DIST_MASK_PRECISE", "cv2.DIST_L1, 3"),
    ),
    *family(
        "true outlines",
        "boundary/truth",
        (
            "jump: signed",
            "np.abs(depth_gt[first] - depth_gt[second]) > jump",
            "depth_gt[first] - depth_gt[second] > jump",
        ),
        ("jump: within an object, too", "found = differ & known", "found = known"),
        ("jump: unknown depth counts", "differ & known & apart", "differ & apart"),
        ("jump: background is marked", "return outline & jumps", "return jumps"),
        ("precision: of the true pixels", "float(right / pred.sum())", "float(right / true.sum())"),
        ("recall: counts predictions", "float(hit / true.sum())", "float(right / true.sum())"),
        ("F: not harmonic", "float(2 * precision * recall / (precision + recall))", "(precision + recall) / 2"),
    ),
]

FRAMES = [
    *family(
        "bounds",
        "conditioning",
        ("not logarithmic", "u = (xp.log(xp.where(positive, depth_m, 1.0))", "u = (xp.where(positive, depth_m, 1.0)"),
        ("middle: of the bounds' sum", "- (low + high) / 2) * (2", "- (low + high)) * (2"),
        ("not compressed beyond", "beyond = xp.sign(u) * (1 + xp.log(xp.where(size > 1, size, 1.0)))", "beyond = u"),
        ("compressed: a jump", "xp.sign(u) * (1 + xp.log", "xp.sign(u) * (2 + xp.log"),
        ("compressed: sign lost", "beyond = xp.sign(u) * (1 +", "beyond = (1 +"),
        ("inverse: not expanded", "xp.where(size > 1, size, 1.0) - 1)", "xp.where(size > 1, size, 1.0) * 0)"),
        (
            "missing is far",
            "return xp.where(positive, xp.where(size > 1, beyond, u), 0.0)",
            "return xp.where(size > 1, beyond, u)",
        ),
        ("middle: a mean", "middle = float(np.median(logs))", "middle = float(np.mean(logs))"),
        ("half range: a deviation", "np.median(np.abs(logs - middle))", "np.max(np.abs(logs - middle))"),
        ("no least range", "min(max(half, SPREADS[0]), SPREADS[1])", "min(half, SPREADS[1])"),
        ("no largest range", "min(max(half, SPREADS[0]), SPREADS[1])", "max(half, SPREADS[0])"),
        ("not wider downwards", "middle - 1.25 * half", "middle - half"),
        (
            "taken from all pixels",
            "if about is None else depth[about & (depth > 0)]",
            "if about is None else depth[depth > 0]",
        ),
    ),
    *family(
        "readings",
        "windows",
        ("taken at corners", "(2 * np.arange(count) + 1) * length", "2 * np.arange(count) * length"),
        ("not pooled", "            pool_readings(small, image)\n", "            pass\n"),
        ("pooled: the farthest from the centre", "order = np.argsort(-away", "order = np.argsort(away"),
        ("pooled: over readings", "(image > 0) & (small == 0)[", "(image > 0) & (small >= 0)["),
        ("tie: by differences", "np.multiply(painted[rows], np.exp", "np.add(painted[rows], np.exp"),
        (
            "tie: upside down",
            "np.log(np.where(known, depth, 1.0) / np.where(known, painted, 1.0))",
            "np.log(np.where(known, painted, 1.0) / np.where(known, depth, 1.0))",
        ),
        ("tie: by another surface", " & (np.abs(ratio) < np.log(SAME))", ""),
        ("padding: black", '(*self.padding, (0, 0)), mode="edge")', "(*self.padding, (0, 0)))"),
        ("tie: to the region, too", "    known &= ~region\n", ""),
    ),
    *family(
        "readings",
        "units",
        ("strays: all alike", "alike - 1 < 0.2 * read", "alike - 1 < 0 * read"),
        ("strays: judged by few", "valid & enough & (alike", "valid & (alike"),
        ("strays: a surface's edge", "alike - 1 < 0.2 * read", "alike - 1 < 0.8 * read"),
    ),
    *family(
        "readings",
        "conditioning",
        (
            "evidence: a reading alone",
            "offset = (fill(depth_n, known + seen) - filled)",
            "offset = (seen * depth_n - filled)",
        ),
        ("evidence: always shown", "seen = valid * region * float(evidence)", "seen = valid * region"),
        ("region counts as known", "known = valid * (1 - region)", "known = valid"),
        ("fill: ends with the shorter side", "if max(depth_n.shape[2:]) <= 1:", "if min(depth_n.shape[2:]) <= 1:"),
    ),
    *family(
        "readings",
        "pipeline",
        ("evidence: left to the final step", "views = views.without_evidence()", "views = views"),
        (
            "near things are lifted",
            "metres = metres.clamp(min=MIN_DEPTH_M)",
            "metres = torch.maximum(metres, 0.5 * bounds.low[:, 0])",
        ),
    ),
    *family(
        "windows",
        "windows",
        ("region shown as it is", "np.ones((2 * rim + 1,) * 2, np.uint8)", "np.ones((1, 1), np.uint8)"),
        ("as tight as the thing", "side = max(MARGIN * max(", "side = max(1.0 * max("),
        ("no least side", ", LEAST * longest)", ", 1)"),
        ("not moved into the frame", "first = min(max(first, 0), length - side)", "first = first + 0"),
        ("larger than the frame: not centred", "first = (length - side) // 2", "first = 0"),
        (
            "rows and columns swapped",
            "return Window(corner[0], corner[1], side)",
            "return Window(corner[1], corner[0], side)",
        ),
        ("outside is not empty", "            out[outside_rows] = 0\n", ""),
        ("pasted everywhere", "inner, where=where[y0:y1, x0:x1])", "inner)"),
        ("pasted: shifted", "part[y0 - self.top : y1 - self.top,", "part[: y1 - y0,"),
        ("a window for each blob", "full=len(boxes) >= most)", "full=False)"),
        ("never shared", "        if fits:\n", "        if fits and full:\n"),
        ("farthest window grows", "np.argmin(np.linalg.norm", "np.argmax(np.linalg.norm"),
        (
            "a shared window does not grow",
            "            members[home].append(blob)",
            "            members[home] = [blob]",
        ),
    ),
    *family(
        "encoder",
        "region/encoder",
        (
            "padding: symmetric",
            "(total // 2, total - total // 2) * 2 if stride > 1",
            "(total - total // 2, total // 2) * 2 if stride > 1",
        ),
        ("input not added", "return x + h if self.residual else h", "return h"),
        (
            "narrowed with a bend",
            "h = self.project(F.relu6(self.depthwise(h)))",
            "h = F.relu6(self.project(F.relu6(self.depthwise(h))))",
        ),
        ("stage of stride 16 taken early", "LAST_STAGE = (0, 1, 2, 4, 5)", "LAST_STAGE = (0, 1, 2, 3, 5)"),
    ),
    *family(
        "encoder",
        "training/pretrained",
        (
            "fold: variance not rooted",
            'torch.sqrt(state[f"{norm}.running_var"] + eps)',
            '(state[f"{norm}.running_var"] + eps)',
        ),
        ("fold: mean added", '- state[f"{norm}.running_mean"] * scale', '+ state[f"{norm}.running_mean"] * scale'),
        ("fold: mean not scaled", 'state[f"{norm}.running_mean"] * scale', 'state[f"{norm}.running_mean"]'),
    ),
    *family(
        "stage two",
        "stage_two",
        ("guides swapped (S8)", "= (M_DA, M_RGB)", "= (M_RGB, M_DA)"),
        ("painters swapped", 'BRANCHES = ("optical", "geometric")', 'BRANCHES = ("geometric", "optical")'),
        (
            "guided by the final step's map",
            "views.region, views.guide, painter.evidence",
            "views.region, views.boundary, painter.evidence",
        ),
        ("evidence always", "views.guide, painter.evidence", "views.guide, True"),
        ("not sharpened", "if painter.detail is not None:", "if painter.detail is None:"),
        (
            "sharpened outside its area",
            "views.valid, views.region, views.rgb",
            "views.valid, 1 - views.region, views.rgb",
        ),
        ("colour features at the wrong strides", "encoder(cl(rgb), levels=4)[1:]", "encoder(cl(rgb), levels=4)[:3]"),
        (
            "samples and views mixed",
            "mean = decoded.unflatten(0, (-1, count)).mean(dim=0)",
            "mean = decoded.unflatten(0, (count, -1)).mean(dim=1)",
        ),
        (
            "every sample the same noise",
            "for start in noise.split(GROUP * views):",
            "for start in noise[:1].expand(noise.shape).split(GROUP * views):",
        ),
    ),
    *family(
        "readings held (detail)",
        "detail",
        ("readings inside thrown away", "trust.new_tensor([3.0, -1.0])", "trust.new_tensor([3.0, -30.0])"),
        ("readings inside trusted as those outside", "trust.new_tensor([3.0, -1.0])", "trust.new_tensor([3.0, 3.0])"),
        ("trusts swapped", "(x[:, 2:4] * trust)", "(x[:, 2:4] * trust.flip(1))"),
        ("trust: the other way", "+ trust * (readings - spread[:, None])", "- trust * (readings - spread[:, None])"),
    ),
]


INPUTS = [
    *family(
        "files of any camera",
        "files",
        ("scale: of integers only", "if raw.dtype == np.float32 and scale == 1:", "if raw.dtype == np.float32:"),
        ("65535 is a distance", "row[stored == NO_READING] = 0", "pass"),
        ("PNG: checksums are not read", 'zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big")', "False"),
        ("JPEG: the end of a thumbnail counts", 'data.rfind(b"\\xff\\xd9") <', 'data.find(b"\\xff\\xd9") <'),
        ("PNG out: always millimetres", "depth_to_png(depth_m, depth_scale))", "depth_to_png(depth_m))"),
    ),
    *family(
        "one set of weights",
        "store",
        ("parts are not compared", 'if other in card["parts"] and card', "if False and card"),
        ("what a part was trained on is not noted", '{"built_on": below, **notes,', "{**notes,"),
        ("NaN is read", '_check_finite(name, tensors, "restore them or train again")', "pass"),
    ),
    *family(
        "cameras of datasets",
        "datasets/dreds",
        ("focal length: of another width", "zoom = width / wide", "zoom = 1.0"),
    ),
    *family(
        "stage one in a frame",
        "pipeline",
        ("the padding is claimed", "self.refine(claimed & frame.picture, refine)", "self.refine(claimed, refine)"),
        ("branches: the same noise", "2 * seed + BRANCHES.index(branch)", "2 * seed"),
        ("looks: only the first", "for scale in refine.looks]", "for scale in refine.looks[:1]]"),
    ),
    *family(
        "stage one scored",
        "evaluation/stage_one",
        (
            "overlap: after refinement",
            "metrics.iou((out.probability > ditr.config.refine.threshold) & judged, sample.region)",
            "metrics.iou(out.region, sample.region)",
        ),
    ),
    *family(
        "sensors' noise and dropouts",
        "simulator/tof",
        ("noise: falls as the light", "/ np.sqrt(np.maximum(amplitude, settings.floor))", "/ amplitude"),
        ("noise: no floor", "np.sqrt(np.maximum(amplitude, settings.floor))", "np.sqrt(amplitude)"),
        ("noise: grows with the light", "/ np.sqrt(np.maximum(amplitude, settings.floor))", "* np.sqrt(amplitude)"),
    ),
    *family(
        "sensors' noise and dropouts",
        "simulator/stereo",
        ("jump: another share", "> 0.04 * np.maximum(depth, 0.2)", "> 0.05 * np.maximum(depth, 0.2)"),
        ("jump: of the depth, however near", "> 0.04 * np.maximum(depth, 0.2)", "> 0.04 * depth"),
        ("jump: in metres", "> 0.04 * np.maximum(depth, 0.2)", "> 0.04"),
    ),
    *family(
        "calibration",
        "evaluation/uncertainty",
        ("fitted on a test split", "if name in HELD_OUT", "if name not in splits"),
        ("geometric: kept readings, too", '"geometric": ~region & ~read', '"geometric": ~region'),
        ("kept: what was painted, too", "KEPT: ~region & read", "KEPT: read"),
    ),
    *family(
        "a frame's way back",
        "windows",
        ("spread: of the geometric branch", 'layer.onto(out, "spread", region)', "pass"),
        ("composed: the optical branch outside its area", 'layer.onto(out, "mean", region)', 'layer.onto(out, "mean")'),
        ("composed: the geometric branch inside", 'layer.onto(out, "mean", region)', "pass"),
        ("composed: readings lost", "np.copyto(out, depth, where=(depth > 0) & ~region)", "pass"),
        ("composed: readings of the region, too", "where=(depth > 0) & ~region)", "where=depth > 0)"),
        ("holes: everything is raised", "out=painted[rows], where=holes[rows])", "out=painted[rows])"),
        ("rows of cells are mixed", "np.searchsorted(y, (cells.start, cells.stop))", "(cells.start, cells.stop)"),
    ),
]
MISTAKES = [
    *family(
        "mistakes of a frame",
        "units",
        ("inverse: depth taken for it", "(where, values, rng) > _on", "(where, 1 / values, rng) > _on"),
        ("inverse: coarse values, too", "if not steps.size or", "if False and"),
        ("BGR: judged as it came only", "and _of_jpeg(pixels[:, ::-1]) > LATTICE[1]", ""),
        ("BGR: grey, too", "> 8)]", "> -1)]"),
        ("BGR: blue's scale for red", "(red - luminance) / 1.402)", "(red - luminance) / 1.772)"),
        ("swapped: the other way round", "reverse.mean() - lost.mean()", "lost.mean() - reverse.mean()"),
        ("swapped: gaps only", "| (both & (truth > 1.01 * depth))", ""),
        ("swapped: noise, too", "(truth > 1.01 * depth)", "(truth > depth)"),
    ),
]
MUTANTS: list[Mutant] = [
    *SCHEDULE,
    *DIFFUSION,
    *AUTOENCODER,
    *ATTENTION,
    *METRICS,
    *PARTITION,
    *REGION,
    *BOUNDARY,
    *FRAMES,
    *INPUTS,
    *MISTAKES,
]


def mutate(source: str, mutant: Mutant) -> str:
    """Return ``source`` with the mistake in it.

    Raises:
        ValueError: unless the passage occurs exactly once and changes.
    """
    found = source.count(mutant.old)
    if found != 1 or mutant.old == mutant.new:
        raise ValueError(f"{mutant.file}.py: {mutant.old!r} occurs {found} times, expected once; update {__file__}")
    return source.replace(mutant.old, mutant.new)


def run_tests(mutant: Mutant | None, tests: Sequence[str]) -> tuple[int, str, float]:
    """Run test files on a copy of the package with ``mutant`` in it (None: as it is).

    Returns:
        pytest's exit status (0: all passed, 1: one failed), the failed test, seconds.
    """
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        left_out = shutil.ignore_patterns("*.safetensors", "__pycache__")
        for part in ("ditr_lite", SCENES):
            shutil.copytree(ROOT / part, copy / part, ignore=left_out)
        fixtures = {str(Path(test).with_name("conftest.py")) for test in tests}
        for file in (*tests, HELPER, *(f for f in fixtures if (ROOT / f).is_file())):
            (copy / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, copy / file)
        if mutant is not None:
            target = copy / "ditr_lite" / f"{mutant.file}.py"
            target.write_text(mutate(target.read_text(encoding="utf-8"), mutant), encoding="utf-8")
        # the copy comes first on the path, before an installed package; comparisons with libraries and tests on all
        # rendered scenes take long and are left out
        plain = [
            "-p",
            "no:cacheprovider",
            "-p",
            "no:nbval",
            "--import-mode=importlib",
            "--rootdir",
            folder,
            "-k",
            "not diffusers and not rendered",
        ]
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=line", *plain, *tests]
        paths = os.pathsep.join((folder, str(copy / "tests")))
        environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
        result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    failed = re.search(r"^(?:FAILED|ERROR) \S+?::(\S+)", result.stdout, flags=re.MULTILINE)
    reason = failed[1] if failed else result.stdout.strip().splitlines()[-1:] or result.stderr[-200:]
    return result.returncode, str(reason), time.perf_counter() - start


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return 0 when every mutant was killed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="run only mutants whose formula, file or mistake contains this")
    parser.add_argument("--jobs", type=int, default=1, help="how many to run at a time (default 1)")
    options = parser.parse_args(arguments)
    chosen = [m for m in MUTANTS if options.only in f"{m.formula} {m.file} {m.mistake}"]
    for test in sorted({m.tests for m in chosen}):
        status, reason, _ = run_tests(None, [test])
        if status:
            print(f"{test} fails without any mutant ({reason}): repair that first", file=sys.stderr)
            return 2
    survivors, formula = [], ""
    with ThreadPoolExecutor(options.jobs) as pool:
        results = pool.map(lambda m: run_tests(m, [m.tests]), chosen)
        for mutant, (status, reason, seconds) in zip(chosen, results, strict=True):
            if mutant.formula != formula:
                formula = mutant.formula
                print(f"\n{formula}  (ditr_lite/{mutant.file}.py)")
            verdict = "killed by " + reason if status == 1 else f"SURVIVED (pytest status {status})"
            survivors += [mutant] * (status != 1)
            print(f"  {mutant.mistake:42s} {seconds:5.1f} s  {verdict}", flush=True)
    killed = len(chosen) - len(survivors)
    print(f"\n{killed} of {len(chosen)} mutants killed ({100 * killed / max(len(chosen), 1):.0f} %)")
    return 1 if survivors or not chosen else 0


if __name__ == "__main__":
    sys.exit(main())
