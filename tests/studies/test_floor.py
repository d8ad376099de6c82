"""The floor: which pixels are edges, what is encoded, which numbers come out."""

import json
from dataclasses import replace

import compare_factors
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ditr_lite import data, metrics, store
from ditr_lite.autoencoder import VQAutoencoder
from ditr_lite.cli import main
from ditr_lite.conditioning import depth_bounds
from ditr_lite.config import preset
from ditr_lite.studies import floor

SHAPE = (32, 48)


class Exact(VQAutoencoder):
    """Changes nothing but adds an offset, in network units, to what was quantised; one code, the second, is used."""

    offset = 0.0

    def forward(self, x):
        indices = torch.ones(1, x.shape[2] // 4, x.shape[3] // 4, dtype=torch.int64)
        return {"reconstruction": x + self.offset, "latents": x, "indices": indices}

    def decode(self, latents, quantize=True):
        assert not quantize
        return latents


@pytest.fixture
def model():
    return Exact(preset("tiny").autoencoder).eval()


@pytest.fixture
def sample():
    rng = np.random.default_rng(0)
    truth = np.tile(np.linspace(0.5, 0.7, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    truth[:, 20:] += 0.4
    region = np.zeros(SHAPE, bool)
    region[8:16, 8:16] = True
    depth = np.where(rng.random(SHAPE) < 0.2, 0, truth).astype(np.float32)
    return data.Sample("test_00000", np.zeros((*SHAPE, 3), np.uint8), depth, truth, region, material=region * 1)


def test_an_edge_is_both_sides_of_a_relative_step():
    depth = np.array([[1.0, 1.0, 1.04, 1.10, 0.0, 2.0, 2.0]], dtype=np.float32)
    assert floor.depth_edges(depth).tolist() == [[False, False, True, True, False, False, False]]
    assert floor.depth_edges(depth.T)[:, 0].tolist() == floor.depth_edges(depth)[0].tolist()
    assert floor.depth_edges(depth, 0.03).sum() == 3
    with pytest.raises(ValueError, match="expected a relative step"):
        floor.depth_edges(depth, 0.0)


@given(arrays(np.float32, (5, 6), elements=st.sampled_from([0.0, 0.5, 0.51, 0.6, 1.0, 1.07])))
def test_edges_agree_with_a_loop_and_do_not_depend_on_the_unit(depth):
    padded, wanted = np.pad(depth.astype(float), 1), np.zeros(depth.shape, bool)
    for y, x in np.argwhere(depth > 0):
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            a, b = padded[y + 1, x + 1], padded[y + 1 + dy, x + 1 + dx]
            wanted[y, x] |= b > 0 and max(a, b) / min(a, b) > 1.05
    assert np.array_equal(floor.depth_edges(depth), wanted)
    assert np.array_equal(floor.depth_edges(1000 * depth), wanted)


def shifted(sample, offset):
    """Return the truth with an offset in network units, in metres."""
    bounds = depth_bounds(sample.depth)
    return bounds.denormalise(bounds.normalise(sample.depth_gt.astype(np.float64)) + offset)


def test_a_stray_reading_does_not_set_the_units(model, sample):
    model.offset = 0.5
    plain = floor.reconstruct(model, sample)[0]
    rows, columns = np.nonzero(sample.depth > 0)
    sample.depth[rows[::40], columns[::40]] = 30.0
    assert np.allclose(floor.reconstruct(model, sample)[0], plain, rtol=0.02)


def test_the_truth_is_what_is_encoded_and_the_raw_depth_sets_the_units(model, sample):
    model.offset = 0.5
    with_it, without, indices = floor.reconstruct(model, sample)
    assert np.allclose(without, sample.depth_gt, atol=1e-5) and indices.shape == (1, 8, 12)
    assert np.allclose(with_it, shifted(sample, 0.5), atol=1e-5)
    unknown = replace(sample, depth_gt=np.where(sample.region, 0, sample.depth_gt).astype(np.float32))
    assert floor.reconstruct(model, unknown)[1].min() > 0.4  # filled, not 0, where no truth is known


def test_the_truth_in_units_has_no_gaps_and_its_bounds_are_the_raw_depth_s(sample):
    bounds, truth = floor.in_units(sample)
    assert truth.shape == (1, 1, *SHAPE) and (bounds.low, bounds.high) == tuple(
        getattr(depth_bounds(sample.depth), end) for end in ("low", "high")
    )
    assert np.allclose(bounds.denormalise(truth[0, 0].numpy()), sample.depth_gt, atol=1e-5)
    unknown = replace(sample, depth_gt=np.where(sample.region, 0, sample.depth_gt).astype(np.float32))
    again = floor.in_units(unknown)[1][0, 0].numpy()
    assert np.allclose(again[~sample.region], truth[0, 0].numpy()[~sample.region]) and abs(again).max() < 5
    with pytest.raises(ValueError, match="no ground-truth depth"):
        floor.in_units(replace(sample, depth_gt=None))


def test_errors_are_sorted_by_their_distance_from_an_edge(model, sample):
    model.offset = 0.5
    sample.depth_gt[0, 0] = 0  # unknown: it counts nowhere
    ((squares, pixels),) = floor.error_by_distance(model, [sample], farthest=3)
    # the step lies between columns 19 and 20, so these two are edges; all columns but 17 to 22 are three away or more
    assert pixels.tolist() == [2 * SHAPE[0], 2 * SHAPE[0], 2 * SHAPE[0], (SHAPE[1] - 6) * SHAPE[0] - 1]
    square = (shifted(sample, 0.5) - sample.depth_gt) ** 2
    assert squares[0] == pytest.approx(square[:, 19:21].sum(), rel=1e-4)
    assert squares.sum() == pytest.approx(square[sample.depth_gt > 0].sum(), rel=1e-4)
    flat = replace(sample, depth_gt=np.full(SHAPE, 0.7, np.float32))
    with pytest.raises(ValueError, match="no depth edge"):
        floor.error_by_distance(model, [flat])


def test_the_report_counts_pixels_codes_and_millimetres(model, sample):
    model.offset = 0.5
    report = floor.measure_floor([sample, sample], model, progress=False)
    square = (shifted(sample, 0.5) - sample.depth_gt) ** 2
    sets = metrics.pixel_sets(sample.depth_gt, sample.region, sample.depth)
    edge = floor.depth_edges(sample.depth_gt)
    sets |= {"edge": edge, "interior": ~edge}
    for name in floor.SETS:
        assert report["rmse_m"][name] == pytest.approx(3 * [np.sqrt(square[sets[name]].mean())], rel=1e-4)
        assert report["rmse_m_unquantized"][name] == pytest.approx([0, 0, 0], abs=1e-6)
    assert report["pixels"]["edge"] == 2 * 2 * SHAPE[0] and report["pixels"]["optical"] == 2 * 64
    assert report["pixels"]["edge"] + report["pixels"]["interior"] == report["pixels"]["whole"] == 2 * 32 * 48
    assert report["codes"] == {"total": 64, "used": 1, "share": 1 / 64, "perplexity": 1.0, "vectors": 2 * 8 * 12}
    assert (report["factor"], report["numbers_per_pixel"], report["bits_per_pixel"]) == (4, 0.25, 6 / 16)
    text = floor.format_floor(report)
    assert "1 of 64 (2%)" in text and "more than 5 % nearer" in text


def test_an_empty_set_is_none_and_a_frame_without_it_does_not_count(model, sample):
    plain = replace(sample, region=None)
    assert floor.measure_floor([plain], model, progress=False)["rmse_m"]["optical"] is None
    assert "-" in floor.format_floor(floor.measure_floor([plain], model, progress=False))
    model.offset = 0.5
    both = floor.measure_floor([plain, sample], model, progress=False)["rmse_m"]["optical"]
    assert both == floor.measure_floor([sample], model, progress=False)["rmse_m"]["optical"]


@pytest.mark.parametrize(("counts", "want"), [([3, 3, 3, 3], 4), ([5, 0, 0], 1), ([2, 2, 0], 2), ([1, 3], 1.7548)])
def test_perplexity(counts, want):
    assert floor.perplexity(counts) == pytest.approx(want, rel=1e-4)


@pytest.mark.parametrize("counts", [[0, 0], [-1, 2], [[1, 2]], []])
def test_perplexity_of_nothing_is_refused(counts):
    with pytest.raises(ValueError, match="expected counts"):
        floor.perplexity(counts)


def test_bad_samples_are_refused(model, sample):
    with pytest.raises(ValueError, match="no frame"):
        floor.measure_floor([], model, progress=False)
    with pytest.raises(ValueError, match="no ground-truth"):
        floor.reconstruct(model, replace(sample, depth_gt=None))
    with pytest.raises(ValueError, match="no reading"):
        floor.reconstruct(model, replace(sample, depth=np.zeros(SHAPE, np.float32)))


def test_the_command_prints_and_writes_json(sample, tmp_path, capsys):
    config = preset("tiny")
    store.save_part("autoencoder", VQAutoencoder(config.autoencoder).state_dict(), config, tmp_path / "w", {})
    data.save_sample(sample, tmp_path / "s" / "test" / sample.name)
    argv = ["floor", "--root", tmp_path / "s", "--weights", tmp_path / "w", "--json", tmp_path / "f.json"]
    assert main([str(word) for word in argv]) == 0
    out, written = capsys.readouterr().out, json.loads((tmp_path / "f.json").read_text())
    assert "test split" in out and "codes in use" in out
    assert written["images"] == 1 and written["command"].startswith("python -m ditr_lite floor --root")
    assert written["weights_sha256"] == {"autoencoder": store.sha256(tmp_path / "w" / "autoencoder.safetensors")}
    assert main(["floor", "--weights", str(tmp_path), "--limit", "1"]) == 2 and "no weights" in capsys.readouterr().err


def test_factors_are_compared(tmp_path):
    for split in ("train", "val"):
        data.save_sample(replace(sample_of(), name=f"{split}_00000"), tmp_path / split / f"{split}_00000")
    argv = ["--preset", "tiny", "--steps", "1", "--batch", "1", "--factors", "2", "4", "--data", tmp_path / "train"]
    argv += ["--val", tmp_path / "val", "--work", tmp_path / "work", "--json", tmp_path / "f.json"]
    assert compare_factors.main([str(word) for word in argv]) == 0
    two, four = json.loads((tmp_path / "f.json").read_text())["rows"]
    assert (two["factor"], four["factor"]) == (2, 4) and two["parameters"] < four["parameters"]
    assert two["floor"]["numbers_per_pixel"] == 4 * four["floor"]["numbers_per_pixel"] == 1
    assert two["step_flop"] > 3.5 * four["step_flop"]  # four times the cells, and attention grows faster


def sample_of():
    truth = np.tile(np.linspace(0.5, 0.9, 96, dtype=np.float32), (64, 1))
    truth[:, 48:] += 0.3
    material = np.zeros(truth.shape, np.uint8)
    material[8:16, 8:16] = 1
    depth = np.where(np.arange(96) < 4, 0, truth).astype(np.float32)  # a strip is missing: there is something geometric
    rgb = np.zeros((64, 96, 3), np.uint8)
    return data.Sample("x", rgb, depth, truth, material > 0, material=material, instances=material)


def test_the_committed_comparison_is_complete():
    result = json.loads((store.WEIGHTS / "results_factors.json").read_text())
    assert [row["factor"] for row in result["rows"]] == [2, 4, 8] and result["split"] == "val"
    config = preset("lite")
    assert [row["step_flop"] for row in result["rows"]] == [compare_factors.step_flops(config, f) for f in (2, 4, 8)]
    errors = [row["floor"]["rmse_m"] for row in result["rows"]]
    assert all(row["edge"][0] > 3 * row["interior"][0] for row in errors)
