"""What a service takes from its clients, and the exceptions for what it does not take."""

from dataclasses import dataclass

MIB = 1 << 20
GIB = 1 << 30
TOKEN_VARIABLE = "IDESPLAT_TOKEN"  # environment variable of the token, which workers do not get


@dataclass(frozen=True)
class Limits:
    """Limits of a service.

    upload_bytes: of a request, and of what its zip holds, unpacked. images: in an upload. megapixels: of an image.
    views: that a job uses. size: the largest height times width that a request may ask to work at.
    queue: jobs that are uploaded or wait. seconds: that a job may run. upload_seconds: that an upload may take.
    keep_seconds: that a finished job stays. storage_bytes: of all jobs' files. stop_seconds: that running jobs get when
    the service is stopped. memory_bytes: of a worker process; None for no limit.
    """

    upload_bytes: int = 512 * MIB
    images: int = 200
    megapixels: int = 64
    views: int = 24
    size: tuple[int, int] = (1024, 1024)
    queue: int = 16
    seconds: float = 600.0
    upload_seconds: float = 300.0
    keep_seconds: float = 3600.0
    storage_bytes: int = 10 * GIB
    stop_seconds: float = 30.0
    memory_bytes: int | None = None


class Refused(Exception):
    """A request that is not served. status: of the HTTP answer. message: one line, what and what to do instead.

    retry_after: seconds after which the same request may be served.
    """

    def __init__(self, status: int, message: str, retry_after: int | None = None) -> None:
        super().__init__(message)
        self.status, self.message, self.retry_after = status, message, retry_after
