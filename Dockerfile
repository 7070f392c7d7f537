# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
# The package in a workspace on ROS 2 Jazzy: the steps of README.md for Ubuntu 24.04.
#   docker build -t t3mpc_ros .
#   docker run --rm --net=host t3mpc_ros ros2 launch t3mpc_ros sim.launch.py
FROM ros:jazzy-ros-base

SHELL ["/bin/bash", "-c"]
WORKDIR /workspace
COPY . src/t3mpc_ros
# A ROS distribution has one version of each package at a time.
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src -y \
    && rm -rf /var/lib/apt/lists/*
# numba of Ubuntu 24.04 predates its Python; cma and daqp have no key of rosdep.
RUN python3 -m venv --system-site-packages venv && touch venv/COLCON_IGNORE \
    && . venv/bin/activate \
    && pip install --no-cache-dir "numba>=0.68,<1" "cma>=4.0,<5" "daqp>=0.11,<1" \
    && . /opt/ros/jazzy/setup.bash \
    && python3 -m colcon build \
    && . install/setup.bash \
    && ros2 run t3mpc_ros t3mpc compile
RUN printf '#!/bin/bash\n. /workspace/venv/bin/activate\n. /workspace/install/setup.bash\nexec "$@"\n' \
    > /start && chmod +x /start
ENTRYPOINT ["/start"]
CMD ["ros2", "launch", "t3mpc_ros", "sim.launch.py"]
