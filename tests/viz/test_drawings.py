"""Drawings: legible, nothing outside its box or over another text, shapes as the networks have them."""

import functools
import itertools

import pytest
import torch

from ditr_lite import config
from ditr_lite.autoencoder import VQAutoencoder
from ditr_lite.conditioning import CHANNELS
from ditr_lite.region import RegionNet
from ditr_lite.unet import DenoisingUNet
from ditr_lite.viz import drawings
from ditr_lite.viz.panels import DPI

COLUMN = 736  # pixels, the width of the book's column
DRAWN = {
    "system": drawings.system("06"),
    "stage one": drawings.stage_one(),
    "four levels": drawings.stage_one(config.RegionConfig()),
    "tiny stage one": drawings.stage_one(config.preset("tiny").region, (64, 96)),
    "autoencoder": drawings.autoencoder(),
    "one level": drawings.autoencoder(config.AutoencoderConfig(multipliers=(1,))),
    "three levels": drawings.autoencoder(config.AutoencoderConfig(multipliers=(1, 2, 4))),
    "U-Net": drawings.unet(),
    "the paper's U-Net": drawings.unet(config.preset("paper").unet, 3, (736, 1280)),
}


def words(figure):
    return [text for text in figure.axes[0].texts if text.get_text()]


def said(figure):
    return [line for text in words(figure) for line in text.get_text().split("\n")]


@functools.cache
def extents(name):
    DRAWN[name].draw_without_rendering()
    return {text: text.get_window_extent() for text in words(DRAWN[name])}


@pytest.mark.parametrize("name", DRAWN)
def test_letters_can_be_read_in_the_book_and_lie_on_the_sheet(name):
    figure = DRAWN[name]
    width, height = figure.get_size_inches() * DPI
    for text, place in extents(name).items():
        assert text.get_fontsize() * DPI / 72 * min(1, COLUMN / width) >= 12, text.get_text()
        inside = place.x0 >= 0 and place.y0 >= 0 and place.x1 <= width and place.y1 <= height
        assert inside, f"{text.get_text()!r} leaves the sheet"


@pytest.mark.parametrize("name", DRAWN)
def test_no_text_covers_another(name):
    for (a, one), (b, two) in itertools.combinations(extents(name).items(), 2):
        apart = one.x1 <= two.x0 or two.x1 <= one.x0 or one.y1 <= two.y0 + 2 or two.y1 <= one.y0 + 2
        assert apart, f"{a.get_text()!r} and {b.get_text()!r}"


@pytest.mark.parametrize("name", DRAWN)
def test_no_text_is_cut_by_the_edge_of_a_box(name):
    figure = DRAWN[name]
    for patch in figure.axes[0].patches:
        box = patch.get_window_extent()
        for text, place in extents(name).items():
            over = place.x0 < box.x1 and box.x0 < place.x1 and place.y0 < box.y1 and box.y0 < place.y1
            within = box.x0 - 1 <= place.x0 and place.x1 <= box.x1 + 1
            assert not over or within, text.get_text()


def test_the_part_of_a_notebook_is_highlighted_and_no_other():
    def lit(part):
        return sum(patch.get_linewidth() > 2 for patch in drawings.system(part).axes[0].patches)

    for number, parts in drawings.NOTEBOOKS.items():
        assert lit(number) == len(parts) and set(parts) <= set(drawings.PARTS)
    assert lit("02_region_refinement") == 1
    with pytest.raises(ValueError, match="expected a notebook, 00, 01"):
        drawings.system("10")


def test_every_notebook_but_the_first_stands_in_the_drawing():
    shown = " ".join(said(drawings.system()))
    assert all(number in shown for number in list(drawings.NOTEBOOKS)[1:])


def shapes(tensors):
    return [" × ".join(map(str, x.shape[1:])) for x in tensors]


def test_shapes_of_stage_one_are_those_of_the_network():
    net = RegionNet(config.preset("lite").region)
    rgb, depth = torch.zeros(1, 3, 192, 256), torch.zeros(1, 1, 192, 256)
    drawn = said(drawings.stage_one())
    assert all(drawn.count(shape) == 4 for shape in shapes(net.encoder_rgb(rgb)))
    assert drawn.count("side, 3 classes") == len(net(rgb, depth, depth)["side"])


def test_shapes_of_the_autoencoder_are_those_of_the_network():
    net = VQAutoencoder(config.AutoencoderConfig())
    x, seen = torch.zeros(1, 1, 192, 256), []
    for layer in net.encoder:
        x = layer(x)
        seen.append(x)
    drawn = said(drawings.autoencoder())
    assert drawn.count(shapes(seen)[-1]) == 2  # latents, and what the quantiser makes of them
    assert drawn.count("32 × 96 × 128") == drawn.count("64 × 48 × 64") == 2
    assert {"32 × 96 × 128", "64 × 48 × 64"} <= set(shapes(seen))


def test_shapes_of_the_u_net_are_those_of_the_network():
    net = DenoisingUNet(config.UNetConfig(colour_channels=()), 4, len(CHANNELS)).eval()
    picture = torch.zeros(1, len(CHANNELS), 192, 256)
    seen = []
    for level in (*net.down, *net.up):
        level.register_forward_hook(lambda module, given, out: seen.append(out))
    with torch.no_grad():
        features = net.features(picture)
        net(torch.zeros(1, 4, 48, 64), torch.zeros(1, dtype=torch.long), features)
    drawn = said(drawings.unet())
    used = [features[k] for k in (0, *net.config.attention_levels)]
    for shape in {*shapes(seen), *shapes(used)}:
        assert drawn.count(shape) == shapes(seen).count(shape) + shapes(used).count(shape), shape
    assert "+ pretrained colour" in drawn and "+ pretrained colour" not in said(drawings.unet(net.config))


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: drawings.stage_one(config.RegionConfig(levels=6, colour="scratch")), "2 to 5 levels, got 6"),
        (lambda: drawings.autoencoder(config.AutoencoderConfig(multipliers=(1, 1, 1, 1))), "at most 3 levels, got 4"),
        (lambda: drawings.unet(config.UNetConfig(multipliers=(1, 2, 4))), "expected 4 levels, got 3"),
    ],
)
def test_what_has_no_room_is_refused(draw, message):
    with pytest.raises(ValueError, match=message):
        draw()
