"""Files, limits, the cache folder and progress."""
