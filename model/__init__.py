"""The networks, written so that they can leave PyTorch: no custom operators, no linear algebra, integer gathers."""
