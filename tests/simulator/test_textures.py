import numpy as np
import pytest

from ditr_lite.simulator.textures import SIZE, environment, texture

KINDS = ("plain", "noise", "stripes", "checker", "wood", "speckle", "print")
COLOURS = np.array([[0.2, 0.3, 0.4], [0.8, 0.7, 0.6]])


@pytest.mark.parametrize("kind", KINDS)
def test_reflectance_image_is_physical_and_follows_from_its_seed(kind):
    image = texture(kind, COLOURS, seed=1)
    assert image.shape == (SIZE, SIZE, 3) and image.dtype == np.float32
    assert image.min() >= 0.01 and image.max() <= 0.97  # nothing reflects nothing or everything
    assert np.array_equal(image, texture(kind, COLOURS, seed=1))
    assert not np.array_equal(image, texture(kind, COLOURS, seed=2))


@pytest.mark.parametrize("kind", KINDS)
def test_colours_lie_between_the_two_given(kind):
    image = texture(kind, COLOURS, seed=3)
    low, high = 0.88 * COLOURS[0], 1.12 * COLOURS[1]  # grain of 2 %
    assert ((image >= low) & (image <= np.minimum(high, 0.97))).mean() > 0.999
    contrast = image[..., 0].std() / image[..., 0].mean()
    assert contrast < 0.03 if kind == "plain" else contrast > 0.03


def test_unknown_texture_is_refused_with_the_choices():
    with pytest.raises(ValueError, match="'marble'.*plain, noise"):
        texture("marble", COLOURS, 0)


def test_environment_is_a_gradient_with_bright_windows():
    image = environment(seed=4, level=0.5)
    assert image.shape == (64, 128, 3) and image.dtype == np.float32 and (image > 0).all()
    assert np.array_equal(image, environment(4, 0.5)) and not np.array_equal(image, environment(5, 0.5))
    assert image.max() > 1.2 * 0.5 * 1.3  # a window outshines the brightest wall
    assert np.allclose(environment(4, 1.0), 2 * image, rtol=1e-5)
