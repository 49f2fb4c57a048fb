"""How messages of exceptions are shown."""

from idesplat.runtime.errors import one_line


def test_a_message_is_one_line_and_an_exception_without_one_is_named() -> None:
    assert one_line(ValueError("cannot be read:\n\t no such file ")) == "cannot be read: no such file"
    assert one_line(MemoryError()) == "MemoryError"
