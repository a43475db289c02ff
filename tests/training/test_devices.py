import pytest
import torch

from sigmaslam.errors import InputError
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.devices import Bfloat16Network, choose_device


@pytest.mark.parametrize(("name", "message"), [("tpu9", "is unknown"), ("meta", "not for training")])
def test_devices_that_are_none_are_refused(name, message):
    with pytest.raises(InputError, match=f"{name}.*{message}"):
        choose_device(name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_a_run_works_on_the_processor():
    with pytest.raises(InputError, match=r"cuda:0 does not exist.*0 GPUs"):
        choose_device("cuda")
    assert choose_device("auto") == torch.device("cpu")


def test_bfloat16_maps_are_float32_and_near_those_of_float32():
    torch.manual_seed(0)
    network = FeatureNetwork().eval()
    cells = torch.rand(1, 16, 24, 24)
    with torch.no_grad():
        exact, found = network(cells), Bfloat16Network(network)(cells)
    for a, b in zip(exact, found, strict=True):
        assert b.dtype == torch.float32
        torch.testing.assert_close(a, b, rtol=0.05, atol=0.05)
