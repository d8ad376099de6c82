"""Two processes (gloo, started by torchrun) train as one does: a denoiser of a branch, from the same draws."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from made_scenes import make_scenes
from safetensors.torch import load_file, save_file

from ditr_lite.boundary import get_backend
from ditr_lite.config import preset
from ditr_lite.pipeline import build
from ditr_lite.training import recipes
from ditr_lite.training.loop import Engine, Recipe, fit, is_first, leave
from ditr_lite.training.parts import painter_of
from ditr_lite.training.scenes import Pool

ROOT = Path(__file__).resolve().parents[2]
TINY = preset("tiny")
RECIPE = Recipe(steps=4, batch=4, lr=1e-3, warmup=1, decay=0.5)


def train(folder, engine=None, steps=4):
    """Train a denoiser and return its weights and losses; in several processes, each its share of every batch."""
    torch.manual_seed(0)
    parts = build(TINY)
    parts["autoencoder"].eval().requires_grad_(False)
    painter, pool = painter_of("geometric", parts, TINY), Pool([make_scenes(4, (64, 96))])
    recipe = Recipe(**{**vars(RECIPE), "steps": steps})
    step = recipes.branch_step("geometric", painter, pool, TINY, recipe, get_backend("classical"))
    losses = []
    how = {"every": 2, "engine": engine or Engine(cpu=True), "watch": lambda k, row: losses.append(row["total"])}
    fit("geometric", painter.net, step, recipe, folder, validate=lambda: {"seen": 1.0}, best="seen", **how)
    return painter.net.state_dict(), losses


def main(folder, workers):
    """Do it in one of several processes; the first writes what came out."""
    weights, losses = train(Path(folder) / "work", Engine(cpu=True, workers=int(workers)))
    if is_first():
        save_file({k: v.contiguous() for k, v in weights.items()}, Path(folder) / "out.safetensors")
        (Path(folder) / "losses.txt").write_text(" ".join(map(repr, losses)))
    leave()


def started_by_torchrun(folder, workers=0, count=2):
    surroundings = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}", __file__]
    return subprocess.run(
        [*command, str(folder), str(workers)], cwd=ROOT, env=surroundings, capture_output=True, text=True, timeout=600
    )


@pytest.mark.skipif(sys.platform == "win32", reason="torch's build for Windows has no libuv store")
def test_two_processes_train_as_one_does(tmp_path):
    wanted, losses = train(tmp_path / "one")
    done = started_by_torchrun(tmp_path, workers=1)
    assert done.returncode == 0, done.stderr[-3000:]
    found = load_file(tmp_path / "out.safetensors")
    assert list(map(float, (tmp_path / "losses.txt").read_text().split())) == pytest.approx(losses, rel=1e-4)
    for key, value in wanted.items():
        torch.testing.assert_close(found[key], value, rtol=1e-3, atol=1e-4)
    with pytest.warns(UserWarning, match="batches in 2 shares, now 1: the same training, but for rounding"):
        train(tmp_path / "work", steps=6)  # one process goes on from where two were


def test_accumulation_trains_a_denoiser_as_the_whole_batch_does():
    wanted, losses = train(None)
    found, again = train(None, Engine(cpu=True, accumulate=4))
    assert again == pytest.approx(losses, rel=1e-4)
    for key, value in wanted.items():
        torch.testing.assert_close(found[key], value, rtol=1e-3, atol=1e-4)


if __name__ == "__main__":
    main(*sys.argv[1:])
