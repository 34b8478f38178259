"""What is said of a driver or a card that cannot be used; the driver is a fake of the functions that are asked."""

import ctypes
from typing import Any

import pytest

from splatctrl_cli.kernels.cuda import memory as driver
from splatctrl_cli.kernels.cuda.memory import DeviceError, usable_card
from tests.refused import expect_refusal


class FakeDriver:
    """libcuda.so.1: a version such as 13000, the status of cuInit, and the capability of each card."""

    def __init__(self, version: int = 13000, init: int = 0, cards: tuple[tuple[int, int], ...] = ((9, 0),)) -> None:
        self.version, self.init, self.cards = version, init, cards

    def cuDriverGetVersion(self, out: Any) -> int:
        out._obj.value = self.version
        return 0

    def cuInit(self, flags: int) -> int:
        return self.init

    def cuDeviceGetCount(self, out: Any) -> int:
        out._obj.value = len(self.cards)
        return 0

    def cuDeviceGet(self, out: Any, index: int) -> int:
        out._obj.value = index
        return 0

    def cuDeviceGetName(self, out: Any, size: int, handle: Any) -> int:
        out.value = f"Card {handle.value}".encode()
        return 0

    def cuDeviceGetAttribute(self, out: Any, attribute: int, handle: Any) -> int:
        out._obj.value = self.cards[handle.value][{75: 0, 76: 1}[attribute]]
        return 0

    def cuGetErrorName(self, status: int, out: Any) -> int:
        out._obj.value = {100: b"CUDA_ERROR_NO_DEVICE", 803: b"CUDA_ERROR_SYSTEM_DRIVER_MISMATCH"}[status]
        return 0

    def install(self, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(ctypes, "CDLL", lambda name: self if name == driver.LIBRARY else None)


REFUSED = {
    "too old": (FakeDriver(12040), 0, "the driver is too old: for CUDA 12.4, expected 13.0"),
    "no card": (FakeDriver(init=100), 0, r"the driver finds no card \(CUDA_ERROR_NO_DEVICE\)"),
    "none counted": (FakeDriver(cards=()), 0, r"the driver finds no card \(it counts none\)"),
    "half updated": (FakeDriver(init=803), 0, "CUDA_ERROR_SYSTEM_DRIVER_MISMATCH"),
    "none of that number": (FakeDriver(), 1, "no such card: expected cuda:0"),
    "none of several": (FakeDriver(cards=((9, 0), (7, 5))), 2, "no such card: expected cuda:0 to cuda:1"),
    "an old card": (
        FakeDriver(cards=((9, 0), (7, 0))),
        1,
        "Card 1 has compute capability 7.0, expected 7.5 or later",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_by_name_with_a_remedy(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fake, index, message = REFUSED[case]
    fake.install(monkeypatch)
    with pytest.raises(DeviceError, match=message) as caught:
        usable_card(index)
    assert caught.value.remedy


def test_a_card_is_named_with_its_capability_and_driver(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    FakeDriver(13020, cards=((9, 0), (12, 0))).install(monkeypatch)
    monkeypatch.setattr(driver, "VERSION_FILE", tmp_path / "version")
    assert usable_card(1).driver == "for CUDA 13.2"
    said = "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.159.04  Release Build\nGCC version: 12.2.0\n"
    (tmp_path / "version").write_text(said)
    card = usable_card(1)
    assert (card.index, card.name, card.capability, card.driver) == (1, "Card 1", (12, 0), "580.159.04")


def test_without_a_driver_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "LIBRARY", "libcuda_of_no_machine.so.1")
    expect_refusal(r"no NVIDIA driver \(libcuda_of_no_machine", usable_card, error=DeviceError)
