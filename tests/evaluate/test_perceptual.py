"""LPIPS against torch's own convolutions with random weights, and files that are no weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import conv2d, max_pool2d

from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.perceptual import Lpips
from splatctrl_cli.records import Float32, Float64

ALEX = {1: [(0, 3, 8, 11, 4, 2, 0)], 2: [(3, 8, 12, 5, 1, 2, 3)], 3: [(6, 12, 16, 3, 1, 1, 3)],
        4: [(8, 16, 10, 3, 1, 1, 0)], 5: [(10, 10, 10, 3, 1, 1, 0)]}  # fmt: skip
VGG = {1: [(0, 3, 4, 3, 1, 1, 0), (2, 4, 4, 3, 1, 1, 0)], 2: [(5, 4, 6, 3, 1, 1, 2), (7, 6, 6, 3, 1, 1, 0)],
       3: [(10, 6, 8, 3, 1, 1, 2), (12, 8, 8, 3, 1, 1, 0), (14, 8, 8, 3, 1, 1, 0)],
       4: [(17, 8, 8, 3, 1, 1, 2), (19, 8, 8, 3, 1, 1, 0), (21, 8, 8, 3, 1, 1, 0)],
       5: [(24, 8, 8, 3, 1, 1, 2), (26, 8, 8, 3, 1, 1, 0), (28, 8, 8, 3, 1, 1, 0)]}  # fmt: skip
Network = dict[int, list[tuple[int, int, int, int, int, int, int]]]


def weights(network: Network) -> dict[str, Float32]:
    rng = np.random.default_rng(0)
    arrays = {}
    for part, layers in network.items():
        for number, before, after, size, *_ in layers:
            arrays[f"net.slice{part}.{number}.weight"] = rng.normal(0, 0.2, (after, before, size, size))
            arrays[f"net.slice{part}.{number}.bias"] = rng.normal(0, 0.2, after)
        arrays[f"lin{part - 1}.model.1.weight"] = rng.random((1, layers[-1][2], 1, 1))
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def by_torch(network: Network, arrays: dict[str, Float32], a: Float64, b: Float64) -> float:
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    pair = [((2 * torch.from_numpy(x).float() - 1 - shift) / scale).permute(2, 0, 1)[None] for x in (a, b)]
    total = 0.0
    for part, layers in network.items():
        for number, _, _, _, stride, padding, pool in layers:
            weight, bias = (
                torch.from_numpy(arrays[f"net.slice{part}.{number}.{kind}"]) for kind in ("weight", "bias")
            )
            pair = [max_pool2d(x, pool, 2) if pool else x for x in pair]
            pair = [torch.relu(conv2d(x, weight, bias, stride, padding)) for x in pair]
        unit = [x / (torch.sqrt(torch.sum(x**2, dim=1, keepdim=True)) + 1e-10) for x in pair]
        linear = torch.from_numpy(arrays[f"lin{part - 1}.model.1.weight"])
        total += float(conv2d((unit[0] - unit[1]) ** 2, linear).mean())
    return total


def pictures() -> tuple[Float64, Float64]:
    rng = np.random.default_rng(1)
    return rng.random((70, 93, 3)), rng.random((70, 93, 3))


@pytest.mark.parametrize(("name", "network"), [("alex", ALEX), ("vgg", VGG)])
def test_it_is_what_torch_makes_of_the_same_weights(tmp_path: Path, name: str, network: Network) -> None:
    arrays = weights(network)
    np.savez(tmp_path / "weights.npz", **arrays)  # type: ignore[arg-type]
    lpips = Lpips(tmp_path / "weights.npz")
    assert lpips.name == name
    a, b = pictures()
    assert lpips(a, b) == pytest.approx(by_torch(network, arrays, a, b), rel=1e-4)
    assert lpips(a, a) == 0.0


@pytest.mark.filterwarnings("ignore")  # torchvision calls its own arguments deprecated
@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_it_is_what_the_authors_package_makes_of_its_own_linear_layers(tmp_path: Path, name: str) -> None:
    """Random convolutions: those that were trained have to be downloaded, the linear layers come with the package."""
    lpips = pytest.importorskip("lpips", reason="the authors' package lpips is not installed")
    torch.manual_seed(7)
    model = lpips.LPIPS(net=name, pnet_rand=True, verbose=False).eval()
    np.savez(tmp_path / "weights.npz", **{key: value.numpy() for key, value in model.state_dict().items()})
    a, b = pictures()
    pair = [(2 * torch.from_numpy(x).float() - 1).permute(2, 0, 1)[None] for x in (a, b)]
    with torch.no_grad():
        expected = model(*pair).item()
    assert Lpips(tmp_path / "weights.npz")(a, b) == pytest.approx(expected, rel=1e-5)


def test_what_is_no_file_of_weights_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.npz: cannot be read: No such file"):
        Lpips(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(InputError, match=r"text.npz: expected LPIPS weights as .npz, got: .*docs/score.md says how"):
        Lpips(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with pytest.raises(
        InputError, match=r"expected LPIPS weights of alex or vgg, got none called net.slice1.0.weight"
    ):
        Lpips(tmp_path / "other.npz")
