# The runtime on a CPU: images and cameras to splats, without PyTorch. Without arguments it runs the quickstart on the
# scene in /data (images and cameras found there), and writes /data/scene.ply:
#   docker build --tag idesplat .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD/photos:/data" idesplat
FROM python:3.13-slim-trixie

COPY . /src
RUN pip install --no-cache-dir "/src[colmap]" && rm -rf /src/build

# For any user: the cache is all that is written outside of /data.
ENV XDG_CACHE_HOME=/tmp/cache
USER nobody
WORKDIR /data
ENTRYPOINT ["idesplat"]
CMD ["infer", "/data", "--out", "/data/scene.ply"]
