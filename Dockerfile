# WorldLine on a CPU: docker build -t worldline .
# With CUDA, by a digest that you have looked up (a base without one is refused): docker build --build-arg BASE=nvidia/cuda:13.0.0-runtime-ubuntu24.04@sha256:... -t worldline:cuda .
# The digest of a base: docker buildx imagetools inspect nvidia/cuda:13.0.0-runtime-ubuntu24.04
ARG BASE=python:3.12.11-slim-bookworm@sha256:519591d6871b7bc437060736b9f7456b8731f1499a57e22e6c285135ae657bf7
FROM ${BASE}
ARG BASE
RUN case "$BASE" in *@sha256:????????*) ;; *) echo "BASE=$BASE has no digest: docker buildx imagetools inspect says it" >&2; exit 1 ;; esac
RUN apt-get update && apt-get install -y --no-install-recommends \
      git make ffmpeg libegl1 libegl-mesa0 libgl1-mesa-dri python3 python3-venv \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home worldline
WORKDIR /worldline
COPY pyproject.toml uv.lock Makefile README.md LICENSE ./
COPY packaging packaging
# What changes seldom first: the environment, then the code, then the shipped files.
RUN python3 -m venv .bootstrap && .bootstrap/bin/pip install --no-cache-dir --require-hashes -r packaging/uv.txt \
    && .bootstrap/bin/uv sync --frozen --no-install-project --extra sim --no-dev
COPY configs configs
COPY worldline_core worldline_core
COPY worldline worldline
COPY tasks tasks
COPY flows flows
COPY artifacts artifacts
# Code and environment stay root's; the store and the folder that commands work in are the user's.
RUN .bootstrap/bin/uv sync --frozen --extra sim --no-dev && chown worldline:worldline . artifacts
USER worldline
ENV PATH="/worldline/.venv/bin:$PATH"
ENTRYPOINT ["worldline"]
CMD ["doctor"]
