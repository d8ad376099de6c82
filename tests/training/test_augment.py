import numpy as np

from ditr_lite.training.augment import colours, dusk, glare


def test_the_generator_decides_and_the_input_stays():
    image = np.random.default_rng(0).integers(1, 256, (48, 64, 3), np.uint8)
    before = image.copy()
    first, again, other = (colours(image, np.random.default_rng(k)) for k in (5, 5, 6))
    assert np.array_equal(first, again) and (image == before).all() and first.dtype == image.dtype
    assert first.shape == image.shape and not np.array_equal(first, other)


def test_colours_change_hue_now_and_then():
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    strongest = [colours(red, np.random.default_rng(k)).mean(axis=(0, 1)).argmax() for k in range(60)]
    assert set(strongest) == {0, 1, 2} and np.mean(np.array(strongest) == 0) > 0.6


def test_glare_only_adds_light_and_blinds_where_it_is_bright():
    image = np.random.default_rng(0).integers(0, 200, (48, 64, 3), np.uint8)
    shares = []
    for k in range(40):
        bright, core = glare(image, np.random.default_rng(k))
        assert (bright >= image).all() and bright.dtype == np.uint8 and core.shape == (48, 64)
        assert not core.any() or bright[core].min() >= 60  # 1.5 exp(-1.5) of the least bright colour
        shares.append(core.mean())
    assert min(shares) == 0 and 0.005 < np.mean(shares) < 0.1


def test_at_dusk_little_light_is_left_of_every_picture():
    image = np.full((48, 64, 3), 200, np.uint8)
    dim = [dusk(image, np.random.default_rng(k)) for k in range(40)]
    left = np.array([d.mean() / 200 for d in dim])
    assert left.max() < 0.9 and 0.3 < left.mean() < 0.6 and left.min() > 0.1
    halves = np.array([d[:, :32].mean() / d[:, 32:].mean() for d in dim])
    assert halves.min() < 0.8 and halves.max() > 1.25  # one side is dimmer than the other, either one
    assert all(d.dtype == np.uint8 and d.shape == image.shape for d in dim)
