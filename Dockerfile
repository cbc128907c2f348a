# One image for all services: they share all but two packages, and one build is one thing to trust.
FROM python:3.11-slim

# Where else pip may look, such as PyTorch's index of small CPU builds; empty: the default index alone.
ARG WHEEL_INDEX=""

ENV PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /app

# Packages first: a change of code does not fetch them again.
COPY pyproject.toml constraints.txt README.md ./
RUN mkdir common services presage worlds models \
 && touch common/__init__.py services/__init__.py presage/__init__.py worlds/.keep models/.keep \
 && pip install ${WHEEL_INDEX:+--extra-index-url "$WHEEL_INDEX"} -c constraints.txt '.[all]' \
 && pip uninstall --yes presage

COPY common common
COPY services services
COPY presage presage
COPY worlds worlds
COPY models models
ENV NUMBA_CACHE_DIR=/var/cache/numba
# The compiled loops are kept in the image; on another processor they are compiled again.
RUN pip install --no-deps . && rm -rf /app/* \
 && useradd --create-home presage && mkdir /recordings && chown presage /recordings \
 && mkdir -m 1777 $NUMBA_CACHE_DIR && cd / \
 && python -c 'from services.estimator.building import *; [prepare(Choice(model=m)) for m in ("learned", "exact")]' \
 && chmod -R a+rwX $NUMBA_CACHE_DIR

USER presage
WORKDIR /home/presage
ENV MPLCONFIGDIR=/tmp
CMD ["presage", "--help"]
