import numpy as np
import pytest

from ditr_lite.peers.gradient_solve import solve


@pytest.fixture
def plane():
    """A slanted table, (24, 32) metres: its inverse depth is linear on the image."""
    v, u = np.indices((24, 32))
    return 1 / (1.5 - 0.01 * v + 0.004 * u)


def log_gradients(depth):
    """Return differences of log depth to the next pixel on the right, and below; 0 at the end."""
    log = np.log(depth)
    return np.stack([np.diff(log, axis=1, append=log[:, -1:]), np.diff(log, axis=0, append=log[-1:])])


def test_a_slanted_plane_comes_back_from_its_orientation_and_a_few_readings(plane):
    readings = np.zeros_like(plane)
    readings[:4, :4] = plane[:4, :4]
    solved = solve(readings, log_gradients(plane), np.zeros_like(plane))
    assert solved.shape == plane.shape and solved.dtype == np.float32
    assert np.abs(solved - plane)[1:-1, 1:-1].max() < 0.004
    flat = solve(readings, np.zeros((2, 24, 32)), np.zeros_like(plane))  # without orientation it stays level
    assert np.abs(flat - plane).max() > 0.05


def test_a_curved_surface_comes_back_level():
    v, u = np.indices((24, 32))
    bowl = 1.0 + 0.0006 * (u - 15.5) ** 2 + 0.0009 * (v - 11.5) ** 2
    readings = np.zeros_like(bowl)
    readings[10:14, 14:18] = bowl[10:14, 14:18]
    solved = solve(readings, log_gradients(bowl), np.zeros_like(bowl))
    error = (solved - bowl)[2:-2, 2:-2]
    assert np.abs(error).max() < 0.006  # 0.02 where gradients are those of a block's first pixels: it tilts
    assert abs(error[:, 0].mean() - error[:, -1].mean()) < 0.002


def test_depth_does_not_run_over_an_edge():
    readings, edges = np.zeros((16, 32)), np.zeros((16, 32))
    readings[:, :2], readings[:, -2:] = 0.5, 1.0
    edges[:, 15:17] = 1
    smooth, cut = (solve(readings, np.zeros((2, 16, 32)), e) for e in (np.zeros_like(edges), edges))
    assert np.abs(cut[:, 4:12] - 0.5).max() < np.abs(smooth[:, 4:12] - 0.5).max() / 2


def test_a_single_reading_is_enough_and_none_is_refused():
    readings = np.zeros((8, 8))
    with pytest.raises(ValueError, match="no reading to solve from"):
        solve(readings, np.zeros((2, 8, 8)), readings)
    readings[3, 4] = 0.7
    assert np.allclose(solve(readings, np.zeros((2, 8, 8)), np.zeros((8, 8))), 0.7, atol=1e-5)
    with pytest.raises(ValueError, match="expected gradients"):
        solve(readings, np.zeros((2, 4, 8)), np.zeros((8, 8)))
