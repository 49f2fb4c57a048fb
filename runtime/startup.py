"""What has to be settled before any library is imported: `runtime`, `export` and `tools` import this module first."""

import os
import sys
from contextlib import suppress

from .system.cache_folder import cache_folder

# ONNX Runtime would write a device id and a queue of events into the user's cache, and connect to its vendor. It reads
# this when it is first imported; its function `disable_telemetry_events` comes too late.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

# numba would keep what it compiles beside our modules, or in a folder of its own in the user's cache, and PyTorch makes
# a folder in the system's temporary folder, even if it compiles nothing.
with suppress(RuntimeError):
    os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder("numba")))
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache_folder("torch")))

# `python -m` lets modules be imported from the current folder, which may hold anybody's files. Python itself has looked
# there by now: only `python -P -m` keeps it from that.
if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:
    del sys.path[0]
