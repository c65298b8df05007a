"""Pictures in batches that a CPU is fast with: the same logits and gradients, and networks that take one order only."""

import pytest
import torch

from patchproof.networks.batches import BatchedNetwork, cpu_batch_size, tune_batches


class Flattens(torch.nn.Module):
    """A convolution and, as networks may hold it, a view that takes one order of memory only."""

    def __init__(self, view: bool):
        super().__init__()
        self.convolution, self.view = torch.nn.Conv2d(3, 8, 3, stride=2), view

    def forward(self, photos):
        features = self.convolution(photos).relu()
        return features.view(len(photos), -1) if self.view else features.flatten(1)


def test_batches_are_cut_and_filled_up():
    seen = []

    def network(photos):
        seen.append(len(photos))
        return photos.mean((2, 3))

    photos = torch.rand(7, 3, 2, 2)
    assert torch.equal(BatchedNetwork(network, 3)(photos), photos.mean((2, 3)))
    assert seen == [3, 3, 3]
    assert torch.equal(BatchedNetwork(network)(photos), photos.mean((2, 3)))
    assert seen[3:] == [7]


@pytest.mark.parametrize(("view", "order"), [(False, torch.channels_last), (True, torch.contiguous_format)])
def test_the_fastest_order_is_the_one_that_the_network_takes(view, order):
    network = Flattens(view)
    pictures = torch.rand(5, 3, 128, 128)
    laid = tune_batches(network, pictures[:2])
    assert laid.memory_format is order and laid.max_pictures == cpu_batch_size(128) == 12
    given, plain = (pictures.clone().requires_grad_() for _ in range(2))
    (gradient,) = torch.autograd.grad(laid(given).square().sum(), given)
    (expected,) = torch.autograd.grad(network(plain).square().sum(), plain)
    torch.testing.assert_close(laid(pictures), network(pictures))
    torch.testing.assert_close(gradient, expected)


def test_few_pictures_at_a_time_on_a_cpu_but_as_many_as_a_network_takes():
    pictures = torch.rand(2, 3, 224, 224)
    assert tune_batches(Flattens(False), pictures).max_pictures == 4
    assert tune_batches(BatchedNetwork(Flattens(False), 8), pictures).max_pictures == 8
    assert cpu_batch_size(64) == 49 and cpu_batch_size(1024) == 1
