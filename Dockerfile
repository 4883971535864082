# The node on ROS 2 Jazzy, for amd64 and arm64. Not tried yet.
#   docker build -t rangeseg . && docker run --net=host --ipc=host rangeseg
FROM ros:jazzy-ros-base
RUN apt-get update && apt-get install --yes --no-install-recommends python3-venv \
    ros-jazzy-visualization-msgs ros-jazzy-diagnostic-msgs ros-jazzy-shape-msgs ros-jazzy-nav-msgs \
    && rm -rf /var/lib/apt/lists/*
COPY . /rangeseg_ros
RUN python3 -m venv --system-site-packages /venv \
    && /venv/bin/pip install --no-cache-dir /rangeseg_ros 'numpy<2'
# Of any processor of the platform, not only of the one that builds.
ENV NUMBA_CPU_NAME=generic
ENV FASTRTPS_DEFAULT_PROFILES_FILE=/venv/share/rangeseg_ros/params/fastdds_large_images.xml
RUN . /opt/ros/jazzy/setup.sh && /venv/bin/rangeseg compile
CMD ["bash", "-c", ". /opt/ros/jazzy/setup.bash && exec /venv/bin/segment_planes"]
