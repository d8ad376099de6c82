import numpy as np
import pytest
import torch

from ditr_lite.config import preset
from ditr_lite.data import load_sample
from ditr_lite.evaluation.protocols import fitted
from ditr_lite.peers import networks
from ditr_lite.pipeline import build, compose
from ditr_lite.stage_two import Painter
from ditr_lite.store import save_part

TINY = preset("tiny")
ALL = (*networks.NAMES, "rgb_only_aligned")


def make(name):
    torch.manual_seed(0)
    net = networks.build_peer(name.removesuffix("_aligned"), TINY)
    for p in net.parameters():
        torch.nn.init.normal_(p, std=0.02)
    autoencoder = build(TINY)["autoencoder"].eval()
    painter = Painter(net, autoencoder, None, None, False) if name == "single_latent_diffusion" else None
    return networks.Peer(name, net, TINY, painter)


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
    assert np.allclose(fitted(2 * truth - 0.3, readings), truth, atol=1e-5)


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


@pytest.mark.parametrize("name", ["regression", "two_stream_confidence", "single_latent_diffusion"])
def test_a_room_behind_and_strays_move_a_prediction_by_little(name, frame):
    peer = make(name)
    far = frame.depth.copy()
    far[5:8:2, 5:250:9] = 30.0
    before, after = peer(frame.rgb, frame.depth), peer(frame.rgb, far)
    assert np.median(np.abs(after / before - 1)) < 0.005


def test_distance_is_no_matter_to_what_sees_depth(frame):
    for name in ("regression", "single_latent_diffusion"):
        one, far = (make(name)(frame.rgb, (k * frame.depth).astype(np.float32)) for k in (1, 3))
        assert np.median(np.abs(far / one - 3)) < 0.01


def test_the_single_denoiser_is_handed_what_the_system_has(tmp_path, frame):
    parts = build(TINY)
    save_part("autoencoder", parts["autoencoder"].state_dict(), TINY, tmp_path, {})
    net = make("single_latent_diffusion").net
    save_part("single_latent_diffusion-0", net.state_dict(), TINY, tmp_path, {})
    peer = networks.load_peers(tmp_path, weights=tmp_path)["single_latent_diffusion"]
    assert peer.painter.net is peer.net and peer.painter.encoder is None and not peer.painter.evidence
    wanted = parts["autoencoder"].state_dict()["latent_scale"].half().float()
    assert torch.equal(peer.painter.autoencoder.state_dict()["latent_scale"], wanted)
    assert (peer(frame.rgb, frame.depth) > 0).all()
    with pytest.raises(ValueError, match="no weights called 'autoencoder'"):
        save_part("x", {}, TINY, tmp_path / "empty", {})
        networks.single_painter(net, TINY, tmp_path / "empty")


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
