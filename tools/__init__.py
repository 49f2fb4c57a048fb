"""What trains, evaluates and measures."""

from ..runtime import startup as startup
