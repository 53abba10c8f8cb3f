"""fogspec: from a short YAML spec to a pinned, reviewable deployment of a robot's ROS 2 nodes."""

__version__ = "0.1.0rc1"
