"""The command `idesplat`, as a module."""

from .runtime.cli.launch import idesplat

if __name__ == "__main__":
    idesplat()
