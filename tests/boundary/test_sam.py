"""The SAM backend on a tiny, randomly initialised SAM that is saved to disk and loaded as the true one would be."""

import json

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from transformers import SamConfig, SamModel

from ditr_lite.boundary import boundaries_from_labels, get_backend, sam
from ditr_lite.boundary.sam import SamBoundary, depth_picture, load, outlines, point_grid, stability, suppress
from ditr_lite.pipeline import Ditr
from ditr_lite.windows import at_centres

MASKS = st.integers(0, 5).flatmap(lambda n: arrays(bool, (n, 6, 7)))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A SAM of 22,165 parameters; its last layers are set so that it is sure of its masks, as a trained one is."""
    same = {"image_size": 64, "patch_size": 8}
    window = {"window_size": 4, "global_attn_indexes": [1], "num_pos_feats": 8}
    small = {"num_hidden_layers": 2, "num_attention_heads": 2, "mlp_dim": 32, "hidden_size": 16}
    head = {"iou_head_hidden_dim": 16, "iou_head_depth": 2}
    config = SamConfig(
        vision_config={**small, **same, **window, "output_channels": 16},
        prompt_encoder_config={**same, "hidden_size": 16, "mask_input_channels": 4},
        mask_decoder_config={**small, **head},
    )
    torch.manual_seed(0)
    model = SamModel(config)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.normal_(0, 0.3)
        model.mask_decoder.iou_prediction_head.proj_out.weight.mul_(0.01)
        model.mask_decoder.iou_prediction_head.proj_out.bias.fill_(1.0)
        for mlp in model.mask_decoder.output_hypernetworks_mlps:
            mlp.proj_out.weight.mul_(1e3)
    folder = tmp_path_factory.mktemp("sam")
    model.save_pretrained(folder)
    return folder


def picture(height=48, width=60):
    image = np.full((height, width, 3), 90, np.uint8)
    image[10:30, 20:45] = (220, 40, 60)
    return image


def test_a_checkpoint_on_disk_becomes_a_backend_for_colour_and_depth(checkpoint):
    backend = get_backend("sam", checkpoint)
    depth = np.full((48, 60), 0.9, np.float32)
    depth[10:30, 20:45] = 0.6
    depth[0, :9] = 0
    for image in (picture(), depth):
        found = backend(image)
        assert found.dtype == bool and found.shape == (48, 60) and found.any()
        assert (backend(image) == found).all()
    assert (backend(depth) == backend(depth_picture(depth))).all()
    assert not backend(np.zeros((20, 30), np.float32)).any()  # no reading, no boundary
    with pytest.raises(ValueError, match="expected RGB"):
        backend(picture().astype(float))


def test_the_networks_masks_are_those_of_the_library_enlarged(checkpoint):
    backend = SamBoundary(load(checkpoint).model, points=3, min_score=-9, min_stability=0, max_overlap=1, batch=4)
    image = picture(64, 64)  # as large as the network's input, so nothing is scaled before it
    pixels = (image.astype(np.float32) - np.float32(sam.MEAN)) / np.float32(sam.STD)
    points = torch.from_numpy(point_grid(3)) * 64
    with torch.no_grad():
        out = backend.model(
            pixel_values=torch.from_numpy(pixels).permute(2, 0, 1)[None], input_points=points[None, :, None]
        )
    wanted = torch.nn.functional.interpolate(out.pred_masks[0], size=(64, 64), mode="bilinear").flatten(0, 1) > 0
    order = out.iou_scores[0].flatten().argsort(descending=True)
    got, wanted = backend.masks(image), wanted[order].numpy()
    wanted = wanted[wanted.any(axis=(1, 2))]
    assert {m.tobytes() for m in got} == {m.tobytes() for m in wanted} and len(got) == len(wanted)


@pytest.mark.parametrize("shape", [(48, 60), (60, 48), (30, 100)])
def test_padding_is_cut_off_and_masks_keep_their_place(shape, monkeypatch):
    """A network that answers with the bright part of what it sees must give that part back, wherever it lies."""

    class Bright(torch.nn.Module):
        config = SamConfig(vision_config={"image_size": 256})

        def get_image_embeddings(self, pixels):
            return pixels

        def forward(self, image_embeddings, input_points, multimask_output):
            logits = torch.nn.functional.avg_pool2d(image_embeddings[:, :1], 4) * 10  # padding is 0: not bright
            out = type("Out", (), {})()
            out.pred_masks = logits[None].expand(1, input_points.shape[1], 3, -1, -1)
            out.iou_scores = torch.ones(1, input_points.shape[1], 3)
            assert (input_points >= 0).all() and (input_points <= 256).all()
            return out

    image = np.zeros((*shape, 3), np.uint8)
    true = np.zeros(shape, bool)
    true[shape[0] // 2 :, 5:20] = True
    image[true] = 255
    masks = SamBoundary(Bright(), points=2).masks(image)
    assert len(masks) == 1 and masks.shape == (1, *shape)  # all twelve answers are one mask
    assert (masks[0] ^ true).sum() <= 0.1 * true.sum()


def test_end_to_end_through_the_pipeline(checkpoint):
    ditr = Ditr.from_pretrained(boundary="sam", boundary_path=checkpoint)
    depth, region = np.full((48, 64), 0.8, np.float32), np.zeros((48, 64), bool)
    region[10:30, 20:45], depth[15:20, 25:30] = True, 0
    out = ditr(picture(48, 64), depth, region, steps=1, samples=1)
    assert out.boundary_rgb.any() and (out.depth > 0).all() and (out.depth == depth)[~region].all()
    frame = np.asarray(ditr.backend(cv2.resize(picture(48, 64), (256, 192), interpolation=cv2.INTER_LINEAR)))
    assert (out.boundary_rgb == at_centres(frame, (48, 64))).all()


def test_filters_drop_unsure_masks(checkpoint):
    model = load(checkpoint).model
    assert len(SamBoundary(model, points=4).masks(picture())) > 0
    assert len(SamBoundary(model, points=4, min_score=9).masks(picture())) == 0
    assert not SamBoundary(model, points=4, min_score=9)(picture()).any()
    assert len(SamBoundary(model, points=4, min_stability=1.01).masks(picture())) == 0


# ---- the parts that are ours


def test_point_grid_by_hand():
    assert point_grid(1).tolist() == [[0.5, 0.5]]
    assert point_grid(2).tolist() == [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]  # x runs first


def test_stability_by_hand():
    logits = torch.tensor([[[5.0, 5.0, -5.0, -5.0]], [[5.0, 0.5, -0.5, -5.0]], [[-5.0] * 4]])
    assert stability(logits).tolist() == pytest.approx([1, 1 / 3, 0])


def test_suppression_by_hand():
    masks = np.zeros((4, 1, 10), bool)
    masks[0, 0, :8], masks[1, 0, :9], masks[2, 0, 6:], masks[3, 0, :8] = True, True, True, True
    scores = np.array([0.8, 0.9, 0.7, 0.8])
    assert suppress(masks, scores, 0.7) == [1, 2]  # 0 and 3 overlap 1 by 8 / 9; 2 by 3 / 10
    assert suppress(masks, scores, 0.9) == [1, 0, 2]  # 3 equals 0
    assert suppress(masks, scores, 1.0) == [1, 0, 3, 2]
    assert suppress(masks[:0], scores[:0]) == []


@settings(deadline=None)
@given(MASKS, st.floats(0, 1))
@example(np.array([[[1, 1, 0]], [[1, 0, 0]]], bool), 0.5 - 1e-13)  # by less than any tolerance too much
@example(np.arange(5)[None, None] < np.array([5, 3])[:, None, None], 3 / 5)
def test_survivors_hardly_overlap_and_everything_else_overlaps_a_better_one(masks, limit):
    scores = np.linspace(1, 0, len(masks))
    kept = suppress(masks, scores, limit)

    def apart(a, b):  # compared as a product: a quotient would round to another side of the limit
        return (a & b).sum() <= limit * (a | b).sum()

    for i in range(len(masks)):
        assert (i in kept) == all(apart(masks[i], masks[k]) for k in kept if k < i)


def test_outlines_by_hand():
    masks = np.zeros((2, 5, 7), bool)
    masks[0] = True  # the table
    masks[1, 1:4, 2:5] = True  # an object on it
    wanted = masks[1].copy()
    wanted[2, 3] = False
    assert (outlines(masks) == wanted).all() and (outlines(masks[::-1]) == wanted).all()  # not the frame; any order
    assert (outlines(masks[1:]) == wanted).all()  # with nothing behind it
    assert not outlines(masks[:1]).any() and not outlines(masks[:0]).any()


@given(arrays(np.int64, (6, 7), elements=st.integers(0, 3)))
def test_outlines_of_a_partition_are_outlines_of_its_labels(labels):
    masks = np.array([labels == k for k in (1, 2, 3) if (labels == k).any()], bool).reshape(-1, 6, 7)
    found, both_sides = outlines(masks), boundaries_from_labels(labels)
    assert not (found & ~both_sides).any()
    for a, b in ((labels[:, :-1], labels[:, 1:]), (labels[:-1], labels[1:])):  # no border is missed on both sides
        sides = (found[:, :-1], found[:, 1:]) if a.shape[1] < labels.shape[1] else (found[:-1], found[1:])
        assert (sides[0] | sides[1])[a != b].all()


def test_depth_as_a_picture_is_near_bright_with_bounds_of_the_raw_readings_and_no_holes():
    depth = np.linspace(0.5, 1.0, 200, dtype=np.float32).reshape(10, 20)
    picture_ = depth_picture(depth)
    assert (
        picture_.shape == (10, 20, 3)
        and picture_.dtype == np.uint8
        and (np.diff(picture_[..., 0].ravel().astype(int)) <= 0).all()
    )
    assert picture_[0, 0, 0] > picture_[9, 19, 0] + 150
    holes = depth.copy()
    holes[4:6, 8:12] = 0
    difference = np.abs(depth_picture(holes).astype(int) - picture_)
    assert difference.max() <= 20
    assert cv2.cvtColor(picture_, cv2.COLOR_RGB2GRAY).std() > 30
    assert (depth_picture(depth * 2) == picture_).mean() > 0.99  # the unit of length does not matter


# ---- checkpoints that cannot be used


def test_a_missing_checkpoint_says_where_to_put_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in (None, tmp_path):
        with pytest.raises(ValueError, match=r"no SAM checkpoint in .*sam-vit-large.*boundary_path=DIR"):
            get_backend("sam", path)


def test_another_model_is_refused(tmp_path):
    for text in (json.dumps({"model_type": "vit"}), "{", "[]"):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(ValueError, match="expected 'sam'"):
            load(tmp_path)


def test_an_incomplete_checkpoint_is_refused(checkpoint, tmp_path):
    from safetensors.torch import load_file, save_file

    (tmp_path / "config.json").write_bytes((checkpoint / "config.json").read_bytes())
    with pytest.raises(ValueError, match="cannot load SAM"):
        load(tmp_path)  # no tensors at all
    tensors = load_file(checkpoint / "model.safetensors")
    tensors.pop("mask_decoder.iou_token.weight")  # transformers would fill it with random numbers and only warn
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ValueError, match="lacks 1 tensors"):
        load(tmp_path)


def test_without_transformers_the_message_says_what_to_install(checkpoint, monkeypatch):
    monkeypatch.setattr(sam.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[sam\]'"):
        load(checkpoint)


@pytest.mark.parametrize(
    "call",
    [
        lambda: suppress(np.zeros((2, 3, 3), bool), np.zeros(3)),
        lambda: outlines(np.zeros((3, 3), bool)),
        lambda: outlines(np.zeros((1, 3, 3))),
        lambda: SamBoundary(torch.nn.Module(), points=0),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match="expected"):
        call()
