"""Environment variables that are of a whole ROS 2 graph: a process with a value of its own would be in another one."""

# Where a graph is, and whom its nodes ask for others. docs.ros.org, "The ROS_DOMAIN_ID", "Improved Dynamic Discovery";
# fast-dds.docs.eprosima.com, "Discovery Server settings".
PLACE = (
    "ROS_DOMAIN_ID", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER",
    "ROS_SUPER_CLIENT", "ROS2_EASY_MODE",
)  # fmt: skip
RMW = "RMW_IMPLEMENTATION"
MIDDLEWARE = ("FASTRTPS_", "FASTDDS_", "ZENOH_")  # what the settings of a middleware begin with


def is_of_graph(name: str) -> bool:
    """Return whether a variable is of a whole graph: its place, its middleware, or that one's settings."""
    return name in (*PLACE, RMW, "CYCLONEDDS_URI") or name.startswith(MIDDLEWARE)
