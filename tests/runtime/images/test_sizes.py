"""The option --size, and numbers that users write."""

import pytest
from idesplat.runtime.errors import InputError
from idesplat.runtime.images.sizes import parse_size
from idesplat.runtime.system.limits import parse_whole_number


def test_sizes():
    assert parse_size("256x448") == (256, 448)
    assert parse_size("8192X1") == (8192, 1)


@pytest.mark.parametrize(
    "text", ["", "256", "²x256", "256x²", "٣x٣", "0x256", "-1x5", "1x2x3", "9" * 5000 + "x1", "1.5x2"]
)
def test_what_is_no_size(text):
    with pytest.raises(InputError, match="expected HEIGHTxWIDTH") as caught:
        parse_size(text)
    assert len(str(caught.value)) < 200


def test_sizes_have_a_limit_that_can_be_raised(monkeypatch):
    with pytest.raises(InputError, match=r"sides of 8192 pixels at most; .*IDESPLAT_MAX_SIDE to more than 8192"):
        parse_size("256x8193")
    monkeypatch.setenv("IDESPLAT_MAX_SIDE", "10000")
    assert parse_size("256x8193") == (256, 8193)


def test_whole_numbers_are_ascii():
    assert parse_whole_number("007") == 7
    for text in ("", "²", "٣", "1 ", "+1", "-1", "1e3", "9" * 19):
        assert parse_whole_number(text) is None
