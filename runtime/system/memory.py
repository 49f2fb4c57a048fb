"""The peak of this process's memory."""

import sys
from contextlib import suppress
from pathlib import Path

CLEAR_REFS, RESET_PEAK = Path("/proc/self/clear_refs"), "5"


def reset_peak() -> None:
    """Measure the peak from now on, where the system can (Linux); elsewhere it is that of the whole process."""
    with suppress(OSError):
        CLEAR_REFS.write_text(RESET_PEAK)


def peak_bytes() -> int | None:
    """Peak resident memory of this process in bytes, since `reset_peak`; None where the system does not tell."""
    try:  # getrusage would include the parent's, of which this process was a fork
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024
    except (OSError, IndexError):
        pass
    if sys.platform == "darwin":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return None
