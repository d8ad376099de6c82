import numpy as np
import pytest
import torch

from ditr_lite.config import preset
from ditr_lite.data import load_sample
from ditr_lite.peers import system
from ditr_lite.pipeline import build
from ditr_lite.store import save_part

TINY = preset("tiny")
NOTES = {"arm": "x", "seed": 0}


@pytest.fixture(scope="module")
def frame():
    return load_sample("val_00000")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("arms")
    save_part("autoencoder", build(TINY)["autoencoder"].state_dict(), TINY, folder, {})
    names = {name: name for name in (*system.IDEAS, *system.SINGLE)}
    names |= {f"ditr_{name}": name for name in system.OWN} | {f"dp_{name}": name for name in system.BRANCHES}
    for tag, name in names.items():
        net = system.build_network(name, TINY)
        for p in net.parameters():
            torch.nn.init.normal_(p, std=0.02)
        save_part(f"{tag}-0", net.state_dict(), TINY, folder, NOTES)
    return folder


ALL = ("ditr", "dp", "bb", *system.PEERS)


def test_all_arms_are_found(folder):
    assert system.trained(folder) == dict.fromkeys(ALL, (0,))


@pytest.mark.parametrize("arm", ALL)
def test_every_arm_is_called_as_ditr_is_and_keeps_readings_outside(arm, folder, frame):
    out = system.load_arm(folder, arm)(frame.rgb, frame.depth, frame.region)
    assert out.depth.shape == frame.depth.shape and (out.depth > 0).all()
    kept = (frame.depth > 0) & ~frame.region
    assert (out.depth[kept] == frame.depth[kept]).all()
    assert len(out.windows) > 0  # the optical part is painted in windows, whoever paints


@pytest.mark.parametrize("arm", ["regression", "implicit_rays", "point_completion", "single_latent_diffusion"])
def test_distance_is_no_matter(arm, folder, frame):
    painter = system.load_arm(folder, arm)
    one, far = (painter(frame.rgb, (k * frame.depth).astype(np.float32), frame.region).depth for k in (1, 3))
    assert np.median(np.abs(far / one - 3)[frame.region]) < 0.01


def test_an_alignment_is_another_reading_of_the_same_weights(folder, frame):
    plain, aligned = (system.load_arm(folder, arm) for arm in ("rgb_only", "rgb_only_aligned"))
    assert torch.equal(plain.parts["idea"].net.out.weight, aligned.parts["idea"].net.out.weight)
    both = [a(frame.rgb, frame.depth, frame.region).depth for a in (plain, aligned)]
    assert not np.allclose(*both)


def test_the_single_denoiser_is_told_of_no_region(folder, frame, monkeypatch):
    painter, seen = system.load_arm(folder, "bb"), []
    usual = system.Ditr.paint

    def spy(self, target, views, *rest):
        seen.append(views)
        return usual(self, target, views, *rest)

    monkeypatch.setattr(system.Ditr, "paint", spy)
    painter(frame.rgb, frame.depth, frame.region)
    assert len(seen) == 2 and not any(views.region.any() for views in seen)


def test_what_has_not_been_trained_is_refused(folder, tmp_path):
    with pytest.raises(ValueError, match="no weights called 'bb-3'"):
        system.load_arm(folder, "bb", 3)
    with pytest.raises(ValueError, match="unknown peer 'oracle'"):
        system.load_arm(folder, "oracle")
    with pytest.raises(ValueError, match="no weights in"):
        system.trained(tmp_path)
