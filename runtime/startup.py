"""Settings made before any library is imported: `runtime`, `export` and `tools` import this module first."""

import os
import sys
from contextlib import suppress

from .system.cache_folder import cache_folder

# Without this ONNX Runtime writes a device id and queued events to the user's cache, and connects to its vendor. The
# variable is read on import; calling `disable_telemetry_events` afterwards would be too late.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

# By default numba caches compiled code beside our modules or in another folder of the user's cache, and PyTorch creates
# a folder in the system's temporary folder, even if it compiles nothing.
with suppress(RuntimeError):
    os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder("numba")))
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache_folder("torch")))

# `python -m` imports modules from the current folder, which may hold untrusted files. By now Python itself has already
# searched it: only `python -P -m` prevents that.
if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:
    del sys.path[0]
