"""Released checkpoints, downloaded from their authors and exported into the cache."""
