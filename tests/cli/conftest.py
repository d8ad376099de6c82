"""A tiny system, scenes and a frame for the tests of commands."""

import cv2
import numpy as np
import pytest
import torch

from ditr_lite import data, pipeline, store
from ditr_lite.config import preset

SHAPE = (64, 96)


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    """Untrained weights of the tiny preset: enough to run everything."""
    folder, config = tmp_path_factory.mktemp("weights"), preset("tiny")
    for name, module in pipeline.build(config).items():
        store.save_part(name, module.state_dict(), config, folder, {})
    return folder


@pytest.fixture(scope="session")
def woken(tmp_path_factory):
    """The same with output layers that do not start at zero, so that noise shows in what is painted."""
    folder, config = tmp_path_factory.mktemp("woken"), preset("tiny")
    torch.manual_seed(0)
    for name, module in pipeline.build(config).items():
        for parameter in module.parameters():
            if parameter.ndim > 1 and not parameter.any():
                torch.nn.init.normal_(parameter, std=0.05)
        store.save_part(name, module.state_dict(), config, folder, {})
    return folder


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """Three small samples in each of the splits test and val."""
    root = tmp_path_factory.mktemp("scenes")
    rng = np.random.default_rng(0)
    truth = np.tile(np.linspace(0.5, 0.7, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    material = np.zeros(SHAPE, np.uint8)
    material[20:36, 30:50] = data.TRANSPARENT
    for split in ("test", "val"):
        for k in range(3):
            rgb = rng.integers(0, 255, (*SHAPE, 3), np.uint8)
            depth = np.where(rng.random(SHAPE) < 0.1, 0, truth + 0.03 * (material > 0)).astype(np.float32)
            sample = data.Sample(
                f"{split}_{k:05d}", rgb, depth, truth, material > 0, material=material, instances=material
            )
            data.save_sample(sample, root / split / sample.name)
    return root


@pytest.fixture
def frame(tmp_path):
    """Return a folder with a good frame: a.png, b.png, m.png, K.txt."""
    folder = tmp_path / "in"
    folder.mkdir()
    rng = np.random.default_rng(1)
    cv2.imwrite(str(folder / "a.png"), rng.integers(0, 255, (*SHAPE, 3), np.uint8))
    depth = np.full(SHAPE, 600, np.uint16)
    depth[10:14, 10:20] = 0
    cv2.imwrite(str(folder / "b.png"), depth)
    mask = np.zeros(SHAPE, np.uint8)
    mask[20:36, 30:50] = 255
    cv2.imwrite(str(folder / "m.png"), mask)
    (folder / "K.txt").write_text("90 0 47.5\n0 90 31.5\n0 0 1\n")
    return folder
