"""Conversion to lower precisions: int8 and fp16."""
