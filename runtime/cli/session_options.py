"""The options of a session that several commands have, as a `SessionConfig`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..inference.session import SessionConfig


def session_config(threads: int | None, device: str | None, provider_options: Sequence[str] | None) -> "SessionConfig":
    """What --threads, --device and --provider-option ask for; raises InputError."""
    from ..inference.providers import parse_provider_options
    from ..inference.session import SessionConfig

    return SessionConfig(threads, device=device, provider_options=parse_provider_options(provider_options or []))
