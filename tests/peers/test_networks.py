import numpy as np
import pytest
import torch

from ditr_lite.autoencoder import VQAutoencoder
from ditr_lite.config import preset
from ditr_lite.data import load_sample
from ditr_lite.peers import networks
from ditr_lite.pipeline import compose
from ditr_lite.store import save_part

TINY = preset("tiny")
ALL = (*networks.NAMES, "rgb_only_aligned")


def make(name):
    torch.manual_seed(0)
    net = networks.build_peer(name.removesuffix("_aligned"), TINY)
    for p in net.parameters():
        torch.nn.init.normal_(p, std=0.02)
    autoencoder = VQAutoencoder(TINY.autoencoder).eval() if name == "single_latent_diffusion" else None
    return networks.Peer(name, net, TINY, autoencoder)


@pytest.fixture(scope="module")
def frame():
    return load_sample("val_00000")


@pytest.mark.parametrize("name", ALL)
def test_every_peer_answers_like_a_baseline(name, frame):
    depth = make(name)(frame.rgb, frame.depth, frame.region)
    assert depth.shape == frame.depth.shape and depth.dtype == np.float32
    assert np.isfinite(depth).all() and (depth > 0).all()
    composed = compose(frame.depth, depth, depth, frame.region)
    kept = (frame.depth > 0) & ~frame.region
    assert (composed[kept] == frame.depth[kept]).all()


def test_colour_alone_looks_at_no_depth(frame):
    peer = make("rgb_only")
    other = np.where(frame.depth > 0, frame.depth + 0.01 * (frame.depth > 0.8), 0).astype(np.float32)
    assert np.allclose(peer(frame.rgb, frame.depth), peer(frame.rgb, other), atol=1e-6)


def test_alignment_undoes_a_scale_and_a_shift():
    truth = np.random.default_rng(0).uniform(0.4, 0.9, (12, 16)).astype(np.float32)
    readings = np.where(truth > 0.6, truth, 0)
    assert np.allclose(networks.aligned(2 * truth - 0.3, readings), truth, atol=1e-5)


def test_confidence_decides_between_prediction_and_sensor():
    depth_n, valid = torch.full((1, 1, 4, 4), 0.5), torch.ones(1, 1, 4, 4)
    out = torch.zeros(1, 3, 4, 4)
    out[:, 0], out[:, 1, :2], out[:, 2, 2:] = -1, 50, 50
    depth = networks.predicted_depth("two_stream_confidence", out, depth_n, valid)
    assert torch.allclose(depth[..., :2, :], torch.tensor(-1.0)) and torch.allclose(
        depth[..., 2:, :], torch.tensor(0.5)
    )


@pytest.mark.parametrize("name", ["rgb_only", "normals_optimisation", "nobody"])
def test_an_output_that_is_no_normalised_depth_is_refused(name):
    one = torch.ones(1, 1, 4, 4)
    with pytest.raises(ValueError, match=f"expected regression or two_stream_confidence, got '{name}'"):
        networks.predicted_depth(name, one, one, one)


def test_readings_inside_the_region_do_not_steer_the_solve(frame):
    peer = make("normals_optimisation")
    far = np.where(frame.region & (frame.depth > 0), frame.depth + 0.3, frame.depth).astype(np.float32)
    assert not np.allclose(peer(frame.rgb, far), peer(frame.rgb, far, frame.region), atol=1e-3)
    assert np.isfinite(peer(frame.rgb, frame.depth, np.ones_like(frame.region))).all()  # nothing left outside


def test_peers_are_loaded_from_their_folder(tmp_path, frame):
    net = make("rgb_only").net
    save_part("rgb_only-0", net.state_dict(), TINY, tmp_path, {"minutes": 1})
    found = networks.load_peers(tmp_path)
    assert set(found) == {"rgb_only", "rgb_only_aligned"}
    assert np.abs(found["rgb_only"](frame.rgb, frame.depth) - make("rgb_only")(frame.rgb, frame.depth)).max() < 0.01
    with pytest.raises(ValueError, match="no peers of seed 3"):
        networks.load_peers(tmp_path, seed=3)
    with pytest.raises(ValueError, match="unknown peer 'oracle'"):
        networks.build_peer("oracle", TINY)
