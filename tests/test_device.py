"""Choice of a device, upload of photos, and the fake GPU itself."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from fake_gpu import CUDA_DEVICE, FakeGpuTensor, listen_to_gpu, use_fake_gpu

from hyrfpack import device as devices
from hyrfpack.device import choose_device, describe_device, make_current, upload
from hyrfpack.errors import HyrfError
from hyrfpack.ops.dispatch import has_triton
from hyrfpack.ops.hash_encode import hash_encode
from hyrfpack.parallel import has_numba
from hyrfpack.scene import Picture

needs_no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@needs_no_gpu
def test_auto_is_the_cpu_where_there_is_no_gpu():
    assert choose_device() == choose_device("cpu") == torch.device("cpu")


def test_auto_is_cuda_where_there_is_a_gpu_with_triton(monkeypatch):
    with use_fake_gpu():
        assert choose_device() == torch.device("cuda")
        monkeypatch.setattr(devices, "has_triton", lambda: False)
        assert choose_device() == torch.device("cpu")


def test_each_thread_selects_the_gpu_that_it_works_on(monkeypatch):
    taken = []
    with use_fake_gpu():
        monkeypatch.setattr(torch.cuda, "set_device", taken.append)
        for name in ("cpu", "cuda", "cuda:0", "cuda:1"):
            make_current(torch.device(name))
    assert taken == [torch.device("cuda:1")]


@needs_no_gpu
@pytest.mark.parametrize("name", ["cuda", "cuda:0", "mps"])
def test_a_device_that_is_not_there_is_rejected_with_a_clear_error(name):
    with pytest.raises(HyrfError, match=f"'{name}' is not available: .*`device='cpu'`"):
        choose_device(name)


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:x", "cuda:-1", "cpu:0", "", "auto:1"])
def test_a_text_that_names_no_device_is_rejected(name):
    with pytest.raises(HyrfError, match="is not a device"):
        choose_device(name)


def test_a_gpu_beyond_the_last_is_rejected():
    with use_fake_gpu(), pytest.raises(HyrfError, match="cuda:1.*sees 1 GPU; use `device='cuda:0'`$"):
        choose_device("cuda:1")


def test_a_gpu_beyond_the_last_of_several_is_rejected_with_the_numbers_that_there_are(monkeypatch):
    with use_fake_gpu(), pytest.raises(HyrfError, match="cuda:5.*sees 2 GPUs; use a number from 0 to 1$"):
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
        choose_device("cuda:5")


@pytest.mark.parametrize("name", ["auto", "cuda", "cuda:0"])
def test_a_child_forked_from_a_process_that_uses_the_gpu_is_a_clear_error(name, monkeypatch):
    monkeypatch.setattr(torch.cuda, "_is_in_bad_fork", lambda: True)
    with use_fake_gpu(), pytest.raises(HyrfError, match="was forked.*'spawn'"):
        choose_device(name)
    assert choose_device("cpu").type == "cpu"


@needs_no_gpu
def test_a_forked_child_uses_the_cpu_where_there_is_no_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "_is_in_bad_fork", lambda: True)
    assert choose_device("auto").type == "cpu"


@needs_no_gpu
def test_a_device_may_be_given_as_a_torch_device():
    assert choose_device(torch.device("cpu", 0)) == torch.device("cpu")
    with pytest.raises(HyrfError, match="'cuda:0' is not available"):
        choose_device(torch.device("cuda", 0))


def test_kernels_reject_tensors_on_a_gpu_that_is_not_the_current_one(monkeypatch):
    with use_fake_gpu() as gpu:
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
        with pytest.raises(ValueError, match=r"set_device\(0\)"):
            hash_encode(torch.zeros(1, 3, device=gpu), torch.zeros(8, 2, device=gpu), (2,), 3)


def test_cuda_without_a_number_is_described_as_the_current_gpu(monkeypatch):
    with use_fake_gpu():
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
        assert describe_device(torch.device("cuda")) == "cuda:1 (a GPU that is not there)"
        assert describe_device(torch.device("cuda", 0)) == "cuda:0 (a GPU that is not there)"
    assert describe_device(torch.device("cpu")) == "cpu"


@pytest.mark.parametrize(
    ("has", "package", "error"),
    [(has_numba, "numba", ImportError), (has_numba, "numba", SystemError), (has_triton, "triton", ImportError)],
)
def test_kernels_are_available_only_where_their_compiler_can_be_imported(has, package, error, monkeypatch):
    """Numba may be installed and raise ImportError or SystemError, where numpy is newer than Numba supports."""

    class Refuses:
        def find_spec(self, name, path=None, target=None):
            if name == package:
                raise error(f"{package} needs an older numpy")

    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Refuses(), *sys.meta_path])
    assert not has.__wrapped__()


def test_a_slow_device_is_reported_when_it_is_named(monkeypatch, caplog):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(devices, "has_triton", lambda: False)
    assert choose_device("mps").type == "mps"
    with use_fake_gpu():
        assert choose_device("cuda").type == "cuda"
        assert choose_device(torch.device("cuda")).type == "cuda"
    monkeypatch.setattr(devices, "has_triton", lambda: True)
    with use_fake_gpu():
        choose_device("cuda")
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: (7, 5))
        choose_device("cuda")
    assert caplog.messages == [devices.NO_METAL_NOTE, devices.NO_TRITON_NOTE, devices.OLD_GPU_NOTE]


@pytest.mark.parametrize("solid", [None, np.array([0.25, 0.5, 1.0], np.float32)])
@pytest.mark.parametrize("has_alpha", [False, True])
def test_a_photo_is_the_same_on_any_device(has_alpha, solid):
    generator = np.random.default_rng(0)
    rgb, alpha = generator.integers(0, 256, (2, 5, 7, 4), dtype=np.uint8)[0][..., :3], None
    if has_alpha:
        alpha = generator.integers(0, 256, (5, 7), dtype=np.uint8)
    picture = Picture(np.ascontiguousarray(rgb), alpha, generator.random((5, 7)) > 0.5)

    here, mask_here = upload(picture, solid, torch.device("cpu"))
    with use_fake_gpu():
        there, mask_there = upload(picture, solid, CUDA_DEVICE)

    assert isinstance(there, FakeGpuTensor) and isinstance(mask_there, FakeGpuTensor)
    torch.testing.assert_close(there.cpu_tensor, here, rtol=0, atol=1e-7)
    assert torch.equal(mask_there.cpu_tensor, mask_here) and torch.equal(mask_here, torch.from_numpy(picture.mask))


def test_a_large_photo_is_uploaded_without_waiting_for_the_gpu():
    shape = (200, 200)
    picture = Picture(np.zeros((*shape, 3), np.uint8), np.full(shape, 255, np.uint8), np.ones(shape, bool))
    heard = []
    with use_fake_gpu() as gpu, listen_to_gpu(lambda kind, name: heard.append(kind)):
        upload(picture, np.zeros(3, np.float32), gpu)
    assert heard.count("copy") == 4 and "wait" not in heard


def test_photos_are_cached_on_a_gpu_up_to_a_limit(monkeypatch):
    rgb = np.random.default_rng(0).integers(0, 256, (2, 4, 5, 3), dtype=np.uint8)
    first, second = (Picture(one, None, None) for one in rgb)
    solid = np.zeros(3, np.float32)
    sent = []
    monkeypatch.setattr(
        devices, "_upload_bytes", lambda *args, send=devices._upload_bytes: sent.append(args[0]) or send(*args)
    )
    with use_fake_gpu() as gpu:
        photos = devices.Photos(gpu)
        assert photos.limit_bytes == 1 << 30
        photos.limit_bytes = first.nbytes + second.nbytes - 1
        drawn = [
            photos.get(name, picture, solid)[0].cpu_tensor
            for name, picture in [("first", first), ("second", second), ("first", first), ("second", second)]
        ]
    assert [picture is first for picture in sent] == [True, False, False]
    assert photos.nbytes == first.nbytes
    for found, picture in zip(drawn, (first, second, first, second), strict=True):
        torch.testing.assert_close(found, torch.from_numpy(picture.composite(solid)), rtol=0, atol=1e-7)


def test_photos_on_the_cpu_are_those_of_upload():
    picture = Picture(np.full((2, 3, 3), 51, np.uint8), None, np.ones((2, 3), bool))
    photos = devices.Photos(torch.device("cpu"))
    found, mask = photos.get("one", picture, None)
    torch.testing.assert_close(found, torch.full((2, 3, 3), 0.2))
    assert mask.all() and photos.nbytes == 0


# -- the fake GPU fails where a real one would --------------------------------------------------------------------


def test_mixing_devices_fails():
    with use_fake_gpu() as gpu:
        there = torch.ones(3, device=gpu)
        with pytest.raises(RuntimeError, match="same device"):
            there + torch.ones(3)
        with pytest.raises(RuntimeError, match="same device"):
            torch.stack([there, torch.ones(3)])
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        with pytest.raises(TypeError, match="numpy"):
            np.asarray(there)


def test_results_stay_on_the_device_of_their_inputs():
    with use_fake_gpu() as gpu:
        there = torch.arange(6.0, device=gpu).requires_grad_()
        made = [there * 2, there.new_zeros(2), there.new_tensor([1.0]), torch.zeros_like(there), there.sum()]
        (there.square().sum() * torch.tensor(2.0)).backward()
        assert all(tensor.device == gpu for tensor in [*made, there.grad])
        assert torch.equal(there.grad.cpu(), 4 * torch.arange(6.0)) and not isinstance(there.cpu(), FakeGpuTensor)
