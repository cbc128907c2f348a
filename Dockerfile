# One image for each service, with only its own packages. `docker compose build` builds the images that compose uses;
# `make images` builds all of them and prints their sizes.
FROM python:3.11-slim AS binutils
RUN apt-get update && apt-get install -y --no-install-recommends binutils
# Of binutils, the images get only this program and the libraries that came with it.
RUN mkdir /strip && cp /usr/bin/strip $(ldd /usr/bin/strip | grep -o '/[^ ]*lib\(bfd\|sframe\)[^ ]*') /strip

FROM python:3.11-slim AS base
# URL of an additional package index, such as PyTorch's index of CPU builds, which are much smaller.
ARG WHEEL_INDEX=""
ENV PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /install
COPY --from=binutils /strip strip
COPY docker/install.py pyproject.toml constraints.txt ./
# Packages are installed before the code is copied, so that a change of code does not install them again.
RUN python install.py router
# Only /tmp has to be writable: the root file system may be read-only.
RUN useradd --uid 1000 --no-create-home presage && mkdir -m 1777 /recordings && chown presage /recordings
ENV PYTHONPATH=/app PATH=/app/bin:$PATH HOME=/tmp MPLCONFIGDIR=/tmp PRESAGE_HEARTBEAT=/tmp

# The program with its compiled modules, because a read-only file system cannot store them later.
FROM base AS program
COPY pyproject.toml README.md ./
COPY common common
COPY services services
COPY presage presage
COPY lab lab
COPY worlds worlds
COPY models models
RUN pip install --no-cache-dir --no-deps --target /app .

FROM base AS router
COPY --from=program /app /app
WORKDIR /tmp
USER presage
HEALTHCHECK --interval=10s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "router"]
CMD ["python", "-m", "common.router", "--listen", "tcp/0.0.0.0:7447"]

# Instead of the simulator, for a robot that is elsewhere: waits for its scans.
FROM router AS none
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "remote"]
CMD ["python", "-m", "common.containers.run_per_robot", "each", "common.containers.remote_robot"]

# Instead of the simulator, for a robot in ROS 2.
FROM base AS bridge_ros2
RUN python install.py bridge_ros2
COPY --from=program /app /app
WORKDIR /tmp
USER presage
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "bridge_ros2"]
CMD ["python", "-m", "common.containers.run_per_robot", "each", "services.bridge_ros2"]

FROM base AS recorder-packages
RUN python install.py recorder

FROM recorder-packages AS recorder
COPY --from=program /app /app
WORKDIR /tmp
USER presage
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "recorder"]
CMD ["python", "-m", "common.containers.run_per_robot", "each", "services.recorder", "--directory", "/recordings"]

# Instead of the simulator: plays a recording.
FROM recorder AS replay
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "replay"]
CMD ["python", "-m", "common.containers.run_per_robot", "each", "services.recorder.replaying.service", "--directory", "/recordings"]

FROM recorder-packages AS terminal-packages
RUN python install.py terminal

# The viewer plays recordings with the command line.
FROM terminal-packages AS viewer
RUN python install.py viewer
COPY --from=program /app /app
WORKDIR /tmp
USER presage
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "viewer"]
CMD ["python", "-m", "common.containers.run_per_robot", "together", "services.viewer", "--host", "0.0.0.0", "--port", "8080", \
     "--allow-control", "--recordings", "/recordings"]

FROM terminal-packages AS cli
RUN python install.py cli
COPY --from=program /app /app
WORKDIR /tmp
USER presage
CMD ["presage", "--help"]

FROM base AS controller
RUN python install.py controller
COPY --from=program /app /app
# Numba's compiled code is stored in the image; on another type of processor it is compiled again. Numba needs a
# writable cache, so each container starts with a copy.
RUN NUMBA_CACHE_DIR=/numba python -c 'from services.controller.policies import grid_paths; grid_paths.prepare()'
ENV NUMBA_CACHE_DIR=/tmp/numba
WORKDIR /tmp
USER presage
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "controller"]
CMD ["sh", "-c", "cp -r /numba /tmp && exec python -m common.containers.run_per_robot each services.controller"]

FROM base AS simulator
RUN python install.py simulator
COPY --from=program /app /app
WORKDIR /tmp
USER presage
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "simulator"]
CMD ["python", "-m", "common.containers.run_per_robot", "each", "services.simulator"]

FROM base AS estimator
RUN python install.py estimator
COPY --from=program /app /app
# As for the controller.
RUN NUMBA_CACHE_DIR=/numba python -c \
    'from services.estimator.factory import *; [prepare_factory(EstimatorOptions(model=m)) for m in ("learned", "exact")]'
ENV NUMBA_CACHE_DIR=/tmp/numba
# Only preset paper needs PyTorch.
ARG ESTIMATOR=precise
ARG WHEEL_INDEX=""
RUN if [ "$ESTIMATOR" = paper ]; then python /install/install.py paper; fi
WORKDIR /tmp
USER presage
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "estimator"]
CMD ["sh", "-c", "cp -r /numba /tmp && exec python -m common.containers.run_per_robot together services.estimator"]

# Instead of the estimator: maps an unknown building.
FROM estimator AS mapper
HEALTHCHECK --interval=5s --timeout=10s --start-period=60s CMD ["python", "-m", "common.containers.healthcheck", "mapper"]
CMD ["sh", "-c", "cp -r /numba /tmp && exec python -m common.containers.run_per_robot each services.mapper --maps /recordings"]
