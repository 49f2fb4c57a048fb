"""Lower precisions: int8 and fp16."""
