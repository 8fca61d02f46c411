# WorldLine on a CPU: docker build -t worldline .
# With CUDA: docker build --build-arg BASE=nvidia/cuda:13.0.0-runtime-ubuntu24.04 -t worldline:cuda .
ARG BASE=python:3.12-slim-bookworm
FROM ${BASE}
RUN apt-get update && apt-get install -y --no-install-recommends \
      git make ffmpeg libegl1 libegl-mesa0 libgl1-mesa-dri python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /worldline
COPY pyproject.toml uv.lock Makefile README.md LICENSE ./
COPY packaging packaging
# What changes seldom first: the environment, then the code, then the shipped files.
RUN python3 -m venv .bootstrap && .bootstrap/bin/pip install --no-cache-dir uv \
    && .bootstrap/bin/uv sync --frozen --no-install-project --extra sim --no-dev
COPY configs configs
COPY worldline_core worldline_core
COPY tasks tasks
COPY flows flows
COPY artifacts artifacts
RUN .bootstrap/bin/uv sync --frozen --extra sim --no-dev
ENV PATH="/worldline/.venv/bin:$PATH"
ENTRYPOINT ["worldline"]
CMD ["doctor"]
