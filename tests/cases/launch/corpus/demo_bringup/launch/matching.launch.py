from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def start(context):
    robot = LaunchConfiguration("robot").perform(context)
    match robot.split("-"):
        case ["arm", joints]:
            package, values = "arm_demo", {"joints": int(joints)}
        case [("base" | "rover") as kind]:
            package, values = "base_demo", {"kind": kind}
        case _:
            raise ValueError(f"no robot {robot}")
    if (simulated := LaunchConfiguration("sim").perform(context).lower()) == "true":
        values["use_sim_time"] = True
    try:
        speed = {"slow": 1, "fast": 5}[LaunchConfiguration("speed").perform(context)]
    except KeyError:
        speed = -1
    finally:
        values["simulated"] = simulated
    return [Node(package=package, executable="controller", parameters=[values | {"speed": speed}])]


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("robot", default_value="arm-7"),
        DeclareLaunchArgument("sim", default_value="True"),
        DeclareLaunchArgument("speed", default_value="other"),
        OpaqueFunction(function=start),
    ])
