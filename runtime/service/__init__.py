"""The HTTP service: uploads become jobs, which worker processes reconstruct with an opened model."""
