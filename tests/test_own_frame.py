"""Notebook 09 runs with any frame: one cell names it, all that follows takes it as it is, and no truth is needed."""

import ast
from dataclasses import replace
from pathlib import Path

import cv2
import nbformat
import numpy as np
import pytest

from ditr_lite import pipeline
from ditr_lite.config import preset
from ditr_lite.data import list_samples, load_sample
from ditr_lite.windows import at_centres

ROOT = Path(__file__).resolve().parents[1]
FRAME, LAST = "c-frame", "c28"  # the reader's cell, and the last one that works on it
MINE = {"RGB", "DEPTH", "K"}


def code_cells():
    cells = nbformat.read(ROOT / "notebooks" / "09_your_own_camera.ipynb", as_version=4).cells
    return {cell.id: cell.source for cell in cells if cell.cell_type == "code"}


def names(source, kind):
    return {
        node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name) and isinstance(node.ctx, kind)
    }


CELLS = code_cells()
ORDER = list(CELLS)
OWN = ORDER[: ORDER.index(LAST) + 1]


@pytest.fixture(scope="module")
def tiny():
    """An untrained system: that every cell runs is no matter of its weights."""
    config = preset("tiny")
    return pipeline.Ditr(pipeline.build(config), config)


def photographed():
    """Return a frame of 640 x 480 as a camera gives it: colour and depth with holes, nothing else."""
    sample = load_sample(list_samples("rooms_val")[4])
    rgb = cv2.resize(sample.rgb, (640, 480), interpolation=cv2.INTER_CUBIC)
    depth = at_centres(sample.depth, (480, 640))
    assert (depth == 0).any()
    return rgb, depth


@pytest.mark.parametrize("glass", [True, False], ids=["with glass", "without glass"])
@pytest.mark.filterwarnings("ignore")
def test_every_cell_runs_with_a_frame_of_another_size_and_without_truth(glass, tiny, monkeypatch, capsys):
    rgb, depth = photographed()

    claim = tiny.claim

    def claim_a_block_or_nothing(*frame):
        found = claim(*frame)
        region = np.zeros_like(found.region)
        if glass:
            height, width = region.shape
            region[height // 2 : 3 * height // 4, width // 3 : width // 2] = True
        return replace(found, region=region)

    monkeypatch.setattr(pipeline.Ditr, "from_pretrained", lambda *_, **__: tiny)
    monkeypatch.setattr(tiny, "claim", claim_a_block_or_nothing)
    space = {"__name__": "notebook"}
    for cell in OWN:
        if cell == FRAME:
            space |= {"RGB": rgb.copy(), "DEPTH": depth.copy(), "K": None}
        else:
            exec(compile(CELLS[cell], cell, "exec"), space)
    assert space["out"].depth.shape == (480, 640) and space["K"].width == 640
    assert (space["RGB"] == rgb).all() and (space["DEPTH"] == depth).all()  # no cell changes the reader's frame
    assert "640 x 480 pixels" in capsys.readouterr().out
    assert space["clouds"]["raw"].shape == ((480, 640) if not glass else space["RGB"][space["box"]].shape[:2])


def test_the_frame_stands_in_one_cell():
    assert names(CELLS[FRAME], ast.Store) == MINE
    written = [cell for cell in ORDER if names(CELLS[cell], ast.Store) & MINE and cell != FRAME]
    assert written == ["c-look"]  # guesses a camera where none was given


def test_nothing_that_runs_with_the_frame_asks_for_truth():
    after = OWN[ORDER.index(FRAME) + 1 :]
    assert len(after) > 15
    for cell in after:
        assert "depth_gt" not in CELLS[cell] and "stand_in" not in CELLS[cell], cell


def test_what_follows_does_not_depend_on_the_frame():
    made = set().union(*(names(CELLS[cell], ast.Store) for cell in OWN[ORDER.index(FRAME) :]))
    shared = {"ditr"}  # the system, not the frame
    seen: set[str] = set()
    for cell in ORDER[len(OWN) :]:
        seen |= names(CELLS[cell], ast.Store)
        arguments = {node.arg for node in ast.walk(ast.parse(CELLS[cell])) if isinstance(node, ast.arg)}
        taken = names(CELLS[cell], ast.Load) & (made | MINE) - shared - seen - arguments
        assert not taken, f"{cell} takes {sorted(taken)} of the reader's frame"
