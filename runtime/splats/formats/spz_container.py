"""The container of .spz files: one gzip stream up to version 3, a zstd stream for each attribute in version 4."""

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

from ...errors import InputError, raise_input_error
from ...system.files import check_expansion

HEADER = struct.Struct("<4sIIBBBB")  # magic, version, Gaussians, SH degree, fractional bits, flags, reserved
MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
HAS_EXTENSIONS = 2  # flag
MAX_FRACTIONAL_BITS = 24
EXPECTED = "a splat file (.spz)"
# The rest of version 4's header: where the table of contents begins.
CONTENTS_AT = struct.Struct("<16xI12x")
CONTENTS_ENTRY = struct.Struct("<QQ")  # compressed and uncompressed size of a stream
MAX_WINDOW = 1 << 27  # bytes, of a zstd stream
AGAIN = "copy or download it again"


class Header(NamedTuple):
    """The fields of the header that are used."""

    version: int
    gaussians: int
    sh_degree: int
    fractional_bits: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes per Gaussian of positions, opacities, colours, scales, rotations and SH coefficients."""
        return 9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * ((self.sh_degree + 1) ** 2 - 1)


def unpack(path: Path, content: bytes) -> tuple[Header, bytes]:
    """Header and uncompressed attributes, in the order of `Header.sizes`, of a file's content.

    Raises InputError, naming the path, if it is not .spz of version 2 to 4, or damaged. No more is
    uncompressed than the header announces.
    """
    if content.startswith(MAGIC):
        return _unpack_zstd(path, content)
    if content.startswith(GZIP):
        return _unpack_gzip(path, content)
    raise_input_error(path, "not a .spz file", f"expected {EXPECTED}")


def _unpack_gzip(path: Path, content: bytes) -> tuple[Header, bytes]:
    inflater = zlib.decompressobj(wbits=31)
    try:
        header = _read_header(path, inflater.decompress(content, HEADER.size), (2, 3))
        size = header.gaussians * sum(header.sizes)
        check_expansion(path, size, len(content))
        body = inflater.decompress(inflater.unconsumed_tail, size) if size else b""
        beyond = inflater.decompress(inflater.unconsumed_tail, 1)  # at the end, zlib compares the checksum
    except zlib.error:
        raise_input_error(path, "the gzip stream is damaged", AGAIN)
    if len(body) < size or not (inflater.eof or beyond):
        raise_input_error(path, f"cut short: {header.gaussians} Gaussians need {size} bytes", AGAIN)
    return header, body


def _unpack_zstd(path: Path, content: bytes) -> tuple[Header, bytes]:
    try:
        import zstandard
    except ImportError:
        remedy = 'pip install "idesplat[spz]", or convert it to version 3'
        raise InputError(f"{path}: .spz of version 4 is compressed with zstd; {remedy}") from None

    header = _read_header(path, content, (4,))
    check_expansion(path, header.gaussians * sum(header.sizes), len(content))
    sizes = [header.gaussians * size for size in header.sizes if header.gaussians * size]
    streams, (start,) = content[HEADER.size - 1], CONTENTS_AT.unpack_from(content.ljust(CONTENTS_AT.size, b"\0"))
    offset = start + streams * CONTENTS_ENTRY.size
    if start < CONTENTS_AT.size or offset > len(content) or streams != len(sizes):
        raise_input_error(
            path, f"{streams} streams with their contents at byte {start}", f"expected {len(sizes)}; {AGAIN}"
        )
    parts = []
    for index, size in enumerate(sizes):
        packed, unpacked = CONTENTS_ENTRY.unpack_from(content, start + index * CONTENTS_ENTRY.size)
        if unpacked != size:
            raise_input_error(path, f"stream {index} holds {unpacked} bytes of {size}", AGAIN)
        reader = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        try:
            parts.append(reader.stream_reader(content[offset : offset + packed]).read(size))
        except zstandard.ZstdError:
            raise_input_error(path, f"stream {index} is damaged", AGAIN)
        if len(parts[-1]) < size:
            raise_input_error(path, f"cut short: stream {index} needs {size} bytes", AGAIN)
        offset += packed
    return header, b"".join(parts)


def _read_header(path: Path, content: bytes, versions: tuple[int, ...]) -> Header:
    """The header, checked for what can be read."""
    if len(content) < HEADER.size:
        raise_input_error(path, "cut short in its header", AGAIN)
    magic, version, gaussians, sh_degree, fractional_bits, flags, _ = HEADER.unpack_from(content)
    if magic != MAGIC:
        raise_input_error(path, "not a .spz file (a gzip stream of something else)", f"expected {EXPECTED}")
    if version not in versions:
        raise_input_error(path, f".spz of version {version}", "expected version 2 to 4; write it as one of those")
    if sh_degree > 3:
        raise_input_error(path, f"SH degree {sh_degree}", "expected 0 to 3; write it with one of those")
    if fractional_bits > MAX_FRACTIONAL_BITS:
        raise_input_error(path, f"{fractional_bits} fractional bits", f"expected at most {MAX_FRACTIONAL_BITS}")
    if flags & HAS_EXTENSIONS:
        raise_input_error(path, "has extensions, which may change its axes", "write it without them")
    return Header(version, gaussians, sh_degree, fractional_bits)
