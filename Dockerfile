# One image for every node: the command chooses which (see compose.yaml).
FROM python:3.12-slim

RUN pip install --no-cache-dir uv==0.13.9

WORKDIR /app
ENV UV_PYTHON_DOWNLOADS=never UV_LINK_MODE=copy PATH=/app/.venv/bin:$PATH PYTHONUNBUFFERED=1

COPY pyproject.toml uv.lock README.md ./
RUN uv sync --frozen --no-dev --no-install-project

COPY astratag astratag
COPY schemas schemas
COPY pipeline pipeline
COPY nodes nodes
COPY recordings recordings
RUN uv sync --frozen --no-dev && .venv/bin/python -c "import astratag"

CMD ["relnav", "--help"]
