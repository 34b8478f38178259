"""Refusals: what is wrong is said in one line, in most cases with a remedy."""

import re
from collections.abc import Callable

import pytest

from splatctrl_cli.errors import InputError, SplatCtrlError


def refused(
    words: str,
    call: Callable[..., object],
    *given: object,
    error: type[SplatCtrlError] = InputError,
    has_remedy: bool = False,
    **named: object,
) -> str:
    """The call is refused with these words, or ones of their pattern, in one line; returns all that it says."""
    with pytest.raises(error) as caught:
        call(*given, **named)
    said = str(caught.value)
    assert words in said or re.search(words, said), said
    assert "\n" not in said and bool(caught.value.remedy) >= has_remedy, said
    return said
