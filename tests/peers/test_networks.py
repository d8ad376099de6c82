import pytest
import torch

from ditr_lite.peers.networks import Critic, PixelUNet


def test_a_body_begins_at_nothing_and_keeps_the_size():
    image = torch.rand(2, 9, 64, 96)
    assert not PixelUNet(9, 3, width=8)(image).any()
    assert PixelUNet(9, 3, width=8)(image).shape == (2, 3, 64, 96)


def test_pretrained_colour_comes_in_at_its_strides():
    torch.manual_seed(0)
    net, image = PixelUNet(3, 1, (4, 6, 8), width=8), torch.rand(1, 3, 64, 64)
    torch.nn.init.normal_(net.out.weight, std=0.1)
    colour = [torch.rand(1, c, 64 // s, 64 // s) for c, s in ((4, 4), (6, 8), (8, 16))]
    usual = net(image, colour)
    for k in range(3):
        other = [2 * m if i == k else m for i, m in enumerate(colour)]
        assert not torch.allclose(net(image, other), usual)
    with pytest.raises(ValueError, match="expected features at 3 strides, got 2"):
        net(image, colour[:2])


def test_a_critic_judges_patches():
    assert Critic(8)(torch.rand(2, 3, 64, 96), torch.rand(2, 1, 64, 96)).shape == (2, 1, 8, 12)
