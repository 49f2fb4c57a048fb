# The runtime on a CPU, without PyTorch, in two images for any user: all that is written outside of /data is in /tmp.
#
# Commands. Without arguments it runs the quickstart on the scene in /data (images and cameras found there), and writes
# /data/scene.ply:
#   docker build --tag idesplat .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD/photos:/data" idesplat
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/data" idesplat batch /data/scenes --out /data/results
#
# The service, with a page at http://127.0.0.1:8000:
#   docker build --target service --tag idesplat-service .
#   docker run --rm --env IDESPLAT_TOKEN --publish 127.0.0.1:8000:8000 idesplat-service
FROM python:3.13-slim-trixie AS base
ENV XDG_CACHE_HOME=/tmp/cache
COPY . /src

FROM base AS service
RUN pip install --no-cache-dir "/src[colmap,serve,spz]" && rm -rf /src/build
USER 65534:65534
WORKDIR /tmp
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/health', timeout=4)"]
ENTRYPOINT ["idesplat", "serve", "--host", "0.0.0.0", "--port", "8000"]
CMD ["--workers", "1"]

FROM base AS command
RUN pip install --no-cache-dir "/src[colmap,ray,remote,spz]" && rm -rf /src/build
USER 65534:65534
WORKDIR /data
HEALTHCHECK NONE
ENTRYPOINT ["idesplat"]
CMD ["infer", "/data", "--out", "/data/scene.ply"]
