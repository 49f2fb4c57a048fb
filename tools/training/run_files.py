"""Names of the files that a training run writes into its folder."""

CHECKPOINT, LOG, CURVES, PREDICTIONS = "last.ckpt", "log.jsonl", "curves.png", "predictions.png"
# The subfolder of cached features.
FEATURES = "features"
