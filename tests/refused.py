"""One assertion for refusals: error type, words, one line, and a remedy if asked for."""

import re
from collections.abc import Callable

import pytest

from splatctrl_cli.errors import InputError, SplatCtrlError


def expect_refusal(
    words: str,
    call: Callable[..., object],
    *given: object,
    error: type[SplatCtrlError] | tuple[type[SplatCtrlError], ...] = InputError,
    has_remedy: bool = False,
    **named: object,
) -> str:
    """Call, expect an error in one line that contains or matches `words`, and return its text."""
    with pytest.raises(error) as caught:
        call(*given, **named)
    said = str(caught.value)
    assert words in said or re.search(words, said), said
    assert "\n" not in said and bool(caught.value.remedy) >= has_remedy, said
    return said
