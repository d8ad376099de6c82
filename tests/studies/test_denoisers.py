import numpy as np
import pytest

from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES
from ditr_lite.pipeline import build
from ditr_lite.studies import denoisers
from ditr_lite.training.scenes import Pool, load_scenes

TINY = preset("tiny")


@pytest.fixture(scope="module")
def pool():
    return Pool([load_scenes(SAMPLES / "train", 2)])


@pytest.fixture(scope="module")
def given():
    autoencoder = build(TINY)["autoencoder"].eval().requires_grad_(False)
    return {"autoencoder": autoencoder}


def test_every_variant_is_a_system_that_can_be():
    lite = preset("lite")
    changed = {name: override(lite, **v.settings) for name, v in denoisers.DENOISERS.items()}
    assert changed["default"] == lite and changed["concatenation"].unet.attention_levels == ()
    assert changed["eps"].sampler.prediction == "eps" and not changed["eps"].unet.anchor


@pytest.mark.parametrize("name", ["default", "decoded depth", "no average", "v"])
def test_a_variant_is_trained_and_scored(name, pool, given, tmp_path):
    painter, config, notes = denoisers.train_denoiser(name, 1e-5, pool, given, TINY, tmp_path, batch=2)
    again = denoisers.train_denoiser(name, 1e-5, pool, given, TINY, tmp_path, batch=2)[2]
    assert again == notes  # nothing is trained twice, and no step is timed anew
    assert notes["steps"] == 1 and notes["parameters"] > 0
    errors = denoisers.denoiser_errors(painter, config, pool.groups[0], 1, 2)
    assert len(errors) == 2 and (errors > 0).all()


def test_decoded_depth_reaches_the_denoiser(pool, given):
    net = build(TINY)["optical"]
    painter = denoisers.Painter(net, given["autoencoder"], None, None, True)
    recipe = denoisers.Recipe(steps=1, batch=2, lr=1e-3)
    step = denoisers.variant_step(denoisers.DENOISERS["decoded depth"], painter, pool, TINY, recipe, 0)
    losses = step(0)
    losses["depth"].backward()
    assert net.out.weight.grad.abs().sum() > 0
    total, latent, depth = (losses[key].item() for key in ("total", "latent", "depth"))
    assert total == pytest.approx(latent + denoisers.DECODED * depth)


@pytest.mark.parametrize(("name", "minutes", "reason"), [("gan", 1, "unknown variant"), ("v", 0, "positive number")])
def test_what_cannot_be_is_refused(name, minutes, reason, pool, given, tmp_path):
    with pytest.raises(ValueError, match=reason):
        denoisers.train_denoiser(name, minutes, pool, given, TINY, tmp_path)


def test_the_table_pairs_every_variant_with_the_default():
    usual = np.linspace(0.02, 0.05, 8)
    ways = [denoisers.way_of(*asked) for asked in denoisers.ASKED]
    errors = {"default": dict.fromkeys(ways, usual), "x0": dict.fromkeys(ways, usual + 0.01)}
    summary = denoisers.summarise_denoisers(errors)
    assert summary["x0"][ways[0]]["minus_default"] == pytest.approx((0.01, 0.01, 0.01))
    head, default, x0 = denoisers.format_denoisers({"summary": summary}).splitlines()
    assert "5 steps, 1 sample" in head and "+1.00 [+1.00, +1.00]" in x0 and "3.50" in default
