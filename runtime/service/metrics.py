"""What a service counts, as Prometheus reads it."""

from collections.abc import Iterable

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric

from .jobs import Job, Jobs
from .pool import Pool

SECONDS = (1, 2, 5, 10, 20, 40, 60, 120, 300, 600)


class _Current:
    """Values of this moment, read when they are asked for."""

    def __init__(self, jobs: Jobs, pool: Pool) -> None:
        self._jobs, self._pool = jobs, pool

    def collect(self) -> Iterable[Metric]:
        values = {
            "queued": ("Scenes that wait.", self._jobs.waiting),
            "running": ("Scenes that are reconstructed.", len(self._jobs.running)),
            "uploading": ("Scenes that are received.", self._jobs.uploading),
            "workers_ready": ("Worker processes with the model open.", self._pool.ready),
            "worker_restarts": ("Worker processes that were started again.", self._pool.restarts),
            "stored_bytes": ("Bytes of uploads and results.", self._jobs.stored),
        }
        for name, (text, value) in values.items():
            yield GaugeMetricFamily(f"idesplat_{name}", text, value)


class Metrics:
    """The metrics of one service."""

    def __init__(self, jobs: Jobs, pool: Pool) -> None:
        self.registry = CollectorRegistry()
        self._scenes = Counter("idesplat_scenes", "Scenes that have ended.", ["state"], registry=self.registry)
        self._seconds = Histogram(
            "idesplat_scene_seconds", "Seconds that scenes took.", buckets=SECONDS, registry=self.registry
        )
        self._answers = Counter("idesplat_answers", "Answers to requests.", ["status"], registry=self.registry)
        self.registry.register(_Current(jobs, pool))
        ProcessCollector(registry=self.registry)
        jobs.on_finish = self.count_job

    def count_job(self, job: Job) -> None:
        """Count a job that has ended."""
        self._scenes.labels(job.state).inc()
        if job.started is not None and job.finished is not None:
            self._seconds.observe(job.finished - job.started)

    def count_answer(self, status: int) -> None:
        """Count an answer."""
        self._answers.labels(str(status)).inc()

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        return generate_latest(self.registry)
